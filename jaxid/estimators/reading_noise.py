"""Bias that the noise of the readings causes in inverse dynamics, and its removal.

Position, velocity and acceleration are regressors of the balance of forces. Their noise makes coefficients
too small, although it does not correlate with the force. The elongation of a stiff coupling between two
encoders may be noise for the most part.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.common.joint_weights import joint_weights
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.several.parts import Part, parts_of
from jaxid.estimators.several.sums import stacked
from jaxid.logs.prepare import motion
from jaxid.machine import Machine
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.misspecified import std_under_misspecification, widening
from jaxid.numerics.precision import Precision, precision_of_matrices
from jaxid.numerics.rows import Rows
from jaxid.session import Session
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_size, sharpened
from jaxid.simulation.sensor_noise import position_noise

# Simulated noise: as many pairs as give so many samples, within limits.
_SAMPLES, _PAIRS = 4000, 8
# Bias from which it is removed, in standard deviations of least squares.
_MATTERS = 0.3
# Uncertainty of the variance of the noise, as a part of it: the high band of a slow log holds motion, too.
_UNCERTAIN = 0.1
# Part of a direction's information that noise may make up for it to be identifiable: twice the uncertainty
# must not reach the whole.
_MOST = 1.0 / (1.0 + 2 * _UNCERTAIN)
# Eigenvalue of the scaled normal matrix, over the largest, below which a direction is not identifiable.
_BLIND = 1e-10
# Largest number of steps, and size of a last step in standard deviations.
_STEPS, _SMALL = 4, 0.05


@dataclass(frozen=True)
class _Noisy:
    """Sums of the equations of least squares, and what the noise of the readings adds to them on average.

    Args:
        normal: Matrix J'J, (p, p).
        gradient: J'e, (p,).
        of_noise: Part of the normal matrix by noise, (p, p).
        bias: Part of the gradient by noise, (p,).
    """

    normal: Float[np.ndarray, "p p"]
    gradient: Float[np.ndarray, " p"]
    of_noise: Float[np.ndarray, "p p"]
    bias: Float[np.ndarray, " p"]

    def __add__(self, other: _Noisy) -> _Noisy:
        return _Noisy(
            self.normal + other.normal,
            self.gradient + other.gradient,
            self.of_noise + other.of_noise,
            self.bias + other.bias,
        )

    def without(self, fixed: Bool[np.ndarray, " p"]) -> _Noisy:
        """Return the equations without some unknowns, whose rows and columns are zero."""
        free = (~fixed).astype(np.float64)
        both = np.outer(free, free)
        return _Noisy(self.normal * both, self.gradient * free, self.of_noise * both, self.bias * free)


@dataclass(frozen=True)
class _Solution:
    """Solution of the equations without their noise.

    Args:
        step: From the values of the unknowns at which the equations stand, (p,).
        least_squares: The same of the equations with their noise, (p,).
        slope: Change of the step with the variance of the noise, over that variance, (p,).
        matrix: Normal matrix without noise; zero in directions that noise dominates, (p, p).
        hidden: Directions that noise dominates, (p, k).
        share: Part of noise in the information of the direction that has most of it, at most one.
    """

    step: Float[np.ndarray, " p"]
    least_squares: Float[np.ndarray, " p"]
    slope: Float[np.ndarray, " p"]
    matrix: Float[np.ndarray, "p p"]
    hidden: Float[np.ndarray, "p k"]
    share: float

    @classmethod
    def of(cls, sums: _Noisy, fixed: Bool[np.ndarray, " p"] | None = None) -> _Solution:
        """Solve the equations in the directions that the log shows beyond its noise.

        Args:
            sums: The equations.
            fixed: Unknowns that stay where they are, at a bound, (p,); None: all may move.
        """
        if fixed is not None and fixed.any():
            inside = cls.of(sums.without(fixed))
            moves = {"step": inside.step, "least_squares": inside.least_squares, "slope": inside.slope}
            return replace(cls.of(sums), **moves)
        squares = np.diag(sums.normal)
        size = np.sqrt(np.where(squares > 0, squares, 1.0))
        normal, noise = (x / np.outer(size, size) for x in (sums.normal, sums.of_noise))
        values, vectors = np.linalg.eigh(normal)
        seen = values > _BLIND * values[-1]
        # Coordinates in which the normal matrix is one, and the noise's is diagonal.
        white = vectors[:, seen] / np.sqrt(values[seen])
        share, turned = np.linalg.eigh(white.T @ noise @ white)
        out, back = white @ turned, (vectors[:, seen] * np.sqrt(values[seen])) @ turned
        clear = share < _MOST

        def step(noise: float) -> np.ndarray:
            left = np.where(clear, 1.0 - noise * share, np.inf)
            return out @ ((out.T @ ((noise * sums.bias - sums.gradient) / size)) / left) / size

        return cls(
            step=step(1.0),
            least_squares=-(out @ (out.T @ (sums.gradient / size))) / size,
            slope=(step(1.0 + _UNCERTAIN) - step(1.0 - _UNCERTAIN)) / (2 * _UNCERTAIN),
            matrix=(back * np.where(clear, 1.0 - share, 0.0)) @ back.T * np.outer(size, size),
            hidden=out[:, ~clear] / size[:, None],
            share=min(float(share.max(initial=0.0)), 1.0),
        )


@dataclass(frozen=True)
class _Log:
    """Balance of forces of one log, with the noise of its readings.

    Args:
        part: The log with its machine.
        noise: Standard deviation of a reading of each joint, (n,).
        weight: Weight of the rows of each joint, (n,).
        size: 2-norm of the weighted measured force.
        pairs: Number of pairs of simulated noise.
    """

    part: Part
    noise: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    size: float
    pairs: int

    @classmethod
    def steps(cls, part: Part, theta: np.ndarray, *, several: bool) -> Steps[_Log]:
        """Weigh the joints of a log, and the log among several, by what a fit leaves of them."""
        data, rows = part.data, part.data.fitted
        noise = np.where(part.log.measured, np.nan_to_num(position_noise(part.machine, part.log)), 0.0)
        draft = cls(part, noise, np.ones(rows.shape[1]), 0.0, 0)
        e, _ = yield draft.request(theta)
        e = np.where(rows, np.asarray(e), 0.0)
        plant = sharpened(part.machine.plant, data)
        by_joint = joint_weights(plant, e, rows)
        weight = draft.weight if by_joint is None else by_joint
        if several:
            weight = weight / max(float(np.sqrt(np.sum((weight * e) ** 2) / max(rows.sum(), 1))), 1e-300)
        arrays = replace(ForceData.of(data, rows), weight=rows * weight)
        size = float((yield SolveRequest(force_size, (plant, arrays))))
        pairs = int(np.clip(np.ceil(0.5 * _SAMPLES / max(len(rows), 1)), 1, _PAIRS))
        return cls(part, noise, weight, size, pairs)

    def request(self, theta: np.ndarray, noise: np.ndarray | None = None) -> SolveRequest:
        """Return the request for residual and Jacobian, with noise added to the readings, (time, n)."""
        part, data = self.part, self.part.data
        if noise is not None:
            key = "velocity" if part.log.integrated else "position"
            recipe = data.recipe
            q, qd, qdd = motion(
                replace(part.log, **{key: noise}),
                recipe.cutoff_hz,
                recipe.order,
                recipe.derivatives,
                recipe.reach,
            )
            force = data.force
            if data.answer is not None:
                driven = list(part.machine.plant.driven(part.machine.plant.joints))
                force = force + noise[:, driven] * data.answer * part.machine.gain
            data = replace(data, q=data.q + q, qd=data.qd + qd, qdd=data.qdd + qdd, force=force)
        arrays, plant = ForceData.of(data, data.fitted), sharpened(part.machine.plant, part.data)
        places, values = part.machine.parameters.places, theta[part.index]
        return SolveRequest(force_and_columns, (plant, places, arrays, values))

    def weighted(self, found: tuple, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the weighted residual and its Jacobian by all unknowns; zero for rows that do not count."""
        counts = self.part.data.fitted
        e = np.where(counts, np.asarray(found[0]) * self.weight, 0.0)
        columns = np.where(counts[..., None], np.asarray(found[1]) * self.weight[:, None], 0.0)
        return e, self.part.widened(columns, width)

    def equations(self, theta: np.ndarray) -> Steps[tuple[Rows, _Noisy]]:
        """Return the rows of this log, and their sums with what as much noise again adds to them.

        Pairs of opposite noise leave its product with itself alone.
        """
        p, rng = theta.size, np.random.default_rng(0)
        e, columns = self.weighted((yield self.request(theta)), p)
        flat = columns.reshape(-1, p)
        normal, gradient = flat.T @ flat, flat.T @ e.ravel()
        of_noise, bias = np.zeros_like(normal), np.zeros_like(gradient)
        for _ in range(self.pairs):
            drawn = self.noise * rng.standard_normal(self.part.log.position.shape)
            up, columns_up = self.weighted((yield self.request(theta, drawn)), p)
            down, columns_down = self.weighted((yield self.request(theta, -drawn)), p)
            flat = 0.5 * (columns_up - columns_down).reshape(-1, p)
            of_noise += flat.T @ flat / self.pairs
            bias += flat.T @ (0.5 * (up - down)).ravel() / self.pairs
        return Rows(columns, e, self.part.data.fitted, self.size), _Noisy(normal, gradient, of_noise, bias)


