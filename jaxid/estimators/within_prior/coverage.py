"""Errors of the fitted combinations of a fit within a prior, where the truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.estimators.within_prior.prior import Prior
from jaxid.machine import Machine


def errors_of_directions(
    machine: Machine,
    width: float,
    directions: Sequence[Mapping[str, Any]],
    truth: Float[np.ndarray, " p"],
    moved: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " r"]:
    """Return the errors of the fitted combinations in units of their reported standard deviation.

    Args:
        machine: The machine at the guesses of the fit.
        width: Relative standard deviation of the guesses.
        directions: The entry `directions` of the details of the estimate.
        truth: True values of the unknowns, (p,).
        moved: True minus read position of each joint at the start, (n,).
    """
    names = machine.parameters.names
    whitened = dict(zip(names, Prior.of(machine, width, np.zeros(0)).inward(truth), strict=True))
    std = machine.sensor.position_std
    if std is not None:
        # The start positions are unknowns beside those of the machine, see `Problem.nuisances`.
        wide = np.broadcast_to(np.asarray(std), moved.shape)
        whitened |= {
            f"start position {k + 1}": m / s for k, (m, s) in enumerate(zip(moved, wide, strict=True))
        }
    return np.array(
        [
            (d["value"] - sum(w * whitened[n] for n, w in d["combination"].items())) / d["std"]
            for d in directions
        ]
    )
