"""An axis with a known load: a joint of an arm, along the motion of the links and the other joints."""

from __future__ import annotations

import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.balance import BehindSprings
from jaxid.model.effect import AddedSpring
from jaxid.plants.axis import Axis


class LoadedAxis(Axis):
    """m a = u + load + effects, the load being a known force of time that no effect of the drive sees.

    In a loop the load comes as further forces behind that of the drive (`Machine.load`). So a gear's
    friction, a saturation or a lag of the drive knows the drive's force alone. It is no kind of [plant].

    The load has three columns: the force on a rigid joint beside that of a constant inertia of its links;
    and, for a spring in front of the links, their inertia about the joint and the rest of their force, both
    over the inertia in the arm's zero position. As in `LinkTree`, an inertia J behind a spring stands for
    that part of the links.
    """

    def applied(self, u: Array, coordinates: int) -> Array:
        return jnp.sum(u[:2], keepdims=True)

    def behind_springs(
        self, q: Array, qd: Array, qdd: Array, u: Array, states: tuple
    ) -> BehindSprings | None:
        whole, elongating = self.inertial(q, qd, qdd), jnp.zeros(())
        own, rest = _links(u)
        springs = [(e, z) for e, z in zip(self.effects, states, strict=True) if isinstance(e, AddedSpring)]
        for spring, state in springs:
            _, _, pull = spring.spring(state)
            links = own * qdd[0] + rest
            elongating = elongating - (links + pull / spring.load_inertia) / own
            whole = whole - spring.load_inertia * links - pull
        return BehindSprings(whole, (elongating,)) if springs else None

    def resting_states(self, q: Array, u: Array) -> tuple:
        rest = _links(u)[1]
        return tuple(
            e.pulling(-e.load_inertia * rest) if isinstance(e, AddedSpring) else z
            for e, z in zip(self.effects, self.initial_states(u), strict=True)
        )


def _links(u: Array) -> tuple[Array, Array]:
    """Return inertia and other forces of the links over their inertia at zero; one and none without load."""
    return (u[2], u[3]) if u.size > 2 else (jnp.ones(()), jnp.zeros(()))
