"""Quantities derived from an estimate, with standard deviations: friction coefficients, frequencies."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.dynamics.frequencies import natural_frequencies
from jaxid.estimators.estimate import Estimate
from jaxid.model.plant import Plant
from jaxid.model.unknowns import effect_name

# Parameter of a friction that states its level as a coefficient.
_COEFFICIENT = "friction_coefficient"


@dataclass(frozen=True)
class Derived:
    """A quantity that is a function of the unknowns.

    Args:
        name: Name in the results.
        value: Value at the estimate.
        std: Standard deviation by the delta method; NaN if an unknown in it is not identifiable.
        unit: Label of the unit.
    """

    name: str
    value: float
    std: float
    unit: str


def dry_friction(estimate: Estimate) -> list[Derived]:
    """Return the level of each dry friction that is given by its coefficient, and the reverse.

    The normal force is that of the plant, its weight m g, because the coefficient is defined by it.
    """
    machine, out = estimate.machine, []
    plant = machine.plant
    q = jnp.zeros(plant.joints)
    for k, effect in enumerate(plant.effects):
        name = effect_name(_before(plant, k), effect)
        level = effect.sliding_level
        # Skip friction laws that have no coefficient as an alternative to the level.
        if level is None or not hasattr(effect, _COEFFICIENT):
            continue
        if not float(plant.port_normal(q)[effect.port]) > 0:
            continue
        by_level = getattr(effect, level) is not None

        def other(theta: Array, k: int = k, by_level: bool = by_level, level: str = level) -> Array:
            moved = machine.parameters.insert(plant, theta)
            friction = moved.effects[k]
            normal = moved.port_normal(q)[friction.port]
            return getattr(friction, level) / normal if by_level else getattr(friction, _COEFFICIENT) * normal

        value, slope = jax.value_and_grad(other)(jnp.asarray(estimate.theta))
        used = np.flatnonzero(np.asarray(slope))
        if not used.size:
            continue
        part = np.asarray(slope)[used]
        covariance = estimate.precision.covariance[np.ix_(used, used)]
        force = machine.units.label("force", plant.motion(plant.effects[k].port))
        field, unit = (_COEFFICIENT, "1") if by_level else (level, force)
        std = float(np.sqrt(part @ covariance @ part))
        out.append(Derived(f"{name}.{field}", float(value), std, unit))
    return out


def natural_frequency(estimate: Estimate) -> list[Derived]:
    """Return the highest natural frequency [Hz] of a plant with a spring, with its joints free."""
    plant, parameters = estimate.machine.plant, estimate.machine.parameters
    rigid = plant.load is None and not any(e.adds_spring for e in plant.effects)
    if rigid or any(e.opens_spring for e in plant.effects):
        return []
    modes = natural_frequencies(plant, parameters.places, estimate.theta)
    std = modes.std(estimate.precision.covariance)
    return [
        Derived("natural_frequency", float(f), float(s), "Hz")
        for f, s in zip(modes.hz[-1:], std[-1:], strict=True)
    ]


def _before(plant: Plant, k: int) -> Plant:
    """Return the plant with its first k effects, which determine the number in the next one's name."""
    return eqx.tree_at(lambda p: p.effects, plant, plant.effects[:k])
