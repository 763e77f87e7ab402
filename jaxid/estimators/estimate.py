"""What every estimator returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxid.machine import Machine
from jaxid.numerics.precision import Precision


@dataclass(frozen=True)
class Estimate:
    """Parameters, how well they are known, and what the solver said.

    Args:
        method: Name of the estimator.
        machine: The machine with the estimates in its plant.
        theta: Estimates, in the order of `machine.parameters`.
        precision: Covariance, and what cannot be told.
        converged: Whether the solver did.
        message: What it said.
        residual: What the estimator minimised, at its samples; NaN where a sample does not count.
        samples: How many samples counted.
        steps: Evaluations of the Jacobian.
        notes: What a user should know of how it was done.
        details: What the method has to say of its own, by the key under which results hold it.
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

    @property
    def names(self) -> list[str]:
        """Names of the parameters."""
        return self.machine.parameters.names

    @property
    def std(self) -> Float[np.ndarray, " p"]:
        """Standard deviations; NaN of parameters that are not identifiable."""
        return self.precision.std

    @property
    def identifiable(self) -> Bool[np.ndarray, " p"]:
        """Mask of the parameters that the log identifies."""
        return self.precision.identifiable

    @property
    def all_identified(self) -> bool:
        """Whether the solver converged and all parameters are identifiable."""
        return self.converged and bool(np.all(self.identifiable))

    def value(self, name: str) -> float:
        """Return the estimate of one parameter.

        Raises:
            KeyError: If there is none of that name.
        """
        if name not in self.names:
            raise KeyError(f"{name!r} is not among {', '.join(self.names)}.")
        return float(self.theta[self.names.index(name)])

    def __str__(self) -> str:
        lines = []
        for f, v, s, ok in zip(
            self.machine.parameters.free, self.theta, self.std, self.identifiable, strict=True
        ):
            told = f"{v:.6g} ± {s:.2g} {f.unit}" if ok else "cannot be told from this log"
            lines.append(f"{f.name:32s} {told}")
        return "\n".join(lines)
