"""The six masses of `wi_mimo_coulomb`, or a case like theirs, under its controller on the exact chain."""

import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.commands.live import Live
from jaxid.estimators.algebraic.online import OnlineEstimate
from jaxid.logs.log import Log
from truth.axis.stepper import Sensor
from truth.chain import six_masses
from truth.chain.stepper import ChainMachine, simulate_under

CASE = Path(__file__).parent / "cases" / "chain6.toml"


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
    """Return the case with some of its lines replaced: `poles="[-9.0, -9.0]"`."""
    out = CASE.read_text()
    for key, value in changes.items():
        line = next(line for line in out.splitlines() if line.startswith(f"{key} = "))
        out = out.replace(line, f"{key} = {value}")
    return out


def true_values(case: Path = CASE) -> dict[str, float]:
    """Return the true values by name."""
    return {f.name: f.true for f in build_machine(load_case(case)).parameters.free}


def machine(case: Path = CASE, actuated: list[int] | None = None) -> ChainMachine:
    """Return the machine of the exact simulator with the true values of the case."""
    return six_masses.machine(true_values(case), actuated)


def driven(
    case: Path,
    seconds: float,
    *,
    identify: bool = False,
    noise: float = 0.0,
    seed: int = 0,
    on: ChainMachine | None = None,
) -> Driven:
    """Call the controller of a case tick by tick on the exact chain, or on another one.

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
    """Return the log of the first 0.1 s at 1 kHz, without noise."""
    return driven(CASE, 0.1).log


def errors(names: list[str], theta: np.ndarray) -> dict[str, float]:
    """Largest relative error of each kind."""
    return six_masses.largest_errors(names, theta, true_values())
