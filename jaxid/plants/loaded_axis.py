"""An axis with a known load: a joint of an arm, along the motion of the links and the other joints."""

from __future__ import annotations

import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.plants.axis import Axis


class LoadedAxis(Axis):
    """m a = u + load + effects, the load being a known force of time that no effect of the drive sees.

    In a loop the load comes as a second force behind that of the drive (`Machine.load`). So a gear's
    friction, a saturation or a lag of the drive knows the drive's force alone. It is no kind of [plant].
    """

    def applied(self, u: Array, coordinates: int) -> Array:
        return jnp.sum(u, keepdims=True)

    def accepts(self, effect: type[Effect], port: int, drives: int) -> bool:
        # The load acts on the links, behind a spring between them and the drive: here it would act before it.
        return not effect.adds_spring and super().accepts(effect, port, drives)
