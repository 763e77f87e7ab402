"""Geometry of an open chain of joints: the common interface, and the most general description."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.parameter import as_array
from jaxid.names import JOINTS


class Geometry(eqx.Module):
    """The frame of each link in the one before: frame j is fixed to link j, z_j along the axis of joint j."""

    joints: eqx.AbstractVar[tuple[str, ...]]

    @property
    def revolute(self) -> Float[np.ndarray, " n"]:
        """One for a revolute joint, zero for a prismatic one."""
        return np.asarray([float(joint == "revolute") for joint in self.joints])

    def frames(self, q: Float[Array, " n"]) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
        """Return each frame in the one before: its axes, as columns, and its origin [m].

        Args:
            q: Joint coordinates [rad or m].
        """
        raise NotImplementedError

    def at_zero(self) -> JointFrames:
        """Return the same geometry by its frames at zero, so that a loop does not compute them anew."""
        return JointFrames(self.joints, *self.frames(jnp.zeros(len(self.joints))))

    def _check_joints(self) -> None:
        if not self.joints:
            raise ValueError("an arm has at least one joint; give a row for each.")
        for k, joint in enumerate(self.joints, start=1):
            if joint not in JOINTS:
                raise ValueError(f"joint {k} is {joint!r}; take one of {', '.join(JOINTS)}.")

    def _check_shape(self, name: str, one: tuple[int, ...]) -> None:
        """Refuse a field without an entry of shape `one` for each joint."""
        value, wanted = getattr(self, name), (len(self.joints), *one)
        # Trees that JAX fills with markers of its own pass; arrays count, with axes of a batch before.
        if isinstance(value, (np.ndarray, Array)) and np.shape(value)[-len(wanted) :] != wanted:
            entry = " x ".join(map(str, one)) + " each, " if one else ""
            shape = np.shape(value)
            raise ValueError(f"{name} has shape {shape}; give {entry}{len(self.joints)}, one a joint.")


class JointFrames(Geometry):
    """Frames at any place in the one before them, as in a URDF file.

    Frame j is reached from frame j - 1 by a fixed motion and then by the joint: a turn about z_j, or a
    slide along it.

    Args:
        joints: "revolute" or "prismatic", from the base to the tip, n of them.
        axes: Axes of each frame along those of the one before, as columns, joints at zero; (n, 3, 3).
        origins: Origin of each frame in the one before [m], (n, 3).

    Raises:
        ValueError: If there is no joint, one of another kind, or an array of another shape.
    """

    joints: tuple[str, ...] = eqx.field(static=True, converter=tuple)
    axes: Array = eqx.field(converter=as_array)
    origins: Array = eqx.field(converter=as_array)

    def __check_init__(self) -> None:
        self._check_joints()
        self._check_shape("axes", (3, 3))
        self._check_shape("origins", (3,))

    def frames(self, q: Float[Array, " n"]) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
        angle = (self.revolute * q)[:, None]
        c, s = jnp.cos(angle), jnp.sin(angle)
        x, y, z = (self.axes[..., k] for k in range(3))
        axes = jnp.stack([c * x + s * y, c * y - s * x, z], axis=-1)
        return axes, self.origins + ((1.0 - self.revolute) * q)[:, None] * z
