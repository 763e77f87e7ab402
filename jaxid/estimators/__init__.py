"""The ladder of estimators, by the names of the command line.

To add one: write its file and register it here as a function of a session.
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


def _output_error(session: Session) -> Estimate:
    from jaxid.estimators.output_error import output_error
    from jaxid.identification import force_start

    return output_error(session.machine, session.fit.log, start=force_start(session))


def _algebraic(session: Session) -> Estimate:
    from jaxid.estimators.algebraic import algebraic

    return algebraic(session.machine, session.fit.log, session.fit.data)


METHODS: dict[str, Callable[[Session], Estimate]] = {
    "output_error": _output_error,
    "inverse_dynamics": _inverse_dynamics,
    "algebraic": _algebraic,
}
