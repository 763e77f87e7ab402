"""What `discover` returns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxid.discovery.score import Score
from jaxid.discovery.where import Where
from jaxid.estimators.estimate import Estimate
from jaxid.gap import Gap
from jaxid.results.result import FitResult
from jaxid.session import Session

if TYPE_CHECKING:
    from jaxid.discovery.search import Step
    from jaxid.discovery.separating.propose import Proposal


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was added.

    Args:
        kind: Its name.
        label: Kind and place, as results name it.
        place: one of `PLACES`, and which, 1-based.
        names: Names of its parameters in the estimate.
        score: Its evidence when it was added.
        alternatives: Effects that this log cannot tell from it.
    """

    kind: str
    label: str
    place: tuple[str, int]
    names: tuple[str, ...]
    score: Score
    alternatives: tuple[Score, ...]


@dataclass(frozen=True)
class Round:
    """One step of the search with its gap.

    Args:
        step: The step.
        fit: RMS force residual on the log, by joint.
        validation: The worst of the validation logs; None without any.
    """

    step: Step
    fit: np.ndarray
    validation: np.ndarray | None


@dataclass(frozen=True, repr=False)
class Discovery(FitResult):
    """Result of `discover`; for its parameters, plots and tables see `FitResult`.

    Args:
        session: Case and logs.
        verdict: "found", "nothing_missing" or "unexplained".
        where: Where the baseline's residual lies; None where nothing is missing.
        effects: Effects added, in order.
        rounds: The search.
        before: The refitted baseline.
        after: The last refit, effects included.
        gaps_before: By log, the fitted one first.
        gaps_after: The same after.
        noise_floor: RMS force that the sensors' noise leaves in the band, by joint.
        proposals: Experiments that would tell effects apart which this log cannot.
        unseen: Why break-away friction was not looked for; empty where it was.
    """

    session: Session
    verdict: str
    where: Where | None
    effects: tuple[NamedEffect, ...]
    rounds: tuple[Round, ...]
    before: Estimate
    after: Estimate
    gaps_before: tuple[Gap, ...]
    gaps_after: tuple[Gap, ...]
    noise_floor: np.ndarray
    proposals: tuple[Proposal, ...] = ()
    unseen: str = ""

    @property
    def kinds(self) -> list[str]:
        """Names of the effects added."""
        return [e.kind for e in self.effects]

    @property
    def estimate(self) -> Estimate:
        """The last refit, effects included; the same as `after`."""
        return self.after

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Disagreement after the last refit with each log; the same as `gaps_after`."""
        return self.gaps_after

    def __repr__(self) -> str:
        from jaxid.results.as_text import discovery_summary

        return discovery_summary(self)

    def __str__(self) -> str:
        from jaxid.results.as_text import discovery_table

        return discovery_table(self)

    def _repr_html_(self) -> str:
        from jaxid.results.as_html import discovery_html

        return discovery_html(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write `discovery.json`, `report.html`, `case.toml` and the proposed experiments to a folder.

        Raises:
            InputError: If the folder holds what jaxid did not make and `overwrite` is not given.
        """
        from jaxid.results.as_json import save_discovery

        return save_discovery(self, Path(folder), overwrite=overwrite)
