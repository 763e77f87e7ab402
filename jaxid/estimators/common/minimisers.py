"""Names of the minimisers of a fit: jaxid's Levenberg-Marquardt, and solvers of optimistix.

The module does not import JAX before a minimiser of optimistix is requested.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, TypeAlias

from jaxid.errors import InputError, suggest
from jaxid.names import MINIMISERS

if TYPE_CHECKING:
    import optimistix as optx

    Minimiser: TypeAlias = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser
else:
    Minimiser = Any

# On the scale of `jaxid.estimators.common.minimise` unknowns and residual are of order one. The cost at the
# end is far below the one at the start, hence the smaller absolute tolerance.
_RTOL, _ATOL = 1e-8, 1e-10


def minimiser_of(given: str | Minimiser | None) -> Minimiser | None:
    """Return the minimiser that a name stands for, or the given one; None for jaxid's Levenberg-Marquardt.

    Args:
        given: One of `MINIMISERS`, a solver of optimistix for least squares or minimisation, or None.

    Raises:
        InputError: If it is neither.
    """
    if given is None or given == MINIMISERS[0]:
        return None
    if isinstance(given, str):
        if given not in MINIMISERS:
            raise InputError(f"minimiser {given!r} is not known", hint=suggest(given, MINIMISERS))
        return _named(given)

    import optimistix as optx

    if isinstance(given, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        return given
    raise InputError(
        f"minimiser is {given!r}, which is no solver of optimistix for least squares or minimisation",
        hint=f"give an instance of one, or a name: {', '.join(MINIMISERS)}",
    )


def minimiser_name(given: str | Minimiser | None) -> str:
    """Return the name of a minimiser for results and messages."""
    if given is None or isinstance(given, str):
        return given or MINIMISERS[0]
    kind = type(given)
    return f"{kind.__module__.split('.')[0]}.{kind.__name__}"


@functools.cache
def _named(name: str) -> Minimiser:
    """Return the single instance for a name: compiled code depends on it, and runs of a study share it."""
    import optimistix as optx

    return getattr(optx, name.removeprefix("optimistix."))(rtol=_RTOL, atol=_ATOL)
