"""The micropositioning stage of Bogdan and Abba on the exact chain: its log, and its case.

Truth is Table 1 of "Identification of mechanical parameters at low velocities for a micropositioning stage
using a velocity hysteresis model" in SI. As printed it contradicts itself: read here with k_e in mN m/A, a
pitch of 2 mm, velocities in rev/s, K_l in 1e9 N/m (as printed it would carry the table's friction after
487 rad), C_p in N m at the motor, B_t in N s/rad. It runs on the set-valued chain of `truth.chain.stepper` in
the coordinate of the table: what turns is a mass J / R^2.

Gains of the loop and the ramp of the reference are not published; those here are chosen:
5 Hz, damped, and just fast enough that the short move of data 2 begins within half a second.
"""

from pathlib import Path

import numpy as np

from truth.axis.stepper import Loop, Sensor
from truth.chain.stepper import ChainMachine, simulate_chain

RATE = 200.0  # Hz
PITCH = 2e-3  # m
R = PITCH / (2 * np.pi)  # m/rad
COUNT = 2 * np.pi / 500  # rad
GAIN = 45.5e-3  # N m/A
LAG = 40e-6  # s
TURN = 2 * np.pi
LAW = {"kp": 1.0, "ki": 12.0, "kd": 0.03, "derivative_filter": 0.01}


def _table(j, bm, fm, mt, bt, ft, cs1, cs2, vs, kl, cp, psi) -> dict[str, float]:
    """Return a column of Table 1 in SI, by the names of a case."""
    return {
        "motor_inertia": j,
        "viscous_friction[1].coefficient": bm,
        "coulomb_friction[1].level": fm,
        "table_mass": mt / 1e3,
        "viscous_friction[2].coefficient": bt / R,
        "coulomb_friction[2].level": ft,
        "velocity_hysteresis[2].level": cs1,
        "velocity_hysteresis[2].level_negative": cs2,
        "velocity_hysteresis[2].velocity": vs * PITCH,
        "stiffness": kl * 1e9,
        "cogging[2].amplitude": cp / R,
        "cogging[2].phase": psi,
    }


TRUTH = {
    1: _table(1.44e-5, 0.65e-4, 5.31e-3, 417, 0.85e-5, 7.79, 2.23, 1.12, 0.5, 1.60e-2, 0.11e-3, -5.83e-2),
    2: _table(1.49e-5, 0.70e-4, 6.80e-3, 422, 0.77e-5, 9.77, 2.88, 1.08, 0.48, 1.36e-2, 0.12e-3, -6.73e-2),
}
# Of the table, in m and m/s; the published criterion (11), percent; the onset and the ramp are chosen.
MOVES = {
    1: {"distance": 0.3e-3, "speed": 0.4 * PITCH, "onset": 0.03},
    2: {"distance": 0.015e-3, "speed": 0.2 * PITCH, "onset": 0.03},
}
CRITERION = {1: 8.70, 2: 5.35}
RAMP = 0.05  # s
_RISING = ("level", "level_negative", "velocity")


def machine(data: int = 1, rigid: bool = False, **changed: float) -> ChainMachine:
    """Build the stage of one column of Table 1; entries by their names there."""
    p = TRUTH[data] | changed
    motor, table = p["motor_inertia"] / R**2, p["table_mass"]
    effects = {
        ("actuator_lag", 1): {"time_constant": LAG},
        ("velocity_hysteresis", 2): {k: p[f"velocity_hysteresis[2].{k}"] for k in _RISING},
        ("cogging", 2): {
            "amplitude": p["cogging[2].amplitude"],
            "period": PITCH,
            "phase": p["cogging[2].phase"],
        },
    }
    dry = [p["coulomb_friction[1].level"] / R, p["coulomb_friction[2].level"]]
    viscous = [p["viscous_friction[1].coefficient"] / R**2, p["viscous_friction[2].coefficient"]]
    if rigid:
        one = {(kind, 1): values for (kind, _), values in effects.items()}
        one[("coulomb_friction", 1)] = {"level": sum(dry)}
        return ChainMachine((motor + table,), (sum(viscous),), (0.0, 0.0), one, actuator_gain=GAIN / R)
    effects |= {("coulomb_friction", k): {"level": dry[k - 1]} for k in (1, 2)}
    return ChainMachine(
        (motor, table),
        tuple(viscous),
        (0.0, p["stiffness"], 0.0),
        effects,
        actuated=(1,),
        actuator_gain=GAIN / R,
    )


