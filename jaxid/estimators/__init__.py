"""The estimators, by their names on the command line.

To add one, write its file and register it here as a function from a session to a generator of solve
requests, so that studies can solve many runs together. Options of a method that the session does not have
are keyword arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.consistency.absent import need_position
from jaxid.errors import InputError
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.needs import (
    need_alike,
    need_consistent,
    need_force,
    need_known_controller,
    need_known_reference,
    need_likelihood,
    need_no_hessian,
    need_no_profile,
    need_one_log,
)
from jaxid.estimators.uncertain_hold import with_uncertain_hold
from jaxid.model.unknowns import in_loop
from jaxid.names import USER_METHODS
from jaxid.numerics.lanes import Steps

if TYPE_CHECKING:
    from jaxid.estimators.common.minimisers import Minimiser
    from jaxid.estimators.several.parts import Part
    from jaxid.machine import Machine
    from jaxid.session import Session
    from jaxid.simulation.replay import Numerics


def _inverse_dynamics(session: Session) -> Steps[Estimate]:
    from jaxid.estimators.reading_noise import without_reading_noise

    if session.more:
        from jaxid.estimators.several.force import inverse_dynamics_steps as together
        from jaxid.estimators.several.parts import parts_of

        estimate = yield from together(session.machine, parts_of(session))
        return (yield from without_reading_noise(session, estimate))
    from jaxid.estimators.inverse_dynamics import inverse_dynamics_steps

    if session.fit.log.steady is not None:
        from jaxid.steady import steady_fit

        return (yield from steady_fit(session))
    estimate = yield from inverse_dynamics_steps(session.machine, session.fit.data)
    return (yield from without_reading_noise(session, estimate))


def _output_error(
    session: Session,
    *,
    solver: str | None = None,
    minimiser: str | Minimiser | None = None,
    on: str | None = None,
    numerics: Numerics | None = None,
    hessian: bool | None = None,
    profile: Sequence[str] | None = None,
    scaled: bool = False,
) -> Steps[Estimate]:
    case, log = session.case, session.fit.log
    stated = case.output_error
    on = on or stated.on
    if case.fits_within_prior("output_error"):
        result = yield from _within_prior(
            session,
            solver=solver,
            minimiser=minimiser,
            on=on,
            numerics=numerics,
            hessian=hessian,
            profile=profile,
            asked="[output_error] prior",
        )
        return replace(result, method="output_error")

    from jaxid.estimators.output_error import output_error_steps
    from jaxid.estimators.several.parts import parts_of
    from jaxid.simulation.sensor_noise import force_noise

    solver, minimiser = solver or stated.solver, minimiser or stated.minimiser
    demands = case.identification
    precision = {
        "hessian": demands.hessian if hessian is None else hessian,
        "profile": demands.profile if profile is None else profile,
    }
    need_no_profile(session, precision["profile"])
    options: dict[str, Any] = {"numerics": numerics, "on": on, "minimiser": minimiser, **precision}
    if session.machine.unforced(log):
        from jaxid.estimators.unforced import unforced_steps

        return (yield from unforced_steps(session, scaled=scaled, **options))
    start = yield from _start(session)
    options["solver"] = solver
    logs = parts_of(session) if session.more else log
    options["command_noise"] = [force_noise(session.machine, run.data) for run in session.fits]
    result = yield from output_error_steps(session.machine, logs, start=start, **options)
    result = replace(result, notes=(*result.notes, *_doubts_of_output_error(session.machine)))
    if all(log.measured) and not session.more:
        from jaxid.estimators.faster_loop import with_loop_of_log

        return (yield from with_loop_of_log(session, result, **options))
    if start is None or session.more:
        return result
    # Without an encoder on every joint inverse dynamics may end far off, especially with coarse readings.
    other = yield from output_error_steps(session.machine, log, **options)
    return min((result, other), key=lambda e: (not e.converged, np.nansum(e.residual**2)))


def _doubts_of_output_error(machine: Machine) -> list[str]:
    """Return why the standard deviations of output error may be too small on a log, a sentence each."""
    if machine.controller is None and any(type(e).opens_spring for e in machine.plant.effects):
        return [
            "an open-loop simulation hangs on every impact in a clearance: the fit may end at a local "
            "optimum, many standard deviations off"
        ]
    if machine.controller is not None and machine.sensor.mean.position_resolution is not None:
        return [
            "the loop is simulated with an encoder that rounds, which makes the cost rough: the fit may end "
            "several standard deviations off, use prediction_error"
        ]
    return []


def _within_prior(
    session: Session,
    *,
    solver: str | None = None,
    minimiser: str | Minimiser | None = None,
    on: str | None = None,
    numerics: Numerics | None = None,
    hessian: bool | None = None,
    profile: Sequence[str] | None = None,
    asked: str = "the method within_prior",
) -> Steps[Estimate]:
    """Fit within the prior of the guesses; `asked` names the request in messages."""
    from jaxid.estimators.simulated_output import choose_numerics, need_loop
    from jaxid.estimators.within_prior.fit import within_prior_steps

    settings, log = session.case.need_prior(), session.fit.log
    solver = solver or settings.solver
    for run in session.fits:
        need_loop(session.machine, run.log, asked, "or take another method")
    if solver is not None and numerics is None:
        numerics = choose_numerics(session.machine, log, solver=solver)
    others = yield from _beside_the_guesses(session)
    demands = session.case.identification
    return (
        yield from within_prior_steps(
            session.machine,
            _parts(session) if session.more else log,
            prior=settings.prior,
            on=on or settings.on,
            starts=settings.starts,
            others=others,
            hessian=settings.hessian or demands.hessian if hessian is None else hessian,
            profile=settings.profile,
            profile_of=demands.profile if profile is None else profile,
            numerics=numerics,
            drawn=settings.drawn,
            minimiser=minimiser or settings.minimiser,
        )
    )


def _prediction_error(
    session: Session,
    *,
    numerics: Numerics | None = None,
    hessian: bool | None = None,
    profile: Sequence[str] | None = None,
    start: np.ndarray | None = None,
    timing: bool = False,
) -> Steps[Estimate]:
    """Fit from the values of inverse dynamics, or from a start that is near the optimum."""
    from jaxid.estimators.inverse_dynamics import inverse_dynamics_steps
    from jaxid.estimators.prediction_error import prediction_error_steps
    from jaxid.estimators.several.parts import Part, parts_of

    machine, run, demands = session.machine, session.fit, session.case.identification
    precision = {
        "hessian": demands.hessian if hessian is None else hessian,
        "profile": demands.profile if profile is None else profile,
    }
    need_no_profile(session, precision["profile"])
    need_no_hessian(session, precision["hessian"])
    alone = start is not None
    if start is None:
        first = _inverse_dynamics(session) if session.more else inverse_dynamics_steps(machine, run.data)
        start = _whole((yield from first), machine)
    options: dict[str, Any] = {"start": start, "numerics": numerics, "alone": alone}
    if session.more:
        return (yield from prediction_error_steps(machine, parts_of(session), **options))
    part = Part.alone(machine, run.log, run.data)
    return (yield from prediction_error_steps(machine, [part], timing=timing, **options, **precision))


def _whole(first: Estimate, machine: Machine) -> np.ndarray | None:
    """Return the values of a fit that has all of them, identified or those of a real body; else None."""
    return first.theta if np.all(first.identifiable | machine.parameters.in_bodies) else None


def _beside_the_guesses(session: Session) -> Steps[list[np.ndarray]]:
    """Return a second start of a fit within a prior: the estimates of the method that the case states.

    If only a sum is identifiable, both of its parts change. Unknowns that do not enter linearly stay at
    their guesses.
    """
    method, unknown = session.case.need_prior().start, session.machine.parameters
    if method == "guess":
        return []
    from jaxid.estimators.recursive.rows import keep_linear_steps

    machine = yield from keep_linear_steps(session.machine, session.fit.data)
    case = replace(session.case, recursive=replace(session.case.recursive, start="guess"))
    first = yield from METHODS[method](replace(session, machine=machine, case=case))
    found = dict(zip(first.names, first.theta, strict=True))
    theta = np.array([found.get(f.name, f.guess) for f in unknown.free])
    return [np.clip(np.where(np.isfinite(theta), theta, unknown.guess), *unknown.bounds)]


def _start(session: Session) -> Steps[np.ndarray | None]:
    """Return the start of output error: the estimates of another method if it identifies all unknowns.

    Otherwise None: the fit starts at the guesses. Parameters of physically consistent links count as
    identified: their unidentifiable combinations stay at those of a body and do not affect the motion.
    Inverse dynamics keeps the bounds and may end at one; the estimates of a method that does not keep
    them may be impossible to simulate.
    """
    parameters = session.machine.parameters
    method = session.case.output_error.start
    if method == "guess":
        return None
    first = yield from METHODS[method](session)
    elsewhere = [in_loop(path) for path, _ in parameters.places]
    usable = first.converged and np.all(first.identifiable | elsewhere | parameters.in_bodies)
    lower, upper = parameters.bounds
    inside = np.all((first.theta >= lower) & (first.theta <= upper))
    return first.theta if usable and inside else None


def _recursive(session: Session) -> Steps[Estimate]:
    from jaxid.estimators.recursive.estimate import recursive_steps
    from jaxid.estimators.recursive.memory import read_memory

    case, run = session.case, session.fit
    for each in session.fits:
        each.log.need_every_encoder("recursive")
    saved = None
    if case.recursive.restart is not None:
        saved = read_memory(case.folder / case.recursive.restart, session.machine.parameters.names)
    logs = _parts(session) if session.more else run.data
    return recursive_steps(session.machine, logs, case.recursive, saved)


def _instrumental_variable(session: Session, *, numerics: Numerics | None = None) -> Steps[Estimate]:
    from jaxid.estimators.instrumental_variable import instrumental_variable_steps

    return instrumental_variable_steps(session.machine, _parts(session), numerics=numerics)


def _didim(session: Session, *, numerics: Numerics | None = None) -> Steps[Estimate]:
    from jaxid.estimators.didim import didim_steps

    return didim_steps(session.machine, _parts(session), numerics=numerics)


def _parts(session: Session) -> list[Part]:
    """Return the fitted logs of a session; of one alone the machine is that of the session."""
    from jaxid.estimators.several.parts import Part, parts_of

    run = session.fit
    return parts_of(session) if session.more else [Part.alone(session.machine, run.log, run.data)]


def _power(session: Session) -> Steps[Estimate]:
    if session.more:
        from jaxid.estimators.several.force import power_steps as together
        from jaxid.estimators.several.parts import parts_of

        return together(session.machine, parts_of(session))
    from jaxid.estimators.power import power_steps

    session.fit.log.need_every_encoder("power")
    return power_steps(session.machine, session.fit.data, session.fit.log)


def _algebraic(session: Session) -> Steps[Estimate]:
    if session.more:
        from jaxid.estimators.several.force import algebraic_steps as together
        from jaxid.estimators.several.parts import parts_of

        if session.case.algebraic.window is not None:
            session.need_one_log("[algebraic] window")
        return together(session.machine, parts_of(session))
    from jaxid.estimators.algebraic.one_window import least_squares_steps
    from jaxid.estimators.algebraic.windows import algebraic_steps

    run, window = session.fit, session.case.algebraic.window
    run.log.need_every_encoder("algebraic")
    if window is None:
        return algebraic_steps(session.machine, run.log, run.data)
    return least_squares_steps(session.machine, run.log, run.data, window)


def _form(name: str) -> Callable[[Session], Steps[Estimate]]:
    """Return the steps function of a form that solves the equations of each joint separately."""

    def steps(session: Session) -> Steps[Estimate]:
        from jaxid.estimators.algebraic.one_window import FORMS

        run, window = session.fit, session.case.algebraic.window
        run.log.need_every_encoder(name)
        return FORMS[name](session.machine, run.log, run.data, window)

    return steps


def _minimal_model(
    session: Session, *, printed: bool = False, weight: float | None = None
) -> Steps[Estimate]:
    from jaxid.estimators.minimal.fit import minimal_model_steps

    return minimal_model_steps(session, printed, weight)


def _minimal_model_printed(session: Session, *, weight: float | None = None) -> Steps[Estimate]:
    return _minimal_model(session, printed=True, weight=weight)


_FORMS = ("single_time", "ratio", "sign_changed", "sign_unchanged")


# Methods that simulate, and accept options of the simulation.
SIMULATING = ("output_error", "within_prior", "instrumental_variable", "didim")
# Methods that solve balances of the measured force, and print what the uncertainty of the time for which each
# force acts adds. `recursive` does not: its precision is that of its memory.
BALANCING = ("inverse_dynamics", "instrumental_variable", "didim", "power", "algebraic")

METHODS: dict[str, Callable[..., Steps[Estimate]]] = {
    "output_error": _output_error,
    "prediction_error": _prediction_error,
    "within_prior": _within_prior,
    "inverse_dynamics": _inverse_dynamics,
    "algebraic": _algebraic,
    "instrumental_variable": _instrumental_variable,
    "didim": _didim,
    "power": _power,
    "recursive": _recursive,
    **{f"algebraic_{name}": _form(f"algebraic_{name}") for name in _FORMS},
    "minimal_model": _minimal_model,
    "minimal_model_printed": _minimal_model_printed,
}


def register_method(name: str, steps: Callable[..., Steps[Estimate]]) -> None:
    """Register an estimator, so that `identify`, `identify_many` and `study` accept its name.

    Args:
        name: Name of the method, in Python and in [study] estimators of a case.
        steps: Function from a session to a generator of solves that returns an `Estimate`.

    Raises:
        InputError: If the name is not an identifier, or is that of another method.
    """
    known = METHODS.get(name)
    taken = known is not None and (known.__module__, known.__qualname__) != (
        steps.__module__,
        steps.__qualname__,
    )
    if taken or name in ("discover", "in_loop") or not name.isidentifier():
        what = "is taken" if name.isidentifier() else "is not a name"
        raise InputError(f"method {name!r} {what}", hint="choose another name, of letters, digits and _")
    METHODS[name] = steps
    if name not in USER_METHODS:
        USER_METHODS.append(name)


def steps_of(method: str, session: Session, **options: Any) -> Steps[Estimate]:
    """Return the steps of a fit by one of `METHODS`.

    Args:
        method: Name of the method.
        session: Case and logs of the fit.
        options: Keyword arguments of the method.

    Raises:
        InputError: If the log lacks a position or time that the method needs; if the reference has unknowns
            and the method does not fit them in a simulated loop; if links must be physically consistent, and
            the method or the links do not allow it; or if the case asks for a Hessian or a profile, and the
            method maximises no likelihood.
    """
    need_likelihood(method, session.case)
    need_one_log(session, method)
    if method != "output_error":
        need_force(session, method)
    else:
        need_alike(session)
    need_position(method, session.fit.log)
    if method not in ("output_error", "within_prior") or session.more:
        need_known_reference(session, f"{method} takes them as they are")
    if method != "output_error" and (method != "within_prior" or session.more):
        why = (
            "does not take them with several logs" if session.more else "does not simulate the loop with them"
        )
        need_known_controller(session, f"{method} {why}")
    if method == "within_prior":
        steps = METHODS[method]
    else:
        from jaxid.estimators.common.shapes import seen_shapes

        # A prior says something about every shape; other methods know what the log shows.
        steps = lambda *args, **kwargs: seen_shapes(
            METHODS[method](*args, **kwargs), session.machine.parameters.guess
        )
    if method in BALANCING:
        steps = partial(with_uncertain_hold, steps)
    if not session.case.identification.physically_consistent:
        return steps(session, **options)
    from jaxid.estimators.common.consistency import need_bodies, with_links

    need_consistent(method, session.case)
    session = need_bodies(session)
    return with_links(steps(session, **options), session)
