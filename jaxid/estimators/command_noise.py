"""Bias of the innovations' maximum by noise with which the logged command was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxid.estimators.joint_likelihood import (
    JointLikelihood,
    Maximum,
    Member,
    gradients_together,
    scored_at,
)
from jaxid.estimators.several.parts import Part
from jaxid.logs.prepare import Prepared, choose_recipe, prepare
from jaxid.numerics.bounds import presses
from jaxid.numerics.lanes import Steps
from jaxid.numerics.precision import Precision

# Pairs of simulated noise for the correction of the bias by noise of the command's reading.
_PAIRS = 4
# Eigenvalue of the scaled information, relative to the largest, below which a direction is not corrected.
_BLIND = 1e-10
# Largest bend of the shift by that noise, as a part of it, up to which it is a parabola of the variance.
_BENT = 0.1
# A value this near to a bound, on the scale of the solver, rests there.
_AT_BOUND = 1e-9
# A correction that changes a value by more than this part of it must leave the measured force as well
# explained: it may raise the RMS of what the values leave by this factor.
_LARGE, _WORSE = 0.02, 1.1
# Steps that bring a correction back to the ridge of the likelihood. They end with one that is shorter than so
# many standard deviations.
_RETURNS, _SHORT = 4, 0.05
# Widening of standard deviations by an uncertain correction from which on a note says so.
_DOUBTFUL = 1.2


@dataclass(frozen=True)
class Corrected:
    """Estimates without the bias by noise with which the commands were read.

    Args:
        theta: Estimates, (p,).
        reads: Noise of each log for which they were corrected, (m,).
        doubt: Difference between two extrapolations to no noise, where the shifts do not decide between them,
            (p,).
        refused: Reason for which they were not corrected, as a note; empty: they were.
    """

    theta: Float[np.ndarray, " p"]
    reads: list[np.ndarray]
    doubt: Float[np.ndarray, " p"]
    refused: str = ""

    def widened(self, precision: Precision) -> Precision:
        """Return a precision by the likelihood, widened by what is not known of the correction."""
        return precision.at_least(np.hypot(precision.std, self.doubt))

    def notes(self, fitted: Float[np.ndarray, " p"], precision: Precision) -> list[str]:
        """Return notes about a correction that is large or uncertain beside the precision.

        Args:
            fitted: Estimates before the correction, (p,).
            precision: Precision by the likelihood.
        """
        known = precision.identifiable & (precision.std > 0)
        std = precision.std[known]
        moved = np.max(np.abs(self.theta - fitted)[known] / std, initial=0.0)
        factor = np.max(self.widened(precision).std[known] / std, initial=1.0)
        notes = [self.refused] if self.refused else []
        if moved > 1:
            notes.append(
                "noise with which the command was read had moved a value by "
                f"{moved:.2g} standard deviations: this was corrected"
            )
        if factor > _DOUBTFUL:
            notes.append(
                "the correction for noise with which the command was read is uncertain: standard deviations "
                f"are widened by up to {factor:.2g} for it"
            )
        return notes

    @classmethod
    def not_at_all(cls, theta: Float[np.ndarray, " p"], drives: Sequence[int]) -> Corrected:
        """Return estimates as they are, for logs with these numbers of drives."""
        return cls(theta, [np.zeros(m) for m in drives], np.zeros_like(theta))


def corrected_steps(fit: JointLikelihood, end: Maximum) -> Steps[Corrected]:
    """Remove the bias by noise with which the commands were read.

    The filter takes the logged command for the applied one plus an error that is independent of the log.
    Noise of the reading is not independent: like noise of a regressor it makes the force count too little.
    As much noise again, simulated, has about the same effect once more. The shift of the optimum, by one step
    of the scoring, is not quite in proportion to the variance that is added: where the shifts by half as much
    and by as much lie near a line, the parabola through them gives the shift from none; elsewhere the line
    does, and its distance from the parabola shows how well the shift is known. Pairs of opposite noise cancel
    in first order. A value at a bound stays there while the likelihood without the bias presses it there.

    Args:
        fit: The likelihood.
        end: Its maximum.

    Source:
        Cook & Stefanski (1994), JASA 89, simulation-extrapolation.
    """
    reads = [
        _noise_of_reading(member, end.x[place]) for member, place in zip(fit.members, fit.places, strict=True)
    ]
    as_it_is = Corrected.not_at_all(end.theta, [m.drives for m in fit.members])
    if not any(np.any(read > 0) for read in reads):
        return as_it_is
    pressed = _pressed(fit, end)
    whole = yield from _shift_steps(fit, end, pressed, reads)
    half = yield from _shift_steps(fit, end, pressed, [np.sqrt(0.5) * read for read in reads])
    if whole is None or half is None:
        return as_it_is

    # Only the unknowns are corrected; the noises may follow as far as they like.
    lower, upper = fit.bounds
    lower[fit.unknowns :], upper[fit.unknowns :] = -np.inf, np.inf

    def without(step: np.ndarray) -> Steps[np.ndarray]:
        room = lower - end.x, upper - end.x
        moved = yield from _on_the_ridge(fit, end, whole.taken_back(step, pressed, room))
        return np.clip(fit.theta(moved), *fit.machine.parameters.bounds)

    line, parabola, bent = extrapolations(half, whole)
    found = yield from without(line if bent else parabola)
    doubt = np.abs((yield from without(parabola)) - found) if bent else as_it_is.doubt
    more = growth_of_gap(fit, end.theta, found)
    if more > _WORSE:
        left = (
            f"leave {more:.3g} times as much of the measured force" if np.isfinite(more) else "give no force"
        )
        note = (
            "the values were not corrected for noise with which the command was read: the corrected ones "
            f"{left}, so that a part of this noise is none"
        )
        return replace(as_it_is, refused=note)
    return Corrected(found, reads, doubt)


def _on_the_ridge(fit: JointLikelihood, end: Maximum, shift: np.ndarray) -> Steps[np.ndarray]:
    """Return a point a step away from the maximum, moved to the ridge of the likelihood.

    A log may determine a ratio a thousand times better than its parts. The likelihood then has a ridge, which
    is curved: a long step along its tangent leaves it. A slope that is added to the likelihood moves its
    maximum by that step if the likelihood is a parabola. The maximum with the slope is found from the end of
    the step by scoring. The noises stay as they are.

    Args:
        fit: The likelihood.
        end: Its maximum.
        shift: The step, (q,). Values that it takes to a bound stay there.

    Returns:
        The maximum with the slope, or the end of the step if that is not found.
    """
    fixed = np.arange(shift.size) >= fit.unknowns
    first = np.where(fixed, end.x, end.x + shift)
    there = fit.sum_of(end.scored)
    slope = -(there.gradient + there.normal @ (first - end.x))
    lower, upper = fit.bounds
    fixed |= (first <= lower + _AT_BOUND) | (first >= upper - _AT_BOUND)

    x, before = first, np.inf
    for _ in range(_RETURNS):
        here = yield from fit.evaluate(x)
        if not here.finite:
            return first
        room = np.where(fixed, 0.0, lower - x), np.where(fixed, 0.0, upper - x)
        step = _bounded_step(here.normal, here.gradient + slope, room)
        size = float(np.sqrt(max(step @ here.normal @ step, 0.0)))
        if size > before:
            return first
        x, before = x + step, size
        if size < _SHORT:
            break
    return x


def growth_of_gap(
    fit: JointLikelihood, fitted: Float[np.ndarray, " p"], corrected: Float[np.ndarray, " p"]
) -> float:
    """Return how many times as much of the measured force corrected values leave as fitted ones.

    Least squares of the force is without the bias: the noise is in what it explains, not in its regressors.

    Args:
        fit: The likelihood, with its logs.
        fitted, corrected: Values of the unknowns, (p,) each.

    Returns:
        Ratio of the RMS forces over all logs, as a root mean square over the driven joints; one where the
        correction is small, or where a joint has no encoder; infinite where corrected values give no force.
    """
    from jaxid.gap import force_gap

    parts = [member.part for member in fit.members]
    large = np.any(np.abs(corrected - fitted) > _LARGE * np.abs(fitted))
    if not large or not all(all(part.log.measured) for part in parts):
        return 1.0

    # A joint without a drive has no measured force: its gap is what the others exert on it.
    plant = fit.machine.plant
    driven = np.asarray(plant.driven(plant.joints))
    squares = []
    for theta in (fitted, corrected):
        gaps = [force_gap(part.at(theta), part.prepared or _prepared(part)) for part in parts]
        squares.append(sum(gap.rms[driven] ** 2 for gap in gaps))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = squares[1] / squares[0]
    ratios = ratios[np.isfinite(ratios)]
    return float(np.sqrt(np.mean(ratios))) if ratios.size else np.inf


def _prepared(part: Part) -> Prepared:
    """Filter the log of a fit that was given no session, as its noise asks."""
    return prepare(part.log, part.machine.gain, choose_recipe(part.log), part.machine.hold_period)


def extrapolations(
    half: Shift, whole: Shift
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"], bool]:
    """Return the shift by the noise that a log has, by a line and by a parabola, and whether it bends far.

    They follow from the shifts by half as much and by as much noise again. With a shift of a v + b v^2 by the
    variance v that is added, the shift from none is a - b.
    """
    bend = 2 * half.step - whole.step
    far = whole.size_of(bend) > _BENT * whole.size_of(whole.step)
    return whole.step, whole.step + 4 * bend, far


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

    def taken_back(
        self,
        step: Float[np.ndarray, " q"],
        pressed: Float[np.ndarray, " q"],
        room: tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]],
    ) -> Float[np.ndarray, " q"]:
        """Return the step from the maximum with a shift to that without it, within bounds.

        Args:
            step: The shift.
            pressed: Gradient of the negative log-likelihood at the maximum, zero away from bounds.
            room: Least and largest step.
        """
        return _bounded_step(self.information, pressed + self.information @ step, room)


def _bounded_step(
    information: Float[np.ndarray, "q q"],
    gradient: Float[np.ndarray, " q"],
    room: tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]],
) -> Float[np.ndarray, " q"]:
    """Return the step to the least value of a parabola with this curvature and slope, within bounds."""
    norm, eigenvalues, vectors = _scaled(information)
    root = np.sqrt(eigenvalues)
    target = -(vectors.T @ (gradient / norm)) / root
    # Rounding must not put a value that rests at its bound outside.
    least, most = np.minimum(room[0], 0.0) * norm, np.maximum(room[1], 0.0) * norm
    most = np.maximum(most, least + np.finfo(np.float64).tiny)
    matrix = root[:, None] * vectors.T
    return scipy.optimize.lsq_linear(matrix, target, (least, most), method="bvls").x / norm


def _noise_of_reading(member: Member, x: np.ndarray) -> Float[np.ndarray, " m"]:
    """Return the noise with which a log's command was read, at most that of the force; zero without any."""
    p, drives = member.unknowns, member.drives
    if member.command_noise is None or member.at.law is not None:
        return np.zeros(drives)
    return np.minimum(member.command_noise, np.exp(x[p : p + drives]))


