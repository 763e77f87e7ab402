"""Results as text, for a terminal or a notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.model.units import joined
from jaxid.results import as_json as results
from jaxid.results.report.numbers import with_std
from jaxid.results.report.words import SLIGHT, place_words, within_prior_words

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification
    from jaxid.discovery.result import Discovery
    from jaxid.estimators.common.derived import Derived
    from jaxid.estimators.estimate import Estimate
    from jaxid.studies.result import Study


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Columns padded to their widest entry."""
    widths = [max(len(r[i]) for r in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(c.ljust(w) for c, w in zip(r, widths, strict=True)) for r in rows]
    return "\n".join(line.rstrip() for line in lines)


def parameter_lines(estimate: Estimate, derived: Sequence[Derived] = ()) -> str:
    """Value, standard deviation and unit of every parameter, and of what follows from them."""
    rows = [["parameter", "value", "std", "unit"]]
    for f, value, std, told in zip(
        estimate.machine.parameters.free,
        estimate.theta,
        estimate.std,
        estimate.identifiable,
        strict=True,
    ):
        shown = with_std(value, std) if told else ("-", "this log cannot tell it")
        rows.append([f.name, *shown, f.unit])
    rows += [[d.name, *with_std(d.value, d.std), d.unit] for d in derived if np.isfinite(d.std)]
    return aligned(rows)


def _number(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_number(v) for v in value)
    return "-" if value is None or not np.isfinite(value) else f"{value:.4g}"


def identification_table(result: Identification) -> str:
    """What `identify` prints."""
    estimate = result.estimate
    gap = results.gap_json(result.session, result.gaps, result.noise_floor)
    head = f"{estimate.method}: {estimate.message}, {estimate.samples} samples"
    simulation = gap["simulation"]
    rows = [
        ["gap", "fit", "validation", "unit"],
        ["force", _number(gap["fit"]), _number(gap["validation"]), joined(gap["unit"])],
        ["force, relative", _number(gap["relative"]["fit"]), _number(gap["relative"]["validation"]), ""],
        ["noise floor", _number(gap["noise_floor"]), "", joined(gap["unit"])],
        [
            "simulated position",
            _number(simulation["fit"]),
            _number(simulation["validation"]),
            joined(simulation["unit"]),
        ],
    ]
    told = parameter_lines(estimate, results.derived(result.session, result.estimate))
    notes = _notes(results.notes(result.session, estimate))
    own = _minimal(estimate.details["minimal"]) if "minimal" in estimate.details else []
    together = _told_together(estimate.details.get("directions", []))
    below = [*_blind(estimate), *within_prior_words(estimate.details), *own]
    return "\n".join([head, "", told, *together, *below, "", aligned(rows), *notes])


def _told_together(directions: Sequence[dict[str, Any]]) -> list[str]:
    """Combinations that a fit within a prior tells, from the guesses on in units of it."""
    return [
        f"told together: {d['value']:+.3f} ± {d['std']:.3f} priors of "
        + ", ".join(f"{w:+.2f} {n}" for n, w in d["combination"].items() if abs(w) > SLIGHT)
        for d in directions
    ]


def _minimal(content: dict[str, Any]) -> list[str]:
    """Coefficients and statistics of a minimal model."""
    # With scipy.stats behind it: a second, which no other table needs.
    from jaxid.estimators.minimal.report import minimal_rows

    rows, lines = minimal_rows(content)
    return ["", aligned(rows), *lines]


def discovery_table(result: Discovery) -> str:
    """What `discover` prints."""
    content = results.discovery_json(result)
    lines = [f"verdict: {result.verdict}"]
    if content["where"]:
        lines.append(f"where:   {content['where']['text']}")
    for found in result.effects:
        others = ", ".join(s.candidate.label for s in found.alternatives)
        told = f"; this log cannot tell it from {others}" if others else ""
        lines.append(f"effect:  {found.label} (evidence {found.score.evidence:.0f} nats{told})")
    lines += [f"experiment: {e['text']}" for e in content["experiments"]]
    gap = content["gap"]
    rows = [["step", "force gap, fit", "force gap, validation"]]
    for step in content["steps"]:
        where = place_words(step)
        where = f" ({where})" if where else ""
        name = f"+ {step['added']}{where}" if step["added"] else "baseline"
        if "dropped" in step:
            name = (f"{name}, " if step["added"] else "") + f"- {step['dropped']}"
            name += "" if step["added"] else where
        rows.append([name, f"{_number(step['fit'])} {joined(gap['unit'])}", _number(step["validation"])])
    told = parameter_lines(result.after, results.derived(result.session, result.after))
    lines += ["", aligned(rows), "", told, *_blind(result.after), ""]
    lines.append(
        f"gap on {gap['on']}: {_number(gap['before'])} -> {_number(gap['after'])} {joined(gap['unit'])} "
        f"(noise floor {_number(gap['noise_floor'])}); simulated position "
        f"{_number(gap['simulation']['before'])} -> {_number(gap['simulation']['after'])} "
        f"{joined(gap['simulation']['unit'])}"
    )
    return "\n".join([*lines, *_notes(content["notes"])])


def _blind(estimate: Estimate) -> list[str]:
    """What the log does not tell; a fit within a prior holds it."""
    combinations = estimate.precision.unidentifiable
    if "directions" in estimate.details:
        return [f"left to the guesses: {_sum(c)}" for c in combinations]
    return _untold(combinations)


def _untold(combinations: Sequence[Mapping[str, float]]) -> list[str]:
    """Unknowns that are without effect, and combinations that are, a line each."""
    alone = [name for c in combinations if len(c) == 1 for name in c]
    lines = [f"cannot be told: {', '.join(alone)}"] if alone else []
    return lines + [f"cannot be told apart: {_sum(c)}" for c in combinations if len(c) > 1]


def _sum(combination: Mapping[str, float]) -> str:
    return ", ".join(f"{w:+.2f} {n}" for n, w in combination.items())


def _notes(lines: Sequence[str]) -> list[str]:
    return ["", *[f"note: {line}" for line in lines]] if lines else []


def check_table(result: Any) -> str:
    """What `check` prints."""
    content = result.json()
    log, machine = content["log"], result.session.machine
    driven = machine.plant.driven(machine.plant.joints)
    unit = lambda quantity, joints=None: joined(machine.unit_by_joint(quantity, joints))
    one = results._one
    head = (
        f"{log['samples']} samples at {log['rate_hz']:.6g} Hz, {log['duration_s']:.4g} s; stroke "
        f"{_number(one(log['stroke']))} {unit('position')}, up to "
        f"{_number(one(log['peak_velocity']))} {unit('position/time')} and "
        f"{_number(one(log['peak_force']))} {unit('force', driven)}; {100 * log['moving']:.0f} % moving"
    )
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
    rows = [["unknown", "guess", "std at best", "unit"]]
    for name, p in content["parameters"].items():
        best = f"{p['expected_std']:.2g}" if p["identifiable"] else "this log cannot tell it"
        rows.append([name, f"{p['guess']:.4g}", best, p["unit"]])
    blind = _untold([c["combination"] for c in content["unidentifiable"]])
    table = ["", aligned(rows)] if len(rows) > 1 else []
    return "\n".join(["the log is sound", head, how, *table, *blind, *_notes(content["warnings"])])


def study_table(result: Study) -> str:
    """What `study` prints."""
    from jaxid.studies.settings import SETTINGS, words_of

    part = lambda x: "-" if not np.isfinite(x) else f"{100 * x:.1f} %"
    keys = ("bias", "spread", "std", "bound")
    own = [name for name in SETTINGS if name in result.table.dims]
    rows = [["estimator", *own, "parameter", "bias", "spread", "reported", "bound", "unit",
             "68 %", "95 %", "failed"]]  # fmt: skip
    for r in result.summary:
        numbers = [*[_number(r[k]) for k in keys], r["unit"]]
        parts = [part(r[k]) for k in ("coverage_68", "coverage_95", "failed")]
        rows.append([r["estimator"], *[f"{r[k]:g}" for k in own], r["parameter"], *numbers, *parts])
    runs, settings = result.table.sizes["run"], int(np.prod([result.table.sizes[k] for k in own]))
    lines = [f"{result.title}: {runs} runs under {settings} setting(s), {result.seconds:.3g} s of work"]
    lines += ["", aligned(rows)]
    if result.tracking:
        sizes = [f"{what} {n}" for what in ("RMS", "peak") for n in ("median", "95 %", "worst")]
        rows = [[*own, "drive", *sizes, "unit"]]
        for r in result.tracking:
            sizes = [_number(x) for name in ("rms", "peak") for x in r[name].values()]
            rows.append([*[f"{r[k]:g}" for k in own], str(r["drive"]), *sizes, r["unit"]])
        lines += ["", "off the reference, last quarter of each run:", aligned(rows)]
    for k, n in enumerate(result.named):
        lines += ["", "named:"] if k == 0 else []
        lines += [f"  {words_of(n)}: {n['runs']} of {runs}: {n['what']}"]
    for k, f in enumerate(result.failures):
        lines += ["", "failed:"] if k == 0 else []
        lines += [f"  {f['estimator']} at {words_of(f)}: {f['runs']} of {runs}: {f['why']}"]
    return "\n".join(lines)
