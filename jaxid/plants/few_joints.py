"""Inverse dynamics of a chain of few joints by polynomials, whose coefficients are computed outside loops.

The points of a chain move with the sine and cosine of each revolute joint, and with the stroke of each
prismatic one, to the first degree. The mass matrix is therefore of the second degree in the coordinate of
each joint, and the weight of the first; the first joint moves the whole chain, so that the mass matrix does
not depend on it. The coefficients are linear in the inertial parameters.
"""

from __future__ import annotations

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.plants.geometry import Geometry
from jaxid.plants.rigid_tree import Tree, inverse_dynamics

# Joints up to which this is known to take less time than the recursion: coefficients are five times as many
# for each joint more.
MOST_JOINTS = 2


class FewJoints(eqx.Module):
    """Polynomials of the mass matrix and of the weight of a chain.

    Args:
        mass: Coefficients of the mass matrix, (n, n, k_2, ..., k_n) by `_powers` of the joints but the first.
        weight: Coefficients of the forces at rest, (n, k_1, ..., k_n).
        revolute: Whether each joint turns; otherwise it slides.
    """

    mass: Array
    weight: Array
    revolute: tuple[bool, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls, tree: Tree, geometry: Geometry, rise: Float[Array, "3"], bodies: Float[Array, "n 4 4"]
    ) -> FewJoints:
        """Compute the coefficients; see `inverse_dynamics` for the arguments."""
        zero = jnp.zeros(len(tree.revolute))

        def mass(q: Array) -> Array:
            force = lambda qdd: inverse_dynamics(tree, geometry, jnp.zeros(3), bodies, q, zero, qdd)
            return jax.jacfwd(force)(zero)

        def weight(q: Array) -> Array:
            return inverse_dynamics(tree, geometry, rise, bodies, q, zero, zero)

        first = np.zeros(1)
        second_degree = [first, *[_nodes(turns, 2) for turns in tree.revolute[1:]]]
        first_degree = [_nodes(turns, 1) for turns in tree.revolute]
        on_mass = _on_grid(mass, second_degree)[:, :, 0]
        return cls(
            _coefficients(on_mass, second_degree[1:], tree.revolute[1:], 2),
            _coefficients(_on_grid(weight, first_degree), first_degree, tree.revolute, 1),
            tree.revolute,
        )

    def __call__(
        self, q: Float[Array, " n"], qd: Float[Array, " n"], qdd: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Return the forces of the joints that give the links a motion [N or N m].

        Source:
            Lagrange's equations; Coriolis and centrifugal forces by Christoffel symbols, for example in
            Siciliano et al. (2009), Robotics, section 7.1.
        """
        kinds = self.revolute[1:]
        powers = [_powers(q[k], turns, 2) for k, turns in enumerate(kinds, start=1)]
        force = jnp.sum(_contracted(self.mass, powers) * qdd, axis=1)

        # Rate of the mass matrix times the velocity, less the slope of the kinetic energy.
        slopes = [jnp.zeros(())]
        for k, turns in enumerate(kinds):
            changed = [*powers[:k], _slopes(powers[k], turns), *powers[k + 1 :]]
            pushed = jnp.sum(_contracted(self.mass, changed) * qd, axis=1)
            force = force + qd[k + 1] * pushed
            slopes.append(0.5 * jnp.sum(qd * pushed))

        around = [_powers(q[k], turns, 1) for k, turns in enumerate(self.revolute)]
        return force - jnp.stack(slopes) + _contracted(self.weight, around)


def _nodes(turns: bool, degree: int) -> Float[np.ndarray, " k"]:
    """Return coordinates of a joint at which values determine the coefficients of a polynomial."""
    count = 2 * degree + 1
    return 2 * np.pi * np.arange(count) / count if turns else np.arange(degree + 1) - 0.5 * degree


def _powers(q: Array, turns: bool, degree: int) -> Float[Array, " k"]:
    """Return 1, cos q, sin q, cos 2 q, sin 2 q of a revolute joint, or 1, q, q^2, to a degree of 1 or 2."""
    if not turns:
        return jnp.stack([jnp.ones_like(q), q, q * q][: degree + 1])
    c, s = jnp.cos(q), jnp.sin(q)
    return jnp.stack([jnp.ones_like(q), c, s, c * c - s * s, 2.0 * s * c][: 2 * degree + 1])


def _slopes(powers: Float[Array, " k"], turns: bool) -> Float[Array, " k"]:
    """Return the derivatives of the powers of second degree by the coordinate."""
    zero = jnp.zeros_like(powers[0])
    if not turns:
        return jnp.stack([zero, powers[0], 2.0 * powers[1]])
    return jnp.stack([zero, -powers[2], powers[1], -2.0 * powers[4], 2.0 * powers[3]])


def _on_grid(function, nodes: list[np.ndarray]) -> Array:
    """Return the values of a function at all combinations of the joints' nodes, whose axes come last."""
    grid = np.array(list(itertools.product(*nodes)))
    values = jax.vmap(function, out_axes=-1)(jnp.asarray(grid))
    return values.reshape(*values.shape[:-1], *map(len, nodes))


def _coefficients(values: Array, nodes: list[np.ndarray], revolute: tuple[bool, ...], degree: int) -> Array:
    """Return the coefficients of polynomials with values at the nodes of the last axes."""
    first = values.ndim - len(nodes)
    for k, (at, turns) in enumerate(zip(nodes, revolute, strict=True)):
        inverse = np.linalg.inv(_basis(at, turns, degree))
        values = jnp.moveaxis(jnp.tensordot(values, inverse, axes=(first + k, 1)), -1, first + k)
    return values


def _basis(at: np.ndarray, turns: bool, degree: int) -> Float[np.ndarray, "k k"]:
    """Return the powers at each node, a row for each."""
    if not turns:
        return at[:, None] ** np.arange(degree + 1)
    columns = [np.ones_like(at)]
    for k in range(1, degree + 1):
        columns += [np.cos(k * at), np.sin(k * at)]
    return np.stack(columns, axis=1)


def _contracted(coefficients: Array, powers: list[Array]) -> Array:
    """Return the values of polynomials, without a call to a matrix library, since it is used in loops."""
    for power in reversed(powers):
        coefficients = jnp.sum(coefficients * power, axis=-1)
    return coefficients
