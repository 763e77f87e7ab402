"""The words and tables of a report, made from the JSON results."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxid.names import PLACES
from jaxid.results.report.data import ParameterRow, ReportData, SearchStep
from jaxid.results.report.numbers import (
    ABSENT,
    is_number,
    nats,
    percent,
    plain,
    pretty_unit,
    scaled_unit,
    short,
    usual_unit,
    with_std,
)

_MOST_INTERVALS = 6
# Effects that a verdict names one by one.
_MOST_NAMED = 4
# Half the width of a 95 % interval, in standard deviations.
_INTERVAL = 1.96
# Ratio of a gap to the measured signal beyond which its number says nothing.
_MOST_RELATIVE = 10.0
# Standard deviation over value from which a value is vague.
_VAGUE = 0.1
# Name of the gap in position.
SIMULATED = "simulated position"
# Weights up to this are omitted from the text of a combination.
SLIGHT = 0.1


@dataclass(frozen=True)
class GapRow:
    """One line of the gap table as numbers; None for a missing value."""

    quantity: str
    log: str
    unit: str
    before: float | None = None
    after: float | None = None
    floor: float | None = None
    relative: float | None = None


def verdict_words(data: ReportData) -> str:
    """Return the verdict in plain words, such as "found: coulomb_friction"."""
    if data.verdict == "found":
        found = f"found: {_named_effects(data)}"
        return found if data.explains else f"{found}; the log is not explained"
    if data.verdict == "nothing_missing":
        return "nothing is missing" if data.model_complete else "nothing was found"
    if data.verdict is not None:
        return data.verdict
    if data.converged is False:
        return "did not converge"
    if not data.explains:
        return "does not explain the log"
    if data.parameters and not data.identified:
        return "nothing identified"
    if data.model_complete is False:
        return "the model is incomplete"
    known = sum(row.identifiable for row in data.parameters)
    count = str(known) if known == len(data.parameters) else f"{known} of {len(data.parameters)}"
    return f"{count} parameter{'' if len(data.parameters) == 1 else 's'} identified"


def verdict_class(data: ReportData) -> str:
    """Name the badge's style: "good", "open" or "bad"."""
    if data.converged is False:
        return "bad"
    if not data.explains:
        return "bad"
    if data.verdict == "unexplained" or data.model_complete is False or not data.identified:
        return "open"
    if data.verdict is None and not (data.model_complete and all(p.identifiable for p in data.parameters)):
        return "open"
    if data.verdict == "nothing_missing" and not data.model_complete:
        return "open"
    return "good"


def answer(data: ReportData) -> str:
    """Compose the answer as one paragraph: the verdict, and how far the gaps have changed."""
    openings = {
        "found": "The declared model lacks physics that the log shows",
        "nothing_missing": "The residual of the declared model is sensor noise",
        "unexplained": "Model and log disagree, and no known effect explains it",
    }
    if data.verdict == "found" and (data.misread or not data.explains):
        openings = {}
    opening = openings.get(data.verdict or "")
    first = data.findings[0] if data.findings else "The declared model was fitted to the log"
    # The finding on a model that a search left as it was says the same.
    lines = [opening, first] if opening and (data.verdict == "found" or not data.findings) else [first]

    # One line for each quantity and unit, of two joints at most one each: the table below has the other logs.
    rows = [r for r in gap_rows(data) if is_number(r.after)]
    rows = [r for r in rows if not (data.drifted and r.quantity.startswith(SIMULATED))]
    quantities: dict[str, list[GapRow]] = {}
    for row in (r for r in rows if r.log == rows[0].log):
        quantities.setdefault(row.quantity.split(", joint ")[0], []).append(row)
    for quantity, of_joints in quantities.items():
        if len(of_joints) <= 2:
            lines += [_gap_words(row) for row in of_joints]
            continue
        for unit in dict.fromkeys(row.unit for row in of_joints):
            alike = [row for row in of_joints if row.unit == unit]
            every = len(alike) == len(of_joints)
            lines.append(_gaps_words(quantity, alike, every) if len(alike) > 1 else _gap_words(alike[0]))

    return unbroken(" ".join(line if line[-1] in ".!?:;" else f"{line}." for line in lines))


