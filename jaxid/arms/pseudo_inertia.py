"""Rigid bodies as 4 x 4 pseudo-inertia matrices: change of frame, and physically consistent coordinates."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.plants import rigid_tree


def pseudo_inertia(ten: Float[Array, "*n 10"]) -> Float[Array, "*n 4 4"]:
    """Compute the integral of (x y z 1)' (x y z 1) over the mass of a body.

    It is positive definite if and only if some body of positive density everywhere has these parameters.

    Args:
        ten: Inertial parameters in the order of `jaxid.names.TEN`; products of inertia are -sum m x y.
    Source:
        Wensing, Kim & Slotine (2018), IEEE RA-L 3(1). (2.9) of the PA-10 report holds the sums +sum m x y.
    """
    xx, xy, xz, yy, yz, zz = (ten[..., k] for k in range(4, 10))
    rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    tensor = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return rigid_tree.pseudo_inertia(ten[..., 0], ten[..., 1:4], tensor)


def ten_parameters(pseudo: Float[Array, "*n 4 4"]) -> Float[Array, "*n 10"]:
    """Invert `pseudo_inertia`."""

    def s(i: int, j: int) -> Array:
        return pseudo[..., i, j]

    return jnp.stack(
        [
            s(3, 3),
            s(0, 3),
            s(1, 3),
            s(2, 3),
            s(1, 1) + s(2, 2),
            -s(0, 1),
            -s(0, 2),
            s(0, 0) + s(2, 2),
            -s(1, 2),
            s(0, 0) + s(1, 1),
        ],
        axis=-1,
    )


def moved(axes: Float[Array, "3 3"], origin: Float[Array, " 3"]) -> Float[np.ndarray, "10 10"]:
    """Build the matrix that transforms a body's parameters from its frame into another.

    Args:
        axes: Axes of its frame in the other, as columns.
        origin: Origin of its frame in the other [m].

    Source:
        Khalil & Dombre (2002), section 9.3: its columns are lambda_1 to lambda_10.
    """
    return np.asarray(_rows_moved(axes, origin)).T


@jax.jit
def _rows_moved(axes: Float[Array, "3 3"], origin: Float[Array, " 3"]) -> Float[Array, "10 10"]:
    place = jnp.eye(4).at[:3, :3].set(axes).at[:3, 3].set(origin)
    return ten_parameters(place @ pseudo_inertia(jnp.eye(10)) @ place.T)


@jax.jit
def log_cholesky(ten: Float[Array, " 10"]) -> Float[Array, " 10"]:
    """Map a body to coordinates in which every body of positive density, and nothing else, is a point.

    The coordinates are half the logarithm of the mass; the centre of mass x, y, z [m]; and the entries of the
    upper triangular A, whose A A' is the spread about the centre (integral of r r' over the mass, divided by
    the mass): the logarithms of its diagonal, and its entries 12, 13, 23.

    Args:
        ten: Inertial parameters of a body, in the order of `jaxid.names.TEN`.


    Source:
        Rucker & Wensing (2022), IEEE RA-L 7(2); their s is here an entry of A itself.
    """
    m = ten[0]
    centre = ten[1:4] / m
    s = pseudo_inertia(ten)[:3, :3] / m - centre[:, None] * centre
    # Written out: LAPACK's factorisation cannot be part of loops and batches.
    a33 = jnp.sqrt(s[2, 2])
    a13, a23 = s[0, 2] / a33, s[1, 2] / a33
    a22 = jnp.sqrt(s[1, 1] - a23**2)
    a12 = (s[0, 1] - a13 * a23) / a22
    a11 = jnp.sqrt(s[0, 0] - a12**2 - a13**2)
    return jnp.concatenate(
        [
            0.5 * jnp.log(m)[None],
            centre,
            jnp.log(jnp.stack([a11, a22, a33])),
            jnp.stack([a12, a13, a23]),
        ]
    )


@jax.jit
def of_log_cholesky(x: Float[Array, " 10"]) -> Float[Array, " 10"]:
    """Invert `log_cholesky`."""
    zero = jnp.zeros(())
    (a11, a22, a33), (a12, a13, a23) = jnp.exp(x[4:7]), x[7:]
    a = jnp.stack([jnp.stack(row) for row in ([a11, a12, a13], [zero, a22, a23], [zero, zero, a33])])
    whole = jnp.zeros((4, 4)).at[:3, :3].set(a).at[:3, 3].set(x[1:4]).at[3, 3].set(1.0)
    return ten_parameters(jnp.exp(2 * x[0]) * jnp.sum(whole[:, None] * whole, axis=-1))