def move(duration: float, distance: float, speed: float, onset: float, ramp: float = RAMP) -> np.ndarray:
    """Return the position of the motor [rad] for a trapezoidal velocity of the table, one value a tick."""
    ramp = min(ramp, distance / speed)
    cruise = distance / speed - ramp
    t = np.arange(round(duration * RATE)) / RATE - onset
    up = np.clip(t, 0.0, ramp)
    down = np.clip(t - ramp - cruise, 0.0, ramp)
    way = speed * (up**2 / (2 * ramp) + np.clip(t - ramp, 0.0, cruise) + down - down**2 / (2 * ramp))
    return way / R


def record(
    stage: ChainMachine,
    reference: np.ndarray,
    *,
    noise: float = 0.0,
    resolution: float = COUNT,
    start: float = 0.0,
    seed: int = 0,
    step: float = 5e-6,
) -> dict[str, np.ndarray]:
    """Simulate the stage in its loop: t, q [rad], x [m], i [A] through noise [A], ref [rad], and the truth.

    `start` [rad] is where the motor truly stands at first: anywhere within the count that reads zero.
    """
    gains = {k: v if k == "derivative_filter" else v / R for k, v in LAW.items()}
    loop = Loop("pid", reference=reference * R, limit=5.0, **gains)
    log = simulate_chain(
        stage,
        [loop],
        Sensor(resolution * R, 0.0, noise),
        rate=RATE,
        duration=len(reference) / RATE,
        seed=seed,
        step=step,
        initial_position=start * R,
    )
    return {
        "t": log["t"],
        "q": log["position"][:, 0] / R,
        "x": log["true_position"][:, -1],
        "i": log["force"][:, 0],
        "ref": reference,
        "true_q": log["true_position"][:, 0] / R,
        "true_i": log["true_command"][:, 0],
    }


def write(log: dict[str, np.ndarray], path, columns: tuple[str, ...] = ("t", "q", "i", "ref")) -> None:
    """Write columns of a log as CSV."""
    table = np.column_stack([log[c] for c in columns])
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.12g")


def text(
    data: int = 1,
    *,
    guess: dict[str, float] | None = None,
    known: tuple[str, ...] = (),
    coupling: str = "rigid",
    reference: str = 'reference = "ref"',
    resolution: float = COUNT,
    more: str = "",
    load: bool = True,
) -> str:
    """Return the case file: everything unknown, guesses at the truth unless others are given.

    `load`: an elastic stage's log has the position of the table.
    """
    truth = {k: v for k, v in TRUTH[data].items() if coupling == "elastic" or k != "stiffness"}
    guess = truth | (guess or {})

    def entry(name: str) -> str:
        if name in known:
            return repr(float(truth[name]))
        return f"{{ guess = {float(guess[name])!r}, true = {float(truth[name])!r} }}"

    def effect(kind: str, joint: str, *lines: str) -> list[str]:
        return ["[[effects]]", f'kind = "{kind}"', *([f"joint = {joint}"] if joint else []), *lines]

    def both(key: str) -> str:
        kind, field = key.split(".")
        return f"{field} = [{entry(f'{kind}[1].{field}')}, {entry(f'{kind}[2].{field}')}]"

    def own(kind: str, *names: str) -> list[str]:
        return [f"{n} = {entry(f'{kind}[2].{n}')}" for n in names]

    plant = ["motor_inertia", "table_mass", *(["stiffness"] if coupling == "elastic" else [])]
    lines = [
        "[plant]",
        'kind = "micropositioning_stage"',
        f'coupling = "{coupling}"',
        "[plant.parameters]",
        f"pitch = {PITCH}",
        *[f"{n} = {entry(n)}" for n in plant],
        *effect("actuator_lag", "1", f"time_constant = {LAG}"),
        *effect("coulomb_friction", "", both("coulomb_friction.level")),
        *effect("viscous_friction", "", both("viscous_friction.coefficient")),
        *effect("velocity_hysteresis", "2", *own("velocity_hysteresis", *_RISING)),
        *effect("cogging", "2", f"period = {PITCH}", *own("cogging", "amplitude", "phase")),
        "[actuator]",
        f"gain = {GAIN}",
        "[log]",
        'time = "t"',
        'position = "q"',
        'force = "i"',
        reference,
        *(['load_position = "x"'] if coupling == "elastic" and load else []),
        "[controller]",
        'kind = "pid"',
        *[f"{k} = {v}" for k, v in LAW.items()],
        f"period = {1 / RATE}",
        "limit = 5.0",
        *(["[sensor]", f"position_resolution = {resolution!r}"] if resolution else []),
        more,
    ]
    return "\n".join(lines) + "\n"