def unbroken(text: str) -> str:
    """Keep numbers and their units on one line of the page."""
    return re.sub(r"(?<=\d) (?=[a-zA-Zµ%±]{1,3}\b|±)", "\u00a0", text)


def place_words(entry: Mapping) -> str:
    """Return the place of an effect, such as "joint 2, elbow" or "spring 3", or nothing."""
    for key in PLACES:
        if entry.get(key) is not None:
            name = f", {entry['joint_name']}" if entry.get("joint_name") else ""
            return f"{key} {entry[key]}{name}"
    return ""


def gap_table(data: ReportData) -> dict:
    """Lay out the gap as headings and lines, without the columns that hold nothing."""
    rows = gap_rows(data)
    after = "gap" if all(row.before is None for row in rows) else "after"
    heads = ["disagreement (RMS)", "log", "before", after, "noise floor"]
    heads += [f"{after} ÷ floor", "relative to the measured"]
    lines = [_gap_cells(row) for row in rows]
    kept = [i for i in range(len(heads)) if i < 2 or any(c[i] != ABSENT for c in lines)]
    return {
        "heads": [heads[i] for i in kept],
        "lines": [[cells[i] for i in kept] for cells in lines],
        "forces": any(row.quantity.startswith("force") for row in rows),
        "positions": any(row.quantity.startswith(SIMULATED) for row in rows),
        "band": short(data.gap["band_hz"]) if is_number(data.gap.get("band_hz")) else None,
    }


def parameter_lines(rows: Sequence[ParameterRow]) -> list[dict]:
    """Format the parameters; lists become one line for each entry, counted from 1."""
    return [_parameter_line(row) for whole in rows for row in _expanded(whole)]


def effect_entries(effects: Sequence[Mapping]) -> list[dict]:
    """Format the effects that were found: place, parameters, evidence, alternatives."""
    entries = []
    for effect in effects:
        rows = [
            ParameterRow(name, p.get("value"), p.get("std"), p.get("unit") or "")
            for name, p in (effect.get("parameters") or {}).items()
        ]
        others = [
            {"kind": f"{a.get('kind', '')} {place_words(a)}".strip(), "evidence": nats(a.get("evidence"))}
            for a in effect.get("alternatives") or ()
        ]
        entries.append(
            {
                "kind": effect["kind"],
                "place": place_words(effect),
                "parameters": parameter_lines(rows),
                "evidence": nats(effect.get("evidence")),
                "alternatives": others,
            }
        )
    return entries


def unidentifiable_lines(entries: Sequence[Mapping]) -> list[dict]:
    """Format each combination that is not identifiable, largest weight first."""
    lines = []
    for entry in entries:
        terms = _terms(entry["combination"])
        lines.append({"terms": terms, "single": len(terms) == 1})
    return lines


def _terms(combination: Mapping[str, float], least: float = 0.0) -> list[dict]:
    """Return names and weights of a combination, largest first, without small ones."""
    weights = {k: w for k, w in combination.items() if is_number(w) and abs(w) > least}
    ranked = sorted(weights.items(), key=lambda item: -abs(item[1]))
    return [{"name": n, "weight": ("+" if w > 0 else "") + plain(w, 2)} for n, w in ranked]


def direction_lines(directions: Sequence[Mapping]) -> list[dict]:
    """Format the combinations that a fit within a prior identifies."""
    lines = []
    for entry in directions:
        value, std = with_std(entry["value"], entry["std"])
        profile = entry.get("profile")
        rise = dict(zip(profile["at_std"], profile["rise"], strict=True)) if profile else {}
        lines.append(
            {
                "terms": _terms(entry["combination"], SLIGHT),
                "value": value,
                "std": std,
                "white": with_std(entry["value"], entry["std_white"])[1],
                "profile": [short(rise[at], 2) for at in (-2.0, 2.0)] if rise else None,
            }
        )
    return lines


