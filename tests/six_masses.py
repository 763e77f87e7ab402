"""The six masses of the experiment, or a case like theirs, its controller in the loop of the exact chain.

Shared by the tests and `experiments/wi_mimo_coulomb.py`.
"""

import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np
from chain_stepper import ChainMachine, simulate_under
from stepper import Sensor

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.commands.live import Live
from jaxid.estimators.algebraic.online import OnlineEstimate
from jaxid.logs.log import Log

CASE = Path(__file__).parent.parent / "experiments" / "cases" / "chain6.toml"
# What is asked of each kind of parameter, relative.
KINDS = {"mass": 0.01, "stiffness": 0.01, "damping": 0.05, "coulomb_friction": 0.05}


class Driven(NamedTuple):
    """A run of the exact chain: what a person would have of it, and the truth behind it.

    Attributes:
        log: Readings, commands and references.
        live: The controller that ran.
        told: What it was told on-line at every tick; None where nothing was.
        position, velocity: True ones, (time, n).
    """

    log: Log
    live: Live
    told: list[OnlineEstimate | None]
    position: np.ndarray
    velocity: np.ndarray


def text(**changes: str) -> str:
    """The case, with some of its lines replaced: `poles="[-9.0, -9.0]"`."""
    out = CASE.read_text()
    for key, value in changes.items():
        line = next(line for line in out.splitlines() if line.startswith(f"{key} = "))
        out = out.replace(line, f"{key} = {value}")
    return out


def true_values(case: Path = CASE) -> dict[str, float]:
    """By name."""
    return {f.name: f.true for f in build_machine(load_case(case)).parameters.free}


def machine(case: Path = CASE, actuated: list[int] | None = None) -> ChainMachine:
    """The exact simulator's machine with the case's true values."""
    values = true_values(case)
    of = lambda kind: [v for name, v in values.items() if name.startswith(kind)]
    levels = enumerate(of("coulomb_friction"), start=1)
    effects = {("coulomb_friction", k): {"level": v} for k, v in levels}
    return ChainMachine(of("mass"), of("damping"), of("stiffness"), effects, actuated)


def driven(
    case: Path,
    seconds: float,
    *,
    identify: bool = False,
    noise: float = 0.0,
    seed: int = 0,
    on: ChainMachine | None = None,
) -> Driven:
    """The case's controller called tick by tick on the exact chain, `on` in place of the case's own.

    Noise of the readings [m] goes through the loop: the controller sees what the log holds.
    """
    live, told = Live(case, identify=identify), []

    def law(_: int, reading: np.ndarray) -> np.ndarray:
        u = live.command(reading)
        told.append(live.online_estimate)
        return u

    ran = simulate_under(
        on or machine(case), law, Sensor(0.0, noise), rate=1 / live.period, duration=seconds, seed=seed
    )
    reference = live.reference[: len(ran["t"])]
    log = Log(ran["t"], ran["position"], ran["force"], reference=reference, source="exact simulator")
    return Driven(log, live, told, ran["true_position"], ran["true_velocity"])


@functools.cache
def first_instants() -> Log:
    """The first 0.1 s at 1 kHz, without noise."""
    return driven(CASE, 0.1).log


def errors(names: list[str], theta: np.ndarray) -> dict[str, float]:
    """Largest relative error of each kind."""
    true = true_values()
    out = dict.fromkeys(KINDS, 0.0)
    for name, value in zip(names, theta, strict=True):
        kind = next(k for k in KINDS if name.startswith(k))
        out[kind] = max(out[kind], abs(value / true[name] - 1))
    return out
