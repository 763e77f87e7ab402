"""Residuals of a result on its logs, and on further ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.errors import InputError, suggest
from jaxid.gap import Gap, gaps
from jaxid.results.parameters import Residuals
from jaxid.session import OpenedLog, open_another

if TYPE_CHECKING:
    from jaxid.results.result import FitResult


def residuals_of(result: FitResult, log: Any = None) -> Residuals:
    """Return measurement minus model on one log; see `FitResult.residuals`."""
    runs = result.session.runs
    names = [run.name for run in runs]

    if log is None:
        log = 0
    if isinstance(log, int):
        if not -len(runs) <= log < len(runs):
            raise InputError(f"the result has no log {log}", hint=f"choose 0 to {len(runs) - 1}")
        return _residuals(result, runs[log], result.gaps[log])
    if isinstance(log, str) and log in names:
        return _residuals(result, runs[names.index(log)], result.gaps[names.index(log)])
    if isinstance(log, str) and "." not in log:
        # No file either, whose name ends in its format.
        raise InputError(f"log {log!r} is not in this result", hint=suggest(log, names))

    opened = open_another(result.session, log)
    return _residuals(result, opened, gaps(result.estimate.machine, (opened,))[0])


def _residuals(result: FitResult, run: OpenedLog, gap: Gap) -> Residuals:
    label = result.session.machine.units.label
    return Residuals(
        name=run.name,
        time=run.log.time,
        position=None if gap.simulation is None else run.log.position - gap.simulation.position,
        force_time=run.log.time[np.asarray(run.data.kept)],
        force=gap.force.residual,
        units={"time": "s", "position": label("position"), "force": label("force")},
    )
