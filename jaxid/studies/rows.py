"""The columns that a study keeps of each run and estimator, declared once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array, library

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


def converged(theta: np.ndarray, std: np.ndarray, identifiable: np.ndarray, steps: np.ndarray) -> Arrays:
    """Return the columns of many runs whose fits converged, (1, runs, ...) each: of one estimator.

    Args:
        theta: Estimates, (runs, p).
        std: Standard deviations, (runs, p).
        identifiable: Masks of the identifiable parameters, (runs, p).
        steps: Evaluations of the Jacobian, (runs,).
    """
    runs = len(theta)
    identifiable = identifiable & np.isfinite(theta).all(axis=1, keepdims=True)
    columns = {
        "estimate": np.where(identifiable, theta, np.nan),
        "std": np.where(identifiable, std, np.nan),
        "identifiable": identifiable,
        "converged": np.ones(runs, bool),
        "steps": steps,
        "message": np.full(runs, "converged"),
        "named": np.full(runs, ""),
        "combinations": np.zeros(runs, int),
        "combination_error": np.full(theta.shape, np.nan),
    }
    return {name: columns[name][None] for name in COLUMNS}


# Fraction of a run, at its end, over which tracking errors count; a law that adapts has settled by then.
_SETTLED = 0.25


def tracking_of(reference: Array | None, followed: Float[Array, "time ... drives"]) -> Float[Array, "... 2"]:
    """Return root mean square and peak of the tracking errors at the end of runs, (..., drives, 2).

    Args:
        reference: The reference, of the shape of `followed`; None: there is none, and no drive has errors.
        followed: Positions of the drives, (time, ..., drives).
    """
    if reference is None:
        return np.zeros((0, 2))
    xp = library(followed)
    error = (reference - followed)[-max(1, round(_SETTLED * len(followed))) :]
    return xp.stack([xp.sqrt(xp.mean(error**2, axis=0)), xp.abs(error).max(axis=0)], axis=-1)


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
