"""The ladder of estimators, by the names of the command line.

To add one: write its file and register it here as a function of a session. What a method can be
asked for beyond that stands in its keywords.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from jaxid.estimators.result import Estimate

if TYPE_CHECKING:
    from jaxid.session import Session


def _inverse_dynamics(session: Session) -> Estimate:
    from jaxid.estimators.inverse_dynamics import inverse_dynamics

    return inverse_dynamics(session.machine, session.fit.data)


def _output_error(session: Session, solver: str | None = None) -> Estimate:
    from jaxid.estimators.output_error import choose_numerics, output_error
    from jaxid.identification import force_start

    start, numerics = force_start(session), None
    if solver is not None:
        machine = session.machine if start is None else session.machine.with_estimate(start)
        numerics = choose_numerics(machine, session.fit.log, solver=solver)
    return output_error(session.machine, session.fit.log, start=start, numerics=numerics)


def _algebraic(session: Session) -> Estimate:
    from jaxid.estimators.algebraic import algebraic

    return algebraic(session.machine, session.fit.log, session.fit.data)


METHODS: dict[str, Callable[..., Estimate]] = {
    "output_error": _output_error,
    "inverse_dynamics": _inverse_dynamics,
    "algebraic": _algebraic,
}
