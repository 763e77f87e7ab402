"""The six masses of the experiment, the case's controller in the loop of the exact chain."""

import functools
from pathlib import Path

import numpy as np
from chain_stepper import ChainMachine, simulate_under
from stepper import Sensor

from jaxid.io.case import load_case
from jaxid.io.log import Log
from jaxid.live import Live
from jaxid.machine import build_machine

CASE = Path(__file__).parent.parent / "experiments" / "cases" / "chain6.toml"
KINDS = {"mass": 0.01, "stiffness": 0.01, "damping": 0.05, "coulomb_friction": 0.05}


def text(**changes: str) -> str:
    """The case, with some of its lines replaced: `poles="[-9.0, -9.0]"`."""
    out = CASE.read_text()
    for key, value in changes.items():
        line = next(line for line in out.splitlines() if line.startswith(f"{key} = "))
        out = out.replace(line, f"{key} = {value}")
    return out


def true_values() -> dict[str, float]:
    return {f.name: f.true for f in build_machine(load_case(CASE)).parameters.free}


def machine() -> ChainMachine:
    values = true_values()
    of = lambda kind: [v for name, v in values.items() if name.startswith(kind)]
    levels = enumerate(of("coulomb_friction"), start=1)
    effects = {("coulomb_friction", k): {"level": v} for k, v in levels}
    return ChainMachine(of("mass"), of("damping"), of("stiffness"), effects)


def driven(live: Live, seconds: float, noise: float = 0.0) -> tuple[Log, dict]:
    """A log of the exact chain under a controller that is called tick by tick, and the truth."""
    ran = simulate_under(
        machine(), lambda k, reading: live.command(reading), Sensor(0.0, noise),
        rate=1 / live.period, duration=seconds,
    )  # fmt: skip
    reference = live.reference[: len(ran["t"])]
    return Log(ran["t"], ran["position"], ran["force"], reference=reference, source="six masses"), ran


@functools.cache
def first_instants() -> Log:
    """The first 0.1 s at 1 kHz, without noise."""
    return driven(Live(CASE), 0.1)[0]


def errors(names: list[str], theta: np.ndarray) -> dict[str, float]:
    """Largest relative error of each kind."""
    true = true_values()
    out = dict.fromkeys(KINDS, 0.0)
    for name, value in zip(names, theta, strict=True):
        kind = next(k for k in KINDS if name.startswith(k))
        out[kind] = max(out[kind], abs(value / true[name] - 1))
    return out