def _shift_steps(
    fit: JointLikelihood, end: Maximum, pressed: np.ndarray, reads: Sequence[np.ndarray]
) -> Steps[Shift | None]:
    """Return the shift of the maximum by more noise of the commands' reading, by one step of the scoring.

    Args:
        fit: The likelihood.
        end: Its maximum.
        pressed: Gradient there of the values at bounds, which no noise has caused, (q,).
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

    norm, eigenvalues, vectors = _scaled(information)
    step = vectors @ ((vectors.T @ ((gradient - pressed) / norm)) / eigenvalues)
    return Shift(-step / norm, information)


def _pressed(fit: JointLikelihood, end: Maximum) -> Float[np.ndarray, " q"]:
    """Return the gradient of the negative log-likelihood by the unknowns that it presses against a bound."""
    gradient = np.zeros(end.x.size)
    for place, scored in zip(fit.places, end.scored, strict=True):
        gradient[place] += scored.gradient
    lower, upper = fit.bounds
    rests = presses(end.x, gradient, lower + _AT_BOUND, upper - _AT_BOUND)
    rests[fit.unknowns :] = False
    return np.where(rests, gradient, 0.0)


def _scaled(
    information: Float[np.ndarray, "q q"],
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " r"], Float[np.ndarray, "q r"]]:
    """Return the norms, and the eigenvalues and eigenvectors of the information divided by them.

    Directions that the log does not show are left out.
    """
    norm = np.sqrt(np.maximum(np.diag(information), 0.0))
    # Rounding over the norm of an unknown that the log does not show at all would be a shift of 1e130.
    norm[norm == 0] = 1.0
    eigenvalues, vectors = np.linalg.eigh(information / np.outer(norm, norm))
    seen = eigenvalues > _BLIND * eigenvalues[-1]
    return norm, eigenvalues[seen], vectors[:, seen]
