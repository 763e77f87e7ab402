"""The ladder of estimators, by the names of the command line.

To add one: write its file and register it here as steps of a session: a generator of what is to be
solved, so that studies can solve many together. What a method can be asked for beyond the session
stands in its keywords.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from jaxid.estimators.result import Estimate
from jaxid.estimators.steps import Steps

if TYPE_CHECKING:
    from jaxid.replay import Numerics
    from jaxid.session import Session


def _inverse_dynamics(session: Session) -> Steps[Estimate]:
    from jaxid.estimators.inverse_dynamics import inverse_dynamics_steps

    return inverse_dynamics_steps(session.machine, session.fit.data)


def _output_error(
    session: Session, *, solver: str | None = None, numerics: Numerics | None = None
) -> Steps[Estimate]:
    from jaxid.estimators.inverse_dynamics import inverse_dynamics_steps
    from jaxid.estimators.output_error import choose_numerics, output_error_steps

    # Inverse dynamics gives the start where it tells all unknowns.
    first = yield from inverse_dynamics_steps(session.machine, session.fit.data)
    start = first.theta if first.told else None
    if solver is not None:
        machine = session.machine if start is None else session.machine.with_estimate(start)
        numerics = choose_numerics(machine, session.fit.log, solver=solver)
    return (
        yield from output_error_steps(session.machine, session.fit.log, start=start, numerics=numerics)
    )


def _algebraic(session: Session) -> Steps[Estimate]:
    from jaxid.estimators.algebraic import algebraic_steps

    return algebraic_steps(session.machine, session.fit.log, session.fit.data)


METHODS: dict[str, Callable[..., Steps[Estimate]]] = {
    "output_error": _output_error,
    "inverse_dynamics": _inverse_dynamics,
    "algebraic": _algebraic,
}
