"""The score of a candidate effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxid.discovery import candidates as cand


@dataclass(frozen=True)
class Score:
    """Evidence of one candidate.

    Args:
        candidate: The candidate that is scored.
        start: Index of its best start.
        guess: Values from which its refit starts.
        evidence: Held-out gain in log-likelihood on the log [nats].
        second: Second values from which a refit starts: for a drive effect, the start that alone reduces the
            residual most. A linear screen exaggerates the gain of a start that affects few samples.
        validation: Gain in log-likelihood on the validation logs [nats]; None without any.
        theta: All unknowns of the superset after its refit; None if it was only screened.
        reason: Reason why it was rejected; empty if it was not.
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
    def refitted(self) -> np.ndarray:
        """All unknowns of the superset after the refit of a candidate that was refitted."""
        assert self.theta is not None, "only screened"
        return self.theta

    @property
    def total(self) -> float:
        """Evidence of log and validation logs together [nats]."""
        return self.evidence + (self.validation or 0.0)
