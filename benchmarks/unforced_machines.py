"""Servos of `benchmarks.unforced` on the exact stepper: machine, loop, command and case of each run.

Inertia, friction, gains, delay, rates and command are drawn. The encoder has 4096 counts a turn, as that of a
hobby servo, or 16 000. The log holds the command and the position, and no force.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.optimize

from truth.axis.machines import moves, multisine
from truth.axis.stepper import Loop, Machine, Sensor, reached, simulate
from truth.chain.stepper import ChainMachine, simulate_chain

COUNT, NOISE = 2 * np.pi / 4096, 2e-4  # rad
FINE, FINE_NOISE = 2 * np.pi / 16_000, 5e-5  # rad
# Longest delay [s], also of the servos with the finer encoder.
LONGEST, LONGEST_FINE = 0.06, 0.1
SECONDS = 6.0
# Ticks of the loop [Hz], and ticks a row of the log.
RATES = ((1000.0, 1), (1000.0, 10), (500.0, 5), (200.0, 4))
# Evidence from which an effect counts as visible [nats], as in the bench of searches with a force.
VISIBLE = 30.0
# Longest integration step of the oracle's runs [s].
COARSE = 4e-5
# Effects for which a search must be asked.
ASKED = ("backlash", "voltage_limit")
# Declared unknowns of the machine, by the key of the exact stepper's effects.
DECLARED = {"viscous_friction": "coefficient", "coulomb_friction": "level"}


@dataclass(frozen=True)
class Servo:
    """A servo with its command.

    Attributes:
        seed: Of everything that is drawn.
        rate: Ticks of its loop [Hz].
        every: Ticks a row of the log, over which the command is held.
        inertia: Moment of inertia [kg m^2].
        kp, kd: Gains [N m/rad, N m s/rad].
        effects: All that acts, with its values, as the stepper takes them.
        command: Command a row [rad].
        known: Whether the case states kp, so that the scale is known.
        hidden: Kind that the case does not declare; None: the case is complete.
        count, noise: Step of the encoder and deviation of its noise [rad].
    """

    seed: int
    rate: float
    every: int
    inertia: float
    kp: float
    kd: float
    effects: Mapping[str, Mapping[str, float]]
    command: np.ndarray = field(repr=False)
    known: bool = True
    hidden: str | None = None
    count: float = COUNT
    noise: float = NOISE

    @property
    def declared(self) -> dict[str, Mapping[str, float]]:
        """Effects of the machine without the hidden one."""
        return {kind: values for kind, values in self.effects.items() if kind != self.hidden}

    @property
    def sensor(self) -> Sensor:
        """Encoder of the servo."""
        return Sensor(position_resolution=self.count, position_noise=self.noise)

    def run(self, *, exact: bool = False, **changes: object) -> dict[str, np.ndarray]:
        """Run the exact stepper; `exact` switches the encoder's errors off, changes replace fields."""
        servo = dataclasses.replace(self, **changes)
        ticks = np.repeat(servo.command, servo.every)
        if "joint_flexibility" in servo.effects or "backlash" in servo.effects:
            return servo._run_flexible(ticks, exact=exact)
        loop = Loop(kind="pd", kp=servo.kp, kd=servo.kd, reference=ticks)
        return simulate(
            Machine(servo.inertia, servo.effects),
            loop,
            Sensor() if exact else servo.sensor,
            rate=servo.rate,
            duration=len(ticks) / servo.rate,
            seed=servo.seed,
            step=COARSE if exact else 5e-6,
            log_rate=servo.rate / servo.every,
            initial_position=float(ticks[0]),
        )

    def _run_flexible(self, ticks: np.ndarray, *, exact: bool) -> dict[str, np.ndarray]:
        """Run the exact chain: the encoder's inertia, and the rest of it behind a spring or in play."""
        effects = {kind: dict(values) for kind, values in self.effects.items()}
        spring = effects.pop("joint_flexibility", None) or effects.pop("backlash")
        load, viscous = spring["load_inertia"], effects["viscous_friction"]["coefficient"]
        acting = {("coulomb_friction", 1): effects["coulomb_friction"]}
        if "gap" in spring:
            acting["backlash", 2] = {"gap": spring["gap"]}
        machine = ChainMachine(
            (self.inertia - load, load),
            (viscous, 0.0),
            (0.0, spring["stiffness"], 0.0),
            effects=acting,
            actuated=(1,),
            coupling=(0.0, spring["damping"], 0.0),
        )
        reference = reached(ticks, Machine(self.inertia, self.effects), self.rate)
        log = simulate_chain(
            machine,
            [Loop(kind="pd", kp=self.kp, kd=self.kd, reference=reference)],
            Sensor() if exact else self.sensor,
            rate=self.rate,
            duration=len(ticks) / self.rate,
            seed=self.seed,
            step=COARSE if exact else 5e-6,
            initial_position=float(ticks[0]),
        )
        return {"t": log["t"][:: self.every], "position": log["position"][:: self.every, 0]}

    def columns(self) -> dict[str, np.ndarray]:
        """Return the log: time, encoder, command."""
        log = self.run()
        return {"t": log["t"], "q": log["position"], "r": self.command}

    def label(self, kind: str, port: int) -> str:
        """Return the name of an effect in the records: a servo has one joint."""
        return kind

    def truth(self) -> dict[str, float]:
        """Return the values of the declared unknowns by the names of results."""
        out = {"inertia": self.inertia, "controller.kp": self.kp, "controller.kd": self.kd}
        for kind, name in DECLARED.items():
            if kind in self.declared:
                out[f"{kind}.{name}"] = self.effects[kind][name]
        if "command_delay" in self.declared:
            out["controller.delay"] = self.effects["command_delay"]["delay"]
        return out

    def case(self) -> dict:
        """Return the case, its guesses up to a factor of three off."""
        rng = np.random.default_rng([391, self.seed])

        def guess(value: float) -> dict[str, float]:
            return {"guess": float(value * 3 ** rng.uniform(-1, 1))}

        controller: dict = {"kind": "pd", "period": 1 / self.rate, "kd": guess(self.kd)}
        controller["kp"] = self.kp if self.known else guess(self.kp)
        if "command_delay" in self.declared:
            controller["delay"] = guess(self.effects["command_delay"]["delay"])
        effects = [
            {"kind": kind, name: guess(self.effects[kind][name])}
            for kind, name in DECLARED.items()
            if kind in self.declared
        ]
        asked = {"discover": {"candidates": [self.hidden]}} if self.hidden in ASKED else {}
        return asked | {
            "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": guess(self.inertia)}},
            "effects": effects,
            "controller": controller,
            "log": {"time": "t", "position": "q", "reference": "r", "reference_hold": "zero_order"},
        }

    def evidence(self) -> float:
        """Return what an oracle sees of the hidden effect [nats], by the exact stepper alone.

        The declared model is fitted to the motion without noise, from the truth. What it leaves is compared
        with the noise of a reading.
        """
        whole = self.run(exact=True)["position"]
        truth = self.truth()
        names = [name for name in truth if name != "controller.kp"]
        start = np.array([truth[name] for name in names])

        def left(factors: np.ndarray) -> np.ndarray:
            values = dict(zip(names, start * np.exp(factors), strict=True))
            effects = {kind: dict(v) for kind, v in self.declared.items()}
            for kind, name in DECLARED.items():
                if kind in effects:
                    effects[kind][name] = values[f"{kind}.{name}"]
            if "command_delay" in effects:
                effects["command_delay"]["delay"] = values["controller.delay"]
            inertia, kd = values["inertia"], values["controller.kd"]
            off = self.run(exact=True, effects=effects, inertia=inertia, kd=kd)["position"] - whole
            return np.nan_to_num(off, nan=1e3, posinf=1e3, neginf=-1e3)

        best = scipy.optimize.least_squares(
            left, np.zeros(len(names)), bounds=(-3, 3), diff_step=1e-3, x_scale="jac", max_nfev=12
        )
        return float(best.cost / (self.noise**2 + self.count**2 / 12))


