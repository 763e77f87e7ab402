"""Inertia of a link as the balance of forces gives it, held against the link's declared mass."""

from __future__ import annotations

import numpy as np

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.plants.link_tree import LinkTree

# Standard deviations by which an inertia must be below the least one that is possible.
_SIGMAS = 5.0
# Parameters of a link that, with its mass, bound its inertia about the axis of its joint from below.
_FIXED = ("mass", "first_moment_x", "first_moment_y")


def least_inertia(plant: Plant, link: int) -> float:
    """Return the inertia of a link's mass at its centre of mass, about the axis of its joint [kg m^2].

    Args:
        plant: An arm.
        link: Index of the link, from 0.
    """
    mass, x, y = (float(np.asarray(getattr(plant, name))[link]) for name in _FIXED)
    return (x**2 + y**2) / mass if mass > 0 else 0.0


def weight_findings(machine: Machine, log: Log, fit: BalanceFit) -> list[Finding]:
    """Find links whose inertia is surely below that of their declared mass at its centre of mass.

    Args:
        machine: The machine; links whose mass or first moment is unknown have no such bound.
        log: The log.
        fit: Balance of the prepared log.
    """
    plant = machine.plant
    if not isinstance(plant, LinkTree) or not fit.counts.any():
        return []
    unknown = set(machine.parameters.names)
    names = [f.name for f in fit.unknowns]
    values, residual = fit.fit(bounded=False)
    std = fit.precision(values, residual).std
    findings = []
    for link in range(plant.mass.size):
        turning = f"inertia_zz[{link + 1}]"
        if turning not in names or any(f"{name}[{link + 1}]" in unknown for name in _FIXED):
            continue
        least, k = least_inertia(plant, link), names.index(turning)
        if not values[k] + _SIGMAS * std[k] < least:
            continue
        unit = machine.unit("inertia", link)
        what = (
            f"least squares gives {turning} = {values[k]:.3g} +- {std[k]:.1g} {unit}, below {least:.3g} "
            f"{unit}, the inertia of the link's declared mass at its centre of mass"
        )
        hint = "check mass and first_moment, and the unit and gain of the force"
        findings.append(Finding("warning", what, f"{log.source}, [[plant.links]] {link + 1}", hint))
    return findings
