"""The result of `compare` as JSON, as text, as a table of a notebook, and as files."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.comparison.result import Comparison, Difference, LogGap, Rival, Value
from jaxid.discovery.evidence import FALSE_POSITIVE
from jaxid.files import json_text, write_results
from jaxid.model.units import joined
from jaxid.results.aligned import aligned
from jaxid.results.as_json import one_or_list, reading_lines, recipe_json, versions
from jaxid.results.parameters import html_table
from jaxid.results.report.numbers import plain, with_std

# Files that `save_comparison` writes.
FILES = ("comparison.json", "report.html")
# What the noise floor of a compared quantity is.
FLOOR = {
    "force": "RMS force that the sensors' noise alone leaves in the band of the filter",
    "position": "RMS that the encoder's noise alone leaves",
}
# A residual above the noise floor by this factor is that of an incomplete model.
_INCOMPLETE = 2.0
_EVIDENCE_WORDS = (
    "evidence: gain in log-likelihood on stretches of the logs that a fit did not use, in nats; noise alone "
    f"exceeds the threshold in one of {1 / FALSE_POSITIVE:.0f} comparisons"
)


def comparison_json(result: Comparison) -> dict[str, Any]:
    """Return the content of comparison.json."""
    unit = result.session.machine.unit_by_joint(result.quantity)
    return {
        "verdict": result.verdict,
        "logs": list(result.logs),
        "differences": [_difference(d) for d in result.differences],
        "why": result.why or None,
        "alike": list(result.alike),
        "tried": result.tried,
        "threshold": result.threshold,
        "false_alarm": FALSE_POSITIVE,
        "parameters": {name: _value(v) for name, v in result.parameters.items()},
        "gap": {
            "quantity": result.quantity,
            "unit": unit,
            "logs": {gap.name: _gap(gap) for gap in result.gaps},
        },
        "preprocess": recipe_json(result.session),
        "versions": versions(),
        "notes": comparison_notes(result),
    }


def _difference(d: Difference) -> dict[str, Any]:
    named = {"parameter": d.parameter} if d.parameter else {"kind": d.kind}
    return {
        **named,
        **(dict([d.place]) if d.place else {}),
        "by_log": {name: _of_log(v) for name, v in d.by_log.items()},
        "evidence": d.evidence,
        "threshold": d.threshold,
        "false_alarm": d.false_alarm,
        "alternatives": [_rival(r) for r in d.alternatives],
    }


def _of_log(v: Value | Mapping[str, Value] | None) -> dict[str, Any] | None:
    if v is None or isinstance(v, Value):
        return None if v is None else _value(v)
    return {name: _value(one) for name, one in v.items()}


def _value(v: Value) -> dict[str, Any]:
    return {"value": v.value, "std": v.std if np.isfinite(v.std) else None, "unit": v.unit}


def _rival(r: Rival) -> dict[str, Any]:
    named = {"parameter": r.parameter} if r.parameter else {"kind": r.kind, "logs": list(r.logs)}
    return {**named, **(dict([r.place]) if r.place else {}), "evidence": r.evidence}


def _gap(gap: LogGap) -> dict[str, Any]:
    return {
        "shared": one_or_list(gap.shared),
        "explained": one_or_list(gap.explained),
        "noise_floor": one_or_list(gap.floor),
    }


def comparison_notes(result: Comparison) -> list[str]:
    """Return what was assumed, and the warnings on the logs."""
    notes = [f"{f.where}: {f.what}; {f.hint}" for f in result.session.findings]
    if result.scale:
        notes.insert(
            0,
            f"the logs have no force, and nothing known gives one: {result.scale} was held at its guess in "
            f"{result.logs[0]}, and all values of forces, inertias and gains are relative to it",
        )
    most = max(_above_noise(gap) for gap in result.gaps)
    if result.verdict == "same" and most > _INCOMPLETE:
        notes.insert(
            0,
            f"the model is incomplete: it leaves up to {most:.0f} times the noise of the sensors in all logs "
            "alike, and a difference that is small beside that is not seen",
        )
    return notes


def _above_noise(gap: LogGap) -> float:
    """Return the largest ratio of what is left of a log to its noise floor."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = gap.explained / gap.floor
    return float(np.max(ratio, initial=0.0, where=np.isfinite(ratio)))


