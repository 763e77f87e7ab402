"""What follows from an estimate, with its sigma: friction in its other form, natural frequency."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxid.estimators.result import Estimate
from jaxid.model import Plant
from jaxid.parameters import effect_name
from jaxid.readings import State, derivative


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
        if effect.kind != "coulomb_friction" or not float(plant.port_normal(q)[effect.port]) > 0:
            continue
        by_level = effect.level is not None

        def other(theta: Array, k: int = k, by_level: bool = by_level) -> Array:
            moved = machine.parameters.insert(plant, theta)
            own = moved.effects[k]
            normal = moved.port_normal(q)[own.port]
            return own.level / normal if by_level else own.friction_coefficient * normal

        value, slope = jax.value_and_grad(other)(jnp.asarray(estimate.theta))
        used = np.flatnonzero(np.asarray(slope))
        if not used.size:
            continue
        part = np.asarray(slope)[used]
        covariance = estimate.precision.covariance[np.ix_(used, used)]
        field, unit = ("friction_coefficient", "1") if by_level else ("level", machine.units.label("force"))
        std = float(np.sqrt(part @ covariance @ part))
        out.append(Derived(f"{name}.{field}", float(value), std, unit))
    return out


def natural_frequency(estimate: Estimate) -> list[Derived]:
    """Of an axis with an elastic coupling, declared or found: the fastest swing, nothing held [Hz].

    Eigenvalues of the plant linearised at rest, dry friction and damping of no account: their size.
    Source of the slope: first-order perturbation, y' dA x / y' x with left and right eigenvectors.
    """
    plant, parameters = estimate.machine.plant, estimate.machine.parameters
    kinds = {e.kind for e in plant.effects}
    if plant.load is None and "joint_flexibility" not in kinds or "backlash" in kinds:
        return []
    theta = jnp.asarray(estimate.theta)
    matrix = lambda theta: _rates(parameters.insert(plant, theta))
    a, slopes = np.asarray(matrix(theta)), np.asarray(jax.jacfwd(matrix)(theta))
    if not np.all(np.isfinite(a)):
        return []
    values, left, right = scipy.linalg.eig(a, left=True)
    k = int(np.argmax(np.where(np.abs(values.imag) > np.abs(values.real), np.abs(values), 0.0)))
    if abs(values[k].imag) <= abs(values[k].real):
        return []
    y, x = left[:, k].conj(), right[:, k]
    moves = np.einsum("i,ijp,j->p", y, slopes, x) / (y @ x)
    slope = np.real(np.conj(values[k]) * moves) / abs(values[k]) / (2 * np.pi)
    used = np.flatnonzero(np.abs(slope * estimate.theta) > 1e-9 * abs(values[k]))
    covariance = estimate.precision.covariance[np.ix_(used, used)]
    std = float(np.sqrt(slope[used] @ covariance @ slope[used]))
    return [Derived("natural_frequency", float(abs(values[k]) / (2 * np.pi)), std, "Hz")]


def _rates(plant: Plant) -> Array:
    """State matrix at rest, dry friction left out."""
    u = jnp.zeros(len(plant.driven(plant.joints)))
    zero = jnp.zeros(plant.joints)
    flat, back = ravel_pytree(State(zero, zero, plant.initial_states(u)))
    none = jnp.zeros_like(plant.ports(zero))
    rates = lambda x: ravel_pytree(derivative(plant, back(x), u, jnp.zeros(()), none))[0]
    return jax.jacfwd(rates)(flat)


def _before(plant: Plant, k: int) -> Plant:
    """The plant with its first k effects: by these the next is numbered."""
    return eqx.tree_at(lambda p: p.effects, plant, plant.effects[:k])
