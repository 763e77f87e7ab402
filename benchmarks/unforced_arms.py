"""Arms of two joints of `benchmarks.unforced` on the exact stepper: machine, loop, commands, case of a run.

Links, rotors, friction, gains, delays, rates, counts and commands are drawn. The arm moves in a vertical
plane; the case states its links, and nothing else. The log holds commands and positions, and no force.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.optimize

from benchmarks.unforced_machines import COARSE, DECLARED, NOISE, RATES, command_of
from truth.arm.servos import Links, Servo, run

COUNTS = (4096, 16000)
# Step of integration [s], and time before a log in which the arm sinks to where its servos hold it [s]; an
# elastic joint swings for longer.
STEP, SETTLING, SWINGING = 2e-5, 1.0, 3.0
# Values of a servo that the case does not know.
OWN = ("rotor", "kp", "kd")
HIDDEN = (
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "saturation",
    "command_delay",
    "dead_band",
    "unbalance",
    "load_friction",
)
# Effects that put a spring between a rotor with its encoder and its link.
ELASTIC = ("joint_flexibility", "backlash")


@dataclass(frozen=True)
class Arm:
    """An arm of two servos with its commands.

    Attributes:
        seed: Of everything that is drawn.
        rate: Ticks of its loop [Hz].
        every: Ticks a row of the log, over which a command is held.
        count: Step of the encoders [rad].
        links: What the case knows.
        servos: The servos of both joints, with all that acts.
        command: Commands a row, (rows, 2) [rad].
        hidden: Kind that the case does not declare; None: the case is complete.
        joint: Its joint, from 0.
        far: Whether every guess of the case is two to five times off, in place of up to three times.
    """

    seed: int
    rate: float
    every: int
    count: float
    links: Links
    servos: tuple[Servo, Servo]
    command: np.ndarray = field(repr=False)
    hidden: str | None = None
    joint: int = 0
    far: bool = False

    known = False

    def declared(self, joint: int) -> dict[str, Mapping[str, float]]:
        """Return the effects of a joint without the hidden one."""
        hidden = self.hidden if joint == self.joint else None
        return {kind: values for kind, values in self.servos[joint].effects.items() if kind != hidden}

    def run(self, *, servos: tuple[Servo, ...] | None = None, exact: bool = False) -> dict[str, np.ndarray]:
        """Run the exact stepper; the arm begins at rest where the true servos hold it.

        Args:
            servos: Other servos.
            exact: Without the errors of the encoders, in the steps of the oracle.
        """
        ticks = np.repeat(self.command, self.every, axis=0)
        swings = any(kind in servo.effects for servo in self.servos for kind in ELASTIC)
        held = np.tile(ticks[0], (round((SWINGING if swings else SETTLING) * self.rate), 1))
        options = {"rate": self.rate, "step": COARSE if exact else STEP}
        settled = run(self.links, self.servos, held, start=ticks[0], **options)
        options |= {"start": settled["position"][-1], "start_of_links": settled["links"][-1]}
        if exact:
            servos = servos or self.servos
            rigid = [k for k, s in enumerate(servos) if not any(kind in s.effects for kind in ELASTIC)]
            options["start_of_links"][rigid] = options["start"][rigid]
            return run(self.links, servos, ticks, **options)
        noise = NOISE * np.random.default_rng([40, self.seed]).standard_normal(ticks.shape)
        return run(self.links, self.servos, ticks, noise=noise, resolution=self.count, **options)

    def columns(self) -> dict[str, np.ndarray]:
        """Return the log: time, encoders, commands."""
        q = self.run()["reading"][:: self.every]
        out = {"t": np.arange(len(q)) * self.every / self.rate}
        for k in range(2):
            out |= {f"q{k + 1}": q[:, k], f"r{k + 1}": self.command[:, k]}
        return out

    def case(self) -> dict:
        """Return the case, its guesses far from the truth."""
        rng = np.random.default_rng([392, self.seed])

        def guess(value: float) -> dict[str, float]:
            factor = rng.uniform(2, 5) ** rng.choice((-1, 1)) if self.far else 3 ** rng.uniform(-1, 1)
            return {"guess": float(value * factor)}

        controller: dict = {"kind": "pd", "period": 1 / self.rate}
        controller |= {name: [guess(getattr(s, name)) for s in self.servos] for name in ("kp", "kd")}
        delays = [self.declared(k).get("command_delay") for k in range(2)]
        if all(delays):
            controller["delay"] = [guess(values["delay"]) for values in delays if values]
        effects = [
            {"kind": kind, "joint": k + 1, name: guess(self.servos[k].effects[kind][name])}
            for kind, name in DECLARED.items()
            for k in range(2)
            if kind in self.declared(k)
        ]
        asked = {"discover": {"candidates": [self.hidden]}} if self.hidden in ELASTIC else {}
        links, zeros = self.links, [0.0] * 5
        rows = zip(
            (0.0, links.length), links.mass, links.along, links.across, links.about, self.servos, strict=True
        )
        return asked | {
            "plant": {
                "kind": "serial_arm",
                "gravity_vector": [0.0, -9.81, 0.0],
                "links": [
                    {
                        "joint": "revolute",
                        "alpha_deg": 0.0,
                        "a": a,
                        "mass": m,
                        "first_moment": [m * x, m * y, 0.0],
                        "inertia": [*zeros, i + m * (x**2 + y**2)],
                        "rotor_inertia": guess(servo.rotor),
                    }
                    for a, m, x, y, i, servo in rows
                ],
            },
            "effects": effects,
            "controller": controller,
            "log": {
                "time": "t",
                "position": ["q1", "q2"],
                "reference": ["r1", "r2"],
                "reference_hold": "zero_order",
            },
        }

    def truth(self) -> dict[str, float]:
        """Return the true values of the unknowns of a complete case, by name."""
        out = {}
        for k, servo in enumerate(self.servos, start=1):
            out |= {f"rotor_inertia[{k}]": servo.rotor}
            out |= {f"controller.{name}[{k}]": getattr(servo, name) for name in ("kp", "kd")}
            out |= {f"{kind}[{k}].{name}": servo.effects[kind][name] for kind, name in DECLARED.items()}
            out |= {f"controller.delay[{k}]": servo.effects["command_delay"]["delay"]}
        return out

    def label(self, kind: str, port: int) -> str:
        """Return the name of an effect in the records, with its joint from 1."""
        return f"{kind}[{port + 1}]"

    def evidence(self) -> float:
        """Return what an oracle that knows the truth gains by the hidden effect [nats].

        The declared model is fitted to the exact motion of both joints from the true values. Half of the
        squares that it leaves, over the variance of an encoder's error, is the gain of the complete model.
        """
        whole = self.run(exact=True)["position"]
        places = [(k, None, name) for k in range(2) for name in OWN]
        names = {**DECLARED, "command_delay": "delay"}
        places += [
            (k, kind, name) for k in range(2) for kind, name in names.items() if kind in self.declared(k)
        ]

        def left(factors: np.ndarray) -> np.ndarray:
            servos = [dataclasses.replace(s, effects=self.declared(k)) for k, s in enumerate(self.servos)]
            for (k, kind, name), factor in zip(places, np.exp(factors), strict=True):
                if kind is None:
                    servos[k] = dataclasses.replace(servos[k], **{name: getattr(servos[k], name) * factor})
                    continue
                effects = dict(servos[k].effects)
                effects[kind] = {**effects[kind], name: effects[kind][name] * factor}
                servos[k] = dataclasses.replace(servos[k], effects=effects)
            off = self.run(servos=tuple(servos), exact=True)["position"][:: self.every] - whole[:: self.every]
            return np.nan_to_num(off.ravel(), nan=1e3, posinf=1e3, neginf=-1e3)

        best = scipy.optimize.least_squares(
            left, np.zeros(len(places)), bounds=(-3, 3), diff_step=1e-3, x_scale="jac", max_nfev=12
        )
        return float(best.cost / (NOISE**2 + self.count**2 / 12))


def arm(seed: int, hidden: str | None = None, joint: int = 0) -> Arm:
    """Draw an arm, and the values of an effect that its case does not declare.

    Args:
        seed: Of everything.
        hidden: Kind of the effect; None: the case is complete.
        joint: Its joint, from 0.
    """
    rng = np.random.default_rng([40, seed])
    rate, every = RATES[rng.integers(len(RATES))]
    links = _links(rng)
    inertias = links.inertia()
    rotors = inertias * rng.uniform(0.3, 2.0, 2)
    servos = tuple(
        _servo(rng, rate, float(own), float(own + rotor)) for own, rotor in zip(rotors, inertias, strict=True)
    )
    if hidden == "command_delay":
        servos = tuple(_without(s, hidden) for s in servos)
    commands = [command_of(rng, rate, every, 2 * seed + k) + rng.uniform(-1.5, 1.5) for k in range(2)]
    made = Arm(
        seed=seed,
        rate=rate,
        every=every,
        count=float(2 * np.pi / COUNTS[rng.integers(len(COUNTS))]),
        links=links,
        servos=servos,
        command=np.stack(commands, axis=1),
        hidden=hidden,
        joint=joint,
    )
    if hidden is None or hidden in DECLARED:
        return made
    if hidden in ELASTIC:
        values = _spring(hidden, made, float(inertias[joint]), rng)
    else:
        values = _values(hidden, made, float(inertias[joint] + servos[joint].rotor), rng)
    found = dataclasses.replace(servos[joint], effects={**servos[joint].effects, hidden: values})
    return dataclasses.replace(made, servos=tuple(found if k == joint else s for k, s in enumerate(servos)))


def _links(rng: np.random.Generator) -> Links:
    """Draw the links of a small arm."""
    lengths, mass = rng.uniform(0.1, 0.35, 2), rng.uniform((0.1, 0.05), (0.6, 0.4))
    along, across = rng.uniform(0.3, 0.7, 2) * lengths, rng.uniform(-0.02, 0.02, 2)
    about = mass * (rng.uniform(0.2, 0.35, 2) * lengths) ** 2
    pairs = ((float(x), float(y)) for x, y in (mass, along, across, about))
    return Links(*pairs, length=float(lengths[0]))


def _servo(rng: np.random.Generator, rate: float, rotor: float, inertia: float) -> Servo:
    """Draw the servo of a joint about which this inertia turns [kg m^2]."""
    bandwidth, damping = rng.uniform(12.0, 40.0 if rate > 200.0 else 25.0), rng.uniform(0.6, 1.1)
    effects = {
        "viscous_friction": {"coefficient": float(inertia * rng.uniform(1.0, 5.0))},
        "coulomb_friction": {"level": float(inertia * rng.uniform(5.0, 25.0))},
        "command_delay": {"delay": float(np.ceil(rng.uniform(0.0, 0.1) * rate) / rate)},
    }
    return Servo(rotor, float(inertia * bandwidth**2), float(2 * damping * inertia * bandwidth), effects)


def _without(servo: Servo, kind: str) -> Servo:
    return dataclasses.replace(servo, effects={k: v for k, v in servo.effects.items() if k != kind})


def _values(kind: str, made: Arm, inertia: float, rng: np.random.Generator) -> dict[str, float]:
    """Draw the values of a hidden effect at a joint about which this inertia turns [kg m^2]."""
    if kind == "saturation":
        peak = float(np.abs(made.run(exact=True)["torque"][:, made.joint]).max())
        return {"limit": peak * rng.uniform(0.45, 0.85)}
    draws = {
        "stribeck_friction": {"level": inertia * rng.uniform(5.0, 15.0), "velocity": rng.uniform(0.1, 0.6)},
        "command_delay": {"delay": round(rng.uniform(0.005, 0.1) * made.rate) / made.rate},
        "dead_band": {"width": rng.uniform(0.005, 0.03)},
        "unbalance": {
            "moment": inertia * rng.uniform(10.0, 40.0) / 9.81,
            "phase": rng.uniform(-np.pi, np.pi),
        },
        "load_friction": {"coefficient": rng.uniform(0.1, 0.35)},
    }
    return {name: float(value) for name, value in draws[kind].items()}


def _spring(kind: str, made: Arm, inertia: float, rng: np.random.Generator) -> dict[str, float]:
    """Draw the values of a spring in front of a link of this inertia [kg m^2], or of play and its contact."""
    if kind == "backlash":
        turn = 2 * np.pi * min(40.0, made.rate / 10)
        values = {"damping": 0.4 * inertia * turn, "gap": rng.uniform(0.01, 0.06)}
    else:
        turn = 2 * np.pi * rng.uniform(5.0, min(20.0, made.rate / made.every / 10))
        values = {"damping": inertia * turn * rng.uniform(0.05, 0.2)}
    return {"stiffness": float(inertia * turn**2)} | {name: float(v) for name, v in values.items()}
