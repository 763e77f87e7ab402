"""A robot's flexible joint with encoders at motor and load, in a loop of 1 kHz, by the exact chain.

The log holds every tick, or every second to eighth one. Machines, tours and noise are drawn.
"""

import tomllib
from dataclasses import dataclass, replace

import numpy as np

from truth.axis.machines import moves
from truth.axis.stepper import Loop, Sensor
from truth.chain.stepper import ChainMachine, simulate_chain

RATE = 1000.0
# Rows a second of slow logs, in turn.
LOG_RATES = (500.0, 200.0, 125.0)
COUNT = 2 * np.pi / 2**17
_SPEEDS = (0.5, 2.0, 6.0, 1.0)  # rad/s
# Where every fit starts.
GUESS = {
    "motor_inertia": 0.05,
    "load_inertia": 0.05,
    "stiffness": 100.0,
    "damping": 0.1,
    "zero_offset": 0.0,
}
FORCE_NOISE = 0.01  # N m
# What may be hidden: joint and parameters, in N m.
HIDDEN = {
    "stribeck_friction": (1, {"level": 0.15, "velocity": 0.2}),
    "quadratic_drag": (2, {"coefficient": 0.02}),
    "static_friction": (2, {"level": 0.1}),
    "cogging": (1, {"amplitude": 0.05, "period": 2 * np.pi / 12, "phase": 0.3}),
}


@dataclass(frozen=True)
class FlexibleJoint:
    """A drawn joint.

    Attributes:
        seed: Its number.
        true: True values by the names of results.
        hidden: Kind of an effect that its case does not declare; None: none.
    """

    seed: int
    true: dict[str, float]
    hidden: str | None = None

    def hiding(self, kind: str) -> "FlexibleJoint":
        """Return the joint with an effect that its case does not declare."""
        return replace(self, hidden=kind)

    @property
    def resonance(self) -> float:
        """Natural frequency of the free joint [Hz]."""
        t = self.true
        return float(np.sqrt(t["stiffness"] * (1 / t["motor_inertia"] + 1 / t["load_inertia"])) / (2 * np.pi))

    def machine(self) -> ChainMachine:
        """Return the moving part."""
        t = self.true
        machine = ChainMachine(
            (t["motor_inertia"], t["load_inertia"]),
            tuple(t[f"viscous_friction[{k}].coefficient"] for k in (1, 2)),
            (0.0, t["stiffness"], 0.0),
            {("coulomb_friction", k): {"level": t[f"coulomb_friction[{k}].level"]} for k in (1, 2)},
            actuated=(1,),
            coupling=(0.0, t["damping"], 0.0),
        )
        if self.hidden is None:
            return machine
        joint, values = HIDDEN[self.hidden]
        return machine.with_effect(self.hidden, joint, **values)

    def log(self, rate: float, duration: float = 12.0) -> dict[str, np.ndarray]:
        """Simulate a tour; return the columns t, q_motor, q_load, torque at so many rows a second."""
        random = np.random.default_rng([32, self.seed])
        points, speeds = [0.0], []
        for k in range(12):
            speeds.append(_SPEEDS[k % 4] * random.uniform(0.7, 1.4))
            points.append(points[-1] + (-1) ** k * speeds[-1] * random.uniform(0.2, 0.6))
        reference = moves(np.arange(round(duration * RATE)) / RATE, points, [*speeds, 2.0], 40.0, rest=0.1)
        whole = self.true["motor_inertia"] + self.true["load_inertia"]
        loop = Loop(
            "cascade_pd", reference=reference, limit=20.0, kp=12.0, kv=40.0 * whole, velocity_average=4
        )
        sensor = Sensor(position_resolution=COUNT, position_noise=0.5 * COUNT, force_noise=FORCE_NOISE)
        log = simulate_chain(self.machine(), [loop], sensor, rate=RATE, duration=duration, seed=self.seed)
        every = round(RATE / rate)
        columns = {"t": log["t"], "q_motor": log["position"][:, 0], "q_load": log["position"][:, 1]}
        return {name: x[::every] for name, x in {**columns, "torque": log["force"][:, 0]}.items()}


def flexible_joint(seed: int) -> FlexibleJoint:
    """Draw a joint with a resonance of 12 to 45 Hz."""
    random = np.random.default_rng([31, seed])
    motor = 0.02 * np.exp(random.uniform(-0.5, 0.5))
    load = motor * np.exp(random.uniform(-0.3, 1.2))
    omega = 2 * np.pi * np.exp(random.uniform(np.log(12), np.log(45)))
    stiffness = omega**2 * motor * load / (motor + load)
    damping = 2 * random.uniform(0.01, 0.05) * stiffness / omega
    viscous = random.uniform(0.03, 0.12, 2)
    coulomb = random.uniform(0.1, 0.3), random.uniform(0.03, 0.15)
    true = {"motor_inertia": motor, "load_inertia": load, "stiffness": stiffness, "damping": damping}
    true |= {"zero_offset": 0.0}
    true |= {f"viscous_friction[{k}].coefficient": float(viscous[k - 1]) for k in (1, 2)}
    true |= {f"coulomb_friction[{k}].level": float(coulomb[k - 1]) for k in (1, 2)}
    return FlexibleJoint(seed, {name: float(value) for name, value in true.items()})


def text(*, sensor: bool = False) -> str:
    """Return the case of a joint as TOML, far from the truth: no controller is stated.

    Args:
        sensor: Whether the noise of the sensors is stated.
    """
    values = [f"{name} = {{ guess = {guess} }}" for name, guess in GUESS.items()]
    lines = ["[plant]", 'kind = "flexible_axis"', 'motion = "rotary"', "[plant.parameters]", *values]
    for kind, key, guesses in (
        ("viscous_friction", "coefficient", (0.2, 0.2)),
        ("coulomb_friction", "level", (0.05, 0.3)),
    ):
        by_joint = ", ".join(f"{{ guess = {guess} }}" for guess in guesses)
        lines += ["[[effects]]", f'kind = "{kind}"', f"{key} = [{by_joint}]"]
    lines += ["[log]", 'time = "t"', 'position = "q_motor"', 'load_position = "q_load"', 'force = "torque"']
    if sensor:
        noise = {"position_resolution": COUNT, "position_noise": 0.5 * COUNT, "force_noise": FORCE_NOISE}
        lines += ["[sensor]", *(f"{name} = {value!r}" for name, value in noise.items())]
    return "\n".join(lines) + "\n"


def case() -> dict:
    """Return the case of a joint as a table: neither controller nor sensor is stated."""
    return tomllib.loads(text())
