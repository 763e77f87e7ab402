"""Refusals: which method goes with which case, log or option, each with a hint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from jaxid.errors import InputError
from jaxid.names import LIKELIHOOD_METHODS, SEVERAL_LOGS, USER_METHODS

if TYPE_CHECKING:
    from jaxid.case.case import Case
    from jaxid.session import Session

# Methods that can keep links physically consistent: each of them minimises, at least within a step, or
# ends at the nearest real bodies.
CONSISTENT = (
    "inverse_dynamics",
    "power",
    "algebraic",
    "instrumental_variable",
    "didim",
    "output_error",
    "prediction_error",
    "within_prior",
    "recursive",
)


def need_likelihood(method: str, case: Case) -> None:
    """Refuse a method that maximises no likelihood if the case asks for a Hessian or for profiles.

    Raises:
        InputError: If [identification] has `hessian` or `profile`, and the method maximises no likelihood.
    """
    for option in ("hessian", "profile"):
        if getattr(case.identification, option):
            refuse_without_likelihood(option, method, f"{case.where}, [identification]")


def refuse_without_likelihood(option: str, method: str, where: str = "") -> None:
    """Refuse an option of the likelihood for a method that maximises none; user methods decide themselves.

    Raises:
        InputError: If the method is one of jaxid and maximises no likelihood.
    """
    if method not in LIKELIHOOD_METHODS and method not in USER_METHODS:
        raise InputError(
            f"{option} needs a method that maximises a likelihood, and {method} does not",
            where=where,
            hint=f"choose one of {', '.join(LIKELIHOOD_METHODS)}, or leave out {option}",
        )


def need_one_log(session: Session, method: str) -> None:
    """Refuse several logs for a method that fits one.

    Raises:
        InputError: If the session has several logs, and the method is none of `jaxid.names.SEVERAL_LOGS`.
    """
    if not session.more:
        return
    where, several = session.case.where, ", ".join(SEVERAL_LOGS)
    if method not in SEVERAL_LOGS:
        what = f"{method} fits one log, and there are {len(session.fits)}"
        raise InputError(what, where=where, hint=f"take one of {several}, or name one log")


def need_no_profile(session: Session, asked: Sequence[str]) -> None:
    """Refuse profiles of a fit to several logs.

    Raises:
        InputError: If any is asked for.
    """
    if asked and session.more:
        hint = "leave profile out, or name one log"
        raise InputError("profile goes with one log", where=session.case.where, hint=hint)


def need_no_hessian(session: Session, asked: bool) -> None:
    """Refuse the full Hessian of innovations of several logs.

    Raises:
        InputError: If it is asked for.
    """
    if asked and session.more:
        hint = "take output_error, or leave hessian out"
        what = "prediction_error gives no full Hessian for several logs"
        raise InputError(what, where=session.case.where, hint=hint)


def need_consistent(method: str, case: Case) -> None:
    """Refuse a method that cannot keep links physically consistent if the case requires that.

    Raises:
        InputError: If the case sets `physically_consistent` and the method does not support it.
    """
    if not case.identification.physically_consistent:
        return
    hint = "" if method in CONSISTENT else f"use {', '.join(CONSISTENT)}, or leave it out"
    if hint:
        what, where = f"physically_consistent does not go with {method}", f"{case.where}, [identification]"
        raise InputError(what, where=where, hint=hint)


def need_force(session: Session, what: str) -> None:
    """Refuse a loop whose force was not logged.

    Raises:
        InputError: If the log of a loop has no force; the message says that `what` needs it.
    """
    for run in session.runs:
        if session.machine.unforced(run.log):
            raise InputError(
                f"the log has no force, which {what} needs",
                where=run.log.source,
                hint="fit by output_error, which simulates the loop",
            )


def need_alike(session: Session) -> None:
    """Refuse logs with and without a force in one fit.

    Raises:
        InputError: If some of the fitted logs hold a force and others do not.
    """
    unforced = [session.machine.unforced(run.log) for run in session.fits]
    if any(unforced) and not all(unforced):
        lacking = session.fits[unforced.index(True)].name
        raise InputError(
            f"the log {lacking} has no force, and others have one",
            where=session.case.where,
            hint="leave force out of [log] to fit all of them by their positions",
        )


def need_known_controller(session: Session, why: str) -> None:
    """Refuse a case whose controller has unknowns.

    Raises:
        InputError: If the controller has any unknown; the message contains `why`.
    """
    names = session.machine.unknown_controller
    if names:
        raise InputError(
            f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} unknown, and {why}",
            where=f"{session.case.where}, [controller]",
            hint="fit by output_error, and give the numbers found",
        )


def need_known_reference(session: Session, why: str) -> None:
    """Refuse a case whose reference has unknowns.

    Raises:
        InputError: If the reference has any unknown; the message contains `why`.
    """
    if session.machine.unknown_reference is not None:
        raise InputError(
            f"the reference has unknowns, and {why}",
            where=f"{session.case.where}, [reference]",
            hint="fit them by output_error, and give the numbers found",
        )
