"""Fits of the mean readings of a loop whose controller reads a coarse, noisy encoder."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import output_error_steps
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics.lanes import Steps
from jaxid.simulation.noisy_loop import ReadingNoise, estimated_noise
from jaxid.simulation.replay import make_replay

# Number of times that the noise of the encoder is estimated, and the unknowns refitted.
_RENEWALS = 2


def fitted_with_noise(
    machine: Machine,
    log: Log,
    start: Float[np.ndarray, " p"],
    *,
    follows: bool = True,
    **options: Any,
) -> Steps[Estimate | None]:
    """Fit the mean readings of a loop whose controller reads a noisy encoder.

    Args:
        machine: The machine.
        log: The log.
        start: Values of the unknowns near the optimum, at which the noise is estimated first.
        follows: Whether the fit follows runs with noise, or one run without, see
            `jaxid.simulation.noisy_loop.ReadingNoise`.
        options: Further arguments of `output_error_steps`.

    Returns:
        The estimate; None if nothing is known of the noise, or the fit does not converge.
    """
    best: Estimate | None = None
    noise: ReadingNoise | None = None
    if options.get("on", "position") != "position":
        return None
    for _ in range(_RENEWALS):
        at = machine.with_estimate(start if best is None else best.theta)
        numerics = options.get("numerics") or choose_numerics(at, log)
        replay = make_replay(at, log, numerics)
        noise = estimated_noise(at, log, replay, follows=follows, before=noise)
        if noise is None:
            return best
        new = yield from output_error_steps(machine, log, start=at.parameters.guess, noise=noise, **options)
        if not new.converged:
            return best
        best = replace(new, notes=(*new.notes, _words(noise)))
    return best


def _words(noise: ReadingNoise) -> str:
    """Return the note on the noise with which a loop was simulated."""
    std = ", ".join(f"{s:.2g}" for s in noise.std)
    counts = " and rounding to counts" if np.any(noise.count > 0) else ""
    return f"the loop reads its encoder with noise of {std} (standard deviation){counts}: the mean is fitted"
