"""Ground truth of one axis under set-valued friction.

Exact are sign, clipping and sticking, in a loop closed by a sampled controller through a quantised noisy
encoder: nothing is smoothed. No line is shared with the package, so agreement between the two is evidence.

Conventions:
    The drive acts in the order delay, gain, offset, lag, saturation, limit by the supply's voltage.
    A command u[k] acts from t[k] to t[k+1]; the reading at t[k] already gave it.
    Before the log starts the command is zero and the actuator has settled there.
    Units are SI; read kg m^2, rad and N m for a rotary axis.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy.signal

from truth.axis import kernel

STANDARD_GRAVITY = 9.81  # m/s^2, the case file's default

# effect -> its parameter -> the kernel's field
EFFECTS = {
    "viscous_friction": {"coefficient": "viscous"},
    "back_emf_damping": {"coefficient": "viscous"},
    "coulomb_friction": {"level": "coulomb"},
    "static_friction": {"level": "static"},
    "stribeck_friction": {"level": "stribeck", "velocity": "stribeck_velocity"},
    "asymmetric_viscous": {"coefficient": "absolute"},
    "quadratic_drag": {"coefficient": "quadratic"},
    "cubic_friction": {"coefficient": "cubic"},
    "quartic_friction": {"coefficient": "quartic"},
    "constant_force": {"level": "constant"},
    "linear_stiffness": {"coefficient": "stiffness1"},
    "quadratic_stiffness": {"coefficient": "stiffness2"},
    "cubic_stiffness": {"coefficient": "stiffness3"},
    "cogging": {"amplitude": "cogging", "period": "cogging_period", "phase": "cogging_phase"},
    "unbalance": {"moment": "moment", "phase": "moment_phase"},
    "velocity_hysteresis": {
        "level": "rising_forth",
        "level_negative": "rising_back",
        "velocity": "rising_velocity",
    },
    "hysteresis": {"stiffness": "dahl_stiffness", "level": "dahl_level"},
    "actuator_gain": {"gain": "gain"},
    "actuator_offset": {"level": "offset"},
    "actuator_lag": {"time_constant": "lag"},
    "input_delay": {"delay": "delay"},
    "saturation": {"limit": "clip"},
    "voltage_limit": {"stall": "stall", "velocity": "no_load"},
    "added_mass": {"mass": "mass"},
    "friction_drift": {"rate": "drift"},
    "load_friction": {"coefficient": "gear", "back": "gear_back"},
}
# Effects between the reference and the law, with their parameter.
ON_COMMAND = {
    "command_delay": "delay",
    "command_lag": "time_constant",
    "velocity_limit": "limit",
    "acceleration_limit": "limit",
    "dead_band": "width",
}
# Steps of a profile with limited acceleration in a tick.
PROFILE_STEPS = 50
KINDS = {
    "open_loop": kernel.OPEN,
    "cascade_pd": kernel.CASCADE_PD,
    "pd": kernel.PD,
    "pid": kernel.PID,
    "friction_compensation": kernel.COMPENSATED,
}


@dataclasses.dataclass(frozen=True)
class Machine:
    """Moving part: inertia, drive and effects.

    Attributes:
        inertia: Mass or moment of inertia [kg].
        effects: Effect name -> its parameters, as in the case file [SI].
        actuator_gain: Known force per unit of command [N per unit].
        gravity_force: Constant weight along the axis, -inertia g if it stands upright [N].
        bursts: Unlogged force pulses, each (start [s], duration [s], amplitude [N]).
        clock_force: Unlogged force A sin(2 pi f t) as (A [N], f [Hz]).
    """

    inertia: float
    effects: Mapping[str, Mapping[str, float]] = dataclasses.field(default_factory=dict)
    actuator_gain: float = 1.0
    gravity_force: float = 0.0
    bursts: Sequence[tuple[float, float, float]] = ()
    clock_force: tuple[float, float] = (0.0, 0.0)

    def with_effect(self, kind: str, **parameters: float) -> "Machine":
        """Return this machine with one effect added or replaced."""
        return dataclasses.replace(self, effects={**self.effects, kind: parameters})


@dataclasses.dataclass(frozen=True)
class Loop:
    """Source of the command.

    Attributes:
        kind: open_loop, cascade_pd, pd, pid or friction_compensation.
        input: Command a tick, open loop only [unit of command].
        hold: Of the open-loop input between ticks: zero_order or linear.
        reference: Wanted position a tick, closed loop [m].
        kp: Position gain.
        kv: Velocity gain of cascade_pd.
        ki: Integral gain of pid.
        kd: Derivative gain of pd and pid.
        velocity_average: Readings in the mean whose backward difference is the velocity.
        derivative_filter: Time constant of the low-pass on pid's derivative [s].
        anti_windup: Stop pid's integral while saturated outward.
        limit: Saturation of the command [unit of command].
        coulomb, viscous, inertia: Fed forward by friction_compensation.
        disturbance: level, on [s], off [s], start [s]; added to the command before `limit`.
    """

    kind: str = "open_loop"
    input: np.ndarray | None = None
    hold: str = "zero_order"
    reference: np.ndarray | None = None
    kp: float = 0.0
    kv: float = 0.0
    ki: float = 0.0
    kd: float = 0.0
    velocity_average: int = 1
    derivative_filter: float = 0.0
    anti_windup: bool = False
    limit: float = np.inf
    coulomb: float = 0.0
    viscous: float = 0.0
    inertia: float = 0.0
    disturbance: Mapping[str, float] | None = None


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Readings: the loop and the log see the same position reading.

    Attributes:
        position_resolution: Step to which the reading is rounded, 0 for none [m].
        position_noise: Standard deviation before rounding [m].
        force_noise: Standard deviation on the logged command alone [unit of command].
    """

    position_resolution: float = 0.0
    position_noise: float = 0.0
    force_noise: float = 0.0


