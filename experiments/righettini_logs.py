"""Identification from logs of the five-bar robot: orders of friction, payload, hidden effects."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import jaxid
from experiments import five_bar_robot as robots
from experiments import righettini_figures
from experiments.common import Table
from experiments.five_bar_robot import PD, Ran, driven, robot
from jaxid.logs.log import Log

# Noise of the torque in a log, at the motor [N m]; for how long the loop holds a command [s].
LOGGED, HELD = 0.02, 1e-3
SENSOR = f"[sensor]\nposition_resolution = {robots.COUNTS}\nforce_noise = {LOGGED}\n"


def log_of(ran: Ran, name: str) -> Log:
    """Return the log of a run by the encoders and drives."""
    rng = np.random.default_rng(5)
    q = np.round(ran.q / robots.COUNTS) * robots.COUNTS
    u = ran.command + LOGGED * rng.standard_normal(ran.command.shape)
    return Log(time=ran.time, position=q, force=u, reference=ran.live.reference[: len(q)], source=name)


def case_text(**stated: object) -> str:
    """Return a case of the loop that made the logs, which holds a command as long."""
    return robots.case_text(PD, inertial=False, period=HELD, **stated)


def logged(folder: Path, name: str, machine: object, seconds: float = 15.0, seed: int = 4) -> Log:
    """Return a log under the PD law at 1 kHz, whose commands a log at that rate holds whole."""
    path = folder / f"{name}.toml"
    path.write_text(case_text(friction="", gain=(1.0, 1.0), seed=seed, duration=seconds))
    live = jaxid.Live(path)
    ran = driven(live, machine, seed=seed, inertial=False, period=HELD)
    return log_of(ran, name)


MODELS = {
    1: ("all", 4),
    2: ("active", 4),
    3: ("active", 3),
    4: ("active", 2),
    5: ("active", 1),
}


def orders(folder: Path) -> None:
    """Table 4: what each model leaves (figure 5), and which one `discover` chooses by itself."""
    begin = time.perf_counter()
    log = logged(folder, "orders", robot())
    table = Table(
        "What models leave of the torque of the joints (figure 5)",
        ["model", "joints", "order", "unknowns", "left [N m]", "running residual, end [N m]"],
    )
    residuals = {}
    for number, (where, order) in MODELS.items():
        friction = robots.friction_text(order)
        if where == "all":
            friction += robots.friction_text(order, "passive = [1, 2, 3]")
        path = folder / f"model{number}.toml"
        path.write_text(case_text(friction=friction, more=RECURSIVE))
        found = jaxid.identify(path, log, method="recursive")
        left = residuals[f"({number})"] = found.gaps[0].force.rms
        running = found.estimate.details["recursive"]["running_residual"]
        table.row(
            number,
            where,
            order,
            len(found.estimate.names),
            ", ".join(f"{x:.3f}" for x in left),
            ", ".join(f"{x:.3f}" for x in np.ravel(running)),
        )
    table.show(time.perf_counter() - begin)
    righettini_figures.bars(folder / "orders.png", {"model": residuals}, "RMS residual [N m]")
    # The paper's future work, by machine: of friction of any order in any hinge, what made the log?
    path = folder / "chooses.toml"
    more = f"{SENSOR}[discover]\nkinds = {list(robots.ORDERS)}\n"
    path.write_text(case_text(friction=robots.friction_text(1), more=more))
    active = {k: np.array(v) * [1, 1, 0, 0, 0] for k, v in robots.FRICTION.items()}
    first = {k: v * (k in robots.ORDERS[:2]) for k, v in active.items()}
    hinge = {k: v + [0, 0, 0, 0, 0.5 * (k == "viscous_friction")] for k, v in active.items()}
    for name, friction in (("third", active), ("first", first), ("hinge", hinge)):
        log = logged(folder, name, robot(friction=friction))
        found = jaxid.discover(path, log, max_effects=8)
        found.save(folder / f"chosen_{name}", overwrite=True)
        print(f"\nfriction of the log: {name} ({time.perf_counter() - begin:.0f} s)\n{found}", flush=True)


RECURSIVE = "[recursive]\nhalf_life = 600.0\ngate_velocity = 0.05\n"


def payload(folder: Path) -> None:
    """Identify a mass at the tool while it moves, with gains of an unloaded run and with free gains."""
    begin = time.perf_counter()
    extra = 0.8
    bare = logged(folder, "bare", robot())
    loaded = logged(folder, "load", robot(tip_mass=2.72 + extra))
    path = folder / "unloaded.toml"
    path.write_text(case_text())
    gains = jaxid.identify(path, bare, method="inverse_dynamics").estimate.theta[:2].tolist()
    table = Table(f"A payload of {extra} kg", ["drive gains", "found [kg]", "sigma [kg]", "gains"])
    for name, gain in (("of the unloaded run", gains), ("free", "{ guess = 1.0 }")):
        path = folder / "loaded.toml"
        path.write_text(case_text(gain=gain, tip_mass="{ guess = 2.0 }"))
        estimate = jaxid.identify(path, loaded, method="inverse_dynamics").estimate
        at = estimate.names.index("tip_mass")
        free = isinstance(gain, str)
        shown = [estimate.value(f"actuator_gain[{k}].gain") for k in (1, 2)] if free else gain
        table.row(
            name,
            f"{estimate.theta[at] - 2.72:.4f}",
            f"{estimate.std[at]:.4f}",
            ", ".join(f"{g:.4f}" for g in shown),
        )
    table.show(time.perf_counter() - begin)


def hidden(folder: Path) -> None:
    """Search for friction on a passive joint, and for a payload."""
    begin = time.perf_counter()
    stated = robots.friction_text(3)
    passive = {k: list(v) for k, v in robots.FRICTION.items()}
    passive["viscous_friction"][3] = 0.5
    machine = robot(friction={k: np.array(v) for k, v in passive.items()})
    for name, hid in (("passive", machine), ("payload", robot(tip_mass=3.52))):
        log = logged(folder, name, hid)
        path = folder / f"hidden_{name}.toml"
        path.write_text(case_text(friction=stated, gain=robots.GAINS, more=SENSOR))
        found = jaxid.discover(path, log)
        found.save(folder / f"hidden_{name}", overwrite=True)
        print(f"\nhidden: {name} ({time.perf_counter() - begin:.0f} s)\n{found}", flush=True)
