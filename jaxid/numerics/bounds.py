"""Values at their bounds in a minimisation."""

from __future__ import annotations

from jaxtyping import Bool, Float

from jaxid.arrays import Array


def presses(
    x: Float[Array, " p"],
    gradient: Float[Array, " p"],
    lower: Float[Array, " p"] | float,
    upper: Float[Array, " p"] | float,
) -> Bool[Array, " p"]:
    """Return the mask of the values at a bound that a fall of the cost would move beyond it.

    Args:
        x: Values, (p,).
        gradient: Gradient of the cost, (p,).
        lower, upper: Bounds, (p,), or one for all.
    """
    return ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
