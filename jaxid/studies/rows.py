"""The columns that a study keeps of each run and estimator, declared once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]


def _column(kept_as: type | None = None, *, by_parameter: bool = False) -> Any:
    """Declare a column: its type in the table, and whether it has an entry for each parameter."""
    return field(metadata={"kept_as": kept_as, "by_parameter": by_parameter})


@dataclass(frozen=True)
class RunRow:
    """One estimator's result in one run. A new column is one line here, and a value in each constructor.

    Args:
        estimate: Estimates (p,); NaN for a parameter that is not identifiable.
        std: Standard deviations (p,); NaN likewise, and for an estimator without any.
        identifiable: Whether each parameter has a value, (p,).
        converged: Whether the solver converged.
        steps: Evaluations of the Jacobian.
        message: Message of the solver, or of the error that ended the run.
        named: Effects that a search named, or its verdict; else empty.
        combinations: Number of combinations that a fit within a prior identifies; else zero.
        combination_error: Errors of the first p of them in units of their reported deviation, (p,); else NaN.
    """

    estimate: np.ndarray = _column(by_parameter=True)
    std: np.ndarray = _column(by_parameter=True)
    identifiable: np.ndarray = _column(np.int8, by_parameter=True)
    converged: bool = _column(np.int8)
    steps: int = _column(np.int32)
    message: str = _column(object)
    named: str = _column(object)
    combinations: int = _column(np.int32)
    combination_error: np.ndarray = _column(by_parameter=True)

    @classmethod
    def fitted(cls, theta: np.ndarray, std: np.ndarray, identifiable: np.ndarray, steps: int) -> RunRow:
        """Return the row of a fit that converged.

        Args:
            theta: Estimates, (p,).
            std: Standard deviations, (p,).
            identifiable: Mask of the identifiable parameters, (p,).
            steps: Evaluations of the Jacobian.
        """
        identifiable = identifiable & np.all(np.isfinite(theta))
        return cls(
            estimate=np.where(identifiable, theta, np.nan),
            std=np.where(identifiable, std, np.nan),
            identifiable=identifiable,
            converged=True,
            steps=steps,
            message="converged",
            named="",
            combinations=0,
            combination_error=np.full(len(theta), np.nan),
        )

    @classmethod
    def failed(cls, parameters: int, why: str) -> RunRow:
        """Return the row of a run that gave no estimate.

        Args:
            parameters: Number of parameters.
            why: Message that says why.
        """
        none = np.full(parameters, np.nan)
        return cls(
            estimate=none,
            std=none,
            identifiable=np.zeros(parameters, bool),
            converged=False,
            steps=0,
            message=why,
            named="",
            combinations=0,
            combination_error=none,
        )


COLUMNS = tuple(f.name for f in fields(RunRow))


def stacked(rows: Sequence[RunRow]) -> Arrays:
    """Return the columns of one run, an entry for each estimator."""
    return {name: np.stack([np.asarray(getattr(row, name)) for row in rows]) for name in COLUMNS}


def variables(columns: Arrays, dims: tuple[str, ...]) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Return the columns of a table as variables of an xarray Dataset.

    Args:
        columns: Arrays of all runs by name.
        dims: Dimensions of a column that has no entry for each parameter.
    """
    out = {}
    for f in fields(RunRow):
        its_dims = (*dims, "parameter") if f.metadata["by_parameter"] else dims
        kept_as, values = f.metadata["kept_as"], columns[f.name]
        out[f.name] = its_dims, values if kept_as is None else values.astype(kept_as)
    return out
