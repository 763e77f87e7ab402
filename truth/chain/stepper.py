"""Ground truth of a chain of masses under set-valued friction.

m_i a_i + c_i v_i + s_i - s_(i+1) = u_i + effects, s_i = k_i (x_i - x_(i-1)) + d_i (v_i - v_(i-1)), the
masses between two walls at 0. Sign and sticking are exact; sampled loops through a quantised noisy encoder.

Conventions, beside those of `truth.axis.stepper`:
    Masses, springs and drives count from 1; spring i joins mass i - 1 and mass i.
    The command is held between ticks. A mass that is not driven has no reference: its column is 0.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from truth.axis.kernel import Law, Physics
from truth.axis.stepper import EFFECTS, Loop, Sensor, control_law, first_samples
from truth.chain import kernel as chain_kernel

# Effects on the elongation of a spring -> power of it in the force.
SPRING_EFFECTS = {"quadratic_stiffness": 2, "cubic_stiffness": 3}
MASS_EFFECTS = (
    "viscous_friction", "coulomb_friction", "static_friction", "stribeck_friction",
    "asymmetric_viscous", "quadratic_drag", "cubic_friction", "quartic_friction",
    "constant_force", "cogging", "velocity_hysteresis", "actuator_lag", "actuator_gain", "added_mass",
    "load_friction",
)  # fmt: skip
Place = tuple[str, int]
_PHYSICS = np.dtype([(name, float) for name in Physics._fields])
_WHOLE = {"kind": np.int64, "average": np.int64, "anti_windup": np.bool_}
_LAW = np.dtype([(name, _WHOLE.get(name, float)) for name in Law._fields])


@dataclasses.dataclass(frozen=True)
class ChainMachine:
    """Moving part: n masses, n + 1 springs, their drives and other effects.

    Attributes:
        mass: Of each mass [kg].
        damping: Of each mass to ground [N s/m].
        stiffness: Of each spring [N/m].
        effects: (kind, mass or spring) -> its parameters, as in the case file [SI].
        coupling: d, of a damper beside each spring [N s/m]; None: none has one.
        actuated: Masses that are driven, in the order of the drives; None: every mass.
        actuator_gain: Known force per unit of command, by drive or one for all [N per unit].
    """

    mass: Sequence[float]
    damping: Sequence[float]
    stiffness: Sequence[float]
    effects: Mapping[Place, Mapping[str, float]] = dataclasses.field(default_factory=dict)
    actuated: Sequence[int] | None = None
    actuator_gain: Sequence[float] | float = 1.0
    coupling: Sequence[float] | None = None

    @property
    def count(self) -> int:
        """Number of masses."""
        return len(self.mass)

    @property
    def driven(self) -> np.ndarray:
        """Masses that are driven, counted from 0 (drives,)."""
        actuated = range(1, self.count + 1) if self.actuated is None else self.actuated
        return np.array(actuated, dtype=np.int64).reshape(-1) - 1

    @property
    def gains(self) -> np.ndarray:
        """Known force per unit of command (drives,)."""
        return np.broadcast_to(np.asarray(self.actuator_gain, dtype=float), self.driven.shape)

    def with_effect(self, kind: str, place: int, **parameters: float) -> "ChainMachine":
        """Return this machine with one effect added or replaced."""
        return dataclasses.replace(self, effects={**self.effects, (kind, place): parameters})

    def frequencies(self) -> np.ndarray:
        """Natural frequencies of the undamped chain without drives (n,) [Hz]."""
        k, root = np.asarray(self.stiffness), np.sqrt(self.mass)
        matrix = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
        return np.sqrt(np.linalg.eigvalsh(matrix / np.outer(root, root))) / (2.0 * np.pi)


def physics(machine: ChainMachine) -> tuple[np.ndarray, np.ndarray]:
    """Flatten a machine into records of the kernel, one a mass, and springs (n + 1, 5).

    Raises:
        ValueError: If lengths do not fit, or an effect, its place or a parameter is unknown.
    """
    n, driven = machine.count, machine.driven
    if len(machine.damping) != n or len(machine.stiffness) != n + 1:
        raise ValueError(f"{n} masses need {n} dampings and {n + 1} springs.")
    if len(set(driven)) < len(driven) or not set(driven) <= set(range(n)):
        raise ValueError(f"actuated names masses from 1 to {n}, each once: {machine.actuated}.")
    springs = np.zeros((n + 1, 5))
    springs[:, 0] = machine.stiffness
    springs[:, 3] = 0.0 if machine.coupling is None else machine.coupling
    own = zip(machine.mass, machine.damping, strict=True)
    fields = [{"mass": float(mass), "viscous": float(damping)} for mass, damping in own]
    for i, gain in zip(driven, machine.gains, strict=True):
        fields[i]["gain"] = float(gain)
    for (kind, place), values in machine.effects.items():
        if kind == "backlash":
            springs[place - 1, 4] = float(values["gap"])
            continue
        if kind not in (*MASS_EFFECTS, *SPRING_EFFECTS):
            raise ValueError(
                f"The chain has no effect {kind!r}; it has {MASS_EFFECTS} by mass "
                f"and {('backlash', *SPRING_EFFECTS)} by spring."
            )
        if not 1 <= place <= n + (kind in SPRING_EFFECTS):
            raise ValueError(f"{kind} cannot act at {place}: there are {n} masses.")
        names = EFFECTS[kind]
        if kind == "velocity_hysteresis":  # the same both ways where nothing else is said
            values = {"level_negative": values["level"], **values}
        if set(values) != set(names):
            raise ValueError(f"{kind} takes {sorted(names)}, got {sorted(values)}.")
        if kind in SPRING_EFFECTS:
            springs[place - 1, SPRING_EFFECTS[kind] - 1] += float(values["coefficient"])
            continue
        own = fields[place - 1]
        for name, value in values.items():
            key = names[name]
            # An added mass and a viscous friction come on top, a gain is a factor.
            if key == "gain":
                own[key] = own.get(key, 1.0) * float(value)
            else:
                own[key] = own.get(key, 0.0) + float(value)
    masses = np.array([tuple(Physics(**own)) for own in fields], dtype=_PHYSICS)
    return masses, springs


def simulate_chain(
    machine: ChainMachine,
    loops: Sequence[Loop],
    sensor: Sensor,
    *,
    rate: float,
    duration: float,
    seed: int = 0,
    step: float = 5e-6,
    initial_position: Sequence[float] | float = 0.0,
    initial_velocity: Sequence[float] | float = 0.0,
) -> dict[str, np.ndarray]:
    """Run the chain and return its log with the truth behind it.

    Args:
        machine: What moves.
        loops: What gives the command of each drive, in the order of `actuated`.
        sensor: What is read, the same at every mass and on every drive.
        rate: Ticks of the controllers, and rows of the log [Hz].
        duration: Length of the log, its last sample excluded [s].
        seed: Of the sensor's noise.
        step: Longest integration step [s]; each tick takes a whole number of equal steps.
        initial_position: True positions at t = 0, or one for all [m].
        initial_velocity: True velocities at t = 0, or one for all [m/s].

    Returns:
        t (time,) [s], position (time, n) [m] and force (time, drives) [unit of command] as
        logged, reference (time, n) [m], and noise-free true_position, true_velocity,
        true_acceleration, true_force (time, n) (of the drive, at the mass [N]) and true_command
        (time, drives), all but positions and velocities just after the tick.

    Raises:
        ValueError: If loops or samples are missing, or the hold is not a zero-order one.
    """
    masses, springs = physics(machine)
    n, driven, count = machine.count, machine.driven, round(duration * rate)
    if len(loops) != len(driven):
        raise ValueError(f"{len(driven)} drives need as many loops, got {len(loops)}.")
    u, reference = np.zeros((count, len(driven))), np.zeros((count, n))
    for d, loop in enumerate(loops):
        if loop.hold != "zero_order":
            raise ValueError(f"the chain holds its command: zero_order, got {loop.hold!r}.")
        if loop.kind == "open_loop":
            u[:, d] = first_samples(loop.input, count, "input")
        else:
            reference[:, driven[d]] = first_samples(loop.reference, count, "reference")
    random = np.random.default_rng(seed)
    noise = sensor.position_noise * random.standard_normal((count, n))
    force_noise = sensor.force_noise * random.standard_normal(u.shape)
    start = lambda value: np.array(np.broadcast_to(value, n), dtype=float)
    laws = np.array([tuple(control_law(loop)) for loop in loops], dtype=_LAW)
    reading, truth = np.zeros((count, n)), np.zeros((count, n, 4))
    chain_kernel.run(
        masses, springs, laws, driven, u, reference, np.zeros((0, 3)), noise,
        float(sensor.position_resolution), 1.0 / rate, float(step), start(initial_position),
        start(initial_velocity), np.zeros(n), np.zeros(n), reading, truth,
        np.zeros((len(driven), 2)),
    )  # fmt: skip
    return {
        "t": np.arange(count) / rate,
        "position": reading,
        "force": u + force_noise,
        "reference": reference,
        "true_position": truth[:, :, 0],
        "true_velocity": truth[:, :, 1],
        "true_acceleration": truth[:, :, 2],
        "true_force": truth[:, :, 3],
        "true_command": u,
    }


def simulate_under(
    machine: ChainMachine,
    law: Callable[[int, np.ndarray], np.ndarray],
    sensor: Sensor,
    *,
    rate: float,
    duration: float,
    seed: int = 0,
    step: float = 5e-6,
) -> dict[str, np.ndarray]:
    """Run the chain, from rest at zero, under any law: a callable of the tick and the readings.

    Returns:
        t (time,) [s], position (time, n) [m] and force (time, drives) [unit of command] as logged,
        noise-free true_position and true_velocity (time, n).
    """
    masses, springs = physics(machine)
    n, driven, count = machine.count, machine.driven, round(duration * rate)
    random = np.random.default_rng(seed)
    noise = sensor.position_noise * random.standard_normal((count, n))
    q, v, pull = np.zeros(n), np.zeros(n), np.zeros(n)
    reading, truth = np.zeros((count, n)), np.zeros((count, n, 2))
    u, drive = np.zeros((count, len(driven))), np.zeros(n)
    for k in range(count):
        reading[k] = q + noise[k]
        if sensor.position_resolution > 0.0:
            count_of = np.round(reading[k] / sensor.position_resolution)
            reading[k] = count_of * sensor.position_resolution
        truth[k, :, 0], truth[k, :, 1] = q, v
        u[k] = law(k, reading[k])
        drive[driven] = machine.gains * u[k]
        chain_kernel.hold(masses, springs, q, v, drive, pull, 1.0 / rate, float(step))
    return {
        "t": np.arange(count) / rate,
        "position": reading,
        "force": u + sensor.force_noise * random.standard_normal(u.shape),
        "true_position": truth[:, :, 0],
        "true_velocity": truth[:, :, 1],
    }


def elongations(position: np.ndarray) -> np.ndarray:
    """Return the elongations of the springs (time, n + 1) from positions of the masses (time, n) [m]."""
    return np.diff(np.pad(position, ((0, 0), (1, 1))), axis=1)


def name_of(kind: str, place: int) -> str:
    """Return the name of an effect in results."""
    return f"{kind}[{'spring ' if kind in ('backlash', *SPRING_EFFECTS) else ''}{place}]"


def column_names(log: Mapping[str, np.ndarray]) -> list[str]:
    """Return the log's columns: t, position1.., force1.. (by drive), reference1.. (by mass)."""
    wide = ("position", "force", "reference")
    return ["t", *[f"{name}{k + 1}" for name in wide for k in range(log[name].shape[1])]]


def write_csv(log: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Write what a user would have: time, readings, commands and references, without the truth."""
    columns = np.column_stack([log[name] for name in ("t", "position", "force", "reference")])
    header = ",".join(column_names(log))
    np.savetxt(path, columns, delimiter=",", header=header, comments="", fmt="%.12g")