def servo(seed: int, hidden: str | None = None, *, fine: bool = False) -> Servo:
    """Draw a servo, and the values of an effect that its case does not declare.

    Args:
        seed: Of everything.
        hidden: Kind of the effect; None: the case is complete.
        fine: Whether the encoder has 16 000 counts, the delay is up to 0.1 s, and no gain is known.
    """
    rng = np.random.default_rng([39, seed])
    longest = LONGEST_FINE if fine else LONGEST
    rate, every = RATES[rng.integers(len(RATES))]
    inertia = float(10 ** rng.uniform(-3.3, -2.0))
    bandwidth, damping = rng.uniform(12.0, 40.0 if rate > 200.0 else 25.0), rng.uniform(0.6, 1.1)
    effects = {
        "viscous_friction": {"coefficient": inertia * rng.uniform(1.0, 5.0)},
        "coulomb_friction": {"level": inertia * rng.uniform(5.0, 25.0)},
        "command_delay": {"delay": np.ceil(rng.uniform(0.0, longest) * rate) / rate},
    }
    command = command_of(rng, rate, every, seed)
    made = Servo(
        seed=seed,
        rate=rate,
        every=every,
        inertia=inertia,
        kp=inertia * bandwidth**2,
        kd=2 * damping * inertia * bandwidth,
        effects=effects,
        command=command,
        known=bool(rng.random() < 0.5) and not fine,
        hidden=hidden,
        count=FINE if fine else COUNT,
        noise=FINE_NOISE if fine else NOISE,
    )
    if hidden is None or hidden in ("viscous_friction", "coulomb_friction"):
        return made
    return dataclasses.replace(made, effects={**effects, hidden: _values(hidden, made, rng)})


