"""Positions that start anew after a turn: found, and joined."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jaxid.logs.finding import Finding

if TYPE_CHECKING:
    from jaxtyping import Float

# A step between neighbouring samples beyond this part of the whole range is a jump.
_JUMP = 0.5
# Part of all steps that may be jumps, and part of the range up to which the other steps go.
_RARE, _STEADY = 0.1, 0.3
# Relative deviation of jumps from each other, from a known turn, and from the range of the position.
_SAME, _KNOWN, _RANGE = 0.05, 0.02, 0.15
# Length of the course between jumps, in turns, that a joint goes at least.
_MOVES = 0.05
# Fewest jumps that show a turn of unknown size.
_SEVERAL = 3
# Turns by name; counts of an encoder or of a register are powers of two.
_TURNS = {2 * math.pi: "2 pi", 360.0: "360", math.pi: "pi", 180.0: "180"} | {
    2.0**k: f"2^{k}" for k in range(7, 33)
}


@dataclass(frozen=True)
class Wrap:
    """Jumps of a position by a turn.

    Args:
        turn: Size of a turn, in the unit of the position.
        name: The turn as text; empty if it is no usual one.
        rows: Samples after which the position jumps.
    """

    turn: float
    name: str
    rows: np.ndarray


def find_wrap(q: Float[np.ndarray, " time"]) -> Wrap | None:
    """Return the jumps by a turn of a position that otherwise moves steadily; None if there are none."""
    step, span = np.diff(q), float(np.ptp(q))
    jumps = np.flatnonzero(np.abs(step) > _JUMP * span)
    if span == 0 or not jumps.size or jumps.size > _RARE * step.size or np.any(np.diff(jumps) == 1):
        # Two jumps in a row are an outlier.
        return None
    others = np.delete(step, jumps)
    if np.quantile(np.abs(others), 0.99) > _STEADY * span:
        return None

    # A turn is the jump and the way that the joint goes on meanwhile.
    meanwhile = np.array([_neighbours(step, jumps, int(k)) for k in jumps])
    sizes = np.abs(step[jumps] - meanwhile)
    turn = float(np.median(sizes))
    room = max(_SAME * turn, 3 * float(np.median(np.abs(others))))
    if np.sum(np.abs(others)) < _MOVES * turn:
        # A course of steps alone: a square wave, or a position command.
        return None
    if np.any(np.abs(sizes - turn) > room) or abs(span - turn) > _RANGE * turn + room:
        return None
    near = [size for size in _TURNS if abs(turn - size) < _KNOWN * size]
    if near:
        size = min(near, key=lambda s: abs(s - turn))
        return Wrap(size, _TURNS[size], jumps)
    return Wrap(turn, "", jumps) if jumps.size >= _SEVERAL else None


def _neighbours(step: np.ndarray, jumps: np.ndarray, k: int) -> float:
    """Return the median step next to a jump."""
    around = [i for i in range(k - 3, k + 4) if 0 <= i < step.size and i not in jumps]
    return float(np.median(step[around])) if around else 0.0


def wrap_findings(position: Float[np.ndarray, "time n"], path: str) -> list[Finding]:
    """Return an error for each joint whose position starts anew after a turn.

    Args:
        position: Positions by joint; NaN for a joint without an encoder.
        path: Name of the log in messages.
    """
    findings = []
    for joint, q in enumerate(position.T, start=1):
        wrap = None if np.isnan(q[0]) else find_wrap(q)
        if wrap is None:
            continue
        size = f"a turn ({wrap.name})" if wrap.name else f"{wrap.turn:.4g}"
        what = (
            f"the position jumps by {size} in {wrap.rows.size} row(s), first after row {wrap.rows[0]}: "
            "it starts anew after a turn"
        )
        hint = "set unwrap = true in [log]" if wrap.name else "set unwrap = <size of a turn> in [log]"
        findings.append(Finding("error", what, f"{path}, position of joint {joint}", hint, "wrap"))
    return findings


def joined(
    position: Float[np.ndarray, "time n"],
    reference: Float[np.ndarray, "time m"] | None,
    turn: bool | float,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Join positions, and references, that start anew after a turn.

    Args:
        position: Positions by joint.
        reference: References by drive; None: there are none.
        turn: Size of a turn, in the unit of the position; True: found in the log.

    Returns:
        Positions and references without jumps; a reference starts within half a turn of the position with the
        same number.
    """
    joints = position.shape[1]
    found = [find_wrap(q) if turn is True else None for q in position.T]
    turns = [None if f is None else f.turn for f in found] if turn is True else [float(turn)] * joints
    out = position.copy()
    for j, size in enumerate(turns):
        if size is not None:
            out[:, j] = np.unwrap(position[:, j], period=size)
    if reference is None:
        return out, None
    followed = reference.copy()
    for k in range(min(reference.shape[1], joints)):
        size = turns[k]
        if size is not None:
            followed[:, k] = np.unwrap(reference[:, k], period=size)
            followed[:, k] += size * np.round((out[0, k] - followed[0, k]) / size)
    return out, followed