def combined(p: dict[str, float]) -> dict[str, float]:
    """Return the sums, at the motor, to which a rigid coupling reduces pairs of parameters."""
    return {
        "inertia": p["motor_inertia"] + R**2 * p["table_mass"],
        "dry": p["coulomb_friction[1].level"] + R * p["coulomb_friction[2].level"],
        "viscous": p["viscous_friction[1].coefficient"] + R**2 * p["viscous_friction[2].coefficient"],
    }


def drawn(seed: int, spread: float = 0.5, data: int = 1) -> dict[str, float]:
    """Draw guesses uniformly about the truth, up to a relative spread."""
    rng = np.random.default_rng(seed)
    return {k: v * (1 + spread * rng.uniform(-1, 1)) for k, v in TRUTH[data].items()}


def believed(seed: int, width: float = 0.5, data: int = 1) -> dict[str, float]:
    """Draw guesses from a log-normal prior of a relative width about the truth; the phase as in `drawn`."""
    rng, uniform = np.random.default_rng(seed), drawn(seed, width, data)
    off = {k: np.exp(width * rng.standard_normal()) for k in TRUTH[data]}
    return {k: uniform[k] if k.endswith("phase") else v * off[k] for k, v in TRUTH[data].items()}


def to_and_fro(seconds: float = 20.0) -> np.ndarray:
    """Return a motion at many speeds [rad] whose strokes have more than two turns, to show a ripple."""
    t = np.arange(round(seconds * RATE)) / RATE
    tones = zip((0.3, 0.7, 1.3), (1.0, 0.5, 0.12), (0.0, 1.0, 2.0), strict=True)
    return TURN * sum(a * (np.sin(2 * np.pi * f * t + p) - np.sin(p)) for f, a, p in tones)


def one_way(seconds: float = 20.0) -> np.ndarray:
    """Return a motion in one direction, at speeds that rise and fall [rad]."""
    t = np.arange(round(seconds * RATE)) / RATE
    speed = 4 + 4 * np.sin(2 * np.pi * 0.3 * t) + 2 * np.sin(2 * np.pi * 0.9 * t)
    return np.cumsum(np.maximum(speed, 0.0) * np.minimum(t, 1.0)) / RATE


def long_case(folder: Path, reference: np.ndarray) -> tuple[Path, Path]:
    """Write a finely read log, and a case without the physics of its table.

    The motor's viscous and Coulomb friction are declared, and its current loop.
    """
    fine = 2 * np.pi / 1e6
    log = record(machine(1, rigid=True), reference, noise=1e-3, resolution=fine, seed=1)
    write(log, folder / "hidden.csv")
    whole = text(1, resolution=fine)
    lines = [
        "[plant]",
        'kind = "micropositioning_stage"',
        'coupling = "rigid"',
        "[plant.parameters]",
        f"pitch = {PITCH}",
        "table_mass = 0.417",
        "motor_inertia = { guess = 1e-5 }",
        "[[effects]]",
        'kind = "actuator_lag"',
        "joint = 1",
        f"time_constant = {LAG}",
        "[[effects]]",
        'kind = "coulomb_friction"',
        "joint = 1",
        "level = { guess = 5e-3 }",
        "[[effects]]",
        'kind = "viscous_friction"',
        "joint = 1",
        "coefficient = { guess = 1e-4 }",
    ]
    (folder / "hidden.toml").write_text("\n".join(lines) + "\n" + whole[whole.index("[actuator]") :])
    return folder / "hidden.toml", folder / "hidden.csv"
