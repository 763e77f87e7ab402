"""Choice of the estimator that suits a case and its log, with the reason."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxid.estimators.estimate import Estimate

if TYPE_CHECKING:
    from jaxid.session import Session

# Samples beyond which a filter over the whole log takes too long for a default.
_LONG = 400_000


class Choice(NamedTuple):
    """A method, and the reason in words.

    Args:
        method: Name of the method.
        reason: Clause that follows "because".
    """

    method: str
    reason: str

    def json(self) -> dict[str, Any]:
        """Return the entry of `settings` in result.json."""
        return {"value": self.method, "reason": self.reason}


def choose_method(session: Session, asked: str | None = None, *, curvature: bool = False) -> Choice:
    """Choose the method for a session whose method is not stated.

    `docs/methods.md` says how often intervals of the chosen method hold, as far as that is measured.

    Args:
        session: Case and logs.
        asked: An option of `output_error` that the user gave, such as "solver"; None: none.
        curvature: Whether the user asked for a Hessian or a profile, which only a likelihood has.
    """
    case, machine, log = session.case, session.machine, session.fit.log
    plant, controller = machine.plant, machine.controller

    if log.steady is not None:
        return Choice("inverse_dynamics", "a table of steady speeds is a balance of forces in each row")
    if asked is not None:
        return Choice("output_error", f"{asked} is an option of it")
    if "output_error" in case.tables and case.within_prior is None:
        return Choice("output_error", "the case has a table [output_error]")
    if case.fits_within_prior(None):
        return Choice(case.prior_method, "the case states a prior")
    if machine.unknown_reference is not None:
        return Choice("output_error", "the reference has unknowns, which only a simulated loop shows")
    if machine.unknown_controller:
        return Choice("output_error", "the controller has unknowns, which only a simulated loop shows")
    if case.identification.physically_consistent:
        return Choice("output_error", "links are to be physically consistent")

    if machine.unforced(log):
        return Choice("output_error", "the log has no force, so that only the simulated loop can be compared")
    if log.passive:
        return Choice(
            "output_error", "nothing drives the machine: the start and the model give the whole motion"
        )

    looped = controller is not None and log.reference is not None
    breaks_away = any(e.break_away_level is not None for e in plant.effects)
    if breaks_away and looped:
        return Choice("output_error", "only a simulated loop shows when a joint breaks away")
    if looped and machine.ticks_between_rows(log):
        return Choice(
            "output_error", "the log is slower than the loop, whose command changes between samples"
        )
    long = ""
    if not plant.filters_fast:
        long = "a filter along the log of such a plant takes long"
    elif (samples := sum(run.log.samples for run in session.fits)) > _LONG:
        long = f"a filter along {samples} samples takes long"
    asks_likelihood = curvature or case.identification.hessian or bool(case.identification.profile)
    if long and asks_likelihood:
        return Choice(
            "output_error", f"{long}, and inverse_dynamics has no likelihood with a Hessian or profile"
        )
    if long:
        return Choice("inverse_dynamics", long)

    if all(log.measured) and any(run.data.faster_loop for run in session.fits) and not asks_likelihood:
        return Choice(
            "inverse_dynamics",
            "the loop is faster than the log, which lacks the forces between its rows: only their mean over "
            "many rows is known",
        )

    how = "open loop and feedback are one case" if controller is None else "the log holds the command"
    if not np.all(log.measured):
        how = "a joint has no encoder"
    return Choice("prediction_error", f"{how}, and the noise of force and position is estimated from the log")


def with_choice(estimate: Estimate, choice: Choice) -> Estimate:
    """Return the estimate with the choice of its method among notes and settings."""
    note = f"{choice.method} was chosen because {choice.reason}"
    settings = {**estimate.details.get("settings", {}), "method": choice.json()}
    return replace(
        estimate, notes=(note, *estimate.notes), details={**estimate.details, "settings": settings}
    )
