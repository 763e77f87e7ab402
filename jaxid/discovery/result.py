"""The result of `discover`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxid.consistency.force_reading import ForceReading
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
    """An effect that the search added.

    Args:
        kind: Kind of the effect, as in case files.
        label: Kind and place, as in results.
        place: A word of `PLACES` and a number counted from 1.
        names: Names of its parameters in the estimate.
        score: Its evidence when it was added.
        alternatives: Effects that explain this log equally well.
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
        step: The step of the search.
        fit: RMS force residual on the fitted log, by joint.
        validation: The largest RMS of the validation logs, by joint; None without any.
        position_fit, position_validation: The same of the simulated position, for logs without a force, of
            which the former are NaN; None for others.
    """

    step: Step
    fit: np.ndarray
    validation: np.ndarray | None
    position_fit: np.ndarray | None = None
    position_validation: np.ndarray | None = None


@dataclass(frozen=True, repr=False)
class Discovery(FitResult):
    """Result of `discover`; for its parameters, plots and tables see `FitResult`.

    Args:
        session: Case and logs.
        verdict: "found", "nothing_missing" or "unexplained".
        where: Region in which the baseline's residual lies; None if nothing is missing.
        effects: Added effects, in order.
        rounds: Steps of the search with their gaps.
        before: Estimate of the refitted baseline.
        after: Estimate of the last refit, effects included.
        gaps_before: Gaps before the search, by log, the fitted one first.
        gaps_after: Gaps after the search, in the same order.
        noise_floor: RMS force residual that the sensors' noise causes in the band, by joint.
        proposals: Experiments that distinguish effects which explain this log equally well.
        unseen: Reason why break-away friction was not searched for; empty if it was.
        force_reading: A late or drifting reading of the force that explains the log as well as effects of the
            search; None if none does.
        joints: Searches of the joints of an arm, each alone, by joint; empty: all were searched at once.
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
    force_reading: ForceReading | None = None
    joints: Mapping[int, Discovery] = field(default_factory=dict)

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
            InputError: If the folder has files that jaxid did not make and `overwrite` is not given.
        """
        from jaxid.results.as_json import save_discovery

        return save_discovery(self, Path(folder), overwrite=overwrite)
