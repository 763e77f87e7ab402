"""Study of the PA-10's drive chain, chapter 5: amplifier, torque constant, supply and what they limit."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import jaxid
from experiments import pa10_figures
from experiments.common import Table
from experiments.pa10_joint import COULOMB, FASTEST, RATE, VISCOUS, case_text, unknown
from jaxid.logs.log import Log
from truth.axis.machines import moves
from truth.axis.stepper import Loop, Machine, Sensor, simulate

# Table 5.1: rated torque [N m] and torque constant [N m/A]; and table 5.2 as printed, whose first is 0.766.
RATED = {"1, 2": (5.3, 0.692, 0.776), "3, 4": (2.0, 0.501, 0.399), "5, 6, 7": (0.36, 0.0831, 0.433)}
TORQUE_CONSTANT = RATED["1, 2"][1]
AMPLIFIER = RATED["1, 2"][0] / TORQUE_CONSTANT / 10  # A/V, (5.1)
# Not in the report, chosen: reduction, resistance [ohm], part of its gain that the amplifier has, its
# offset [V], and the first joint's inertia with the arm stretched out [kg m^2].
REDUCTION, RESISTANCE, ACTUAL, OFFSET, INERTIA = 50.0, 2.0, 0.85, 0.25, 6.0
# As in the report: the amplifier's input [V], and supplies [V].
INPUT, SUPPLIES = 10.0, (24.0, 48.0)
CONSTANT = REDUCTION * TORQUE_CONSTANT  # N m/A at the joint, and V s/rad
DECLARED = CONSTANT * AMPLIFIER  # N m/V
KP, KD = 300.0, 12.0  # V/rad and V s/rad
SENSOR = Sensor(position_noise=1e-5, force_noise=1e-3)


def machine(supply: float) -> Machine:
    """Return the first joint with its drive, for an exact stepper."""
    stiff = ACTUAL * DECLARED
    return Machine(
        INERTIA,
        {
            "viscous_friction": {"coefficient": VISCOUS},
            "coulomb_friction": {"level": COULOMB},
            "actuator_gain": {"gain": ACTUAL},
            "actuator_offset": {"level": stiff * OFFSET},
            "saturation": {"limit": stiff * INPUT},
            "voltage_limit": {"stall": CONSTANT * supply / RESISTANCE, "velocity": supply / CONSTANT},
        },
        actuator_gain=DECLARED,
    )


def moved(supply: float, limit: float = INPUT) -> dict[str, np.ndarray]:
    """Drive the joint to and fro, harder and faster than the smaller supply allows, for 20 s."""
    return led(supply, limit, 0, 20.0, 100.0, 1.5)


def led(
    supply: float, limit: float, seed: int, duration: float, acceleration: float, fastest: float
) -> dict[str, np.ndarray]:
    """Move the joint from place to place at speeds up to the fastest [rad/s]."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * RATE)) / RATE
    points = rng.uniform(0.05, 0.4, 24) * np.where(np.arange(24) % 2, 1.0, -1.0)
    reference = moves(t, points, rng.uniform(0.15, fastest, 24), acceleration, rest=0.1)
    loop = Loop("pd", reference=reference - reference[0], kp=KP, kd=KD, limit=limit)
    return simulate(machine(supply), loop, SENSOR, rate=RATE, duration=duration, seed=seed, step=1e-5)


def drive(folder: Path) -> None:
    """Show the effects of the amplifier's offset and input and of the supply; identify all from one log."""
    start = time.perf_counter()
    table = Table("Table 5.2: A_g = T_r / (10 V K_T) [A/V]", ["joint", "computed", "printed"])
    for joint, (torque, constant, printed) in RATED.items():
        table.row(joint, f"{torque / constant / 10:.3f}", f"{printed:.3f}")
    table.show(time.perf_counter() - start)
    table = Table(
        "led hard: torque at the joint [N m], time with command and offset beyond 10 V, fastest [rad/s]",
        ["supply", "command within", "largest", "smallest", "beyond", "fastest", "no load"],
    )
    runs = {}
    for supply in SUPPLIES:
        for limit in (INPUT, 9.7):
            runs[supply, limit] = log = moved(supply, limit)
            clips = np.abs(log["true_command"] + OFFSET) > INPUT
            table.row(
                f"{supply:.0f} V",
                f"{limit:.1f} V",
                f"{log['true_force'].max():.1f}",
                f"{log['true_force'].min():.1f}",
                f"{100 * clips.mean():.2f} %",
                f"{np.abs(log['true_velocity']).max():.3f}",
                f"{supply / CONSTANT:.3f}",
            )
    table.show(time.perf_counter() - start)
    pa10_figures.supplies(folder / "supplies.png", runs, FASTEST)
    chain(folder)
    hidden(folder)


