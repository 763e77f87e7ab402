"""An axis with a known load: a joint of an arm, along the motion of the links and the other joints."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.balance import BehindSprings
from jaxid.model.effect import AddedSpring, Effect
from jaxid.model.parameter import as_array
from jaxid.plants.axis import Axis


class LoadedAxis(Axis):
    """m a = u + load + effects, the load being a known force of time that no effect of the drive sees.

    In a loop the load comes as further forces behind that of the drive (`Machine.load`). So a gear's
    friction, a saturation or a lag of the drive knows the drive's force alone. It is no kind of [plant].

    The load has three columns: the force on a rigid joint beside that of a constant inertia of its links [N
    or N m]; and, for a spring in front of the links, their inertia about the joint, and the rest of their
    force [m/s^2 or rad/s^2], both over the inertia in the arm's zero position. As in `LinkTree`, an inertia J
    behind a spring stands for that part of the links.

    Args:
        mean: The constant inertia of the links, a part of `inertia`.
        at_zero: Their inertia in the arm's zero position.
    """

    mean: Array = eqx.field(converter=as_array, default=0.0, kw_only=True)
    at_zero: Array = eqx.field(converter=as_array, default=1.0, kw_only=True)

    def accepts(self, effect: type[Effect], port: int, drives: int) -> bool:
        # The load would act in front of any other spring.
        known = not effect.adds_spring or issubclass(effect, AddedSpring)
        return known and super().accepts(effect, port, drives)

    def applied(self, u: Array, coordinates: int) -> Array:
        return jnp.sum(u[:2], keepdims=True)

    def behind_springs(
        self, q: Array, qd: Array, qdd: Array, u: Array, states: tuple
    ) -> BehindSprings | None:
        whole, elongating = self.inertial(q, qd, qdd), jnp.zeros(())
        if u.size == 1:  # linearised without a load
            u = jnp.concatenate([u, jnp.asarray([0.0, 1.0, 0.0])])
        own, rest = u[2], u[3]
        springs = [(e, z) for e, z in zip(self.effects, states, strict=True) if isinstance(e, AddedSpring)]
        for spring, state in springs:
            (_, _, pull), part = spring.spring(state), spring.load_inertia / self.at_zero
            elongating = elongating - (own * qdd[0] + rest + pull / spring.load_inertia) / own
            # All that the links would take of a rigid joint, at the constant inertia and beside it.
            whole = whole - part * (self.mean * qdd - u[1:2]) - pull
        return BehindSprings(whole, (elongating,)) if springs else None

    def links_behind(self, joint: int) -> Array:
        return self.at_zero

    def resting_states(self, q: Array, u: Array) -> tuple:
        rest = u[3] if u.size > 1 else 0.0
        return tuple(
            e.pulling(-e.load_inertia * rest) if isinstance(e, AddedSpring) else z
            for e, z in zip(self.effects, self.initial_states(u), strict=True)
        )