def command_of(rng: np.random.Generator, rate: float, every: int, seed: int) -> np.ndarray:
    """Draw a command, a value a row of the log [rad].

    Args:
        rng: Generator of its moves.
        rate: Ticks of the loop [Hz].
        every: Ticks a row.
        seed: Seed of the phases of its sines.
    """
    t = np.arange(round(SECONDS * rate / every)) * every / rate
    count = int(rng.integers(4, 8))
    waypoints = np.concatenate([[0.0], rng.uniform(-1.2, 1.2, count)])
    command = moves(
        t, waypoints, rng.uniform(1.0, 5.0, count + 1), rng.uniform(20.0, 60.0), rng.uniform(0.05, 0.3)
    )
    return command + multisine(t, rng.uniform(0.3, 3.5, 3), rng.uniform(0.05, 0.2), seed)


def _values(kind: str, made: Servo, rng: np.random.Generator) -> dict[str, float]:
    """Draw the values of a hidden effect."""
    longest = LONGEST if made.count == COUNT else LONGEST_FINE
    if kind == "saturation":
        peak = float(np.abs(made.run(exact=True)["true_force"]).max())
        return {"limit": peak * rng.uniform(0.45, 0.85)}
    if kind == "voltage_limit":
        run = made.run(exact=True)
        force, speed = (float(np.abs(run[name]).max()) for name in ("true_force", "true_velocity"))
        return {"stall": force * rng.uniform(0.8, 1.5), "velocity": speed * rng.uniform(0.7, 1.1)}
    if kind == "backlash":
        load = made.inertia * rng.uniform(0.3, 0.7)
        turn = 2 * np.pi * min(40.0, made.rate / 10)
        values = {"stiffness": load * turn**2, "damping": 0.4 * load * turn, "gap": rng.uniform(0.01, 0.06)}
        return {name: float(value) for name, value in {**values, "load_inertia": load}.items()}
    if kind == "joint_flexibility":
        load = made.inertia * rng.uniform(0.3, 0.7)
        turn = 2 * np.pi * rng.uniform(5.0, min(20.0, made.rate / made.every / 10))
        values = {"stiffness": load * turn**2, "damping": load * turn * rng.uniform(0.05, 0.2)}
        return {name: float(value) for name, value in {**values, "load_inertia": load}.items()}
    draws = {
        "stribeck_friction": {
            "level": made.inertia * rng.uniform(5.0, 15.0),
            "velocity": rng.uniform(0.1, 0.6),
        },
        "command_delay": {"delay": round(rng.uniform(0.005, longest) * made.rate) / made.rate},
        "command_lag": {"time_constant": rng.uniform(0.01, 0.06)},
        "dead_band": {"width": rng.uniform(0.005, 0.03)},
        "unbalance": {
            "moment": made.inertia * rng.uniform(10.0, 40.0) / 9.81,
            "phase": rng.uniform(-np.pi, np.pi),
        },
        "load_friction": {"coefficient": rng.uniform(0.1, 0.35)},
        "linear_stiffness": {"coefficient": made.kp * rng.uniform(0.05, 0.3)},
    }
    return {name: float(value) for name, value in draws[kind].items()}


HIDDEN = (
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "saturation",
    "command_delay",
    "command_lag",
    "dead_band",
    "unbalance",
    "load_friction",
    "linear_stiffness",
    "joint_flexibility",
    "backlash",
    "voltage_limit",
)
# Those that a search tries without being asked.
UNASKED = tuple(kind for kind in HIDDEN if kind not in ASKED)
