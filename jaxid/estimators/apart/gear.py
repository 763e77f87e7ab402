"""Friction that grows with the load of a gear, in a joint of an arm that is simulated alone."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.effects.friction import LoadFriction
from jaxid.model.effect import Action, Signals


class GearFriction(LoadFriction):
    """Friction of the gear of a joint alone, whose drive's force counts without that of the links beside it.

    Args:
        beside: Force of the links at the samples of a log, (time,) [N m or N].
        period: Sampling time of the log [s].
        late: Part of a sample after which the links' force of a tick of the loop is taken.
    """

    beside: Array = eqx.field(kw_only=True)
    period: Array = eqx.field(kw_only=True)
    late: Array = eqx.field(kw_only=True)

    @classmethod
    def of(cls, friction: LoadFriction, beside: Array, period: float, tick: float) -> GearFriction:
        """Return a friction that knows the force of the links, for a loop with a tick [s]."""
        numbers = {"beside": beside, "period": period, "late": 0.5 * tick / period}
        own = {name: jnp.asarray(value) for name, value in numbers.items()}
        return cls(port=friction.port, coefficient=friction.coefficient, back=friction.back, **own)

    def act(self, x: Signals, state: None) -> Action:
        links = jnp.interp(x.t / self.period + self.late, jnp.arange(self.beside.size), self.beside)
        return super().act(eqx.tree_at(lambda s: s.u, x, x.u - links), state)
