"""Search one step further ahead: the two effects that explain most together.

Two hidden effects can each explain little alone, while a third imitates the sum of both: a search that adds
one effect at a time would take the imitation and never find the way back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxid.discovery import evidence as ev
from jaxid.discovery.candidates import Candidate, Point

# Number of best pairs that are tried, until one is accepted.
PAIRS = 5


@dataclass(frozen=True)
class Pairs:
    """Linearised evidence of every two points beside a base [nats].

    Args:
        points: Candidates, each at one start.
        evidence: (point, point), symmetric; the diagonal is the evidence of single points.
    """

    points: tuple[Point, ...]
    evidence: Float[np.ndarray, "point point"]

    def best(self, broken: list[Candidate]) -> list[tuple[Point, Point, float]]:
        """Return the best pairs of two effects, each at its best starts, best first.

        Args:
            broken: Effects whose refit gained much less than their linear evidence promised.
        """
        best: dict[frozenset[int], tuple[Point, Point, float]] = {}
        pair = np.triu(self.evidence, 1)
        for k in np.argsort(-pair, axis=None):
            i, j = np.unravel_index(k, pair.shape)
            two = [self.points[i].candidate, self.points[j].candidate]
            key = frozenset(id(c) for c in two)
            if pair[i, j] <= 0 or len(best) == PAIRS:
                break
            if key not in best and not any(c is b for c in two for b in broken):
                best[key] = (self.points[i], self.points[j], float(pair[i, j]))
        return list(best.values())

    def with_partner(self, kind: str, port: int) -> float:
        """Return the evidence of an effect together with its best partner."""
        rows = [k for k, p in enumerate(self.points) if (p.candidate.kind, p.candidate.port) == (kind, port)]
        return float(self.evidence[rows].max()) if rows else 0.0


def score_pairs(
    base: Float[np.ndarray, "row k"],
    e: Float[np.ndarray, "row 1"],
    points: list[tuple[Point, Float[np.ndarray, "row j"], Float[np.ndarray, "row 1"] | None]],
    blocks: np.ndarray,
) -> Pairs:
    """Compute the held-out evidence of every two effects, from one set of products of all columns.

    Args:
        base: Whitened columns of the model.
        e: Whitened residual of the model, (rows, 1).
        points: Points, each with its whitened columns and its whitened change of the residual.
        blocks: Block of time of every row.
    """
    parts = [base, e]
    for _, columns, offset in points:
        parts += [columns, np.zeros_like(e) if offset is None else offset]
    ends = np.cumsum([0, *[p.shape[1] for p in parts[1:]]])
    places = [np.arange(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    products = ev.partial_products(ev.grams(np.concatenate(parts, axis=1), blocks), base.shape[1])
    rows = len(blocks)

    def held_out_squares(*chosen: int) -> float:
        """Compute the held-out sum of squares with the columns of some points, at their offsets."""
        columns = np.concatenate([np.zeros(0, int), *[places[1 + 2 * k] for k in chosen]])
        target = np.concatenate([places[0], *[places[2 + 2 * k] for k in chosen]])
        return ev.residual_squares(*products, columns, target)

    before = held_out_squares()
    n = len(points)
    evidence = np.zeros((n, n))
    for i in range(n):
        for j in range(i, n):
            if i != j and points[i][0].candidate is points[j][0].candidate:
                gain = -np.inf  # two starts of one effect are no pair
            else:
                after = held_out_squares(*((i,) if i == j else (i, j)))
                gain = float(ev.log_evidence(rows, np.array(before), np.array(after)))
            evidence[i, j] = evidence[j, i] = gain
    return Pairs(tuple(p for p, *_ in points), evidence)
