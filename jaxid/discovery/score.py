"""The score of a candidate effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxid.discovery import candidates as cand


@dataclass(frozen=True)
class Score:
    """Evidence of one candidate.

    Args:
        candidate: Which.
        start: Index of its best start.
        guess: Where its refit starts.
        second: Where it starts too: of an effect in the drive, the start that by itself brings the
            residual down most. A linear screen promises wonders of a start that touches few samples.
        evidence: Held-out gain in log-likelihood on the log [nats].
        validation: The same on the validation logs; None without any.
        theta: All unknowns of the union after its refit; None where it was only screened.
        reason: Why it was turned down; empty where it was not.
    """

    candidate: cand.Candidate
    start: int
    guess: np.ndarray
    evidence: float
    second: np.ndarray | None = None
    validation: float | None = None
    theta: np.ndarray | None = None
    reason: str = ""

    @property
    def total(self) -> float:
        """Evidence of log and validation together."""
        return self.evidence + (self.validation or 0.0)
