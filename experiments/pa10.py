"""The PA-10: what an arm's torques tell, friction compensation, the dominant-inertia method and its failure.

"PA-10 traineeship": a joint is let go under a law that compensates its friction, K_p q is added, and the
inertia is read off the period of what swings. The joint, the first, is an exact-friction simulator that
shares no code with jaxid; its friction crosses the report's K_d = -12 at 1.2 rad/s, as theirs did.

    python -m experiments.pa10 [-o FOLDER] [--only NAME]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxid
from experiments import pa10_arm, pa10_configurations, pa10_drive, pa10_figures
from experiments.common import Table, run_studies
from experiments.pa10_joint import (
    COULOMB,
    CROSSING,
    EXACT,
    FAST,
    FASTEST,
    INERTIA,
    JOINT,
    NOISE,
    RATE,
    SITUATIONS,
    VISCOUS,
    case_text,
    law,
    released,
    settled,
    swinging,
    unknown,
)
from jaxid.arms.dominant_inertia import of_swing
from jaxid.logs.log import Log
from truth.axis.stepper import Loop, Machine, Sensor, simulate
from truth.chain.stepper import ChainMachine, simulate_chain

# Table C.I: joint, and viscous and Coulomb friction forwards and backwards.
TABLE = {
    2: (3.57, 14.26, 7.64, 18.25),
    3: (1.64, 3.27, 1.70, 4.15),
    4: (2.58, 6.93, 2.89, 4.95),
    5: (1.61, 3.75, 1.64, 3.64),
    7: (0.27, 0.82, 0.21, 1.23),
}


def frictions(folder: Path) -> None:
    """Table C.I from trapezoids of velocity: plateau means as the report, and jaxid on the whole log."""
    start = time.perf_counter()
    table = Table(
        "Table C.I: f_v, f_c forwards and backwards; by means of plateaus, and by `identify`",
        ["joint", "true", "plateaus", "identify", "off by sigma"],
    )
    logs = {}
    for joint, (vp, cp, vn, cn) in TABLE.items():
        effects = {
            "viscous_friction": {"coefficient": (vp + vn) / 2},
            "asymmetric_viscous": {"coefficient": (vp - vn) / 2},
            "coulomb_friction": {"level": (cp + cn) / 2},
            "constant_force": {"level": -(cp - cn) / 2},
        }
        reference, speed = plateaus()
        loop = Loop("pd", reference=reference, kp=2000.0, kd=120.0)
        made = simulate(
            Machine(0.5, effects),
            loop,
            NOISE,
            rate=RATE,
            duration=len(reference) / RATE,
            seed=joint,
            step=2e-5,
        )
        log = Log(time=made["t"], position=made["position"], force=made["force"], source=f"joint {joint}")
        means = by_means(speed, made["force"])
        (folder / f"friction{joint}.toml").write_text(FRICTION)
        found = jaxid.identify(folder / f"friction{joint}.toml", log, method="inverse_dynamics").estimate
        # From sums and differences to either way; sigma likewise.
        names = (
            "viscous_friction.coefficient",
            "asymmetric_viscous.coefficient",
            "coulomb_friction.level",
            "constant_force.level",
        )
        index = [found.names.index(n) for n in names]
        ways = np.array([[1, 1, 0, 0], [0, 0, 1, -1], [1, -1, 0, 0], [0, 0, 1, 1]])
        values = ways @ found.theta[index]
        std = np.sqrt(np.diag(ways @ found.precision.covariance[np.ix_(index, index)] @ ways.T))
        off = (values - TABLE[joint]) / std
        show = lambda x: ", ".join(f"{v:.2f}" for v in x)
        table.row(joint, show(TABLE[joint]), show(means), show(values), ", ".join(f"{o:+.1f}" for o in off))
        logs[joint] = (speed, made["force"], TABLE[joint], values)
    table.show(time.perf_counter() - start)
    pa10_figures.frictions(folder / "frictions.png", logs)


FRICTION = case_text(
    unknown(2.0),
    {
        "viscous_friction": {"coefficient": unknown(1.0)},
        "asymmetric_viscous": {"coefficient": unknown(0.0)},
        "coulomb_friction": {"level": unknown(1.0)},
        "constant_force": {"level": unknown(0.0)},
    },
)


def plateaus() -> tuple[np.ndarray, np.ndarray]:
    """Return a reference of trapezoids of velocity up to the fastest, each way, and its velocity."""
    parts = []
    for top in np.linspace(0.1, FASTEST, 8):
        ramp = np.linspace(0.0, top, 200, endpoint=False)
        hill = np.concatenate([ramp, np.full(1000, top), top - ramp])
        parts += [hill, -hill]
    speed = np.concatenate(parts)
    return np.concatenate([[0.0], np.cumsum(speed)[:-1]]) / RATE, speed


def by_means(speed: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Fit as the report does: the mean torque of every plateau, and a line through those of a direction."""
    flat = np.flatnonzero(np.diff(speed) == 0)
    pieces = np.split(flat, np.flatnonzero(np.diff(flat) > 1) + 1)
    points = np.array([(speed[p[0]], torque[p[len(p) // 3 :]].mean()) for p in pieces if len(p) > 500])
    out = []
    for side in (1.0, -1.0):
        v, tau = points[np.sign(points[:, 0]) == side].T
        out += np.polyfit(np.abs(v), side * tau, 1).tolist()
    return np.array(out)


def situations(folder: Path) -> None:
    """Velocity that remains after a start, in the four situations: figures 5.12 to 5.15."""
    start = time.perf_counter()
    grid = np.linspace(0.1, 1.1, 11)
    curves = {}
    for name in SITUATIONS:
        runs = [released(name, v) for v in grid]
        curves[name] = np.array([_until(r) for r in runs])
        pa10_figures.velocities(folder / f"released_{name}.png", name, runs, FASTEST)
    table = Table(
        "velocity that remains [rad/s] after one at the start; at 1.2 the joint is at its limit",
        ["", *[f"{v:.1f}" for v in grid]],
    )
    for name, values in curves.items():
        table.row(name, *[f"{v:.3f}" for v in values])
    low, high = 0.1, 1.1
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        gains = _until(released("s3", middle, duration=40.0)) > middle
        low, high = (low, middle) if gains else (middle, high)
    table.show(time.perf_counter() - start)
    print(
        f"crossing: parts the starts of s3 at {low:.4f}, what remains of s4 at {curves['s4'].mean():.4f}; "
        f"(f_c - f~_c) / (f~_v - f_v) = {CROSSING} rad/s"
    )
    pa10_figures.settled(folder / "settled.png", grid, curves)


def _until(log: dict[str, np.ndarray]) -> float:
    """Velocity at the end, or the fastest if the joint gets there."""
    v = log["true_velocity"]
    return FASTEST if v.max() >= FASTEST else float(v[-1])


def limit_cycle(folder: Path) -> None:
    """Show the limit cycle of situation s4 with a spring: its amplitude, and the effect of sampling."""
    start = time.perf_counter()
    table = Table(
        "amplitude [rad] in s4 after starts of 0.8, 1 and 3 times the analytic (4/pi) v_a sqrt(I/K_p)",
        ["K_p [N m/rad]", "analytic", "at 20 kHz", "over analytic", "at 1 kHz", "over analytic"],
    )
    for kp in (200.0, 400.0, 800.0):
        expected = 4 / np.pi * CROSSING * np.sqrt(INERTIA / kp)
        row = []
        for rate in (FAST, RATE):
            ends = [settled(swinging(kp, f * expected, rate=rate))[0] for f in (0.8, 1.0, 3.0)]
            row += [", ".join(f"{a:.4f}" for a in ends), f"{np.max(ends) / expected:.3f}"]
        table.row(f"{kp:.0f}", f"{expected:.4f}", *row)
    table.show(time.perf_counter() - start)
    pa10_figures.angles(folder / "limit_cycle.png", [swinging(400.0, q, duration=15.0) for q in (0.05, 0.2)])


STIFF = (100.0, 200.0, 400.0, 800.0, 1600.0)


def dominant(folder: Path) -> None:
    """Figure 5.9: I_d = K_p T^2 / 4 pi^2 against K_p, and what bends it."""
    start = time.perf_counter()
    static = JOINT.with_effect("static_friction", level=3.0)
    lopsided = JOINT.with_effect("constant_force", level=1.5)
    lopsided = lopsided.with_effect("asymmetric_viscous", coefficient=0.8)
    variants: dict[str, Callable[[float], dict[str, np.ndarray]]] = {
        "Coulomb and viscous, 20 kHz": lambda kp: swinging(kp, 0.3, rate=FAST),
        "sampled at 1 kHz": lambda kp: swinging(kp, 0.3),
        "+ static friction 3 N m": lambda kp: swinging(kp, 0.3, machine=static),
        "+ asymmetry": lambda kp: swinging(kp, 0.3, machine=lopsided),
        "+ velocity of 20 samples": lambda kp: swinging(kp, 0.3, velocity_average=20),
        "+ flexible joint 3000 N m/rad": lambda kp: flexible(kp, 3000.0),
    }
    table = Table(
        "I_d = K_p T^2 / 4 pi^2 over the inertia, by K_p [N m/rad]; at rest: it sticks",
        ["", *[f"{k:.0f}" for k in STIFF], "spread"],
    )
    curves = {}
    for name, run in variants.items():
        values = np.array([of_swing(kp, settled(run(kp))[1]) for kp in STIFF]) / INERTIA
        curves[name] = values
        told = [f"{v:.4f}" if np.isfinite(v) else "at rest" for v in values]
        table.row(name, *told, f"{100 * (np.nanmax(values) - np.nanmin(values)):.1f} %")
    table.show(time.perf_counter() - start)
    pa10_figures.dominant(folder / "dominant.png", STIFF, curves)


def flexible(kp: float, stiffness: float) -> dict[str, np.ndarray]:
    """Fit the joint with half of its inertia behind a spring; friction and encoder are at the motor."""
    machine = ChainMachine(
        [INERTIA / 2, INERTIA / 2],
        [0.0, 0.0],
        [0.0, stiffness, 0.0],
        {("viscous_friction", 1): {"coefficient": VISCOUS}, ("coulomb_friction", 1): {"level": COULOMB}},
        actuated=[1],
        coupling=[0.0, 2.0, 0.0],
    )
    duration = 40.0
    loop = replace(law("s4", kp=kp), reference=np.zeros(round(duration * RATE)))
    return simulate_chain(
        machine, [loop], EXACT, rate=RATE, duration=duration, step=5e-5, initial_position=0.3
    )


VISCOUS_ONLY = {"viscous_friction": {"coefficient": unknown(12.0)}}
DRY = VISCOUS_ONLY | {"coulomb_friction": {"level": unknown(2.0)}}
SWUNG = {
    "kind": "friction_compensation",
    "kp": 400.0,
    "kd": 0.0,
    "coulomb": 10.1,
    "viscous": 3.0,
    "period": 1 / RATE,
}


def same_logs(folder: Path) -> None:
    """Identify the log of a swing by other methods, and search it from viscous friction alone."""
    start = time.perf_counter()
    # Read finely: what the reading's noise does in the loop's difference would shake the joint.
    made = swinging(400.0, 0.3, duration=8.0, sensor=Sensor(position_noise=1e-7, force_noise=0.2), step=5e-6)
    keys = dict(position="position", force="force", reference="reference")
    log = Log(time=made["t"], **{k: made[v] for k, v in keys.items()}, source="the swing")
    (folder / "swing.toml").write_text(case_text(unknown(6.0), DRY, controller=SWUNG))
    table = Table("from one log of a swing, K_p = 400", ["", "inertia", "Coulomb", "viscous"])
    table.row("true", INERTIA, COULOMB, VISCOUS)
    table.row("K_p T^2 / 4 pi^2", f"{of_swing(400.0, settled(made)[1]):.4f}", "", "")
    for method in ("inverse_dynamics", "output_error"):
        found = jaxid.identify(folder / "swing.toml", log, method=method)
        e = found.estimate
        cell = lambda n, e=e: f"{e.theta[e.names.index(n)]:.4f} +- {e.std[e.names.index(n)]:.2g}"
        table.row(method, *map(cell, ("inertia", "coulomb_friction.level", "viscous_friction.coefficient")))
    table.show(time.perf_counter() - start)
    (folder / "viscous_only.toml").write_text(case_text(unknown(6.0), VISCOUS_ONLY, controller=SWUNG))
    found = jaxid.discover(folder / "viscous_only.toml", log)
    found.save(folder / "viscous_only", overwrite=True)
    print(
        f"\ntold of viscous friction only: {found.verdict}: {', '.join(found.kinds)}"
        f" ({time.perf_counter() - start:.1f} s)\n{found}"
    )


def tracking(folder: Path) -> None:
    """Figure 5.6: tracking with friction and inertia fed forward as identified from plateaus, and without."""
    start = time.perf_counter()
    reference, speed = plateaus()
    run = lambda loop: simulate(
        JOINT,
        replace(loop, reference=reference, kp=300.0, kd=30.0),
        NOISE,
        rate=RATE,
        duration=len(reference) / RATE,
        step=2e-5,
    )
    plain = run(Loop("friction_compensation"))
    log = Log(time=plain["t"], position=plain["position"], force=plain["force"], source="plateaus")
    (folder / "tracking.toml").write_text(FRICTION)
    found = jaxid.identify(folder / "tracking.toml", log, method="inverse_dynamics")
    friction = {
        "coulomb": found.value("coulomb_friction.level"),
        "viscous": found.value("viscous_friction.coefficient"),
    }
    runs = {
        "PD": plain,
        "and friction": run(Loop("friction_compensation", **friction)),
        "and inertia": run(Loop("friction_compensation", inertia=found.value("inertia"), **friction)),
    }
    table = Table("tracking error [mrad]", ["", "RMS", "largest", "RMS of PD over it"])
    errors = {name: 1e3 * (r["reference"] - r["true_position"]) for name, r in runs.items()}
    rms = {name: np.sqrt(np.mean(e**2)) for name, e in errors.items()}
    for name, e in errors.items():
        table.row(name, f"{rms[name]:.3f}", f"{np.abs(e).max():.2f}", f"{rms['PD'] / rms[name]:.1f}")
    table.show(time.perf_counter() - start)
    pa10_figures.tracking(folder / "tracking.png", plain["t"], errors)


STUDIES: dict[str, Callable[[Path], None]] = {
    f.__name__: f
    for f in (
        pa10_arm.dependencies,
        pa10_arm.excitation,
        pa10_arm.identification,
        frictions,
        situations,
        limit_cycle,
        dominant,
        pa10_configurations.configurations,
        same_logs,
        tracking,
        pa10_drive.drive,
    )
}


if __name__ == "__main__":
    run_studies(__doc__, "results/pa10", STUDIES)
