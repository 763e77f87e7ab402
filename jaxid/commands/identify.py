"""The command `identify`: estimates of a case's unknowns from a log, the gap, and the noise floor."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxid.case.case import Case, CaseLike, load_case
from jaxid.case.user_faults import named_faults
from jaxid.commands.robot_case import implied_case
from jaxid.errors import InputError, suggest
from jaxid.estimators import steps_of
from jaxid.estimators.choice import choose_method, with_choice
from jaxid.estimators.common.minimisers import Minimiser, minimiser_name, minimiser_of
from jaxid.estimators.common.profile import need_names
from jaxid.estimators.effort import with_effort
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.force_course import with_force_course
from jaxid.estimators.loop_noise import with_loop_noise
from jaxid.estimators.needs import refuse_without_likelihood
from jaxid.gap import Gap, gaps, noise_floor
from jaxid.logs.in_memory import LogLike
from jaxid.names import METHODS, OUTPUTS, SEVERAL_LOGS, SOLVERS, USER_METHODS
from jaxid.numerics.lanes import Precompile, Steps, run_alone, run_batched
from jaxid.results.result import FitResult
from jaxid.session import Logs, Session, open_session
from jaxid.session.timing import states_timing


@dataclass(frozen=True, repr=False)
class Identification(FitResult):
    """Result of `identify`; for its parameters, plots and tables see `FitResult`.

    Args:
        session: Case and logs.
        estimate: Parameters and their precision.
        gaps: Disagreement with each log, the fitted log first.
        noise_floor: RMS force that the sensors' noise leaves in the band, by joint.
    """

    session: Session
    estimate: Estimate
    gaps: tuple[Gap, ...]
    noise_floor: np.ndarray

    def __repr__(self) -> str:
        from jaxid.results.as_text import identification_summary

        return identification_summary(self)

    def __str__(self) -> str:
        from jaxid.results.as_text import identification_table

        return identification_table(self)

    def _repr_html_(self) -> str:
        from jaxid.results.as_html import identification_html

        return identification_html(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write `result.json` and `report.html` to a folder.

        Raises:
            InputError: If the folder holds files that jaxid did not make and `overwrite` is not given.
        """
        from jaxid.results.as_json import save_identification

        return save_identification(self, Path(folder), overwrite=overwrite)


@named_faults()
def identify(
    case: CaseLike,
    log: Logs = None,
    *,
    method: str | None = None,
    solver: str | None = None,
    minimiser: str | Minimiser | None = None,
    on: str | None = None,
    hessian: bool | None = None,
    profile: Sequence[str] = (),
    validate: Sequence[LogLike] = (),
    progress: Callable[[str], None] = lambda text: None,
) -> Identification:
    """Identify the unknowns of a case from a log, or from several together.

    Args:
        case: The case, its file, or a dict with its tables; or a robot's file in MJCF or URDF, with which the
            log implies a case.
        log: The log, its file, or a table of the columns that [log] names (DataFrame, Dataset, dict); or a
            list of several. They are fitted with the logs of [[fit]]; None: those alone.
        method: One of `jaxid.names.METHODS`, or a registered one; None: chosen from case and log, with the
            reason in `result.json` under `settings`.
        solver: For `output_error`, one of `jaxid.names.SOLVERS`: diffrax then integrates between
            samples and dry friction is smoothed; None: fixed steps and exact dry friction. The gap is
            computed with fixed steps either way.
        minimiser: For `output_error` and `within_prior`, one of `jaxid.names.MINIMISERS`, or a solver of
            optimistix; None: that of the case, or jaxid's Levenberg-Marquardt.
        on: For `output_error`, the outputs of the simulated loop that are fitted: one of
            `jaxid.names.OUTPUTS`; None: those that the case names, or position.
        hessian: Whether the covariance uses the full Hessian in place of Gauss-Newton's, for a method that
            maximises a likelihood; None: as the case says. `result.covariance.kind` says which one it is.
        profile: Names of the unknowns whose profile likelihood is computed, for such a method; empty: those
            of the case.
        validate: Logs to validate on, beside those of the case.
        progress: Function called with a line of text at every stage.

    Raises:
        InputError: If case, log, method or an option is unsound, or an option does not go with the method.
    """
    if method is not None:
        _check_method(method)
    options = _checked_options(method, solver, minimiser, on, hessian, profile)
    case = load_case(implied_case(case, log))
    session = open_session(case, log, validate, method=method, piecewise=_piecewise(case, method, options))
    need_names(options.get("profile", session.case.identification.profile), session.machine.parameters.names)
    if not session.machine.parameters.free:
        raise InputError(
            "no parameter is unknown",
            where=session.case.where,
            hint="give at least one parameter as { guess = ... }",
        )

    choice = None
    if method is None:
        asked = next((name for name in options if name not in ("hessian", "profile")), None)
        choice = choose_method(session, asked, curvature=bool(hessian or profile))
        method = choice.method

    progress(f"fitting by {method}")
    session, estimate = run_alone(_tested(method, session, options), _gaps_of(session))
    if choice is not None:
        estimate = with_choice(estimate, choice)
    progress("simulating")
    left = gaps(estimate.machine, session.runs)
    return Identification(
        session,
        with_effort(estimate, session, left),
        left,
        noise_floor(estimate.machine, session.fit.log, session.fit.data),
    )


