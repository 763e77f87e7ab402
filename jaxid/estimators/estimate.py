"""The result that every estimator returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxid.machine import Machine
from jaxid.numerics.precision import Precision

# Half width of a 95 % interval in standard deviations.
INTERVAL = 1.96


@dataclass(frozen=True)
class Estimate:
    """Parameters, their precision, and the state in which the solver ended.

    Args:
        method: Name of the estimator.
        machine: The machine with the estimates in its plant.
        theta: Estimates, in the order of `machine.parameters`.
        precision: Covariance, and which parameters are not identifiable.
        converged: Whether the solver converged.
        message: Message of the solver.
        residual: Minimised residual, (time, n); NaN for a sample that does not count.
        samples: Number of samples that counted.
        steps: Number of evaluations of the Jacobian.
        notes: Remarks for a user on how the fit was done.
        details: Further results of the method, by their key in `result.json`.
        std_misspecified: Standard deviations of the values that fit best, which hold even if the model is
            incomplete, (p,), see `jaxid.numerics.misspecified`; None if the method has none.
    """

    method: str
    machine: Machine
    theta: Float[np.ndarray, " p"]
    precision: Precision
    converged: bool
    message: str
    residual: Float[np.ndarray, "time n"]
    samples: int
    steps: int = 1
    notes: tuple[str, ...] = field(default=())
    details: Mapping[str, Any] = field(default_factory=dict)
    std_misspecified: Float[np.ndarray, " p"] | None = None

    @property
    def names(self) -> list[str]:
        """Names of the parameters."""
        return self.machine.parameters.names

    @property
    def std(self) -> Float[np.ndarray, " p"]:
        """Standard deviations, (p,); NaN for parameters that are not identifiable."""
        return self.precision.std

    @property
    def identifiable(self) -> Bool[np.ndarray, " p"]:
        """Mask of the parameters that the log identifies."""
        return self.precision.identifiable

    @property
    def all_identified(self) -> bool:
        """True if the solver converged and all parameters are identifiable."""
        return self.converged and bool(np.all(self.identifiable))

    def value(self, name: str) -> float:
        """Return the estimate of one parameter.

        Raises:
            KeyError: If no parameter has that name.
        """
        if name not in self.names:
            raise KeyError(f"{name!r} is not among {', '.join(self.names)}.")
        return float(self.theta[self.names.index(name)])

    def holding(self, *others: Float[np.ndarray, " p"]) -> Estimate:
        """Return the estimate with 95 % intervals that hold other values of the unknowns too, (p,) each."""
        if not others:
            return self
        away = np.max([np.abs(theta - self.theta) for theta in others], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            wider = 1 + away / (INTERVAL * self.std)
        return self.wider(np.where(np.isfinite(wider), wider, 1.0))

    def wider(self, factor: Float[np.ndarray, " p"]) -> Estimate:
        """Return the estimate with each standard deviation multiplied by a factor, (p,)."""
        beside = None if self.std_misspecified is None else self.std_misspecified * factor
        return replace(self, precision=self.precision.widened(factor), std_misspecified=beside)

    def __str__(self) -> str:
        lines = []
        for f, v, s, ok in zip(
            self.machine.parameters.free, self.theta, self.std, self.identifiable, strict=True
        ):
            text = f"{v:.6g} ± {s:.2g} {f.unit}" if ok else "not identifiable from this log"
            lines.append(f"{f.name:32s} {text}")
        return "\n".join(lines)


def rms_left(estimate: Estimate) -> float:
    """Return the RMS of what a fit leaves of the logs, in the unit of its residual; NaN does not count."""
    return float(np.sqrt(np.nanmean(np.square(estimate.residual))))


def misfit(estimate: Estimate) -> float:
    """Return a number by which fits of the same logs compare, the least one that of the best fit.

    It is the squared residual of one log; that of each log of several is divided by its noise.
    """
    logs = list(estimate.details.get("fits", {}).values())
    if not logs:
        return float(np.nansum(estimate.residual**2))
    samples = [log["samples"] for log in logs]
    # Each log counts by its own noise, so that the likelihood is that of the sum of these logarithms.
    return float(np.dot(samples, [2 * np.log(max(log["noise"], 1e-300)) for log in logs]))