def within_prior_words(content: Mapping) -> list[str]:
    """Return the statistics of a fit within a prior; empty for any other fit."""
    if "criterion_percent" not in content:
        return []
    lines = [f"criterion: {short(content['criterion_percent'], 3)} % of the squared deviation from the mean"]
    starts = content.get("starts")
    if starts:
        shown = f"starts: {starts['same_optimum']} of {starts['count']} end at the same cost"
        if starts["flat"]:
            shown += f"; {starts['flat']}, at which the simulation does not move, were moved first"
        lines.append(shown)
    return lines


def where_lines(data: ReportData) -> dict | None:
    """Return the region of the disagreement in words."""
    where = data.where
    if not where:
        return None
    variable = where.get("variable")
    unit = pretty_unit(_variable_unit(data, variable))
    facts = [("acts at", place_words(where)), ("stands out over", variable or "")]
    region = where_region(data)
    if region and len(region) == 2 and all(is_number(r) for r in region):
        text = f"{short(region[0], 3)} to {short(region[1], 3)} {unit}"
        facts.append(("region", text.strip()))
    # Of a pattern over velocity or position the instants say nothing.
    spans = where.get("intervals") or []
    if spans and variable not in ("velocity", "position"):
        listed = [f"{short(a)}–{short(b)}" for a, b in spans[:_MOST_INTERVALS]]
        more = f" and {len(spans) - len(listed)} more" if len(spans) > len(listed) else ""
        facts.append(("when", f"{', '.join(listed)} {data.units.get('time', 's')}{more}"))
    return {"text": unbroken(where.get("text") or ""), "facts": [f for f in facts if f[1]]}


def where_region(data: ReportData) -> Sequence[float] | None:
    """Return the range in which the residual is largest; None for a line in its spectrum, or a ripple."""
    where = data.where or {}
    return None if is_number(where.get("frequency_hz")) or where.get("periods") else where.get("region")


def step_lines(data: ReportData) -> list[dict]:
    """Format the steps of the search."""
    lines = []
    for number, step in enumerate(data.steps):
        best = next((c.evidence for c in step.candidates if c.accepted), None)
        lines.append(
            {
                "number": number,
                "change": step_words(number, step),
                "fit": plain(step.gap_fit),
                "validation": plain(step.gap_validation),
                "tried": len(step.candidates) or ABSENT,
                "evidence": nats(best),
                "threshold": short(step.threshold) if step.candidates else ABSENT,
            }
        )
    return lines


def step_words(number: int, step: SearchStep) -> str:
    """Return the change of a step in words."""
    changes = [f"{step.added} added"] if step.added else []
    changes += [f"{step.dropped} dropped"] if step.dropped else []
    if changes:
        return ", ".join(changes)
    return "declared model, refitted" if number == 0 else "nothing added"


def shows_places(data: ReportData) -> bool:
    """Check that the places of effects are needed: a machine with one joint has one place."""
    return bool(data.joints or {place_words(e) for e in data.effects} - {"", "joint 1"})


def _named_effects(data: ReportData) -> str:
    """Return the effects in the order in which they were found; of many, their kinds and numbers."""
    if len(data.effects) <= _MOST_NAMED:
        return ", then ".join(_named(e, shown=shows_places(data)) for e in data.effects)
    by_kind: dict[str, list[Mapping]] = {}
    for effect in data.effects:
        by_kind.setdefault(effect["kind"], []).append(effect)
    return ", ".join(
        _named(alike[0], shown=shows_places(data)) if len(alike) == 1 else f"{kind} at {len(alike)} places"
        for kind, alike in by_kind.items()
    )


def _named(effect: Mapping, *, shown: bool) -> str:
    place = place_words(effect)
    return f"{effect['kind']} ({place})" if shown and place else effect["kind"]


def _variable_unit(data: ReportData, variable: str | None) -> str:
    if data.where_plot is not None and data.where_plot[0] == variable:
        return data.where_plot[1]
    return data.units.get(variable or "", "")


def _gap_words(row: GapRow) -> str:
    _, log, before, after, *_ = _gap_cells(row)
    fall = _change(before, after, row.before, row.after) if row.before is not None else f"is {after}"
    floor = f", at a noise floor of {_gap_cells(row)[4]}" if is_number(row.floor) else ""
    quantity, _, joint = row.quantity.partition(", ")
    of_joint = f" of {joint}" if joint else ""
    return f"The {quantity} residual{of_joint} on the {_log_words(log)} {fall} (RMS){floor}"


