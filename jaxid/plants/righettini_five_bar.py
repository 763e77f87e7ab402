"""The five-bar robot that Righettini et al. measured."""

from __future__ import annotations

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.parameter import as_array
from jaxid.plants.five_bar import FiveBar


def righettini_five_bar(
    effects: tuple[Effect, ...] = (), *, reduction: Array | list[float] | None = None
) -> FiveBar:
    """Build the robot of tables 1 and 2.

    Args:
        effects: Forces beside the inertia.
        reduction: Turns of each motor for one of its joint; the paper does not state it.

    Source:
        Righettini et al. (2025), Robotics 14(4), 36, tables 1 and 2. The centres of mass of the
        proximal links (118.8, 0.7 mm) are not needed: I_p is about the fixed joints, and nothing has weight.
    """
    return FiveBar(
        length=as_array([0.180, 0.250, 0.250, 0.250, 0.250]),
        center=as_array([[0.1254, 0.0009], [0.1303, 0.0006]]),
        mass=as_array([2.32, 2.78]),
        inertia=as_array([0.292, 0.292, 0.030, 0.036]),
        tip_mass=as_array(2.72),
        reduction=as_array(reduction),
        effects=effects,
    )
