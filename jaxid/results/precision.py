"""The precision of an estimate in words: kind of the covariance, profiles, and correlations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jaxid.numerics.precision import FULL_HESSIAN, KINDS
from jaxid.results.report.numbers import with_std

if TYPE_CHECKING:
    from jaxid.estimators.estimate import Estimate


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


def _interval(ends: list[float | None], std: float) -> str:
    low, high = ("open" if x is None else with_std(x, std)[0] for x in ends)
    return f"{low} to {high}"
