"""Geometry of an open chain of joints, by modified Denavit-Hartenberg parameters."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.parameter import as_array
from jaxid.plants.geometry import Geometry


class DenavitHartenberg(Geometry):
    """The frame of each link in the one before it.

    Frame j is fixed to link j, z_j along the axis of joint j. From frame j - 1 it is reached by turning
    alpha about x, moving a along x, turning theta about z and moving d along z.
    The variable of a revolute joint is added to theta, that of a prismatic one to d.

    Args:
        joints: "revolute" or "prismatic", from the base to the tip, n of them.
        alpha: Twists [rad], (n,).
        a: Lengths [m], (n,).
        d: Offsets [m], (n,).
        theta: Angles [rad], (n,).

    Raises:
        ValueError: If there is no joint, one of another kind, or a column of another length.

    Source:
        Khalil & Kleinfinger (1986); Craig, Introduction to Robotics, chapter 3.
    """

    joints: tuple[str, ...] = eqx.field(static=True, converter=tuple)
    alpha: Array = eqx.field(converter=as_array)
    a: Array = eqx.field(converter=as_array)
    d: Array = eqx.field(converter=as_array)
    theta: Array = eqx.field(converter=as_array)

    def __check_init__(self) -> None:
        self._check_joints()
        for name in ("alpha", "a", "d", "theta"):
            self._check_shape(name, ())

    @classmethod
    def of_rows(cls, rows: Sequence[Sequence]) -> DenavitHartenberg:
        """Build it from a table with a row for each joint: joint, alpha [rad], a [m], d [m], theta [rad].

        Raises:
            ValueError: If a row has another number of columns, or an invalid entry.
        """
        for k, row in enumerate(rows, start=1):
            if len(row) != 5:
                raise ValueError(f"row {k} has {len(row)} columns; give joint, alpha, a, d, theta.")
        columns = list(zip(*rows, strict=True)) or [()] * 5
        return cls(columns[0], *(np.asarray(c, dtype=np.float64) for c in columns[1:]))

    def frames(self, q: Float[Array, " n"]) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
        theta = self.theta + self.revolute * q
        d = self.d + (1.0 - self.revolute) * q
        c, s, ca, sa = jnp.cos(theta), jnp.sin(theta), jnp.cos(self.alpha), jnp.sin(self.alpha)
        zero = jnp.zeros_like(c)
        axes = [[c, -s, zero], [s * ca, c * ca, -sa], [s * sa, c * sa, ca]]
        origin = [jnp.broadcast_to(self.a, d.shape), -sa * d, ca * d]
        rows = [jnp.stack(jnp.broadcast_arrays(*row), axis=-1) for row in axes]
        return jnp.stack(rows, axis=-2), jnp.stack(origin, axis=-1)