def log_of(run: dict[str, np.ndarray], source: str) -> Log:
    """Return the log of a run, with the columns of a user."""
    return Log(run["t"], run["position"], run["force"], reference=run["reference"], source=source)


def chain(folder: Path) -> None:
    """Identify the whole chain from one log at the smaller supply, with a known inertia.

    The amplifier's input is not told: an offset of 0.25 V exceeds it in few samples, and by 2 %. With its
    guess at 180 N m, below the truth, `output_error` ends elsewhere altogether.
    """
    start = time.perf_counter()
    supply = SUPPLIES[0]
    run = moved(supply)
    (folder / "drive.toml").write_text(case_of(DECLARED, INERTIA, CHAIN))
    true = machine(supply).effects
    table = Table(
        "the chain from one log, as the case has it, and as the report does",
        ["", "true", "inverse_dynamics", "output_error"],
    )
    fits = [
        jaxid.identify(folder / "drive.toml", log_of(run, "moves"), method=m)
        for m in ("inverse_dynamics", "output_error")
    ]
    for name in fits[0].estimate.names:
        kind, _, parameter = name.partition(".")
        std = [f.estimate.std[f.estimate.names.index(name)] for f in fits]
        cells = [f"{f.value(name):.4f} +- {s:.2g}" for f, s in zip(fits, std, strict=True)]
        cells = [c if np.isfinite(s) else "not identified" for c, s in zip(cells, std, strict=True)]
        table.row(name, f"{true[kind][parameter]:.4f}", *cells)
    physical = [_physical(f.value) for f in fits]
    truths = (ACTUAL * AMPLIFIER, OFFSET, supply, RESISTANCE)
    names = ("amplifier [A/V]", "its offset [V]", "supply [V]", "resistance [ohm]")
    for row in zip(names, truths, *physical, strict=True):
        table.row(row[0], *[f"{x:.4f}" for x in row[1:]])
    table.show(time.perf_counter() - start)


def _physical(value) -> tuple[float, ...]:
    """Return amplifier and supply by the parameters of the case."""
    stiff = value("actuator_gain.gain") * DECLARED
    supply = value("voltage_limit.velocity") * CONSTANT
    return (
        stiff / CONSTANT,
        value("actuator_offset.level") / stiff,
        supply,
        CONSTANT * supply / value("voltage_limit.stall"),
    )


def hidden(folder: Path) -> None:
    """Search for a hidden supply of 24 V in a gentler motion; the offset is unknown.

    In the hard motion, where a fourth of the commands saturate, it fails: with the offset hidden too it names
    the limit, but beside cubic friction and with a stall torque of 2010 N m in place of 415.
    """
    table = Table("hidden: a supply of 24 V", ["looks for", "verdict", "names", "s"])
    gain = ACTUAL * DECLARED
    told = case_of(gain, unknown(4.0), {**FRICTION, **BOUNDED, "saturation": {"limit": INPUT * gain}})
    start = time.perf_counter()
    runs = (led(SUPPLIES[0], INPUT, seed, 8.0, 15.0, 0.75) for seed in (0, 1))
    fit, other = (log_of(run, f"moves {seed}") for seed, run in enumerate(runs))
    for what, asked in (("the supply, too", ["voltage_limit"]), ("what it always does", [])):
        begun = time.perf_counter()
        more = f"[discover]\ncandidates = {asked}\n" if asked else ""
        (folder / "hidden.toml").write_text(told + more)
        found = jaxid.discover(folder / "hidden.toml", fit, validate=[other])
        found.save(folder / f"hidden{len(asked)}", overwrite=True)
        names = ", ".join(found.kinds)
        table.row(what, found.verdict, names, f"{time.perf_counter() - begun:.0f}")
        print(found)
    table.show(time.perf_counter() - start)


def case_of(gain: float, inertia: float | dict[str, float], effects: dict) -> str:
    """Return the case of the joint in its loop, with the gain of its drive declared [N m/V]."""
    law = {"kind": "pd", "kp": KP, "kd": KD, "limit": INPUT}
    sensor = {"position_noise": SENSOR.position_noise, "force_noise": SENSOR.force_noise}
    return case_text(inertia, effects, actuator={"gain": gain}, controller=law, sensor=sensor)


FRICTION = {
    "viscous_friction": {"coefficient": unknown(8.0)},
    "coulomb_friction": {"level": unknown(5.0)},
}
# The report's margin of 0.3 V bounds it. Without bounds a search pushes it into saturation: the drive is then
# a constant that constant_force cancels, a perfect fit to any log.
BOUNDED = {"actuator_offset": {"level": unknown(0.0, min=-6.7, max=6.7)}}
CHAIN = {
    **FRICTION,
    "actuator_gain": {"gain": unknown(1.0)},
    **BOUNDED,
    "saturation": {"limit": unknown(250.0)},
    "voltage_limit": {"stall": unknown(600.0), "velocity": unknown(0.9)},
}
