"""Results as text, for a terminal: the tables that commands print, and summaries of a few lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.logs.seen import sights_of
from jaxid.model.units import joined
from jaxid.results import as_json as results
from jaxid.results.aligned import aligned
from jaxid.results.by_joint import joint_rows
from jaxid.results.notes import grouped_notes
from jaxid.results.parameters import lines_of
from jaxid.results.precision import precision_lines, ratio_rows
from jaxid.results.report.numbers import plain, with_std
from jaxid.results.report.words import SLIGHT, place_words, within_prior_words
from jaxid.results.verdict.robot_file import file_of, values_of_file

if TYPE_CHECKING:
    from jaxid.commands.check import Check
    from jaxid.commands.identify import Identification
    from jaxid.discovery.result import Discovery
    from jaxid.estimators.estimate import Estimate
    from jaxid.gap import Gap
    from jaxid.machine import Machine
    from jaxid.results.result import FitResult
    from jaxid.session import Session
    from jaxid.studies.result import Study

# Number of sets of unidentified parameters that a study prints.
_PARTIAL = 6
# Stands in tables in place of a standard deviation.
UNIDENTIFIABLE = "not identifiable from this log"
# Head of the standard deviations that hold for an incomplete model, and what they are.
INCOMPLETE = "std of the best fit"
_INCOMPLETE_WORDS = (
    f"{INCOMPLETE}: scatter over logs of this kind, about the values with which this model fits them best; "
    "those are not the machine's"
)
# Name of the noise floor in the table of gaps, and what it is.
FLOOR = "noise floor"
_FLOOR_WORDS = "noise floor: RMS force that the sensors' noise alone leaves in the band of the filter"
_EVIDENCE_WORDS = (
    "evidence: gain in log-likelihood on stretches of the log that a fit did not use, in nats (natural "
    "logarithm): e to that power is the odds in favour"
)


def parameter_rows(result: FitResult) -> list[list[str]]:
    """Return a header, and value, standard deviation and unit of every parameter and derived quantity.

    With an incomplete model the deviations that hold then stand in a column, and so do the values of the
    robot's file, where there is one.
    """
    session, estimate = result.session, result.estimate
    beside = estimate.std_misspecified if result.model_complete is False else None
    of_file = values_of_file(session)
    heads = [] if beside is None else [INCOMPLETE]
    heads += [f"in {file_of(session)}"] if of_file else []
    rows = [["parameter", "value", "std", *heads, "unit"]]
    free = estimate.machine.parameters.free
    for k, f in enumerate(free):
        value, std, ok = estimate.theta[k], estimate.std[k], estimate.identifiable[k]
        shown = with_std(value, std) if ok else ("-", UNIDENTIFIABLE)
        more = [] if beside is None else [with_std(value, beside[k])[1] if ok else "-"]
        if of_file:
            more.append(plain(of_file[f.name]) if f.name in of_file else "-")
        rows.append([f.name, *shown, *more, f.unit])
    derived = [d for d in results.derived(session, estimate) if np.isfinite(d.std)]
    rows += [[d.name, *with_std(d.value, d.std), *("-" for _ in heads), d.unit] for d in derived]
    return rows


def gap_rows(session: Session, gaps: Sequence[Gap], floor: np.ndarray) -> list[list[str]]:
    """Return a header, and the disagreement of a model with its logs in force and in position."""
    gap = results.gap_json(session, gaps, floor)
    simulation = gap["simulation"]
    floor_of_position = [FLOOR, _number(simulation.get("noise_floor")), "", joined(simulation["unit"])]
    forces = [
        ["force", _number(gap["fit"]), _number(gap["validation"]), joined(gap["unit"])],
        ["force, relative", _number(gap["relative"]["fit"]), _number(gap["relative"]["validation"]), ""],
        [FLOOR, _number(gap["noise_floor"]), "", joined(gap["unit"])],
    ]
    return [
        ["gap", "fit", "validation", "unit"],
        *([] if session.machine.unforced(session.fit.log) else forces),
        [
            "simulated position",
            _number(simulation["fit"]),
            _number(simulation["validation"]),
            joined(simulation["unit"]),
        ],
        *([floor_of_position] if "noise_floor" in simulation else []),
    ]


def logs_rows(session: Session, gaps: Sequence[Gap], floor: np.ndarray) -> list[list[str]]:
    """Return a header, and the disagreement of a model with each of several fitted logs."""
    gap = results.gap_json(session, gaps, floor)
    units = joined(gap["unit"]), joined(gap["simulation"]["unit"])
    rows = [["fitted log", "samples", f"force [{units[0]}]", f"simulated position [{units[1]}]"]]
    for run in session.fits:
        own = gap["fits"][run.name]
        rows.append([run.name, str(run.log.samples), _number(own["force"]), _number(own["simulation"])])
    return rows


def _parameters_text(result: FitResult) -> str:
    """Return the table of parameters, with a line below it if the model is incomplete."""
    rows = parameter_rows(result)
    return aligned(rows) + (f"\n{_INCOMPLETE_WORDS}" if INCOMPLETE in rows[0] else "")


def _number(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_number(v) for v in value)
    return "-" if value is None or not np.isfinite(value) else f"{value:.4g}"


def identification_table(result: Identification) -> str:
    """Return the text that `identify` prints."""
    session, estimate = result.session, result.estimate
    head = f"{estimate.method}: {estimate.message}, {estimate.samples} samples"
    parameters = _parameters_text(result)
    below = [
        *_identifiable_combinations(estimate.details.get("directions", [])),
        *_unidentifiable(estimate),
        *_relative(estimate),
        *within_prior_words(estimate.details),
        *precision_lines(estimate),
        *(_minimal(estimate.details["minimal"]) if "minimal" in estimate.details else []),
    ]
    gap = aligned(gap_rows(session, result.gaps, result.noise_floor))
    if session.more:
        gap += "\n\n" + aligned(logs_rows(session, result.gaps, result.noise_floor)) + "\n"
    notes = _notes(results.notes(session, estimate))
    seen = results.reading_lines(session)
    floor = [] if session.machine.unforced(session.fit.log) else [_FLOOR_WORDS]
    lines = [*result.findings, "", *seen, head, "", parameters, *below, "", gap, *floor, *notes]
    return "\n".join(lines)


def identification_summary(result: Identification) -> str:
    """Return an identification in a few lines."""
    estimate = result.estimate
    head = f"Identification of {result.session.case.name} by {estimate.method}: {estimate.message}"
    return "\n".join([head, *_indented(result), *lines_of(result.parameters), _gap_line(result)])


def _indented(result: FitResult) -> list[str]:
    return [f"  {finding}" for finding in result.findings]


def discovery_summary(result: Discovery) -> str:
    """Return a discovery in a few lines."""
    effects = ": " + ", ".join(e.label for e in result.effects) if result.effects else ""
    head = f"Discovery in {result.session.case.name}: {result.verdict.replace('_', ' ')}{effects}"
    return "\n".join([head, *_indented(result), *lines_of(result.parameters), _gap_line(result)])


def _gap_line(result: FitResult) -> str:
    """Return the force residual on the fitted and the validation logs in one line."""
    gap = results.gap_json(result.session, result.gaps, result.noise_floor)
    what = "force gap"
    if "noise_floor" in gap["simulation"]:
        what, gap = "gap of the simulated position", gap["simulation"]
    others = "" if gap["validation"] is None else f", validation {_number(gap['validation'])}"
    floor = f"noise floor {_number(gap['noise_floor'])} {joined(gap['unit'])}"
    return f"  {what}: fit {_number(gap['fit'])}{others}, {floor}"


def _identifiable_combinations(directions: Sequence[dict[str, Any]]) -> list[str]:
    """Return the combinations that a fit within a prior identifies, from the guesses on in units of it."""
    return [
        f"identifiable combination: {d['value']:+.3f} ± {d['std']:.3f} priors of "
        + ", ".join(f"{w:+.2f} {n}" for n, w in d["combination"].items() if abs(w) > SLIGHT)
        for d in directions
    ]


def _minimal(content: dict[str, Any]) -> list[str]:
    """Return the coefficients and statistics of a minimal model."""
    # With scipy.stats behind it: a second, which no other table needs.
    from jaxid.estimators.minimal.report import minimal_rows

    rows, lines = minimal_rows(content)
    return ["", aligned(rows), *lines]


def verdict_line(verdict: str, complete: bool | None) -> str:
    """Return the line with the verdict of a search, and whether it is sure that nothing is missing."""
    sure = verdict != "nothing_missing" or complete is not None
    return f"verdict: {verdict}" + ("" if sure else " (but whether anything is missing is not known)")


def discovery_table(result: Discovery) -> str:
    """Return the text that `discover` prints."""
    content = results.discovery_json(result)
    verdict = verdict_line(result.verdict, result.model_complete)
    lines = [verdict, *[f"finding: {finding}" for finding in result.findings]]
    # An effect says itself where it acts, better than a curve that knows no physics.
    if content["where"] and not result.effects:
        lines.append(f"where:   {content['where']['text']}")
    for effect in result.effects:
        others = ", ".join(s.candidate.label for s in effect.alternatives)
        alternatives = f"; not distinguishable from {others} in this log" if others else ""
        named = results.joint_name(effect.place, result.session.case.plant.names)
        at = f" at joint '{named['joint_name']}'" if named else ""
        lines.append(f"effect:  {effect.label}{at} (evidence {effect.score.evidence:.0f} nats{alternatives})")
    lines += [_EVIDENCE_WORDS] if result.effects else []
    by_joint = joint_rows(content)
    lines += ["", aligned(by_joint)] if by_joint else []
    lines += [f"experiment: {e['text']}" for e in content["experiments"]]

    parameters = _parameters_text(result)
    below = [*_unidentifiable(result.after), *_relative(result.after)]
    lines += ["", aligned(step_rows(content)), "", parameters, *below, ""]

    gap = content["gap"]
    position = (
        f"{_number(gap['simulation']['before'])} -> {_number(gap['simulation']['after'])} "
        f"{joined(gap['simulation']['unit'])}"
    )
    if result.judgement.drifted:
        position = "drifts off in open loop, see above"
    motion = gap["simulation"]
    if "noise_floor" in motion:
        floor = f"{FLOOR} {_number(motion['noise_floor'])} {joined(motion['unit'])}"
        lines.append(f"simulated position, gap on {gap['on']}: {position} ({floor})")
        return "\n".join([*lines, *_notes(content["notes"]), *results.reading_lines(result.session)])
    lines.append(
        f"gap on {gap['on']}: {_number(gap['before'])} -> {_number(gap['after'])} {joined(gap['unit'])} "
        f"({FLOOR} {_number(gap['noise_floor'])}); simulated position {position}"
    )
    lines.append(_FLOOR_WORDS)
    return "\n".join([*lines, *_notes(content["notes"]), *results.reading_lines(result.session)])


def step_rows(content: Mapping[str, Any]) -> list[list[str]]:
    """Return a header, and a row for each step of a search.

    Args:
        content: Content of discovery.json.
    """
    of_position = any("simulation" in step for step in content["steps"])
    what = "gap of the simulated position" if of_position else "force gap"
    unit = joined(content["gap"]["simulation"]["unit"]) if of_position else content["gap"]["unit"]
    rows = [["step", f"{what}, fit", f"{what}, validation"]]
    for step in content["steps"]:
        place = place_words(step)
        place = f" ({place})" if place else ""
        name = f"+ {step['added']}{place}" if step["added"] else "baseline"
        if "dropped" in step:
            name = (f"{name}, " if step["added"] else "") + f"- {step['dropped']}"
            name += "" if step["added"] else place
        left = step["simulation"] if of_position else step
        rows.append([name, f"{_number(left['fit'])} {unit}", _number(left["validation"])])
    return rows


def _relative(estimate: Estimate) -> list[str]:
    """Return the table of `ratio_rows` with a blank line before it; empty without ratios."""
    rows = ratio_rows(estimate)
    return ["", aligned(rows)] if rows else []


def _unidentifiable(estimate: Estimate) -> list[str]:
    """Return the combinations that the log does not determine; a fit within a prior holds them."""
    combinations = estimate.precision.unidentifiable
    if "directions" in estimate.details:
        return [f"held at the guesses: {_sum(c)}" for c in combinations]
    return _unidentifiable_lines(combinations)


def _unidentifiable_lines(combinations: Sequence[Mapping[str, float]]) -> list[str]:
    """Return unknowns, and combinations of them, that the log does not determine."""
    alone = [name for c in combinations if len(c) == 1 for name in c]
    lines = [f"not identifiable: {', '.join(alone)}"] if alone else []
    return lines + [f"not identifiable in combination: {_sum(c)}" for c in combinations if len(c) > 1]


def _sum(combination: Mapping[str, float]) -> str:
    return ", ".join(f"{w:+.2f} {n}" for n, w in combination.items())


def _notes(lines: Sequence[str]) -> list[str]:
    return ["", *[f"note: {line}" for line in grouped_notes(lines)]] if lines else []


def check_table(result: Check) -> str:
    """Return the text that `check` prints."""
    content = result.json()
    log, machine = content["log"], result.session.machine
    unit = lambda quantity, joints=None: joined(machine.unit_by_joint(quantity, joints))
    one = results.one_or_list
    heads = [_motion_line(log, machine)]
    if "fits" in content:
        heads = [f"{name}: {_motion_line(own, machine)}" for name, own in content["fits"].items()]
    recipe = content["preprocess"]
    what = f"{recipe['cutoff_hz']:.4g} Hz"
    if "reach" in recipe:
        what = f"parabola through {2 * recipe['reach'] + 1} samples, half the velocity at {what}"
    if "median" in recipe:
        what = f"median of {recipe['median']} samples of the force, {what}"
    how = (
        f"filter: {what}, one sample in {recipe['decimation']} kept; noise "
        f"floor {_number(one(content['noise_floor']))} {unit('force')}"
    )
    source = log["noise_from"]
    speeds = result.session.fit.log.integrated
    what, of = ("velocity", "position/time") if speeds else ("position", "position")
    noise = (
        f"noise of a reading: {what} {_number(one(log[f'{what}_noise']))} {unit(of)} "
        f"({source[what]}), force {_number(log['force_noise'])} in units of the log ({source['force']})"
    )
    lines = [*heads, how, noise]
    if result.session.fit.log.steady is not None:
        peaks = f"{_number(one(log['peak_velocity']))} {unit('position/time')}"
        peaks += f" and {_number(one(log['peak_force']))} {unit('force')}"
        lines = [f"{log['samples']} steady speeds, up to {peaks}"]
    rows = check_rows(content)
    combinations = _unidentifiable_lines([c["combination"] for c in content["unidentifiable"]])
    table = ["", aligned(rows)] if len(rows) > 1 else []
    session = result.session
    sound = "the logs are sound" if "fits" in content else "the log is sound"
    seen = [str(sight) for sight in result.sights]
    doubts = [f for f in session.findings if not f.about]
    others = [f"log {run.name}: {sight}" for run in session.runs[1:] for sight in sights_of(run.log)]
    notes = _notes([f"{f.where}: {f.what}; {f.hint}" for f in doubts])
    return "\n".join([*seen, *others, sound, *lines, *table, *combinations, *notes])


def _motion_line(log: Mapping[str, Any], machine: Machine) -> str:
    """Return length, stroke, speed and force of a log in one line."""
    driven = machine.plant.driven(machine.plant.joints)
    unit = lambda quantity, joints=None: joined(machine.unit_by_joint(quantity, joints))
    one = results.one_or_list
    return (
        f"{log['samples']} samples at {log['rate_hz']:.6g} Hz, {log['duration_s']:.4g} s; stroke "
        f"{_number(one(log['stroke']))} {unit('position')}, up to "
        f"{_number(one(log['peak_velocity']))} {unit('position/time')} and "
        f"{_number(one(log['peak_force']))} {unit('force', driven)}; {100 * log['moving']:.0f} % moving"
    )


def check_rows(content: Mapping[str, Any]) -> list[list[str]]:
    """Return a header, and the guess and the smallest standard deviation of each unknown.

    Args:
        content: Content of check.json.
    """
    rows = [["unknown", "guess", "std at best", "unit"]]
    for name, p in content["parameters"].items():
        best = f"{p['expected_std']:.2g}" if p["identifiable"] else UNIDENTIFIABLE
        rows.append([name, f"{p['guess']:.4g}", best, p["unit"]])
    return rows


def check_summary(result: Check) -> str:
    """Return a check in a few lines."""
    content = result.json()
    log, session = content["log"], result.session
    parameters = content["parameters"].values()
    known = sum(p["identifiable"] for p in parameters)
    lines = [
        f"Check of {session.case.name}: the log is sound",
        f"  {log['samples']} samples at {log['rate_hz']:.6g} Hz",
        f"  {known} of {len(parameters)} unknowns identifiable",
    ]
    return "\n".join(lines + [f"  {len(content['warnings'])} warning(s)"] * bool(content["warnings"]))


def study_table(result: Study) -> str:
    """Return the text that `study` prints."""
    from jaxid.studies.settings import SETTINGS, words_of

    settings = [name for name in SETTINGS if name in result.table.dims]
    runs = result.table.sizes["run"]
    lines = [_study_head(result), "", aligned(study_rows(result))]

    if result.tracking:
        sizes = [f"{what} {n}" for what in ("RMS", "peak") for n in ("median", "95 %", "worst")]
        rows = [[*settings, "drive", *sizes, "unit"]]
        for r in result.tracking:
            sizes = [_number(x) for name in ("rms", "peak") for x in r[name].values()]
            rows.append([*[f"{r[k]:g}" for k in settings], str(r["drive"]), *sizes, r["unit"]])
        lines += ["", "tracking error, last quarter of each run:", aligned(rows)]

    for k, n in enumerate(result.named):
        lines += ["", "named:"] if k == 0 else []
        lines += [f"  {words_of(n)}: {n['runs']} of {runs}: {n['what']}"]

    lines += ["", *result.verdicts] if result.verdicts else []

    for k, part in enumerate(result.partial[:_PARTIAL]):
        lines += ["", "identified in part:"] if k == 0 else []
        without = ", ".join(part["unidentifiable"])
        lines += [f"  {part['estimator']} at {words_of(part)}: {part['runs']} of {runs}: without {without}"]
    more = len(result.partial) - _PARTIAL
    lines += [f"  and {more} more; summary.json has all"] if more > 0 else []

    for k, f in enumerate(result.failures):
        lines += ["", "failed:"] if k == 0 else []
        lines += [f"  {f['estimator']} at {words_of(f)}: {f['runs']} of {runs}: {f['why']}"]
    return "\n".join(lines)


def study_rows(result: Study) -> list[list[str]]:
    """Return a header, and a row for each estimator, setting and parameter of a study."""
    from jaxid.studies.settings import SETTINGS

    def percent(x: float) -> str:
        return f"{100 * x:.1f} %" if np.isfinite(x) else "-"

    settings = [name for name in SETTINGS if name in result.table.dims]
    levels = [f"coverage_{level}" for level in (50, 68, 80, 95)]
    heads = ["bias", "spread", "reported", "bound", "unit", "50 %", "68 %", "80 %", "95 %"]
    heads += ["identifiable", "failed"]
    rows = [["estimator", *settings, "parameter", *heads]]
    for r in result.summary:
        sizes = [*[_number(r[k]) for k in ("bias", "spread", "std", "bound")], r["unit"]]
        parts = [percent(r[k]) for k in (*levels, "identifiable", "failed")]
        rows.append([r["estimator"], *[f"{r[k]:g}" for k in settings], r["parameter"], *sizes, *parts])
    return rows


def study_summary(result: Study) -> str:
    """Return a study in a few lines."""
    names = ", ".join(str(n) for n in result.table.estimator.values)
    failed = sum(f["runs"] for f in result.failures)
    lines = [f"Study of {_study_head(result)}", f"  estimators: {names}"]
    return "\n".join([*lines, f"  {failed} of {result.table['converged'].size} fits failed"])


def _study_head(result: Study) -> str:
    from jaxid.studies.settings import SETTINGS

    runs = result.table.sizes["run"]
    settings = int(np.prod([result.table.sizes[k] for k in SETTINGS if k in result.table.dims]))
    return f"{result.title}: {runs} runs under {settings} setting(s), {result.seconds:.3g} s of work"