def without_reading_noise(session: Session, estimate: Estimate) -> Steps[Estimate]:
    """Return an estimate of inverse dynamics without the bias by the noise of its readings.

    The noise adds its products to the normal matrix and to the gradient of least squares. They are
    simulated, and subtracted, where they move a value by a part of its standard deviation. A direction of
    which noise makes up almost all information is not identifiable.

    Args:
        session: Case and logs.
        estimate: Estimate of `inverse_dynamics`.

    Returns:
        The estimate; unchanged if the noise hardly moves it, if links are to be those of real bodies, or if
        the steps do not converge.

    Source:
        Fuller (1987), Measurement Error Models, chapter 2, for the correction by moments; Cook & Stefanski
        (1994), JASA 89, for simulated noise.
    """
    machine = session.machine
    if machine.parameters.bodies or not machine.parameters.free or not np.all(np.isfinite(estimate.theta)):
        return estimate
    several = bool(session.more)
    parts = parts_of(session) if several else [Part.alone(machine, session.fit.log, session.fit.data)]
    logs = []
    for part in parts:
        logs.append((yield from _Log.steps(part, np.asarray(estimate.theta), several=several)))
    if not any(log.noise.any() for log in logs):
        return estimate

    theta, lower, upper = np.asarray(estimate.theta), *machine.parameters.bounds
    # A coefficient that noise took to its bound may have taken others anywhere.
    if np.any((theta <= lower) | (theta >= upper)):
        theta = machine.parameters.guess
    equations = yield from _Equations.steps(machine, logs, theta)
    if equations is None:
        return estimate
    solution = equations.solution
    with np.errstate(invalid="ignore", divide="ignore"):
        bias = (solution.least_squares - solution.step) / estimate.std
    largest = np.abs(np.where(np.isfinite(bias), bias, 0.0))
    if solution.share < _MOST and largest.max() < _MATTERS:
        return estimate
    return (yield from _corrected(machine, estimate, logs, theta, equations))