def physics(machine: Machine) -> kernel.Physics:
    """Flatten a machine into the kernel's fields.

    Raises:
        ValueError: If an effect or one of its parameters is unknown or missing.
    """
    effects = {kind: dict(values) for kind, values in machine.effects.items()}
    coulomb = effects.get("coulomb_friction", {})
    if "friction_coefficient" in coulomb:
        added = effects.get("added_mass", {}).get("mass", 0.0)
        coulomb["level"] = coulomb.pop("friction_coefficient") * (machine.inertia + added) * STANDARD_GRAVITY
    fields = {}
    for kind, values in effects.items():
        if kind in ON_COMMAND:
            continue
        if kind not in EFFECTS:
            raise ValueError(f"The stepper has no effect {kind!r}; it has {sorted(EFFECTS)}.")
        names = EFFECTS[kind]
        if kind == "velocity_hysteresis":  # the same both ways where nothing else is said
            values.setdefault("level_negative", values["level"])
        if kind == "load_friction":
            values.setdefault("back", values["coefficient"])
        if set(values) != set(names):
            raise ValueError(f"{kind} takes {sorted(names)}, got {sorted(values)}.")
        fields |= {names[name]: float(value) for name, value in values.items()}
    total = machine.inertia + fields.pop("mass", 0.0)
    return kernel.Physics(
        mass=float(total),
        weight=float(machine.gravity_force * total / machine.inertia),
        gain=float(machine.actuator_gain * fields.pop("gain", 1.0)),
        clock=float(machine.clock_force[0]),
        clock_frequency=float(machine.clock_force[1]),
        **fields,
    )


def control_law(loop: Loop) -> kernel.Law:
    """Flatten a loop into the kernel's fields."""
    if loop.kind not in KINDS:
        raise ValueError(f"The stepper has no controller {loop.kind!r}; it has {sorted(KINDS)}.")
    pulses = {name: float(value) for name, value in (loop.disturbance or {}).items()}
    gains = {
        name: float(getattr(loop, name))
        for name in ("kp", "kv", "ki", "kd", "derivative_filter", "limit", "coulomb", "viscous", "inertia")
    }
    average, windup = int(loop.velocity_average), bool(loop.anti_windup)
    return kernel.Law(kind=KINDS[loop.kind], average=average, anti_windup=windup, **gains, **pulses)


def reached(reference: np.ndarray, machine: Machine, rate: float) -> np.ndarray:
    """Return what reaches the law of a reference [m], behind delay, lag and limits of the command.

    The delayed reference is joined by lines; the lag is the low-pass y[k] = a r[k] + (1 - a) y[k-1] that has
    settled at the first reference, with a = h / (T + h). A limited velocity moves to the reference by at most
    that much a tick. See `profile` for a limited acceleration.
    """
    delay, constant = (
        machine.effects.get(kind, {}).get(ON_COMMAND[kind], 0.0) for kind in ("command_delay", "command_lag")
    )
    t = np.arange(len(reference)) / rate
    out = np.interp(t - delay, t, reference)
    a = 1.0 / (1.0 + constant * rate)
    lagged = scipy.signal.lfilter([a], [1.0, a - 1.0], out - out[0]) + out[0]
    fastest = machine.effects.get("velocity_limit", {}).get("limit", np.inf) / rate
    slow = [lagged[0]]
    for goal in lagged[1:]:
        slow.append(min(max(goal, slow[-1] - fastest), slow[-1] + fastest))
    limit = machine.effects.get("acceleration_limit", {}).get("limit")
    return np.asarray(slow) if limit is None else profile(np.asarray(slow), limit, rate)


