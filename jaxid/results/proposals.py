"""Proposed experiments as words, JSON and CSV."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.model.units import joined
from jaxid.names import PLACES

if TYPE_CHECKING:
    from jaxid.discovery.separating.propose import Proposal
    from jaxid.experiment_design.limits import Limits, Peaks
    from jaxid.machine import Machine


def sentence(proposal: Proposal, machine: Machine) -> str:
    """Return an experiment and its expected evidence in one line."""
    p = proposal
    if not p.separates:
        unstated = [n for n in ("stroke", "speed", "force") if n not in p.limits.stated]
        wider = f"; a wider [limits] {', '.join(unstated)} may" if unstated else ""
        why = f"expected {_nats(p.expected)} nats; {_nats(p.needed)} wanted"
        if p.values is None:
            why = "none was found in which the machine keeps to them"
        return f"no experiment within these limits separates {p.named} from {p.rival} ({why}){wider}"
    start = ", ".join(f"{x:.4g}" for x in np.ravel(p.start))
    speaks = "" if p.present >= 0 else f" for {p.rival}"
    return (
        f"to separate {p.named} from {p.rival} run {p.file} as the {p.signal}: "
        f"{p.time[-1]:.3g} s, from rest at {start} {joined(machine.unit_by_joint('position'))}; "
        f"expected {_nats(p.expected)} nats, {_nats(p.needed)} wanted, this log has {_nats(abs(p.present))}"
        f"{speaks}"
    )


def _nats(value: float) -> str:
    return f"{value:.1f}" if abs(value) < 10 else f"{value:.0f}"


def proposal_json(proposal: Proposal, machine: Machine) -> dict[str, Any]:
    """Return one entry of `experiments` in discovery.json."""
    p = proposal
    period = float(p.time[1] - p.time[0])
    return {
        "separates": [p.named, p.rival],
        **{f"{place}s": [k if kind == place else None for kind, k in p.places] for place in PLACES},
        "possible": p.separates,
        "text": sentence(p, machine),
        "nats": {"present": p.present, "expected": p.expected, "needed": p.needed},
        "file": p.file if p.separates else None,
        "signal": p.signal,
        "rate_hz": 1 / period,
        "duration": len(p.time) * period,
        "start": _one(p.start),
        "limits": {**_bounds(p.limits), "stated": list(p.limits.stated)},
        "peaks": None if p.peaks is None else _bounds(p.peaks),
    }


def _bounds(b: Limits | Peaks) -> dict[str, Any]:
    stroke = np.stack([b.low, b.high], axis=1)
    return {
        "stroke": stroke[0].tolist() if len(stroke) == 1 else stroke.tolist(),
        "speed": _one(b.speed),
        "force": _one(b.force),
    }


def _one(x: np.ndarray) -> float | list[float]:
    """Return a number for one joint, a list for several."""
    values = [float(v) for v in np.ravel(x)]
    return values[0] if len(values) == 1 else values
