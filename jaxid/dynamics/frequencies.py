"""Natural frequencies of a plant about rest, with their slopes in the unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter

# Relative to the square of the highest frequency, below this one is that of a rigid motion.
_RIGID = 1e-9
# Relative to its largest term, a slope below this is rounding of terms that cancel.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Modes:
    """Natural frequencies, lowest first, without rigid motions.

    Args:
        hz: The frequencies [Hz], (modes,).
        slopes: Their derivatives in the unknowns, (modes, p).
    """

    hz: Float[np.ndarray, " modes"]
    slopes: Float[np.ndarray, "modes p"]

    def std(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " modes"]:
        """Return the standard deviations [Hz]; NaN for a mode with an unknown that has none."""
        known = np.isfinite(np.diag(covariance))
        inner = np.where(np.outer(known, known), covariance, 0.0)
        std = np.sqrt(np.maximum(np.einsum("mi,ij,mj->m", self.slopes, inner, self.slopes), 0.0))
        return np.where(np.any((self.slopes != 0) & ~known, axis=1), np.nan, std)


def natural_frequencies(
    plant: Plant, places: tuple, theta: Float[np.ndarray, " p"], held: tuple[int, ...] = ()
) -> Modes:
    """Compute the natural frequencies of a plant about rest without friction: the size of its eigenvalues.

    Dry friction and damping of the joints are left out: damping changes the size of a weakly damped mode
    only in the second order, but a strongly damped mode would be lost, and guesses of damping may be far
    off. Damping among the effects' internal states stays; beside a single spring it does not change the size.

    Args:
        plant: The plant with its effects.
        places: Places of its unknowns (`Parameters.places`).
        theta: Values of the unknowns.
        held: Joints that are held still.

    Source:
        First-order perturbation for the slopes: y' dA x / y' x with left and right eigenvectors.
    """
    a, slopes = (np.asarray(x) for x in _matrix(plant, places, np.asarray(theta), held))
    if not (a.size and np.all(np.isfinite(a))):
        return Modes(np.zeros(0), np.zeros((0, len(theta))))
    values, left, right = (np.asarray(x) for x in scipy.linalg.eig(a, left=True))
    size = np.abs(values)
    swings = np.imag(values) > np.abs(np.real(values))
    swings &= size**2 > _RIGID * np.max(size[swings] ** 2, initial=0.0)
    at = np.flatnonzero(swings)[np.argsort(size[swings])]
    y, x, direction = left[:, at].conj(), right[:, at], values[at].conj() / size[at]
    per = 2 * np.pi * np.sum(y * x, axis=0)
    slope = np.real(np.einsum("im,ijp,jm->mp", y, slopes, x) * (direction / per)[:, None])
    largest = np.einsum("im,ijp,jm->mp", *(np.abs(k) for k in (y, slopes, x))) / np.abs(per)[:, None]
    return Modes(size[at] / (2 * np.pi), np.where(np.abs(slope) > _ROUNDING * largest, slope, 0.0))


@eqx.filter_jit
def _matrix(plant: Plant, places: tuple, theta: Array, held: tuple[int, ...]) -> tuple[Array, Array]:
    """Compute the state matrix, (s, s), and its slopes in the unknowns, (s, s, p)."""

    def matrix(theta: Array) -> tuple[Array, Array]:
        a = _state_matrix(scatter(places, plant, theta), held)
        return a, a

    slopes, a = jax.jacfwd(matrix, has_aux=True)(theta)
    return a, slopes


def _state_matrix(plant: Plant, held: tuple[int, ...]) -> Float[Array, "s s"]:
    """Compute the state matrix at rest: positions and velocities of the free joints, and internal states."""
    free = np.asarray([i for i in range(plant.joints) if i not in held], dtype=int)
    n, u = len(free), jnp.zeros(len(plant.driven(plant.joints)))
    internal, back = ravel_pytree(plant.initial_states(u))
    no_friction = jnp.zeros_like(plant.ports(jnp.zeros(plant.joints)))

    def balance(q: Array, v: Array, a: Array, internal: Array) -> tuple[Array, Array]:
        q, v, a = (jnp.zeros(plant.joints).at[free].set(x) for x in (q, v, a))
        b = plant.balance(q, v, a, u, jnp.zeros(()), back(jnp.asarray(internal)), no_friction)
        return b.residual[free], ravel_pytree(b.rates)[0]

    zero = jnp.zeros(n)
    forces, rates = jax.jacfwd(balance, argnums=(0, 1, 2, 3))(zero, zero, zero, internal)
    by_q, _, mass, by_own = forces
    # Without the column of the velocities, which is the damping.
    a_q, a_own = (-jnp.linalg.solve(mass, x) for x in (by_q, by_own))
    return jnp.block(
        [
            [jnp.zeros((n, n)), jnp.eye(n), jnp.zeros((n, internal.size))],
            [a_q, jnp.zeros((n, n)), a_own],
            [rates[0] + rates[2] @ a_q, rates[1], rates[3] + rates[2] @ a_own],
        ]
    )
