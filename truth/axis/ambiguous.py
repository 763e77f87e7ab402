"""Exact axes whose logs cannot separate two effects."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from truth.axis import machines
from truth.axis.cases import Declared
from truth.axis.machines import Setup
from truth.axis.stepper import Loop

VISCOUS = ("viscous_friction", {"coefficient": 203.5})
COULOMB = ("coulomb_friction", {"level": 20.39})
OFFSET = ("constant_force", {"level": 3.0})
SPRING = ("linear_stiffness", {"coefficient": 3000.0})
WIDER = "[limits]\nstroke = [0.0, 0.25]\nspeed = 0.15\n"


def hidden(
    kind: str, values: Mapping[str, float], declared: Declared, reference: np.ndarray, noise: float
) -> Setup:
    """Build an axis with one effect that its case does not declare, under a reference."""
    own = machines.emps_like(0, noise, len(reference) / 1000.0)
    effects = {name: dict(v) for name, v in declared} | {kind: dict(values)}
    machine = dataclasses.replace(own.machine, effects=effects)
    return dataclasses.replace(own, machine=machine, loop=dataclasses.replace(own.loop, reference=reference))


def curved(seconds: float = 8.0) -> tuple[Setup, Declared]:
    """Hide a progressive spring on an axis that moves by 2 cm, over which two curvatures look equal.

    Two degrees of polynomial differ by 400 N/m^2 times (1 cm)^2, a tenth of the noise.
    """
    declared = (VISCOUS, COULOMB, OFFSET)
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    reference = machines.moves(t, (0.19, 0.21), (0.04, 0.03, 0.02, 0.04), 0.4)
    return hidden("quadratic_stiffness", {"coefficient": 400.0}, declared, reference, 30.0), declared


def one_speed(seconds: float = 8.0) -> tuple[Setup, Declared]:
    """Hide friction that differs by direction on an axis with one speed, at which it is a constant force."""
    declared = (VISCOUS, COULOMB)
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    reference = machines.moves(t, (0.1, 0.2), (0.05, 0.05), 2.0)
    return hidden("asymmetric_viscous", {"coefficient": 20.0}, declared, reference, 30.0), declared


def heavier(seconds: float = 4.0) -> tuple[Setup, Declared]:
    """Hide a load: a mass, or a drive that is weaker than the case says."""
    declared = (VISCOUS, COULOMB)
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    reference = machines.moves(t, machines.EMPS_WAYPOINTS, machines.EMPS_SPEEDS, 0.8424)
    return hidden("added_mass", {"mass": 15.0}, declared, reference, 1.0), declared


def sprung(seconds: float = 4.0) -> tuple[Setup, Declared]:
    """Shake an axis on a spring in open loop, at one frequency."""
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    loop = Loop(kind="open_loop", input=2.0 * np.sin(2 * np.pi * 1.0 * t))
    own = hidden("quadratic_drag", {"coefficient": 3000.0}, (VISCOUS, SPRING), t, 10.0)
    return dataclasses.replace(own, loop=loop), (VISCOUS, SPRING)


def again(setup: Setup, values: np.ndarray, start: float, seed: int = 5) -> dict[str, np.ndarray]:
    """Run the true machine under another reference, or input in open loop, from a position."""
    changed = {"input" if setup.loop.kind == "open_loop" else "reference": values}
    loop = dataclasses.replace(setup.loop, **changed)
    moved = dataclasses.replace(setup, loop=loop, seed=seed, duration=len(values) / setup.rate)
    return moved.run(initial_position=start)


def started(setup: Setup) -> float:
    """Return the first value of a setup's reference, 0 in open loop."""
    return 0.0 if setup.loop.reference is None else float(setup.loop.reference[0])
