"""Bias of the innovations' maximum by noise with which the logged command was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxid.estimators.joint_likelihood import (
    JointLikelihood,
    Maximum,
    Member,
    gradients_together,
    scored_at,
)
from jaxid.numerics.lanes import Steps

# Pairs of simulated noise for the correction of the bias by noise of the command's reading.
_PAIRS = 4
# Eigenvalue of the scaled information, relative to the largest, below which a direction is not corrected.
_BLIND = 1e-10
# Largest bend of the shift by that noise, as a part of it, up to which it is a parabola of the variance.
_BENT = 0.1


def corrected_steps(fit: JointLikelihood, end: Maximum) -> Steps[tuple[np.ndarray, list[np.ndarray]]]:
    """Remove the bias by noise with which the commands were read; return the estimates and the noise.

    The filter takes the logged command for the applied one plus an error that is independent of the log.
    Noise of the reading is not independent: like noise of a regressor it makes the force count too little.
    As much noise again, simulated, has about the same effect once more. The shift of the optimum, by one step
    of the scoring, is not quite in proportion to the variance that is added: where the shifts by half as much
    and by as much lie near a line, the parabola through them gives the shift from none. Pairs of opposite
    noise cancel in first order.

    Args:
        fit: The likelihood.
        end: Its maximum.

    Returns:
        The estimates, (p,), and the noise of each log for which they were corrected, (m,).

    Source:
        Cook & Stefanski (1994), JASA 89, simulation-extrapolation.
    """
    reads = [
        _noise_of_reading(member, end.x[place]) for member, place in zip(fit.members, fit.places, strict=True)
    ]
    if not any(np.any(read > 0) for read in reads):
        return end.theta, reads
    whole = yield from _shift_steps(fit, end, reads)
    half = yield from _shift_steps(fit, end, [np.sqrt(0.5) * read for read in reads])
    if whole is None or half is None:
        return end.theta, [np.zeros_like(read) for read in reads]
    moved = end.x.copy()
    moved[: fit.unknowns] -= shift_from_none(half, whole)[: fit.unknowns]
    return np.clip(fit.theta(moved), *fit.machine.parameters.bounds), reads


def shift_from_none(half: Shift, whole: Shift) -> Float[np.ndarray, " q"]:
    """Return the shift by the noise that a log has, from those by half as much and by as much again.

    With a shift of a v + b v^2 by the variance v that is added, it is a - b.
    """
    bend = 2 * half.step - whole.step
    if whole.size_of(bend) > _BENT * whole.size_of(whole.step):
        return whole.step
    return whole.step + 4 * bend


@dataclass(frozen=True)
class Shift:
    """Shift of a maximum by noise.

    Args:
        step: Change of all unknowns and noises on the scale of the solver, (q,).
        information: Information there, (q, q).
    """

    step: Float[np.ndarray, " q"]
    information: Float[np.ndarray, "q q"]

    def size_of(self, step: Float[np.ndarray, " q"]) -> float:
        """Return the length of a step in standard deviations."""
        return float(np.sqrt(max(step @ self.information @ step, 0.0)))


def _noise_of_reading(member: Member, x: np.ndarray) -> Float[np.ndarray, " m"]:
    """Return the noise with which a log's command was read, at most that of the force; zero without any."""
    p, drives = member.unknowns, member.drives
    if member.command_noise is None or member.at.law is not None:
        return np.zeros(drives)
    return np.minimum(member.command_noise, np.exp(x[p : p + drives]))


def _shift_steps(fit: JointLikelihood, end: Maximum, reads: Sequence[np.ndarray]) -> Steps[Shift | None]:
    """Return the shift of the maximum by more noise of the commands' reading, by one step of the scoring.

    Args:
        fit: The likelihood.
        end: Its maximum.
        reads: Noise that is added to the command of each log, (m,).

    Returns:
        The shift; None if the likelihood is not finite there.
    """
    size = end.x.size
    gradient, information = np.zeros(size), np.zeros((size, size))
    rng = np.random.default_rng(0)
    for member, place, read in zip(fit.members, fit.places, reads, strict=True):
        p, drives, own = member.unknowns, member.drives, end.x[place].copy()
        own[p : p + drives] += 0.5 * np.log1p((read / np.exp(own[p : p + drives])) ** 2)
        information[np.ix_(place, place)] += (yield from scored_at(member.problem, own, p)).information
        if not np.any(read > 0):
            continue
        kalman, noisier = member.problem.kalman, []
        command, every = np.asarray(kalman.command), kalman.every
        for _ in range(_PAIRS):
            more = read * rng.standard_normal((len(command[::every]), drives))
            more = np.repeat(more, every, axis=0)[: len(command)]
            for sign in (1.0, -1.0):
                shifted = eqx.tree_at(lambda k: k.command, kalman, command + sign * more)
                noisier.append(member.problem._replace(kalman=shifted))
        gradients = yield from gradients_together(noisier, own, p)
        gradient[place] += np.mean(gradients, axis=0)
    if not (np.all(np.isfinite(information)) and np.all(np.isfinite(gradient))):
        return None

    norm = np.sqrt(np.maximum(np.diag(information), 0.0))
    # Rounding over the norm of an unknown that the log does not show at all would be a shift of 1e130.
    norm[norm == 0] = 1.0
    inverse = np.linalg.pinv(information / np.outer(norm, norm), rcond=_BLIND, hermitian=True)
    return Shift(-inverse @ (gradient / norm) / norm, information)
