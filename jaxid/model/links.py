"""Links of a plant that move in space and can carry inertial sensors."""

from __future__ import annotations

from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.plant import Plant


class WithLinks(Plant):
    """A plant whose links move in space. It writes `links` and `frame`, and states its `base_gravity`."""

    @classmethod
    def links(cls, joints: int) -> int:
        raise NotImplementedError

    def frame(self, link: int, q: Float[Array, " n"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        raise NotImplementedError
