"""The domain in which a search compares a model with its logs.

A search adds, refits and drops effects by residuals and their derivatives alone. This module states what it
asks of a domain, and gives that of forces. The positions of a simulated loop are in
`jaxid.discovery.in_loop.positions`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float

from jaxid.discovery import candidates as cand
from jaxid.discovery.points import grid_points, start_points

Wanted = Sequence[int] | np.ndarray | None


class Samples(Protocol):
    """The samples of the logs that a search uses.

    Args:
        moving: Mask of the samples that count, by joint.
        weight: Weight of a residual in a fit, by joint.
        noisier: The same samples with a second draw of noise in the logged force; empty without one.
    """

    moving: Bool[np.ndarray, "kept n"]
    weight: Float[np.ndarray, "kept n"]
    noisier: list[Any]


class Domain(Protocol):
    """The residuals of a model with all candidates, at any values of its unknowns."""

    def evaluate(
        self, samples: Any, theta: np.ndarray, wanted: Wanted = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residual, (kept, n), and its derivatives by the wanted unknowns, (kept, n, p)."""
        ...

    def points(
        self, rest: list[cand.Candidate], samples: Any, theta: np.ndarray, residual: np.ndarray
    ) -> list[cand.Point]:
        """Linearise each of some candidates at each of its starts, beside a model."""
        ...

    def noisier(self, samples: Any, theta: np.ndarray) -> np.ndarray:
        """Compute the residual of the samples with more noise of the force."""
        ...


@dataclass(frozen=True)
class ForceDomain:
    """Measured forces against those of inverse dynamics.

    Args:
        superset: Machine with all candidates.
    """

    superset: cand.CandidateModel
    _grids: dict[tuple[str, int, int], list[cand.Point]] = field(default_factory=dict, compare=False)

    def evaluate(
        self, samples: Any, theta: np.ndarray, wanted: Wanted = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residual and its derivatives; see `Domain`."""
        return cand.evaluate(self.superset, samples, theta, wanted)

    def points(
        self, rest: list[cand.Candidate], samples: Any, theta: np.ndarray, residual: np.ndarray
    ) -> list[cand.Point]:
        """Linearise candidates; see `Domain`."""
        points = start_points(self.superset, rest, samples, theta, residual)
        for c in rest:
            if c.has_grid:
                points.extend(self.grid(c, samples))
        return points

    def grid(self, candidate: cand.Candidate, samples: Any) -> list[cand.Point]:
        """Linearise a candidate at its many starts; the result is kept, since no other effect enters it."""
        key = (candidate.kind, candidate.port, len(candidate.starts))
        if key not in self._grids:
            self._grids[key] = grid_points(self.superset, candidate, samples)
        return self._grids[key]

    def noisier(self, samples: Any, theta: np.ndarray) -> np.ndarray:
        """Compute the residual of the samples with more noise of the force."""
        return cand.evaluate_on(self.superset, samples.noisier, theta, ())[0]