@dataclass(frozen=True)
class _Equations:
    """Equations of all logs at values of the unknowns, with their solution.

    Args:
        rows: Residual and Jacobian of each log.
        solution: The solution without noise.
    """

    rows: list[Rows]
    solution: _Solution

    @classmethod
    def steps(cls, machine: Machine, logs: Sequence[_Log], theta: np.ndarray) -> Steps[_Equations | None]:
        """Compute and solve the equations; None if they are not finite.

        An unknown at a bound beyond which its step goes stays there, and the others are solved with it.
        """
        rows, noisy = [], []
        for log in logs:
            of_log, sums = yield from log.equations(theta)
            rows.append(of_log)
            noisy.append(sums)
        sums = functools.reduce(operator.add, noisy)
        if not all(np.all(np.isfinite(x)) for x in (sums.normal, sums.of_noise, sums.bias)):
            return None
        lower, upper = machine.parameters.bounds
        free = _Solution.of(sums)
        beyond = ((theta <= lower) & (free.step < 0)) | ((theta >= upper) & (free.step > 0))
        return cls(rows, _Solution.of(sums, beyond) if beyond.any() else free)


def _corrected(
    machine: Machine, estimate: Estimate, logs: Sequence[_Log], theta: np.ndarray, start: _Equations
) -> Steps[Estimate]:
    """Step to the solution without noise, and return it with its precision."""
    bounds, names, at = machine.parameters.bounds, machine.parameters.names, start
    for _ in range(_STEPS):
        theta = np.clip(theta + at.solution.step, *bounds)
        found = yield from _Equations.steps(machine, logs, theta)
        if found is None:
            return estimate
        at = found
        plain, precision = _precision(names, theta, logs, at)
        change = np.clip(theta + at.solution.step, *bounds) - theta
        if not np.any(precision.identifiable & (np.abs(change) > _SMALL * precision.std)):
            return _without_bias(machine, estimate, logs, theta, at, plain, precision)
    # Unknowns in which the balance is far from linear keep the values of least squares.
    return estimate


