"""The interface of every plant, with the defaults of a plain machine.

A plain machine has no springs, no gears and no links in space; its joints are all of one kind. Other plants
inherit from a mixin (`jaxid.model.springs`, `gears`, `links`, `weight`) or override single methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.model.search_hints import SearchHints


class PlantInterface(SearchHints):
    """The interface with the defaults of a plant without springs, gears and links."""

    kind: ClassVar[str]
    # Whether the mass matrix is diagonal: no linear system is solved then.
    diagonal: ClassVar[bool] = False
    # Joint behind an elastic coupling, which may have no encoder; None: there is none.
    load: ClassVar[int | None] = None
    # Classes by the coupling that a case may state; empty if there is no choice.
    couplings: ClassVar[Mapping[str, type[PlantInterface]]] = {}
    # "linear" or "rotary" for each port of a machine that has both kinds; empty: as the case states.
    motions: ClassVar[tuple[str, ...]] = ()
    # "linear" or "rotary" if a case does not state `motion`; None: linear.
    usual_motion: ClassVar[str | None] = None
    # Whether a case describes the plant link by link, which then takes a `geometry`.
    linked: ClassVar[bool] = False
    # Number of angles between links without a drive, and of tools, that are ports behind the joints.
    passives: ClassVar[int] = 0
    tools: ClassVar[int] = 0

    def ports(self, q: Array) -> Array:
        """Return the coordinates on which effects act: the joints, then any others such as springs."""
        return q

    def motion(self, port: int) -> str | None:
        """Return "linear" or "rotary" for a port of a machine that has both; None: as the case states."""
        return self.motions[port] if port < len(self.motions) else None

    def velocity_groups(self) -> list[tuple[int, ...]]:
        """Return the joints that share a typical velocity: those of one kind of motion."""
        motions = [self.motion(k) for k in range(self.joints)]
        return [tuple(k for k, m in enumerate(motions) if m == kind) for kind in dict.fromkeys(motions)]

    def place(self, port: int) -> tuple[str, int]:
        """Return the name of a port: one of `jaxid.names.PLACES`, and its number from 1."""
        parts = self.bodies(self.joints)
        return ("joint", port + 1) if port < parts else ("spring", port - parts + 1)

    def directions(self, port: int) -> tuple[int, ...]:
        """Return the entries of `ports` along which an effect on a port acts, on each separately."""
        return (port,)

    def own_inertia(self) -> Array | None:
        """Return the constant inertia at each joint alone [kg or kg m^2]; None if it varies."""
        return None

    def impossible(self, q: Float[np.ndarray, "time n"]) -> tuple[int, str] | None:
        """Return the first row of positions that the machine cannot take, and the reason; or None."""
        return None

    def any_motion(self, random: np.random.Generator) -> Float[np.ndarray, "3 n"]:
        """Draw a possible position, velocity and acceleration, to test the dependencies of the balance.

        Raises:
            InputError: If no position in a thousand is possible.
        """
        motion = random.uniform(0.5, 1.5, (3, self.joints))
        for _ in range(1000):
            if self.impossible(motion[:1]) is None:
                return motion
            motion[0] = random.uniform(-np.pi, np.pi, self.joints)
        raise InputError(f"kind = '{self.kind}' cannot take any position", hint="check its lengths")

    def port_gravity(self, q: Array) -> Array:
        """Return the acceleration of gravity along each port [m/s^2]."""
        return jnp.zeros_like(self.ports(q))

    @property
    def field(self) -> Array:
        """Magnitude of the acceleration of gravity [m/s^2]."""
        return jnp.linalg.norm(self.base_gravity)

    def port_normal(self, q: Array) -> Array:
        """Return the force that presses the sliding surfaces of each port together [N]."""
        return jnp.zeros_like(self.ports(q))

    def port_spring(self, q: Array) -> tuple[Array, Array]:
        """Return stiffness and damping of the plant's spring at each port; zero on joints."""
        zero = jnp.zeros_like(self.ports(q))
        return zero, zero

    @property
    def geared(self) -> tuple[tuple[int, int, Array], ...]:
        """Ports in fixed proportion to a joint: port, joint, and ratio (positive).

        Their dry friction is added to that joint's: no log can separate two that slide as one.
        """
        return ()

    @classmethod
    def links(cls, joints: int) -> int:
        """Return the number of links that have a `frame`."""
        return 0

    def frame(self, link: int, q: Float[Array, " n"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """Return the axes of a link's frame, as columns, and its origin [m], in the base's frame.

        Raises:
            InputError: If the plant has no links that move in space.
        """
        what = f"kind = '{self.kind}' has no links that move in space"
        raise InputError(what, hint="put sensors on the links of a serial_arm or five_bar")

    @property
    def base_gravity(self) -> Float[Array, "3"]:
        """Acceleration of gravity in the base's frame [m/s^2]."""
        return jnp.asarray((0.0, 0.0, -9.81))

    def joint_positions(self, tool: Float[np.ndarray, " k"]) -> Float[Array, " n"] | None:
        """Return the joint positions for a position of the tool; NaN out of reach, None if not available."""
        return None