@named_faults()
def identify_many(
    case: CaseLike | Sequence[CaseLike],
    logs: Sequence[LogLike],
    *,
    method: str | None = None,
    lanes: int = 16,
) -> list[Estimate | Exception]:
    """Identify the unknowns of one case from each of many logs of one length, side by side.

    Args:
        case: The case, its file, or a dict with its tables; or one for each log, with guesses that may
            differ.
        logs: Logs, or their files.
        method: One of `jaxid.names.METHODS`, or a registered one; None: chosen for each case and log.
        lanes: Largest number of logs in a compiled call. On a processor few of them are fitted one by one.

    Returns:
        The estimate of each log, or the exception that ended its fit, which leaves the other logs alone.

    Raises:
        InputError: If a case or the method is unsound, or cases are not as many as logs.
    """
    if method is not None:
        _check_method(method)
    if isinstance(case, Case | Mapping | str | Path):
        cases = [load_case(case)] * len(logs)
    elif len(case) == len(logs):
        cases = [load_case(c) for c in case]
    else:
        raise InputError(f"{len(case)} cases for {len(logs)} logs", hint="give one case, or one for each log")

    def steps(case: Case, log: LogLike) -> Steps[Estimate]:
        session = open_session(case, log, method=method)
        if method is not None:
            return (yield from _tested(method, session, {}))[1]
        choice = choose_method(session)
        _, estimate = yield from _tested(choice.method, session, {})
        return with_choice(estimate, choice)

    return run_batched([steps(*of) for of in zip(cases, logs, strict=True)], lanes)


def _checked_options(
    method: str | None,
    solver: str | None,
    minimiser: str | Minimiser | None,
    on: str | None,
    hessian: bool | None,
    profile: Sequence[str],
) -> dict[str, Any]:
    """Return the options of `identify` that were given, by name.

    Raises:
        InputError: If one is unknown, or does not go with the method.
    """
    options: dict[str, Any] = {}
    if solver is not None:
        options["solver"] = _checked("solver", solver, tuple(SOLVERS), method)
    if minimiser is not None:
        _need_output_error("minimiser", minimiser_name(minimiser), method)
        minimiser_of(minimiser)
        options["minimiser"] = minimiser
    if on is not None:
        options["on"] = _checked("on", on, OUTPUTS, method)
    if hessian is not None:
        if method is not None:
            refuse_without_likelihood("hessian", method)
        options["hessian"] = hessian
    if profile:
        if method is not None:
            refuse_without_likelihood("profile", method)
        options["profile"] = (profile,) if isinstance(profile, str) else tuple(profile)
    return options


def _tested(method: str, session: Session, options: Mapping[str, Any]) -> Steps[tuple[Session, Estimate]]:
    """Fit by a method, and test what it assumed: the course of the force, and a loop without noise.

    Returns:
        The session under the course of the force that the fit chose, and the fit.
    """
    more = {"scaled": True} if method == "output_error" else {}
    if method == "prediction_error":
        more["timing"] = not states_timing(session)
    estimate = yield from steps_of(method, session, **options, **more)
    if method != "inverse_dynamics" or session.more:
        return (yield from with_force_course(session, method, estimate, {**options, **more}))
    return session, (yield from with_loop_noise(session, estimate))


def _piecewise(case: Case, method: str | None, options: Collection[str]) -> bool:
    """Check that a fit can take the stretches of a log with gaps as several logs."""
    demands = case.identification
    single = demands.hessian or demands.profile or case.unknown_reference
    apart = {"hessian", "profile", "minimiser"} & set(options)
    return method in (None, *SEVERAL_LOGS) and not (single or apart or case.fits_within_prior(method))


def _check_method(method: str) -> None:
    """Refuse a method that is neither one of jaxid nor registered.

    Raises:
        InputError: If it is not known.
    """
    known = (*METHODS, *USER_METHODS)
    if method not in known:
        raise InputError(f"method {method!r} is not known", hint=f"choose one of {', '.join(known)}")


def _checked(option: str, value: str, known: Collection[str], method: str | None) -> str:
    _need_output_error(option, value, method)
    if value not in known:
        raise InputError(f"{option} {value!r} is not known", hint=suggest(value, known))
    return value


def _need_output_error(option: str, value: str, method: str | None) -> None:
    methods = ("output_error", "within_prior")
    if method is not None and method not in methods:
        raise InputError(
            f"{option} {value!r} goes only with {' and '.join(methods)}",
            hint=f"leave out {option}, or method {method!r}",
        )


# Samples beyond which the compilation of the gap could take memory that the fit needs.
_COMPILED_BESIDE = 100_000


def _gaps_of(session: Session) -> Precompile | None:
    """Return the call that follows a fit, to be compiled in the background meanwhile."""
    machine, samples = session.machine, tuple(r.log.samples for r in session.runs)
    if sum(samples) > _COMPILED_BESIDE:
        return None
    key = (gaps, jax.tree.structure((machine.plant, machine.controller)), samples)
    return Precompile(gaps, (machine, session.runs), key)