def _log_words(log: str) -> str:
    """Return a log in a sentence; one of several has a name behind its kind."""
    kind, _, name = log.partition(": ")
    return f"{kind} log {name}".strip()


def _change(before: str, after: str, old: float | None, new: float | None) -> str:
    """Return a change in words; a number that reads the same before and after stays."""
    if before == after:
        return f"stays at {after}"
    rises = old is not None and new is not None and new > old
    return f"{'rises' if rises else 'falls'} from {before} to {after}"


def _gaps_words(quantity: str, rows: Sequence[GapRow], every: bool = True) -> str:
    """Return the gaps of several joints of one unit as ranges; unless it is every joint, they are named."""
    numbers = [x for r in rows for x in (r.before, r.after, r.floor) if is_number(x)]
    scale, unit = scaled_unit(rows[0].unit, numbers)

    def span(values: list[float | None]) -> str:
        known = [x / scale for x in values if x is not None and is_number(x)]
        ends = dict.fromkeys(plain(x) for x in (min(known), max(known))) if known else ()
        return f"{'–'.join(ends)} {unit}".strip() if ends else ""

    before, after, floor = (span([getattr(r, k) for r in rows]) for k in ("before", "after", "floor"))
    sizes = [
        float(np.sqrt(np.sum(np.square([x for r in rows if is_number(x := getattr(r, k))]))))
        for k in ("before", "after")
    ]
    fall = _change(before, after, *sizes) if before else f"is {after}"
    over = f", at noise floors of {floor}" if floor else ""
    log = _log_words(rows[0].log)
    names = [row.quantity.rpartition("joint ")[2] for row in rows]
    joints = f"the {len(rows)} joints" if every else f"joints {', '.join(names[:-1])} and {names[-1]}"
    return f"The {quantity} residual of {joints} on the {log} {fall} (RMS){over}"


def gap_rows(data: ReportData) -> list[GapRow]:
    """Return the gaps in force and in simulated position that are known, by log and joint."""
    gap = data.gap
    motion = gap.get("simulation") or {}
    force = {"quantity": "force", "unit": gap.get("unit"), "floor": gap.get("noise_floor")}
    position = {"quantity": SIMULATED, "unit": motion.get("unit"), "floor": motion.get("noise_floor")}
    if "before" in gap or "after" in gap:
        log = gap.get("on") or "fit"
        # A log without a force has no gap in it, and states the noise of its positions.
        rows = []
        if "noise_floor" not in motion:
            rows = _by_joint(log=log, before=gap.get("before"), after=gap.get("after"), **force)
            rows += _other_log(data, log, force)
        both = {"before": motion.get("before"), "after": motion.get("after")}
        rows += _by_joint(log=log, **both, **position)
        # A table of steady speeds has no position to simulate.
        return [r for r in rows if is_number(r.before) or is_number(r.after)]
    return _fitted_rows(gap, force) + _fitted_rows(motion, position)


def _fitted_rows(gap: Mapping, shared: Mapping) -> list[GapRow]:
    relative = gap.get("relative") or {}
    rows: list[GapRow] = []
    known = [x for x in (gap.get("fit"), gap.get("validation")) if x is not None]
    if known and all(np.all(np.isnan(np.asarray(x, float))) for x in known):
        # A log without a force has no gap in it.
        return rows
    for log in ("fit", "validation"):
        each = gap.get(f"{log}s") or {}
        if gap.get(log) is not None and not each:
            rows += _by_joint(log=log, after=gap[log], relative=relative.get(log), **shared)
        for name, value in each.items():
            if isinstance(value, Mapping):
                known = {"after": value.get("force"), "relative": value.get("relative")}
            else:
                known = {"after": value, "relative": relative.get(log) if value == gap.get(log) else None}
            rows += _by_joint(log=f"{log}: {name}", **known, **shared)
    return rows


