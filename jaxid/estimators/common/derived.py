"""What follows from an estimate, with its sigma: friction in its other form, natural frequency."""

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


@dataclass(frozen=True)
class Derived:
    """A quantity that is a function of the unknowns.

    Args:
        name: As in results.
        value: At the estimate.
        std: By the delta method; NaN where an unknown in it cannot be told.
        unit: Label.
    """

    name: str
    value: float
    std: float
    unit: str


def dry_friction(estimate: Estimate) -> list[Derived]:
    """Of every Coulomb friction the level where its coefficient is a parameter, and the reverse.

    The normal force is the plant's own, m g: a weight, by which a coefficient has its meaning.
    """
    machine, out = estimate.machine, []
    plant = machine.plant
    q = jnp.zeros(plant.joints)
    for k, effect in enumerate(plant.effects):
        name = effect_name(_before(plant, k), effect)
        level = effect.sliding_level
        # Only a law that may be stated either way has the other way to be derived.
        if level is None or not hasattr(effect, "friction_coefficient"):
            continue
        if not float(plant.port_normal(q)[effect.port]) > 0:
            continue
        by_level = getattr(effect, level) is not None

        def other(theta: Array, k: int = k, by_level: bool = by_level, level: str = level) -> Array:
            moved = machine.parameters.insert(plant, theta)
            own = moved.effects[k]
            normal = moved.port_normal(q)[own.port]
            return getattr(own, level) / normal if by_level else own.friction_coefficient * normal

        value, slope = jax.value_and_grad(other)(jnp.asarray(estimate.theta))
        used = np.flatnonzero(np.asarray(slope))
        if not used.size:
            continue
        part = np.asarray(slope)[used]
        covariance = estimate.precision.covariance[np.ix_(used, used)]
        field, unit = ("friction_coefficient", "1") if by_level else (level, machine.units.label("force"))
        std = float(np.sqrt(part @ covariance @ part))
        out.append(Derived(f"{name}.{field}", float(value), std, unit))
    return out


def natural_frequency(estimate: Estimate) -> list[Derived]:
    """Of an axis with an elastic coupling, declared or found: the fastest swing, nothing held [Hz]."""
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
    """The plant with its first k effects: by these the next is numbered."""
    return eqx.tree_at(lambda p: p.effects, plant, plant.effects[:k])
