"""The flexible ball-screw axis of Janot et al. on the exact chain: its log, and its case.

Truth is Table 2 of "Experimental joint stiffness identification depending on measurements availability", on
the set-valued chain of `truth.chain.stepper`: two masses, a spring and a damper between.
"""

import dataclasses
from pathlib import Path

import numpy as np

from truth.axis.stepper import Loop, Sensor
from truth.chain.stepper import ChainMachine, simulate_chain

RATE = 1000.0
COUNT = 5e-3 / 100_000  # m: a lead of 5 mm, 100 000 counts a revolution
TRUTH = {
    "motor_inertia": 72.3,
    "load_inertia": 34.8,
    "stiffness": 8.0e5,
    "damping": 126.0,
    "viscous_friction[1].coefficient": 92.0,
    "viscous_friction[2].coefficient": 110.0,
    "coulomb_friction[1].level": 10.0,
    "coulomb_friction[2].level": 10.4,
}
# The wrong values from which every fit starts.
GUESS = {
    "motor_inertia": 50.0,
    "load_inertia": 60.0,
    "stiffness": 4e5,
    "damping": 300.0,
    "viscous_friction[1].coefficient": 200.0,
    "viscous_friction[2].coefficient": 40.0,
    "coulomb_friction[1].level": 4.0,
    "coulomb_friction[2].level": 25.0,
}
SENSOR = Sensor(position_resolution=COUNT, position_noise=0.5 * COUNT, force_noise=0.1)
GAIN = 35.15  # N/V
LAW = {"kp": 100.0, "kv": 250.0, "velocity_average": 2}
PULSES = {"level": 4.0, "on": 0.5, "off": 0.5, "start": 0.3405}  # V, between ticks


def machine(**changed: float) -> ChainMachine:
    """Build the axis of Table 2; entries by their names there."""
    p = TRUTH | changed
    return ChainMachine(
        (p["motor_inertia"], p["load_inertia"]),
        tuple(p[f"viscous_friction[{k}].coefficient"] for k in (1, 2)),
        (0.0, p["stiffness"], 0.0),
        {("coulomb_friction", k): {"level": p[f"coulomb_friction[{k}].level"]} for k in (1, 2)},
        actuated=(1,),
        actuator_gain=GAIN,
        coupling=(0.0, p["damping"], 0.0),
    )


def trapezoids(
    duration: float, stroke: float = 0.2, speed: float = 0.2, acceleration: float = 2.0, dwell: float = 0.2
) -> np.ndarray:
    """Return a motion to and fro with trapezoidal velocity, one value a tick [m]."""
    ramp = speed / acceleration
    cruise = stroke / speed - ramp
    corners = np.cumsum([0.0, ramp, cruise, ramp, dwell])
    t = np.arange(round(duration * RATE)) / RATE
    within, trips = np.mod(t, corners[-1]), np.floor(t / corners[-1])
    velocity = np.interp(within, corners, [0.0, speed, speed, 0.0, 0.0])
    return np.cumsum(np.where(trips % 2 == 0, velocity, -velocity)) / RATE


def record(
    axis: ChainMachine | None = None,
    *,
    duration: float = 8.0,
    reference: np.ndarray | None = None,
    pulses: dict[str, float] | None = PULSES,
    law: dict[str, float] = LAW,
    sensor: Sensor = SENSOR,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Simulate the axis in its loop; return the log of `simulate_chain`."""
    axis = machine() if axis is None else axis
    reference = trapezoids(duration) if reference is None else reference
    loop = Loop("cascade_pd", reference=reference, disturbance=pulses, limit=10.0, **law)
    return simulate_chain(axis, [loop], sensor, rate=RATE, duration=duration, seed=seed)


def columns(log: dict[str, np.ndarray], noise: float = 0.01) -> dict[str, np.ndarray]:
    """Return the columns t, q, q_load, a_load (through so much noise [m/s^2]), u, ref of a user's log."""
    accelerometer = noise * np.random.default_rng(len(log["t"])).standard_normal(len(log["t"]))
    return {
        "t": log["t"],
        "q": log["position"][:, 0],
        "q_load": log["position"][:, 1],
        "a_load": log["true_acceleration"][:, 1] + accelerometer,
        "u": log["force"][:, 0],
        "ref": log["reference"][:, 0],
    }


def write(log: dict[str, np.ndarray], path: Path, noise: float = 0.01) -> None:
    """Write those columns as CSV."""
    table = columns(log, noise)
    np.savetxt(
        path,
        np.column_stack([*table.values()]),
        delimiter=",",
        header=",".join(table),
        comments="",
        fmt="%.12g",
    )


def text(
    *,
    load: bool = True,
    known: dict[str, float] | None = None,
    guess: dict[str, float] = GUESS,
    pulses: dict[str, float] | None = PULSES,
    law: dict[str, float] = LAW,
    sensor: Sensor = SENSOR,
    offset: bool = False,
    accelerometer: bool = False,
    joints: tuple[int, ...] = (1, 2),
    effects: str = "",
    true: dict[str, float] = TRUTH,
) -> str:
    """Return the case file: all of the axis unknown except what is given as known.

    Args:
        load, accelerometer: Whether the load's encoder, and its acceleration, are in the log.
        known: Values that are given.
        guess: Where the others start.
        pulses, law: Of the loop, as in `record`.
        sensor: As far as it is not exact.
        offset: Whether the second encoder has an unknown one.
        joints: With friction.
        effects: More of them, as text.
        true: True values of what is unknown.
    """
    known = known or {}

    def entry(name: str) -> str:
        return repr(known[name]) if name in known else f"{{ guess = {guess[name]}, true = {true[name]} }}"

    of_plant = ("motor_inertia", "load_inertia", "stiffness", "damping")
    lines = ["[plant]", 'kind = "flexible_axis"', "[plant.parameters]"]
    lines += [f"{name} = {entry(name)}" for name in of_plant]
    lines += ["zero_offset = { guess = 0.0 }"] if offset else []
    for kind, key in (("viscous_friction", "coefficient"), ("coulomb_friction", "level")):
        for k in joints:
            value = entry(f"{kind}[{k}].{key}")
            lines += ["[[effects]]", f'kind = "{kind}"', f"joint = {k}", f"{key} = {value}"]
    lines += [effects, "[actuator]", f"gain = {GAIN}", "[log]", 'time = "t"', 'position = "q"', 'force = "u"']
    lines += ['reference = "ref"'] + (['load_position = "q_load"'] if load else [])
    lines += ['load_acceleration = "a_load"'] if accelerometer else []
    lines += ["[controller]", 'kind = "cascade_pd"', *[f"{k} = {v}" for k, v in law.items()], "limit = 10.0"]
    if pulses:
        lines += ["disturbance = { " + ", ".join(f"{k} = {v}" for k, v in pulses.items()) + " }"]
    told = [f"{f.name} = {v}" for f in dataclasses.fields(sensor) if (v := getattr(sensor, f.name)) > 0]
    lines += ["[sensor]", *told] if told else []
    return "\n".join(lines) + "\n"


def rigid_text(sensor: Sensor = SENSOR) -> str:
    """Return a case that takes the axis for one inertia, and reads the motor alone."""
    motor = text(load=False, sensor=sensor)
    return RIGID + motor[motor.index("[actuator]") :]


RIGID = """[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 60.0 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 100.0 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 40.0 }
"""