def _other_log(data: ReportData, log: str, force: Mapping) -> list[GapRow]:
    if not data.steps:
        return []
    other = "fit" if log == "validation" else "validation"
    ends = [getattr(step, f"gap_{other}") for step in (data.steps[0], data.steps[-1])]
    if not all(is_number(end) for end in ends):
        return []
    # The floor is only given for the log that was judged, and steps hold one number for all joints.
    several = isinstance(data.gap.get("after"), (list, tuple))
    shared = {**force, "floor": None, "quantity": "force, worst joint" if several else "force"}
    return _by_joint(log=other, before=ends[0], after=ends[1], **shared)


def _by_joint(**columns: object) -> list[GapRow]:
    """Make one line, or one for each joint if the numbers are lists."""
    lengths = [len(v) for v in columns.values() if isinstance(v, (list, tuple))]
    if not lengths:
        return [GapRow(**{**columns, "unit": columns["unit"] or ""})]
    rows = []
    for i in range(max(lengths)):
        one = {k: v[i] if isinstance(v, (list, tuple)) else v for k, v in columns.items()}
        one["quantity"] = f"{one['quantity']}, joint {i + 1}"
        rows.append(GapRow(**{**one, "unit": one["unit"] or ""}))
    return rows


def _gap_cells(row: GapRow) -> list[str]:
    numbers = (row.before, row.after, row.floor)
    scale, unit = scaled_unit(row.unit, [n for n in numbers if is_number(n)])
    texts = [
        f"{plain(n / scale)} {unit}".strip() if n is not None and is_number(n) else ABSENT for n in numbers
    ]
    after, floor = row.after, row.floor
    ratio = ABSENT
    if after is not None and floor is not None and is_number(after) and is_number(floor) and floor > 0:
        ratio = f"{after / floor:.2f}"
    return [row.quantity, row.log, *texts, ratio, _relative(row.relative, 1.0, most=_MOST_RELATIVE)]


def _expanded(row: ParameterRow) -> list[ParameterRow]:
    if not isinstance(row.value, (list, tuple)):
        return [row]
    stds = row.std if isinstance(row.std, (list, tuple)) else [row.std] * len(row.value)
    pairs = zip(row.value, stds, strict=True)
    return [
        replace(row, name=f"{row.name}[{i}]", value=value, std=std)
        for i, (value, std) in enumerate(pairs, start=1)
    ]


def _misspecified(row: ParameterRow, scale: float) -> str | None:
    """Write the deviation that holds for an incomplete model; None if there is none."""
    if not is_number(row.std_misspecified) or not is_number(row.value):
        return None
    return with_std(row.value / scale, row.std_misspecified / scale)[1]


def _interval(row: ParameterRow, scale: float) -> str:
    """Write the 95 % interval; of an incomplete model that of the values that fit best."""
    std = row.std_misspecified if is_number(row.std_misspecified) else row.std
    if not is_number(row.value) or not is_number(std) or std <= 0:
        return ABSENT
    # Two digits of the deviation: its ends are no better known.
    ends = (with_std((row.value + side * _INTERVAL * std) / scale, std / scale)[0] for side in (-1, 1))
    return " to ".join(ends)


def _relative(part: float | None, whole: float | None, most: float = 1.0) -> str:
    """Write a part as a percentage; beyond `most` the number says nothing."""
    if is_number(part) and is_number(whole) and abs(part) > most * abs(whole):
        return f"over {100 * most:g} %"
    return percent(part, whole)


def _parameter_line(row: ParameterRow) -> dict:
    scale, unit = usual_unit(row.unit, row.value, row.std)
    sizes = [x / scale if is_number(x) else x for x in (row.value, row.std)]
    value, std = with_std(*sizes) if row.identifiable else (ABSENT, ABSENT)
    return {
        "name": row.name,
        "value": value,
        "std": std,
        "interval": _interval(row, scale) if row.identifiable else ABSENT,
        "relative": _relative(row.std, row.value) if row.identifiable else ABSENT,
        "misspecified": _misspecified(row, scale),
        "in_file": None if row.in_file is None else plain(row.in_file / scale),
        "unit": unit,
        "identifiable": row.identifiable and is_number(row.value),
        "vague": not (is_number(row.value) and is_number(row.std) and row.std < _VAGUE * abs(row.value)),
    }
