"""Identification of a case's unknowns from a log: estimate, gap, noise floor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from jaxid.case.case import Case, CaseLike, load_case
from jaxid.errors import InputError, suggest
from jaxid.estimators import steps_of
from jaxid.estimators.common.minimisers import Minimiser, minimiser_name, minimiser_of
from jaxid.estimators.estimate import Estimate
from jaxid.gap import Gap, gaps, noise_floor
from jaxid.logs.log import Log
from jaxid.names import METHODS, OUTPUTS, SOLVERS
from jaxid.numerics.lanes import Precompile, Steps, run_alone, run_batched
from jaxid.session import Session, open_session


@dataclass(frozen=True)
class Identification:
    """What `identify` returns.

    Args:
        session: Case and logs.
        estimate: Parameters and their precision.
        gaps: The fitted log's first, then the validations'.
        noise_floor: RMS force that the sensors' noise leaves in the band, by joint.
    """

    session: Session
    estimate: Estimate
    gaps: tuple[Gap, ...]
    noise_floor: np.ndarray

    @property
    def converged(self) -> bool:
        """Whether the solver did."""
        return self.estimate.converged

    def value(self, name: str) -> float:
        """Estimate of one parameter, by its name in results."""
        return self.estimate.value(name)

    def __str__(self) -> str:
        from jaxid.results.as_text import identification_table

        return identification_table(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write `result.json` and `report.html` to a folder.

        Raises:
            InputError: If the folder holds what jaxid did not make and `overwrite` is not given.
        """
        from jaxid.results.as_json import save_identification

        return save_identification(self, Path(folder), overwrite=overwrite)


def identify(
    case: CaseLike,
    log: Log | str | Path,
    *,
    method: str = "output_error",
    solver: str | None = None,
    minimiser: str | Minimiser | None = None,
    on: str | None = None,
    validate: Sequence[Log | str | Path] = (),
    progress: Callable[[str], None] = lambda text: None,
) -> Identification:
    """Identify the unknowns of a case from a log.

    Args:
        case: The case, its file, or a dict with its tables.
        log: The log, or its file.
        method: One of `jaxid.names.METHODS`.
        solver: For `output_error`, one of `jaxid.names.SOLVERS`: diffrax then integrates between samples,
            dry friction smoothed; None: fixed steps, dry friction exact. The gap is that
            of the fixed steps either way.
        minimiser: For `output_error`, one of `jaxid.estimators.common.minimisers.MINIMISERS`, or a solver of
            optimistix; None: as the case says, or jaxid's Levenberg-Marquardt.
        on: For `output_error`, what of the simulated loop is to meet its log: one of
            `jaxid.names.OUTPUTS`; None: as the case says, or position.
        validate: Logs to validate on, beside the case's own.
        progress: Called with a line at every stage.

    Raises:
        InputError: If case, log, method, solver, minimiser or `on` are unsound.
    """
    if method not in METHODS:
        raise InputError(f"method {method!r} is not known", hint=f"choose one of {', '.join(METHODS)}")
    options = {}
    if solver is not None:
        options["solver"] = _checked("solver", solver, tuple(SOLVERS), method)
    if minimiser is not None:
        _need_output_error("minimiser", minimiser_name(minimiser), method)
        minimiser_of(minimiser)
        options["minimiser"] = minimiser
    if on is not None:
        options["on"] = _checked("on", on, OUTPUTS, method)
    session = open_session(case, log, validate, method=method)
    if not session.machine.parameters.free:
        raise InputError(
            "nothing is unknown",
            where=session.case.where,
            hint="give at least one parameter as { guess = ... }",
        )
    progress(f"fitting by {method}")
    estimate = run_alone(steps_of(method, session, **options), _gaps_of(session))
    progress("simulating")
    return Identification(
        session,
        estimate,
        gaps(estimate.machine, session.runs),
        noise_floor(estimate.machine, session.fit.log, session.fit.data),
    )


def identify_many(
    case: CaseLike | Sequence[CaseLike],
    logs: Sequence[Log | str | Path],
    *,
    method: str = "output_error",
    lanes: int = 16,
) -> list[Estimate | Exception]:
    """Identify the unknowns of one case from each of many logs of one length, in few compiled calls.

    Args:
        case: The case, its file, or a dict with its tables; or one for each log, with guesses that may
            differ.
        logs: Logs, or their files.
        method: One of `jaxid.names.METHODS`.
        lanes: Logs in a compiled call.

    Returns:
        The estimate of each log, or what kept it from one: no log fails for another.

    Raises:
        InputError: If a case or the method is unsound, or cases are not as many as logs.
    """
    if method not in METHODS:
        raise InputError(f"method {method!r} is not known", hint=f"choose one of {', '.join(METHODS)}")
    if isinstance(case, Case | Mapping | str | Path):
        cases = [load_case(case)] * len(logs)
    elif len(case) == len(logs):
        cases = [load_case(c) for c in case]
    else:
        raise InputError(f"{len(case)} cases for {len(logs)} logs", hint="give one case, or one for each log")

    def steps(case: Case, log: Log | str | Path) -> Steps[Estimate]:
        return (yield from steps_of(method, open_session(case, log, method=method)))

    return run_batched([steps(*of) for of in zip(cases, logs, strict=True)], lanes)


def _checked(option: str, value: str, known: Sequence[str], method: str) -> str:
    _need_output_error(option, value, method)
    if value not in known:
        raise InputError(f"{option} {value!r} is not known", hint=suggest(value, known))
    return value


def _need_output_error(option: str, value: str, method: str) -> None:
    if method not in ("output_error", "within_prior"):
        raise InputError(
            f"{option} {value!r} goes only with {' and '.join(methods)}",
            hint=f"leave out {option}, or method {method!r}",
        )


# Samples beyond which the gap would take memory beside the fit that a fit may need.
_COMPILED_BESIDE = 100_000


def _gaps_of(session: Session) -> Precompile | None:
    """What a fit is followed by."""
    machine, samples = session.machine, tuple(r.log.samples for r in session.runs)
    if sum(samples) > _COMPILED_BESIDE:
        return None
    key = (gaps, jax.tree.structure((machine.plant, machine.controller)), samples)
    return Precompile(gaps, (machine, session.runs), key)
