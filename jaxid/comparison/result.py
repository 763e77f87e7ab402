"""The result of `compare`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from jaxid.session import Session


@dataclass(frozen=True)
class Value:
    """A value with its standard deviation.

    Args:
        value: The value.
        std: Its standard deviation; NaN if the logs do not determine it.
        unit: Label of the unit.
    """

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class Rival:
    """Another change that explains the logs equally well.

    Args:
        label: Name of the parameter, or kind and place of the effect.
        parameter: Name of the parameter; empty for an effect.
        kind: Kind of the effect; empty for a parameter.
        place: A word of `PLACES` and a number counted from 1; None for a parameter without a place.
        logs: Logs in which an effect acts; empty for a parameter.
        evidence: Held-out gain in log-likelihood [nats].
    """

    label: str
    parameter: str
    kind: str
    place: tuple[str, int] | None
    logs: tuple[str, ...]
    evidence: float


@dataclass(frozen=True)
class Difference:
    """A difference between logs.

    Args:
        label: Name of the parameter, or kind and place of the effect.
        parameter: Name of the parameter; empty for an effect that acts in some of the logs only.
        kind: Kind of the effect; empty for a parameter.
        place: A word of `PLACES` and a number counted from 1; None for a parameter without a place.
        by_log: Values by the name of the log: one of a parameter; of an effect its parameters by their
            names, and None where it does not act.
        evidence: Held-out gain in log-likelihood by the difference [nats].
        threshold: Evidence that noise alone exceeds once in a thousand comparisons [nats].
        false_alarm: Probability that noise alone reaches the evidence with any of the changes tried.
        alternatives: Other changes that explain the logs equally well.
    """

    label: str
    parameter: str
    kind: str
    place: tuple[str, int] | None
    by_log: Mapping[str, Value | Mapping[str, Value] | None]
    evidence: float
    threshold: float
    false_alarm: float
    alternatives: tuple[Rival, ...] = ()


@dataclass(frozen=True)
class LogGap:
    """Force or position that one model leaves unexplained of a log, by joint.

    Args:
        name: Name of the log.
        shared: RMS with one model for all logs.
        explained: RMS with the differences that were found.
        floor: RMS that the noise of the sensors causes.
        time: Time of the samples [s].
        before, after: Residual of both models, NaN at rest.
    """

    name: str
    shared: Float[np.ndarray, " n"]
    explained: Float[np.ndarray, " n"]
    floor: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " kept"]
    before: Float[np.ndarray, "kept n"]
    after: Float[np.ndarray, "kept n"]


@dataclass(frozen=True, repr=False)
class Comparison:
    """Result of `compare`.

    Args:
        session: Case and logs, the base first.
        verdict: "same", "differs" or "unexplained".
        differences: The fewest changes that explain what differs.
        alike: Effects that the case lacks in all logs alike.
        gaps: Unexplained force or position of each log.
        why: Sentence on what differs if nothing known explains it; empty otherwise.
        tried: Number of changes that were compared with the model of one machine.
        threshold: Evidence that noise alone exceeds once in a thousand comparisons [nats].
        parameters: Values of the unknowns that all logs share, by their names.
        quantity: What was compared: "force", or "position" of the simulated loop for logs without a force.
        scale: Name of the unknown that was held at its guess in the first log, because nothing known gives
            the logs a scale; empty if something does.
    """

    session: Session
    verdict: str
    differences: tuple[Difference, ...]
    alike: tuple[str, ...]
    gaps: tuple[LogGap, ...]
    why: str
    tried: int
    threshold: float
    parameters: Mapping[str, Value]
    quantity: str = "force"
    scale: str = ""

    @property
    def logs(self) -> tuple[str, ...]:
        """Names of the logs, the base first."""
        return tuple(gap.name for gap in self.gaps)

    def json(self) -> dict:
        """Return the content of `comparison.json`."""
        from jaxid.results.comparison import comparison_json

        return comparison_json(self)

    def __repr__(self) -> str:
        return self.__str__().splitlines()[0]

    def __str__(self) -> str:
        from jaxid.results.comparison import comparison_table

        return comparison_table(self)

    def _repr_html_(self) -> str:
        from jaxid.results.comparison import comparison_html

        return comparison_html(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write `comparison.json` and `report.html` to a folder.

        Raises:
            InputError: If the folder has files that jaxid did not make and `overwrite` is not given.
        """
        from jaxid.results.comparison import save_comparison

        return save_comparison(self, Path(folder), overwrite=overwrite)
