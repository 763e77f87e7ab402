"""The class of all machines: parameters, inertial forces, ports, and the effects on them.

A plant states `M(q) qdd + h(q, qd)` and carries effects; `Plant.balance` puts them together. Right-hand side,
regressor, iterated integrals and set-valued step all read that one statement; they live in `jaxid.dynamics`.
docs/adding_a_plant.md shows how to write one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.balance import Balance, BehindSprings, balance, stacked
from jaxid.model.effect import Effect
from jaxid.model.interface import PlantInterface
from jaxid.model.parameter import parameters_of
from jaxid.model.smoothing import Smoothing


class Plant(PlantInterface):
    """A machine: inertial forces and additional effects.

    A plant must state its parameters as fields (`jaxid.model.parameter.parameter`), its `kind`, the number of
    `joints` if that is not one, and `inertial`. It may define `ports`. Everything else is inherited.

    Args:
        effects: Forces beside the inertia, in the order of the drive.
        smoothing: Width of the smoothed sign of dry friction. It belongs to the numerics: the code that
            evaluates the balance sets it by `smoothed`; the file of a plant neither declares nor reads it.
    """

    effects: tuple[Effect, ...] = eqx.field(default=(), kw_only=True)
    smoothing: Smoothing = eqx.field(default_factory=Smoothing, kw_only=True)

    def inertial(self, q: Float[Array, " n"], qd: Float[Array, " n"], qdd: Float[Array, " n"]) -> Array:
        """Return M(q) qdd + h(q, qd), weight included, by joint [N or N m]."""
        raise NotImplementedError

    @property
    def ports_are_joints(self) -> bool:
        """True if all ports are joints; else the derivative of `ports` takes half of the compile time."""
        return type(self).ports is PlantInterface.ports

    def prepared(self) -> Self:
        """Return the same plant with all that depends on its parameters alone computed, for a loop.

        Inside a loop the compiler moves each use of such an expression out of it as another value, and then
        no longer sees that what follows is the same.
        """
        return self

    def with_effect(self, effect: Effect) -> Self:
        """Return the plant with one more effect, the last one of its drive."""
        return eqx.tree_at(lambda p: p.effects, self, (*self.effects, effect))

    def smoothed(self, sharpness: Array | None = None, velocity_scale: Array | None = None) -> Self:
        """Return the plant with another width of the smoothed sign; arguments are those of `Smoothing`.

        An argument that is not given stays as it is.
        """
        new = {"sharpness": sharpness, "velocity_scale": velocity_scale}
        smoothing = replace(self.smoothing, **{k: v for k, v in new.items() if v is not None})
        return replace(self, smoothing=smoothing)

    def port_width(self, q: Float[Array, " n"]) -> Float[Array, " ports"]:
        """Return the velocity of each port over which the sign is smoothed."""
        width, ports = self.smoothing.width, self.ports(q).shape
        if width.ndim == 0 or self.ports_are_joints:
            return jnp.broadcast_to(width, ports)
        # One width a joint: any other port takes that of the first joint that it loads.
        joints = [self.joints_loaded_by(k, q.size)[0] for k in range(q.size, ports[0])]
        return jnp.concatenate([width, width[np.asarray(joints)]])

    def command_delays(self, drives: int) -> Float[Array, " m"]:
        """Return the total delay of the command of each drive [s]."""
        total: list[Array | float] = [0.0] * drives
        for e in self.effects:
            j = self.drive_of(e.port, drives)
            if j is not None:
                total[j] = total[j] + e.command_delay()
        return stacked(total)

    def initial_states(self, u: Float[Array, " m"]) -> tuple:
        """Return the internal states of the effects after the drives have long been at `u`."""
        drives = [self.drive_of(e.port, u.size) for e in self.effects]
        zero = jnp.zeros((), u.dtype)
        return tuple(
            e.initial_state(zero if j is None else u[j]) for e, j in zip(self.effects, drives, strict=True)
        )

    def resting_states(self, q: Float[Array, " n"], u: Float[Array, " m"]) -> tuple:
        """Return the internal states of the effects at rest at a position under a long constant `u`.

        A plant whose links are behind springs that effects add overrides it: their weight stretches these.
        """
        return self.initial_states(u)

    def behind_springs(
        self,
        q: Float[Array, " n"],
        qd: Float[Array, " n"],
        qdd: Float[Array, " n"],
        u: Float[Array, " m"],
        states: tuple,
    ) -> BehindSprings | None:
        """Return what the plant does with links behind springs of its effects; None: it has no such links.

        Arguments are those of `balance`.
        """
        return None

    def links_behind(self, joint: int) -> Array | None:
        """Return the inertia of the links that a spring at a joint may have behind it; None: not links."""
        return None

    def beyond_springs(
        self, q: Float[Array, " n"], qd: Float[Array, " n"], states: tuple
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]] | None:
        """Return position and velocity of the links; None: they are those of the joints."""
        return None

    def balance(
        self,
        q: Float[Array, " n"],
        qd: Float[Array, " n"],
        qdd: Float[Array, " n"],
        u: Float[Array, " m"],
        t: Float[Array, ""],
        states: tuple,
        reaction: Float[Array, " ports"] | None = None,
        *,
        behind: bool = False,
    ) -> Balance:
        """Compute the balance of forces at one instant.

        Args:
            q: Coordinates [m or rad].
            qd: Velocities [m/s or rad/s].
            qdd: Accelerations [m/s^2 or rad/s^2].
            u: Declared force of each drive, delay already applied [N or N m].
            t: Time from the start of the log [s].
            states: Internal state of each effect (None if it has none).
            reaction: Force of dry friction by port, if a set-valued step has computed it. Absent:
                smoothed, -level tanh(yd / width).
            behind: Whether links are behind springs that effects add to their joints, as in a simulation.
                Otherwise such a spring has a constant inertia behind it, and the weight acts in front, which
                is near enough along a measured motion.

        Returns:
            Residual `M qdd + h - effects - drive`, levels of dry friction, rates of the states, drive.
        """
        return balance(self, q, qd, qdd, u, t, states, reaction, behind=behind)


def inertia_behind(plant: Plant, joint: int) -> float:
    """Return the largest inertia that may be behind a spring which an effect adds to a joint."""
    links = plant.links_behind(joint)
    return inertia_at(plant, joint) if links is None else float(np.asarray(links))


def inertia_at(plant: Plant, joint: int) -> float:
    """Return the inertia of a joint, its added masses included.

    It is infinite if it varies with the position, or if the joint is a body that another one carries along.
    """
    constant = plant.own_inertia()
    if constant is None or joint >= np.size(constant):
        return np.inf
    added = [
        float(np.sum(np.asarray(getattr(e, name))))
        for e in plant.effects
        if e.port == joint and not e.adds_spring
        for name, info in parameters_of(type(e)).items()
        if info.dimension == "inertia" and getattr(e, name) is not None
    ]
    return float(np.atleast_1d(np.asarray(constant))[joint]) + sum(added)