def answer(result: Comparison) -> str:
    """Return the verdict as a sentence."""
    logs = f"{len(result.logs)} logs"
    if result.verdict == "same":
        return f"one set of parameters explains the {logs} as well as one for each does{_alike(result)}"
    if result.verdict == "unexplained":
        return (
            f"the {logs} differ, and no parameter of the case and no known effect explains how: {result.why}"
        )
    found = " and ".join(_words(d, result) for d in result.differences)
    return f"the {logs} are not of one machine in one state: {found}{_alike(result)}"


def _alike(result: Comparison) -> str:
    """Return what the case lacks in all logs, as the end of a sentence."""
    if not result.alike:
        return ""
    return f"; the case lacks {' and '.join(result.alike)} in all of them alike"


def _words(d: Difference, result: Comparison) -> str:
    if d.parameter:
        return f"{d.label} differs"
    own = [name for name, v in d.by_log.items() if v is not None]
    return f"{d.label} acts in {' and '.join(own)} only"


def comparison_table(result: Comparison) -> str:
    """Return the text that `compare` prints."""
    lines = [f"verdict: {result.verdict}", f"finding: {answer(result)}"]
    for d in result.differences:
        others = ", ".join(rival_words(r) for r in d.alternatives)
        alternatives = f"; these logs do not distinguish it from {others}" if others else ""
        sure = f"evidence {d.evidence:.0f} nats, threshold {d.threshold:.0f}"
        lines.append(f"difference: {d.label} ({sure}{alternatives})")
    lines += [_EVIDENCE_WORDS] if result.differences else []
    if result.differences:
        lines += ["", aligned(value_rows(result))]
    lines += ["", aligned(gap_rows(result))]
    lines.append(f"noise floor: {FLOOR[result.quantity]}")
    notes = [f"note: {line}" for line in comparison_notes(result)]
    return "\n".join([*lines, *([""] if notes else []), *notes, *reading_lines(result.session)])


def rival_words(r: Rival) -> str:
    """Return an alternative in words, with the logs in which it acts."""
    return r.label if r.parameter else f"{r.label} in {' and '.join(r.logs)}"


def value_rows(result: Comparison) -> list[list[str]]:
    """Return a header, and a row for each value that differs: by log, then its unit."""
    rows = [["what differs", *result.logs, "unit"]]
    for d in result.differences:
        if d.parameter:
            values = [v for v in d.by_log.values() if isinstance(v, Value)]
            rows.append([d.label, *[_cell(v) for v in values], values[0].unit])
            continue
        own = next(v for v in d.by_log.values() if isinstance(v, Mapping))
        for name in own:
            cells = [_cell(v[name]) if isinstance(v, Mapping) else "absent" for v in d.by_log.values()]
            rows.append([f"{d.label}.{name}", *cells, own[name].unit])
    return rows


def _cell(v: Value) -> str:
    if not np.isfinite(v.std):
        return f"{plain(v.value)} (held)"
    value, std = with_std(v.value, v.std)
    return f"{value} ± {std}"


def gap_rows(result: Comparison) -> list[list[str]]:
    """Return a header, and the unexplained force or position of each log."""
    rows = [
        [f"unexplained {result.quantity} (RMS)", "one machine", "with what differs", "noise floor", "unit"]
    ]
    unit = joined(result.session.machine.unit_by_joint(result.quantity))
    if not result.differences:
        rows[0][2] = "as found"
    for gap in result.gaps:
        several = len(gap.shared) > 1
        for joint in range(len(gap.shared)):
            name = f"{gap.name}, joint {joint + 1}" if several else gap.name
            rows.append([name, *[plain(x[joint]) for x in (gap.shared, gap.explained, gap.floor)], unit])
    return rows


def comparison_html(result: Comparison) -> str:
    """Return the verdict and the values by log, as a notebook shows them."""
    rows = value_rows(result) if result.differences else gap_rows(result)
    return f"<p><b>{escape(result.verdict)}: {escape(answer(result))}</b></p>" + html_table(rows)


def save_comparison(result: Comparison, folder: Path, *, overwrite: bool = False) -> Path:
    """Write comparison.json and report.html."""
    from jaxid.results.report.comparison import comparison_report

    files = {"report.html": comparison_report(result), "comparison.json": json_text(comparison_json(result))}
    write_results(folder, files, overwrite=overwrite)
    return folder
