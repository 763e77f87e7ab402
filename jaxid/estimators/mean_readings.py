"""Fits of the mean readings of a loop whose controller reads a coarse, noisy encoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import output_error_steps
from jaxid.estimators.several.parts import Part
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics.lanes import Steps
from jaxid.simulation.noisy_loop import ReadingNoise, estimated_noise, mean_readings
from jaxid.simulation.replay import Numerics, make_replay
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import TooStiffError

# Number of times that the noise of the encoder is estimated, and the unknowns refitted.
_RENEWALS = 2


def fitted_with_noise(
    machine: Machine,
    log: Log | Sequence[Part],
    start: Float[np.ndarray, " p"],
    *,
    follows: bool = True,
    **options: Any,
) -> Steps[Estimate | None]:
    """Fit the mean readings of a loop whose controller reads a noisy encoder.

    Args:
        machine: The machine of all logs.
        log: The log, or the parts of several.
        start: Values of the unknowns near the optimum, at which the noise is estimated first.
        follows: Whether the fit follows runs with noise, or one run without, see
            `jaxid.simulation.noisy_loop.ReadingNoise`.
        options: Further arguments of `output_error_steps`.

    Returns:
        The estimate; None if nothing is known of the noise, or the fit does not converge.
    """
    best: Estimate | None = None
    noise: list[ReadingNoise | None] = []
    if options.get("on", "position") != "position":
        return None
    parts = [Part.alone(machine, log)] if isinstance(log, Log) else list(log)
    for _ in range(_RENEWALS):
        at = start if best is None else best.theta
        noise = noise_of_parts(parts, at, options.get("numerics"), follows=follows, before=noise)
        if not any(noise):
            return best
        new = yield from output_error_steps(machine, parts, start=at, noise=noise, **options)
        if not new.converged:
            return best
        best = replace(new, notes=(*new.notes, _words(noise)))
    return best


def noise_of_parts(
    parts: Sequence[Part],
    theta: Float[np.ndarray, " p"],
    numerics: Numerics | None = None,
    *,
    follows: bool = True,
    before: Sequence[ReadingNoise | None] = (),
) -> list[ReadingNoise | None]:
    """Estimate the noise of the encoder in the loop of each log, at values of all unknowns.

    Args:
        parts: The logs.
        theta: Values of the unknowns, (p,).
        numerics: Settings of the integration; None: chosen from machines and logs.
        follows: See `jaxid.simulation.noisy_loop.ReadingNoise`.
        before: Noise of each log at values nearby; empty: it is estimated anew.

    Returns:
        The noise by log; None where nothing is known of it, or the loop is too stiff to be simulated.
    """
    found: list[ReadingNoise | None] = []
    for part, near in zip(parts, before or [None] * len(parts), strict=True):
        at = part.at(theta)
        try:
            replay = make_replay(at, part.log, numerics or choose_numerics(at, part.log))
        except TooStiffError:
            # The fit of an incomplete model may run there.
            found.append(None)
            continue
        found.append(estimated_noise(at, part.log, replay, follows=follows, before=near))
    return found


def far_from_logs(
    parts: Sequence[Part], estimate: Estimate, numerics: Numerics | None = None, *, times: float
) -> bool:
    """Check that a model is incomplete: noise in its loop does not explain what a fit without noise leaves.

    Noise is simulated only in the log of which the fit leaves most.

    Args:
        parts: The logs.
        estimate: A fit to all of them without noise.
        numerics: Settings of the integration; None: chosen from machines and logs.
        times: RMS over the noise of a reading from which a model is far from a log.
    """
    left = left_over_noise(parts, estimate)
    if max(left) <= times:
        return False
    worst = parts[int(np.argmax(left))]
    at = worst.at(estimate.theta)
    [noise] = noise_of_parts([worst], estimate.theta, numerics)
    if noise is None:
        return False
    replay = make_replay(at, worst.log, numerics or choose_numerics(at, worst.log))
    replay = replay.following(at.parameters.places, jnp.asarray(at.parameters.guess))
    mean = np.asarray(mean_readings(noise.on(replay), at.plant))
    return _over_noise(worst, worst.log.filled - mean) > times


def left_over_noise(parts: Sequence[Part], estimate: Estimate) -> list[float]:
    """Return the RMS left of each log's positions over the noise of a reading, that of the worst joint."""
    ends = np.cumsum([part.log.samples for part in parts])[:-1]
    offs = np.split(estimate.residual, ends)
    return [_over_noise(part, off) for part, off in zip(parts, offs, strict=True)]


def _over_noise(part: Part, off: Float[np.ndarray, "time n"]) -> float:
    """Return the largest RMS of a joint over the noise of its readings; infinite where a loop diverges."""
    noise = position_noise(part.machine, part.log)
    with np.errstate(invalid="ignore", over="ignore"):
        rms = np.sqrt(np.nan_to_num(np.nanmean(np.square(off), axis=0), nan=np.inf))
    return float(np.max(rms[noise > 0] / noise[noise > 0], initial=0.0))


def _words(noise: Sequence[ReadingNoise | None]) -> str:
    """Return the note on the noise with which the loops were simulated."""
    known = [one for one in noise if one is not None]
    std = ", ".join(f"{s:.2g}" for s in np.max([one.std for one in known], axis=0))
    counts = " and rounding to counts" if any(np.any(one.count > 0) for one in known) else ""
    return f"the loop reads its encoder with noise of {std} (standard deviation){counts}: the mean is fitted"
