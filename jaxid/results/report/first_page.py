"""The first page of a report: what was found in words, the key numbers, and the values with intervals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxid.results.effect_words import words_of
from jaxid.results.report.data import LogView, ReportData
from jaxid.results.report.numbers import ABSENT, is_number, usual_unit, with_std
from jaxid.results.report.words import parameter_lines, place_words, shows_places

# Rows of values that the first page shows whole, and those that it shows of more; all of them stand below.
MOST_VALUES, FIRST_VALUES = 14, 8
# Combinations, and names without a value, beyond which the section on them is folded.
_MANY_COMBINATIONS, _MANY_NAMES = 3, 12
_MODEL = {
    True: ("model complete", "good"),
    False: ("model incomplete", "open"),
    None: ("completeness not known", "open"),
}


def found_entries(data: ReportData) -> list[dict]:
    """Return each kind of effect that was found as words: name, formula, machines, and where it acts.

    Under `at` stands for each place: its name, the values there, and the rivals.
    """
    entries: dict[str, dict] = {}
    for effect in sorted(data.effects, key=lambda e: e.get("joint") or 0):
        words = words_of(effect["kind"], effect.get("doc", ""))
        others = [
            f"{a.get('kind', '')} {place_words(a)}".strip().replace("_", " ")
            for a in effect.get("alternatives") or ()
        ]
        entry = entries.setdefault(
            effect["kind"],
            {
                "kind": effect["kind"],
                "name": words.name[:1].upper() + words.name[1:],
                "formula": words.formula,
                "met": words.met,
                "at": [],
            },
        )
        entry["at"].append(
            {
                "place": place_words(effect) if shows_places(data) else "",
                "numbers": values_words(effect.get("parameters") or {}),
                "others": others,
            }
        )
    # Kinds stand in the order in which they were found.
    return [entries[kind] for kind in dict.fromkeys(effect["kind"] for effect in data.effects)]


def values_words(parameters: Mapping[str, Mapping]) -> str:
    """Return values with standard deviations and usual units in one line."""
    shown = []
    for name, entry in parameters.items():
        value, std = entry.get("value"), entry.get("std")
        if not is_number(value):
            shown.append(f"{name} not identifiable")
            continue
        scale, unit = usual_unit(entry.get("unit") or "", value, std)
        text, deviation = with_std(value / scale, std / scale if is_number(std) else None)
        shown.append(f"{name} = {text}{'' if deviation == ABSENT else f' ± {deviation}'} {unit}".rstrip())
    return ", ".join(shown)


def completeness(data: ReportData) -> dict | None:
    """Return the words on whether the model is complete, and their style; None if the verdict says it."""
    if data.verdict is None and data.model_complete is False:
        return None
    if data.model_complete is None and not data.findings:
        return None
    text, style = _MODEL[data.model_complete]
    if data.parameters and not data.identified:
        style = "open"
    return {"text": text, "style": style if data.explains else "bad"}


def first_values(data: ReportData) -> tuple[list[dict], int]:
    """Return the rows of values for the first page, and the number of those left out.

    Of many, identifiable ones come first, then those of found effects, those that are not vague, and those of
    effects, which a reader knows better than sums of inertias.
    """
    lines = parameter_lines((*data.parameters, *data.derived))
    if len(lines) <= MOST_VALUES:
        return lines, 0
    found = tuple(f"{e['kind']}" for e in data.effects)

    def rank(k: int) -> tuple:
        line = lines[k]
        is_found = line["name"].startswith(found or ("\0",))
        return not line["identifiable"], not is_found, line["vague"], "." not in line["name"], k

    order = sorted(range(len(lines)), key=rank)
    return [lines[k] for k in sorted(order[:FIRST_VALUES])], len(lines) - FIRST_VALUES


def many_unidentifiable(combinations: int, names: int) -> bool:
    """Check that what a log does not determine is a long list."""
    return combinations > _MANY_COMBINATIONS or names > _MANY_NAMES


def main_view(data: ReportData) -> int | None:
    """Return the number of the view that the first page shows: the joint of the first log that tells most.

    It is the one on which the first found effect acts, or else the one with the largest residual in units of
    the noise, or else of the measured force.
    """
    if not data.views:
        return None
    first: list[int] = []
    for k, view in enumerate(data.views):
        if view.joint in {data.views[j].joint for j in first}:
            break
        first.append(k)
    joint = next((e.get("joint") for e in data.effects if e.get("joint")), None)
    if joint is not None:
        at = [k for k in first if data.views[k].joint == joint - 1]
        if at:
            return at[0]
    floors = data.gap.get("noise_floor")
    return max(first, key=lambda k: _loudness(data.views[k], floors))


def _loudness(view: LogView, floors: object) -> float:
    residual = view.residual_after if view.residual_after is not None else view.residual_before
    if residual is None or not len(residual):
        return 0.0
    floor = floors[view.joint] if isinstance(floors, list) else floors
    scale = floor if is_number(floor) and floor > 0 else float(np.sqrt(np.nanmean(view.force_measured**2)))
    rms = float(np.sqrt(np.nanmean(np.square(residual))))
    return rms / scale if np.isfinite(rms) and scale > 0 else 0.0
