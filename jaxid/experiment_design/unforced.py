"""Design experiments for a loop whose force is not logged, by the position of the simulated loop.

The information of such a log is that of its position. It never tells a scale that nothing known gives: the
design then names a remedy: a gain that is stated, or a payload that is known in a second log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.estimators.several.parts import Part
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.estimators.unforced import base_of, common_scale_group, without
from jaxid.estimators.within_prior.prior import Prior
from jaxid.experiment_design.by_trials import Trials, informative_commands
from jaxid.experiment_design.in_loop import (
    PRIOR,
    SHARPNESS,
    LoopDesign,
    empty_replay,
    family,
    informative_signals,
    limits_of,
)
from jaxid.experiment_design.limits import Limits
from jaxid.experiment_design.position_information import (
    PositionInformation,
    gained,
    log_at_rest,
    peaks_of,
    played,
)
from jaxid.experiment_design.present import Present, present_of
from jaxid.experiment_design.second_logs import second_logs
from jaxid.experiment_design.shapes import Shapes
from jaxid.experiment_design.unforced_design import UnforcedDesign
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER
from jaxid.scene import refuse_impossible, sampling_of

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification

# Number of most informative starts that are improved, and evaluations for each.
_IMPROVED, _EVALUATIONS = 3, 100
# Part by which the rate of the log may differ from a whole part of the loop's: of a stated loop, and of one
# whose rate is that of a log, which is no round number.
_WHOLE, _NEARLY = 1e-3, 0.02


@dataclass(frozen=True)
class _Sampling:
    """Rows of the designed log.

    Args:
        rate: Rows a second [Hz].
        rows: Number of rows.
        every: Ticks of the loop a row.
    """

    rate: float
    rows: int
    every: int


@dataclass(frozen=True)
class _Search:
    """Hold the settings of a search for commands.

    Args:
        case: The case.
        present: The machine, the noise and the present logs.
        sampling: Rows of the designed log.
        limits: Limits of the experiment.
        base: Unknown that is held because nothing gives a scale; None: something does.
        known: Information of the present logs.
    """

    case: Case
    present: Present
    sampling: _Sampling
    limits: Limits
    base: int | None
    known: PositionInformation


def designed_unforced(
    case: Case, result: Identification | None, progress: Callable[[str], None]
) -> UnforcedDesign:
    """Find the reference whose log, without a force, would tell the unknowns best beside the present logs.

    The search maximises the determinant of the information of the position: for an arm by trials of the whole
    arm (`jaxid.experiment_design.by_trials`), else by gradients through the smoothed loop. The deviations of
    the result are those of the loop with exact dry friction.

    Args:
        case: The case, with the tables that `jaxid.design` requires.
        result: A fit of the present logs; None: there are none, and the guesses count.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If the noise of the encoder is not known, the rate of the log does not go with that of
            the loop, or no experiment keeps within the limits.
    """
    _refuse(case)
    present = present_of(case, result, sampling_of(case)[0])
    machine, width = present.machine, len(present.machine.parameters.free)
    sampling, limits = _sampling(case, machine), _limits(case, machine)
    rate, rows = sampling.rate, sampling.rows

    before = [PositionInformation.of(part, present.noise, width) for part in present.parts]
    known = PositionInformation.none(width)
    for one in before:
        known = known + one
    stroke = np.linspace(limits.low, limits.high, rows)
    resting = log_at_rest(machine, np.zeros((rows, 1)), rate, present.start)
    blank = Part.alone(machine, replace(resting, position=stroke))
    group = common_scale_group(machine, [*present.parts, blank])
    base = base_of(machine, group) if group else None
    held = () if base is None else (base,)
    search = _by_trials if case.plant.cls.linked else _by_gradients
    signals, has_tour = search(_Search(case, present, sampling, limits, base, known), progress)

    progress("computing the expected precision of each")
    parts = [Part.alone(machine, played(machine, signal, rate, present.start)) for signal in signals]
    informed = [known + PositionInformation.of(part, present.noise, width) for part in parts]
    guess = np.delete(machine.parameters.guess, held)
    scores = [gained(one.least(machine, held), guess) for one in informed]
    best = int(np.argmax(scores))

    progress("trying second logs")
    signal, whole = signals[best], informed[best]
    second = second_logs(case, present, limits, signal, rate, whole, held)
    gains = [k for k in group if machine.parameters.free[k].path[0] == CONTROLLER or k == base]
    return UnforcedDesign(
        case=case,
        machine=machine,
        time=np.arange(rows) / rate,
        values=signal,
        group=group,
        base=base,
        std=present.std(whole, held),
        plain=present.std(informed[0], held) if has_tour else None,
        before=present.std(known, held) if before else None,
        stating={machine.parameters.names[k]: present.std(whole, (k,)) for k in gains},
        second=second,
        noise=present.noise,
        peaks=peaks_of(machine, parts[best].log),
        result=result,
    )


def _refuse(case: Case) -> None:
    """Refuse a machine, or settings, for which no such experiment is designed."""
    if case.identification.per_log:
        what = "no experiment is designed for unknowns with a value in each log"
        hint = "leave per_log out, and state what is known to differ by set in [[fit]]"
        raise InputError(what, where=f"{case.where}, [identification]", hint=hint)
    others = [] if case.design is None else [k for k in case.tables.get("design", {}) if k != "acceleration"]
    if others:
        what = f"{others[0]} is of an experiment along a reference, and a log without a force has none"
        raise InputError(what, where=f"{case.where}, [design]", hint=f"leave {others[0]} out")


def _limits(case: Case, machine: Machine) -> Limits:
    """Take the limits of a case; a command may saturate if the saturation is an unknown."""
    limits = limits_of(case, machine)
    unknown = [f.path[1] for f in machine.parameters.free if f.path[0] == CONTROLLER]
    if "limit" in unknown and case.limits.force is None:
        return replace(limits, force=np.full(limits.force.shape, np.inf))
    return limits


def _by_trials(
    search: _Search, progress: Callable[[str], None]
) -> tuple[list[Float[np.ndarray, "rows m"]], bool]:
    """Return the tour and the best command of those that are tried; see `_by_gradients`."""
    shapes, starts = _commands(search.case, search.present.machine, search.sampling, search.limits)
    held = () if search.base is None else (search.base,)
    trials = Trials(search.present, search.known, held, search.limits, shapes, search.sampling.rate)
    tour, best = informative_commands(trials, starts, search.case.where, progress)
    found = [best] if tour is None else [tour, best]
    return [trial.signal for trial in found], tour is not None


def _by_gradients(
    search: _Search, progress: Callable[[str], None]
) -> tuple[list[Float[np.ndarray, "rows m"]], bool]:
    """Return commands improved by gradients through the loop, and whether the first one is the tour.

    It is not if the tour breaks the limits.
    """
    problem = _problem(search)
    signals = informative_signals(problem, search.case.where, progress, _IMPROVED, _EVALUATIONS)
    return signals, problem.within(problem.starts[0]) is not None


def _commands(
    case: Case, machine: Machine, sampling: _Sampling, limits: Limits
) -> tuple[Shapes, list[np.ndarray]]:
    """Return the family of commands with a value a row of the log, and those from which a search starts.

    Raises:
        InputError: If the machine cannot start where the case says.
    """
    refuse_impossible(machine.plant, _start(case)[None], f"{case.where}, [simulation] initial_position")
    stated_limit = None if case.design is None else case.design.acceleration
    acceleration = None
    if stated_limit is not None:
        by_joint = np.broadcast_to(stated_limit, machine.plant.joints)
        acceleration = np.asarray(machine.plant.at_drives(by_joint))
    return family(machine, limits, sampling.rows, 1 / sampling.rate, acceleration)


def _sampling(case: Case, machine: Machine) -> _Sampling:
    """Return the rows of the log that a case asks for, at a whole part of the loop's rate.

    Raises:
        InputError: If the rate of the log is no whole part of the loop's.
    """
    rate, duration = sampling_of(case)
    assert machine.controller is not None, "without a controller there is no loop"
    period = float(machine.controller.period)
    every = max(1, round(1 / (rate * period)))
    whole = 1 / (every * period)
    stated = None if case.controller is None else case.controller.period
    # The period of a robot's file is that of its simulation; the machine has that of the log.
    is_stated = stated is not None and np.isclose(period, stated, rtol=_WHOLE)
    if abs(whole / rate - 1) > (_WHOLE if is_stated else _NEARLY):
        raise InputError(
            f"a loop of {1 / period:g} Hz cannot be logged at sample_rate = {rate:g}",
            where=case.where,
            hint="take the loop's rate, or a whole part of it",
        )
    return _Sampling(whole, round(duration * whole), every)


def _start(case: Case) -> Float[np.ndarray, " n"]:
    """Return the position at the start, (n,)."""
    return np.broadcast_to(np.asarray(case.simulation.initial_position, float), case.plant.joints)


def _problem(search: _Search) -> LoopDesign:
    """Set up the search for a reference by gradients, with the base of a scale held."""
    case, present, sampling, limits = search.case, search.present, search.sampling, search.limits
    base, known = search.base, search.known
    machine = present.machine if base is None else without(present.machine, base)
    shapes, starts = _commands(case, machine, sampling, limits)
    assert machine.controller is not None, "without a controller there is no loop"
    period, rows, every = float(machine.controller.period), sampling.rows, sampling.every
    plant = machine.plant.smoothed(np.asarray(SHARPNESS), np.asarray(float(limits.speed.max())))
    machine = machine.with_plant(plant, machine.parameters)

    memory = choose_numerics(machine, log_at_rest(machine, np.zeros((rows, 1)), sampling.rate, present.start))
    prior = Prior.of(machine, PRIOR, np.zeros(0))
    slope = prior.slope(machine.parameters.guess)
    matrix = known.least(present.machine, () if base is None else (base,)) * np.outer(slope, slope)
    ticks = (rows - 1) * every + 1
    return LoopDesign(
        machine=machine,
        replay=empty_replay(machine, _start(case), ticks, period, every, memory.longest_delay),
        weight=np.tile(1.0 / present.noise, (rows, 1)),
        direct_share=np.ones(len(present.noise)),
        prior=prior,
        on="position",
        limits=limits,
        shapes=shapes,
        starts=starts,
        known=np.eye(len(matrix)) + matrix,
    )
