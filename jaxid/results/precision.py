"""The precision of an estimate in words: kind of the covariance, profiles, and correlations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.numerics.precision import FULL_HESSIAN, KINDS
from jaxid.results.report.numbers import with_std

if TYPE_CHECKING:
    from jaxid.estimators.estimate import Estimate

# Number of parameters whose correlations are all shown, and size from which those of more are.
_FEW, _STRONG = 8, 0.5


def kind_words(kind: str) -> str:
    """Return the sentence that says where the standard deviations come from; empty if that is not known."""
    return f"σ from {KINDS[kind]}" if kind in KINDS else ""


def precision_lines(estimate: Estimate) -> list[str]:
    """Return the lines of the terminal on covariance and profiles of an estimate."""
    kind = estimate.precision.kind
    # The usual one needs no line.
    lines = [kind_words(kind)] if kind == FULL_HESSIAN else []
    profiles: Mapping[str, Mapping[str, Any]] = estimate.details.get("profiles", {})
    return lines + [profile_words(name, entry) for name, entry in profiles.items()]


def profile_words(name: str, entry: Mapping[str, Any]) -> str:
    """Return the likelihood intervals of an unknown in one line."""
    intervals = [
        f"{level} % interval {_interval(entry[f'interval_{level}'], entry['std'])} {entry['unit']}".rstrip()
        for level in (68, 95)
    ]
    rises = ", ".join("-" if r is None else f"{r:.3g}" for r in entry["rise"])
    at = ", ".join(f"{x:+.0f}" for x in entry["at_std"])
    return f"profile of {name}: {', '.join(intervals)}; rise {rises} at {at} σ"


def ratio_rows(estimate: Estimate) -> list[list[str]]:
    """Return the ratios of unknowns without an absolute scale, a head first; empty without such."""
    ratios = estimate.details.get("relative")
    if ratios is None:
        return []
    rows = [[f"over {ratios['to']}", "value", "std", "unit"]]
    for name, of in ratios["values"].items():
        rows.append([name, *with_std(of["value"], of["std"]), of["unit"]])
    return rows


def _interval(ends: list[float | None], std: float) -> str:
    low, high = ("open" if x is None else with_std(x, std)[0] for x in ends)
    return f"{low} to {high}"


def precision_content(estimate: Estimate) -> dict[str, Any] | None:
    """Return the content of the report's section on precision; None if no parameter is identifiable.

    It has `words` on the covariance; `names` and `matrix` with all correlations of a few parameters, `pairs`
    with the strong ones of more; and the `profiles`.
    """
    shown = np.flatnonzero(estimate.identifiable)
    if not shown.size:
        return None
    names = [estimate.names[k] for k in shown]
    matrix = estimate.precision.covariance[np.ix_(shown, shown)]
    std = np.sqrt(np.diag(matrix))
    correlation = matrix / np.where(std > 0, np.outer(std, std), np.inf)

    pairs = [
        {"names": (names[i], names[j]), "value": correlation[i, j], "text": f"{correlation[i, j]:+.2f}"}
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > _STRONG
    ]
    pairs.sort(key=lambda pair: -abs(pair["value"]))
    few = 1 < len(names) <= _FEW
    strong = f"Correlations beyond {_STRONG} of {len(names)} parameters."
    none = f"No correlation of {len(names)} parameters is beyond {_STRONG}."

    profiles: Mapping[str, Mapping[str, Any]] = estimate.details.get("profiles", {})
    words = kind_words(estimate.precision.kind)
    return {
        "words": f"Source of the standard deviations (σ): {words.removeprefix('σ from ')}." if words else "",
        "names": names,
        "matrix": [_row(name, row) for name, row in zip(names, correlation, strict=True)] if few else [],
        "pairs": [] if few else pairs,
        "pairs_words": "" if few or len(names) == 1 else strong if pairs else none,
        "profiles": profiles,
        "profile_words": [profile_words(name, entry) for name, entry in profiles.items()],
    }


def _row(name: str, row: np.ndarray) -> dict[str, Any]:
    """Return a row of the table of correlations, each cell tinted by its size."""
    cells = [
        {
            "text": f"{x:+.2f}" if np.isfinite(x) else "–",
            "colour": "0, 114, 178" if x >= 0 else "213, 94, 0",
            "strength": f"{0.45 * min(abs(x), 1.0):.2f}" if np.isfinite(x) else "0",
        }
        for x in row
    ]
    return {"name": name, "cells": cells}
