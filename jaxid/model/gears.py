"""Gears of known ratio, by which a joint moves other parts of its plant."""

from __future__ import annotations

from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.plant import Plant


class WithGears(Plant):
    """A plant whose first joint moves all other ports through gears, rigidly or through a stiff spring.

    It writes `port_ratios`; ports that follow rigidly are listed in `geared`. The width of the smoothed sign
    is then that of the first joint, times the ratio.
    """

    def port_ratios(self, q: Float[Array, " n"]) -> Float[Array, " ports"]:
        """Return the velocity of each port per velocity of the first joint."""
        raise NotImplementedError

    def velocity_groups(self) -> list[tuple[int, ...]]:
        return [tuple(range(self.joints))]

    def port_width(self, q: Float[Array, " n"]) -> Float[Array, " ports"]:
        return self.smoothing.width * self.port_ratios(q)
