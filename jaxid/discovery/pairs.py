"""One step further ahead: which two effects together explain most.

Two hidden effects can each explain little alone, while a third imitates the sum of both: a search
that adds one effect at a time would take the imitation and never find the way back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxid.discovery import evidence as ev
from jaxid.discovery.candidates import Candidate, Point

# So many of the best pairs are looked at, until one has strengths of signs that it may have.
PAIRS = 5


@dataclass(frozen=True)
class Pairs:
    """Evidence of every two points beside a base, linearised [nats].

    Args:
        points: Candidates at a start each.
        evidence: (point, point), symmetric; the diagonal holds each alone.
    """

    points: tuple[Point, ...]
    evidence: Float[np.ndarray, "point point"]

    def best(self, broken: list[Candidate]) -> list[tuple[Point, Point, float]]:
        """The best pairs of two effects, each with its best starts, best first.

        Args:
            broken: Effects whose linear promise a refit has not kept.
        """
        found: dict[frozenset[int], tuple[Point, Point, float]] = {}
        pair = np.triu(self.evidence, 1)
        for k in np.argsort(-pair, axis=None):
            i, j = np.unravel_index(k, pair.shape)
            two = [self.points[i].candidate, self.points[j].candidate]
            key = frozenset(id(c) for c in two)
            if pair[i, j] <= 0 or len(found) == PAIRS:
                break
            if key not in found and not any(c is b for c in two for b in broken):
                found[key] = (self.points[i], self.points[j], float(pair[i, j]))
        return list(found.values())

    def with_partner(self, kind: str, port: int) -> float:
        """Evidence of an effect with the best partner."""
        rows = [k for k, p in enumerate(self.points) if (p.candidate.kind, p.candidate.port) == (kind, port)]
        return float(self.evidence[rows].max()) if rows else 0.0


def score_pairs(
    base: Float[np.ndarray, "row k"],
    e: Float[np.ndarray, "row 1"],
    points: list[tuple[Point, Float[np.ndarray, "row j"], Float[np.ndarray, "row 1"] | None]],
    blocks: np.ndarray,
) -> Pairs:
    """Held-out evidence of every two effects, from one set of products of all columns.

    Args:
        base: Whitened columns of the model.
        e: Its whitened residual.
        points: Each with its whitened columns, and by how much the residual differs there.
        blocks: Block of time of every row.
    """
    parts = [base, e]
    for _, columns, offset in points:
        parts += [columns, np.zeros_like(e) if offset is None else offset]
    ends = np.cumsum([0, *[p.shape[1] for p in parts[1:]]])
    places = [np.arange(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    swept = ev.swept(ev.grams(np.concatenate(parts, axis=1), blocks), base.shape[1])
    rows = len(blocks)

    def left(*chosen: int) -> float:
        """Held-out sum of squares with the columns of some points, the residual at their offsets."""
        columns = np.concatenate([np.zeros(0, int), *[places[1 + 2 * k] for k in chosen]])
        target = np.concatenate([places[0], *[places[2 + 2 * k] for k in chosen]])
        return ev.left_beside(*swept, columns, target)

    before, n = left(), len(points)
    evidence = np.zeros((n, n))
    for i in range(n):
        for j in range(i, n):
            same = i != j and points[i][0].candidate is points[j][0].candidate
            chosen = (i,) if i == j or same else (i, j)
            # Two starts of one effect are no pair.
            after = np.inf if same else left(*chosen)
            gain = -np.inf if same else ev.log_evidence(rows, np.array(before), np.array(after))
            evidence[i, j] = evidence[j, i] = float(gain)
    return Pairs(tuple(p for p, *_ in points), evidence)