def profile(target: np.ndarray, limit: float, rate: float) -> np.ndarray:
    """Return the course that follows a target, held from tick to tick, with a limited acceleration.

    It is bang-bang: it pushes towards the target until only full braking stops there, and then brakes. From
    rest at the first target; integrated in steps of a small part of a tick.
    """
    h = 1.0 / rate / PROFILE_STEPS
    out, x, v = np.empty(len(target)), float(target[0]), 0.0
    for k, goal in enumerate(target):
        out[k] = x
        for _ in range(PROFILE_STEPS):
            away = goal - x
            if abs(away) < limit * h**2 and abs(v) < 2 * limit * h:
                x, v = goal, 0.0
                break
            ahead = away - v * abs(v) / (2 * limit)
            a = limit if ahead > 0 else -limit
            x, v = x + h * (v + 0.5 * h * a), v + h * a
    return out


def first_samples(values: np.ndarray | None, count: int, what: str) -> np.ndarray:
    """Return the first `count` samples as a fresh array of floats.

    Raises:
        ValueError: If there are fewer.
    """
    if values is None or len(values) < count:
        have = 0 if values is None else len(values)
        raise ValueError(
            f"{count} samples of {what} are needed, got {have}: lengthen it or shorten duration."
        )
    return np.array(values[:count], dtype=float)


def simulate(
    machine: Machine,
    loop: Loop,
    sensor: Sensor,
    *,
    rate: float,
    duration: float,
    seed: int = 0,
    step: float = 5e-6,
    log_rate: float | None = None,
    initial_position: float = 0.0,
    initial_velocity: float = 0.0,
) -> dict[str, np.ndarray]:
    """Run the axis and return its log with the truth behind it.

    Args:
        machine: What moves.
        loop: What gives the command.
        sensor: What is read.
        rate: Ticks of the controller, or samples of the input [Hz].
        duration: Length of the log, its last sample excluded [s].
        seed: Of the sensor's noise.
        step: Longest integration step [s]; each tick takes a whole number of equal steps.
        log_rate: Rows a second in the log [Hz]; divides `rate`, default the same.
        initial_position: True position at t = 0 [m].
        initial_velocity: True velocity at t = 0 [m/s].

    Returns:
        t [s], position [m] and force [unit of command] as logged, reference
        [m] (zero in open loop), and noise-free true_position, true_velocity,
        true_acceleration, true_command and true_force (at the load, after the
        drive's effects [N]), the last three just after the tick.

    Raises:
        ValueError: If samples are missing or `log_rate` does not divide `rate`.
    """
    count, every = round(duration * rate), round(rate / (log_rate or rate))
    if abs(every * (log_rate or rate) - rate) > 1e-6 * rate:
        raise ValueError(f"log_rate must divide rate ({rate} Hz), got {log_rate} Hz.")
    if loop.hold not in ("zero_order", "linear"):
        raise ValueError(f"hold is zero_order or linear, got {loop.hold!r}.")
    is_open = loop.kind == "open_loop"
    u = first_samples(loop.input, count, "input") if is_open else np.zeros(count)
    reference = np.zeros(count) if is_open else first_samples(loop.reference, count, "reference")
    width = machine.effects.get("dead_band", {}).get("width", 0.0)
    law = control_law(loop)._replace(dead_band=float(width))
    random = np.random.default_rng(seed)
    noise = sensor.position_noise * random.standard_normal(count)
    force_noise = sensor.force_noise * random.standard_normal(count)
    bursts = np.array(machine.bursts, dtype=float).reshape(-1, 3)
    reading, truth = np.zeros(count), np.zeros((count, 4))
    kernel.run(
        physics(machine), law, u, is_open and loop.hold == "linear",
        reached(reference, machine, rate), bursts, noise, float(sensor.position_resolution),
        1.0 / rate, float(step),
        float(initial_position), float(initial_velocity), reading, truth, np.zeros(2),
    )  # fmt: skip
    log = {
        "t": np.arange(count) / rate,
        "position": reading,
        "force": u + force_noise,
        "reference": reference,
    }
    log |= dict(
        zip(
            ("true_position", "true_velocity", "true_acceleration", "true_force"),
            truth.T,
            strict=True,
        )
    )
    log["true_command"] = u
    return {name: values[::every].copy() for name, values in log.items()}


def write_csv(log: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Write what a user would have: time, reading, command and reference, without the truth."""
    columns = np.column_stack([log[name] for name in ("t", "position", "force", "reference")])
    np.savetxt(path, columns, delimiter=",", header="t,q,u,ref", comments="", fmt="%.12g")