def _without_bias(
    machine: Machine,
    estimate: Estimate,
    logs: Sequence[_Log],
    theta: np.ndarray,
    at: _Equations,
    plain: Precision,
    precision: Precision,
) -> Estimate:
    """Return the estimate with values that lost their bias, and the note on it.

    Args:
        machine: Machine of all logs.
        estimate: Estimate by least squares.
        logs: The logs.
        theta: Values without bias, (p,).
        at: Equations at these.
        plain: Precision that least squares would have there.
        precision: Precision of the values.
    """
    residual = [
        np.where(row.counts, row.residual / log.weight, np.nan)
        for row, log in zip(at.rows, logs, strict=True)
    ]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = precision.std / plain.std
    ratio = np.where(np.isfinite(ratio), ratio, 1.0)
    masks = zip(estimate.names, plain.identifiable, precision.identifiable, strict=True)
    hidden = [name for name, shown, kept in masks if shown and not kept]
    quantity = "velocity" if logs[0].part.log.integrated else "position"
    share = at.solution.share
    note = (
        f"the bias by the noise of the measured {quantity} was removed: noise is {100 * share:.2g} % of the "
        "information on a combination of the unknowns"
    )
    return replace(
        estimate,
        theta=theta,
        machine=machine.with_estimate(theta),
        precision=precision,
        converged=True,
        message="converged",
        residual=np.concatenate(residual),
        std_misspecified=std_under_misspecification(*stacked(at.rows)) * ratio,
        notes=(*estimate.notes, note),
        details={**estimate.details, "reading_noise": {"share": share, "hidden": hidden}},
    )


def _precision(
    names: list[str], theta: np.ndarray, logs: Sequence[_Log], at: _Equations
) -> tuple[Precision, Precision]:
    """Return the precision of least squares, and that of the solution without noise.

    The normal matrix of the second is smaller. The variance of the noise is uncertain, which
    counts as one more error.
    """
    rows, solution = at.rows, at.solution
    jacobian, e, counts = stacked(rows)
    squares = np.sum(jacobian**2, axis=(0, 1))
    norm = np.sqrt(np.where(squares > 0, squares, 1.0))
    matrices = [row.matrices(norm) for row in rows]
    normal, meat = (np.sum([pair[k] for pair in matrices], axis=0) for k in (0, 1))
    signal = float(np.sqrt(sum(row.signal**2 for row in rows)))
    plain = precision_of_matrices(names, normal, meat, norm, signal, None)
    found = precision_of_matrices(names, solution.matrix / np.outer(norm, norm), meat, norm, signal, None)

    if any(log.part.data.faster_loop for log in logs):
        found = found.widened(widening(plain, jacobian, e, counts, [len(row.residual) for row in rows]))
    found = found.with_error(_UNCERTAIN * solution.slope)
    return plain, _without_hidden(found, plain, names, theta, solution.hidden)


def _without_hidden(
    precision: Precision,
    plain: Precision,
    names: list[str],
    theta: np.ndarray,
    hidden: Float[np.ndarray, "p k"],
) -> Precision:
    """Return the precision without the unknowns that noise hides.

    Along a hidden direction any value is possible. It hides an unknown that it moves by a part of its
    standard deviation, until one of the unknowns is twice its value.

    Args:
        precision: Precision without noise.
        plain: Precision of least squares, with the directions that no log of these motions would show.
        names: Names of the unknowns.
        theta: Their values, (p,).
        hidden: Hidden directions, (p, k).
    """
    if not hidden.shape[1]:
        return replace(precision, unidentifiable=plain.unidentifiable)
    # A value that is zero within its deviation has the size of that.
    size = np.maximum(np.abs(theta), np.nan_to_num(plain.std))
    unidentifiable = [*plain.unidentifiable]
    for direction in hidden.T:
        relative = np.divide(direction, size, out=np.zeros_like(direction), where=size > 0)
        most = float(np.max(np.abs(relative)))
        moved = np.abs(direction) / (most or 1.0)
        held = ~precision.identifiable | (moved > _MATTERS * precision.std)
        seen = precision.identifiable & ~held
        covariance = np.where(np.outer(seen, seen), precision.covariance, np.nan)
        precision = replace(precision, covariance=covariance, identifiable=seen)
        weights = relative / (np.linalg.norm(relative) or 1.0)
        unidentifiable.append({n: float(w) for n, w, h in zip(names, weights, held, strict=True) if h and w})
    return replace(precision, unidentifiable=unidentifiable)
