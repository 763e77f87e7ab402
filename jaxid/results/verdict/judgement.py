"""The verdict on a fit, from its parameters, its gaps and the noise, and its findings as sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxid.consistency.absent import known_forces
from jaxid.consistency.clipped import SEEMS
from jaxid.consistency.force_reading import ForceReading
from jaxid.consistency.law import law_of_rows
from jaxid.effects import EFFECTS
from jaxid.estimators.apart.joint import stands_apart
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.force_timing import delay_words
from jaxid.estimators.several.parts import parts_of
from jaxid.gap import DRIFTED, Gap
from jaxid.logs.units_check import INERTIA_DOUBT
from jaxid.machine import Machine
from jaxid.names import LEAVE_ROWS_OUT, SIMULATE_THE_LOOP
from jaxid.results.report.numbers import percent, plain, scaled_unit
from jaxid.results.verdict.absurd import Remark, remarks_on, undetermined
from jaxid.results.verdict.completeness import Residual, position_residuals, residuals_of
from jaxid.results.verdict.needed_noise import needed_noise
from jaxid.results.verdict.robot_file import contradicted_file
from jaxid.session import OpenedLog, Session

# A force residual of this part of the measured force, or a distance of the simulated position of this part of
# the motion's standard deviation, is of the order of the motion itself.
_OF_THE_ORDER = 0.5
# Ratio of gap to noise beyond which the ratio says more than the colour.
_CLEARLY = 1.3
# Ratio of what a loop leaves without noise to what its mean readings leave from which a sentence names both.
_MOVED = 2.0
# A residual beyond this many times the measured force is stated without a number.
_FAR = 10.0
# A model that leaves this part of the force explains nothing: the log's columns are in doubt first.
_NOTHING = 0.9
# Delay of the force in samples below which it is a note only.
_SLIGHT = 0.05
# Most sentences on single values; further ones are counted.
_MOST = 6
_SEARCH = "The command jaxid discover searches for what is missing."

# Of an arm without a force, which is searched joint by joint.
_NO_SPRINGS = (
    "A drive that is elastic or has clearance is searched for at a joint of an arm without a force on "
    'request only, as such a search takes long (candidates = ["joint_flexibility"] in [discover]): other '
    "effects may be named in its place, as an unbalance or a constant force."
)


@dataclass(frozen=True)
class Judgement:
    """The verdict on a fit.

    Args:
        model_complete: Whether the model leaves nothing but noise; None if that cannot be decided.
        explains: Whether the model explains the log at all.
        identified: Whether the log determines at least one parameter.
        findings: The reasons as sentences, the most important first.
        drifted: Whether an open-loop simulation drifts away from a log; its position then measures nothing.
        residuals: Comparison of each joint's force residual with the noise.
    """

    model_complete: bool | None
    explains: bool
    identified: bool
    findings: tuple[str, ...]
    drifted: bool
    residuals: tuple[Residual, ...]


def judge(
    session: Session,
    estimate: Estimate,
    gaps: Sequence[Gap],
    search: str | None = None,
    reading: ForceReading | None = None,
) -> Judgement:
    """Judge a fit.

    Args:
        session: Case and logs.
        estimate: Parameters and their precision.
        gaps: Gaps of the fitted machine, the fitted log first.
        search: Verdict of a search for missing effects; None without one.
        reading: A late or drifting reading of the force that explains the log as well as effects of the
            search; None if none does.
    """
    residuals = tuple(
        found
        for k, (run, gap) in enumerate(zip(session.runs, gaps, strict=True))
        for found in _residuals(run.machine(estimate.machine), run, gap, fitted=k < len(session.fits))
    )
    complete = _complete(residuals)
    if search == "nothing_missing" and complete is False:
        complete = None

    remarks = remarks_on(session, estimate)
    noisy = needed_noise(session, estimate)
    units = _unit_words(session)
    doubt = _doubt(remarks, reading) or ("a unit is in doubt" if units else noisy)
    complete = None if complete and doubt else complete
    blind = undetermined(estimate)
    identified = len(blind) < len(estimate.names) or not estimate.names
    against = [*_large_gaps(session, gaps, residuals), *_left(session, gaps)]
    # A guess may be far off; only beside a residual that is not noise does that question the model.
    impossible = [r for r in remarks if r.impossible] if complete is not True else []
    against += [f"{r.text}." for r in impossible]

    contrary = [r for r in remarks if r.contradicts and r not in impossible]

    findings = units + _scale_words(session)
    findings += [] if estimate.converged else [f"The fit did not converge: {estimate.message}."]
    findings += _delay_words(estimate)
    findings += _clipped_words(session, estimate)
    findings += [] if reading is None else reading.findings
    findings += [f"The fit contradicts the case: {r.text}." for r in contrary]
    findings += _law_words(session, estimate)
    if against:
        findings.append(f"This model does not explain the log: {against[0]}")
        findings += [_capital(text) for text in against[1:]]
    if not identified:
        findings.append("This log determines none of the unknowns.")
    findings += _hidden_words(session, estimate)
    worst = max((float(np.nanmax(g.force.relative, initial=0.0)) for g in gaps), default=0.0)
    doubtful = bool(against) and worst >= _NOTHING
    if doubtful:
        findings.append(
            "Check first that the columns of position and force are the right ones, with sign, unit and gain."
        )
    findings += _completeness_words(
        session, residuals, complete, None if doubtful else search or "none", doubt
    )
    may_lack = noisy or any(r.above_floor for r in residuals)
    findings += [_SEARCH] if complete is None and may_lack and not search else []
    findings += contradicted_file(session, estimate)
    others = [r for r in remarks if r not in (*impossible, *contrary)]
    findings += _remark_words(others)
    drifted = _drifted(session, gaps)
    findings += drifted
    return Judgement(complete, not against, identified, tuple(findings), bool(drifted), residuals)


def _unit_words(session: Session) -> list[str]:
    """Return a sentence on a unit that is in doubt, as the inertia of the log is far from its guess."""
    doubts = [f for f in session.findings if f.what.startswith(INERTIA_DOUBT)]
    return [f"A unit is in doubt: {doubts[0].what}; {doubts[0].hint}."] if doubts else []


def _scale_words(session: Session) -> list[str]:
    """Return a sentence on the known value that gives a free swing its scale, which the log cannot check."""
    machine, log = session.machine, session.fit.log
    if not log.passive or machine.controller is not None or session.more:
        return []
    known = known_forces(machine)
    if not known:
        return []
    listed = ", ".join(known[:_MOST])
    return [
        f"Nothing drives the machine, so all values are in proportion to {listed}, which the log cannot "
        "check. If it is an assumption, only the ratios of the values hold."
    ]


def _clipped_words(session: Session, estimate: Estimate) -> list[str]:
    """Return a sentence on the rows of the fitted logs in which the recording of the force is clipped."""
    masks = [run.log.clipped for run in session.fits if run.log.clipped is not None]
    if not masks or (session.machine.controller is not None and estimate.method in SIMULATE_THE_LOOP):
        return []
    rows, samples = sum(int(m.any(axis=1).sum()) for m in masks), sum(run.log.samples for run in session.fits)
    head = f"{SEEMS[0].upper()}{SEEMS[1:]} in {rows} rows ({100 * rows / samples:.2g} %)"
    if estimate.method in LEAVE_ROWS_OUT:
        return [f"{head}, which are left out."]
    method = estimate.method
    return [f"{head}. {method} cannot leave them out, and its values may be off: use prediction_error."]


def _delay_words(estimate: Estimate) -> list[str]:
    """Return a sentence on a delay of the force that was estimated, or that the log asks for."""
    delay = estimate.details.get("force_delay")
    if delay is None or abs(delay["samples"]) < _SLIGHT:
        return []
    how = delay_words(delay)
    if delay["used"]:
        return [f"The force is taken as logged {how}, which was estimated with the unknowns."]
    return [
        f"The force seems to be logged {how}: that is too long to be taken for timing, and the values are "
        "those of the log as it is."
    ]


def _hidden_words(session: Session, estimate: Estimate) -> list[str]:
    """Return a sentence on the unknowns that the noise of the readings hides, if there are any."""
    hidden = estimate.details.get("reading_noise", {}).get("hidden", [])
    if not hidden:
        return []
    more = f" and {len(hidden) - _MOST} more" if len(hidden) > _MOST else ""
    other = "" if session.fit.log.integrated else "; the method instrumental_variable may"
    return [
        f"Noise of the readings hides {', '.join(hidden[:_MOST])}{more}: a faster log, finer encoders or "
        f"faster motion would show them{other}."
    ]


def _law_words(session: Session, estimate: Estimate) -> list[str]:
    """Return a sentence on a control law that explains the logs clearly better than the stated one."""
    other = estimate.details.get("other_law")
    if other is None:
        return []
    scale, unit = scaled_unit(session.machine.unit("position"), [other["rms"], other["rms_stated"]])
    less, more = (f"{plain(other[key] / scale)} {unit}" for key in ("rms", "rms_stated"))
    return [
        f"With derivative = '{other['derivative']}' in place of the stated '{other['stated']}' the fitted "
        f"loop leaves {less} of the position, not {more}: check the law of the servo."
    ]


def _residuals(machine: Machine, run: OpenedLog, gap: Gap, *, fitted: bool) -> list[Residual]:
    """Compare what a model leaves of a log with the noise: of the force, or of the position of a loop.

    The force of a log slower than its loop is known at the rows only, so that a complete model may leave more
    than noise of it. The position that the loop then simulates decides.
    """
    of_position = lambda: position_residuals(machine, run, gap.simulation, fitted=fitted)
    if machine.unforced(run.log):
        return of_position()
    of_force = residuals_of(machine, run, gap.force, fitted=fitted)
    if run.log.reference is None or not machine.ticks_between_rows(run.log) or _complete(of_force):
        return of_force
    return of_position()


def _complete(residuals: Sequence[Residual]) -> bool | None:
    """Return False if any residual is more than noise, None if any is undecided or there is none."""
    decided = [r.complete for r in residuals]
    if False in decided:
        return False
    return None if None in decided or not decided else True


def _place(session: Session, log: str, joint: int) -> str:
    """Return the place of a number in words: joint and log, where there are several."""
    joints = int(np.sum(session.fit.log.measured))
    at = f" at joint {joint + 1}" if joints > 1 else ""
    on = f" on the log {log}" if log != session.fit.name or session.more else ""
    return at + on


def _large_gaps(session: Session, gaps: Sequence[Gap], residuals: Sequence[Residual]) -> list[str]:
    """Return sentences on residuals of the order of the measured force."""
    noise = {(r.log, r.joint) for r in residuals if r.complete}
    out = []
    for gap in gaps:
        for joint, relative in enumerate(gap.force.relative):
            if np.isfinite(relative) and relative >= _OF_THE_ORDER and (gap.name, joint) not in noise:
                where = _place(session, gap.name, joint)
                much = f"leaves {percent(relative)} of the measured force unexplained"
                if relative > _FAR:
                    much = f"is off by more than {_FAR:g} times the measured force"
                out.append((relative, f"it {much}{where}."))
    return [text for _, text in sorted(out, key=lambda entry: -entry[0])]


def _left(session: Session, gaps: Sequence[Gap]) -> list[str]:
    """Return sentences on simulated loops that leave the log."""
    out = []
    for run, gap in zip(session.runs, gaps, strict=True):
        if not _looped(session, run):
            continue
        on = "" if run.name == session.fit.name and not session.more else f" on the log {run.name}"
        if gap.simulation is None:
            out.append(f"the simulated loop diverges{on}.")
            continue
        off = _off(run, gap)
        worst = int(np.argmax(off))
        if off[worst] >= _OF_THE_ORDER:
            text = f"the simulated loop leaves it, by {percent(off[worst])} of the motion"
            out.append(f"{text}{_place(session, run.name, worst)}.")
    return out


def _looped(session: Session, run: OpenedLog) -> bool:
    """Check that a log is simulated in its loop."""
    machine = session.machine
    known = run.log.reference is not None or machine.unknown_reference is not None
    return machine.controller is not None and known


def _off(run: OpenedLog, gap: Gap) -> np.ndarray:
    """Return the RMS distance of a simulation over the standard deviation of the motion, by joint."""
    assert gap.simulation is not None, "the simulation of this gap has run"
    spread = np.std(run.log.filled, axis=0)
    off = np.nan_to_num(gap.simulation.rms / np.where(spread > 0, spread, np.inf))
    return np.where(run.log.measured, off, 0.0)


def _drifted(session: Session, gaps: Sequence[Gap]) -> list[str]:
    """Return a sentence on open-loop simulations that drift away from their log."""
    for run, gap in zip(session.runs, gaps, strict=True):
        if _looped(session, run) or run.log.steady is not None:
            continue
        if gap.simulation is None or np.max(_off(run, gap)) >= DRIFTED:
            return [
                "The simulated position is no measure here: without a controller the simulation runs in open "
                "loop, where any small error of the force decides when friction sticks and grows with time."
            ]
    return []


def _doubt(remarks: Sequence[Remark], reading: ForceReading | None) -> str:
    """Return the reason for which a model that leaves only noise is not called complete; empty if none."""
    if reading is not None:
        return f"{' and '.join(reading.effects)} may stand for the {reading.short}"
    return next((r.text for r in remarks if r.forbids), "")


def _completeness_words(
    session: Session,
    residuals: Sequence[Residual],
    complete: bool | None,
    search: str | None,
    doubt: str = "",
) -> list[str]:
    """Return the sentences on the completeness of the model.

    Args:
        session: Case and logs.
        residuals: Comparison of the residuals with noise.
        complete: Whether the model leaves nothing but noise.
        search: Verdict of a search; "none" if one may help.
        doubt: Reason for which the model is not called complete.
    """
    if complete:
        with_it = "With what was found the" if search == "found" else "The"
        left = max((r for r in residuals if r.within_numerics), key=_severity, default=None)
        what = "what it leaves has the size and colour of noise"
        if left is not None:
            what = f"{_residual_words(session, left)}, but no more than {_numerics_words(session, left)}"
        return [f"{with_it} model is complete for this log: {what}.", *_noise_words(session, residuals)]
    if complete is None:
        reason = next((r.reason for r in residuals if r.complete is None), doubt)
        unexplained = not reason and search == "nothing_missing"
        if unexplained:
            reason = "the residual is not quite noise, and no known effect accounts for it"
        return [
            f"Whether the model is complete is not known: {reason or 'the log has no samples in motion'}.",
            *(_loop_words(session) if unexplained else []),
        ]
    worst = max((r for r in residuals if r.complete is False), key=_severity)
    what = {
        "found": "With what was found the model is still incomplete",
        "unexplained": "The model is incomplete, and no known effect explains it",
    }.get(search or "", "The model is incomplete")
    lines = [f"{what}: {_residual_words(session, worst)}."]
    lines.append(
        "The standard deviations count noise only: the values are those that fit best in this model, and the "
        "machine's may differ by more."
    )
    lines += _loop_words(session)
    machine = session.machine
    by_joint = stands_apart(machine, parts_of(session))
    if search == "none" and (by_joint or not (machine.unforced(session.fit.log) and machine.plant.coupled)):
        lines.append(_SEARCH)
    asked = {*session.case.kinds, *(effect.kind for effect in session.case.candidates)}
    springs = any(EFFECTS[kind].adds_spring for kind in asked if kind in EFFECTS)
    if search in ("found", "unexplained") and by_joint and not springs:
        lines.append(_NO_SPRINGS)
    return lines


def _noise_words(session: Session, residuals: Sequence[Residual]) -> list[str]:
    """Return a sentence on the residual that noise in the loop moves most, if it moves one clearly."""
    moved = [r for r in residuals if r.quiet > _MOVED * r.rms]
    if not moved:
        return []
    r = max(moved, key=lambda r: r.quiet / r.rms)
    scale, unit = scaled_unit(session.machine.unit(r.quantity, r.joint), [r.rms, r.quiet])
    return [
        f"The loop answers the noise of its encoder{_place(session, r.log, r.joint)}: simulated with this "
        f"noise it leaves {plain(r.rms / scale)} {unit} of the position, and {plain(r.quiet / scale)} {unit} "
        "without it, as in the table."
    ]


def _loop_words(session: Session) -> list[str]:
    """Return a sentence on a loop that is not declared and may be faster than its log."""
    machine, log = session.machine, session.fit.log
    if machine.controller is not None or log.reference is None or log.steady is not None:
        return []
    law = law_of_rows(machine, log)
    named = f" (its rows are those of {law})" if law else ""
    rate = f"{plain(log.rate_hz)} Hz of the log"
    known = session.fit.data.faster_loop
    faster = f"as the loop is faster than the {rate}" if known else f"if the loop is faster than the {rate}"
    return [
        f"The log has a reference, and the case no [controller]{named}: {faster}, its force changes between "
        "the rows, and only a declared loop with its period gives it."
    ]


def _numerics_words(session: Session, r: Residual) -> str:
    """Return in words how large the errors of filtering and integration in a residual may be."""
    scale, unit = scaled_unit(session.machine.unit(r.quantity, r.joint), [r.numerics])
    return f"the {plain(r.numerics / scale)} {unit} that filtering and integration may leave"


def _severity(r: Residual) -> float:
    return r.rms / r.floor if np.isfinite(r.floor) and r.floor > 0 else r.excess


def _residual_words(session: Session, r: Residual) -> str:
    """Return in words how a residual differs from noise."""
    scale, unit = scaled_unit(session.machine.unit(r.quantity, r.joint), [r.rms, r.floor])
    gap = "force gap" if r.quantity == "force" else "gap of the simulated position"
    where = _place(session, r.log, r.joint)
    ratio = r.rms / r.floor if np.isfinite(r.floor) and r.floor > 0 else np.nan
    sizes = f"{plain(r.rms / scale)} {unit}"
    if np.isfinite(ratio) and ratio > _CLEARLY:
        noise = f"{plain(r.floor / scale)} {unit} that the sensors' noise leaves"
        return f"the {gap} of {sizes}{where} is {plain(ratio, 2)} times the {noise}"
    return f"the {gap} of {sizes}{where} follows the motion, which noise does not"


def _remark_words(remarks: Sequence[Remark]) -> list[str]:
    lines = [f"{r.text}." for r in remarks[:_MOST]]
    return lines + ([f"{len(remarks) - _MOST} more values are in question."] if len(remarks) > _MOST else [])


def _capital(text: str) -> str:
    """Begin a sentence with a capital, unless it begins with the name of a parameter."""
    return text[0].upper() + text[1:] if text.startswith(("it ", "the ")) else text
