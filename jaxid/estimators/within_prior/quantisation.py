"""Posterior of a fit whose loop reads quantised positions, by a synthetic likelihood from simulated logs.

The fit itself simulates the loop without quantisation. In a loop with a coarse encoder the instant at which
a reading steps is chaotic, and the effect on the force is neither small nor white, and its mean is not zero.
Therefore logs are simulated with quantisation at points about the fit. Logs that quantisation moves more
than it moved the measured one are rejected. A linear regression of the others on their points gives the
expected log, and its scatter the covariance of the samples, which is the noise of the synthetic likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.within_prior.evaluations import DRAWS, precompile_residuals_at, residuals_at
from jaxid.estimators.within_prior.precision import SubspacePrecision, precision_of_directions
from jaxid.estimators.within_prior.problem import Problem
from jaxid.estimators.within_prior.subspace import KEPT_STD, SubspaceFit, with_definite_signs
from jaxid.machine import Machine
from jaxid.numerics.lanes import Precompile, Steps, run_alone
from jaxid.numerics.precision import ROUNDING
from jaxid.simulation.replay import with_sensor

# Until the passes settle, points are drawn from a box about the last estimate. Its half width is this many
# posterior standard deviations, or the last step if that is larger, and at most this many standard
# deviations of the prior; it changes by these factors at most from pass to pass. A step is never longer.
_BOX, _MOST = 2.5, 1.5
_NARROWER, _WIDER = 0.3, 2.0
# Half width of the box of the first pass, over the scatter of logs simulated at the fit itself.
_FIRST_BOX = 4.0
# A direction takes part if its slope over the noise is above this, although fewer are fitted: directions
# that are identified a little are correlated with those that are identified well.
_LEAST_SLOPE = 0.35
# Number of passes, and of those after which the logs of all passes are pooled.
_PASSES, _SETTLING = 10, 4
# Rejection of logs of a loop that ran away: distance from the others, in standard deviations of that
# distance, and the number of iterations.
_OUTLIER, _ITERATIONS = 6.0, 3
# Least number of accepted logs, below which nothing is identifiable; and the number of logs that are accepted
# although none of them can be the measured one.
_FEWEST, _CLOSEST = 100, 128
# Most samples of a log for which every sample is compared.
_SHORT_LOG = 100
# Least fraction of the residual's power that is taken as noise of the sensors.
_LEAST_NOISE = 0.1
# Relative variance added to a scatter that is zero, along a direction that ended at a bound.
_JITTER = 1e-12


def omits_quantisation(machine: Machine, problem: Problem) -> bool:
    """Tell whether the loop reads quantised positions that its simulation leaves out."""
    coarse = machine.sensor.position_resolution is not None and problem.on != "position"
    return coarse and problem.replay.controller is not None


def precompile_quantised(machine: Machine, problem: Problem) -> Precompile:
    """Return the compiled call of `fit_with_quantisation`, to compile ahead of time in the background."""
    return precompile_residuals_at(_with_quantisation(machine, problem))


def quantised_residuals(
    machine: Machine, problem: Problem, rng: np.random.Generator
) -> Steps[Float[np.ndarray, "draws rows"]]:
    """Simulate with quantisation at the guesses, from starts within one count, and return the residuals."""
    starts = rng.uniform(-0.5, 0.5, (DRAWS, len(problem.encoders))) * _resolutions(machine, problem)
    points = np.zeros((DRAWS, problem.prior.base.size))
    return residuals_at(_with_quantisation(machine, problem), points, starts)


def _resolutions(machine: Machine, problem: Problem) -> Float[np.ndarray, " k"]:
    """Return the position resolution of each encoder [m or rad]."""
    resolution = machine.sensor.position_resolution
    assert resolution is not None, "asked only of a sensor that quantises"
    each = np.broadcast_to(resolution, problem.replay.position.size)
    return each[[*problem.encoders]]


def _with_quantisation(machine: Machine, problem: Problem) -> Problem:
    """Return the problem with quantised readings in its loop."""
    return replace(problem, replay=with_sensor(problem.replay, machine.sensor))


def quantisation_samples(
    machine: Machine, problem: Problem, draws: int
) -> Float[np.ndarray, "draws rows"] | None:
    """Sample the effect of quantisation on the residual at the guesses, the start anywhere in its count.

    Args:
        machine: The machine, whose sensor quantises.
        problem: The problem whose residual is sampled.
        draws: Number of samples.

    Returns:
        Residuals less their mean; None if the loop's readings are not quantised.
    """
    if not omits_quantisation(machine, problem):
        return None
    rng = np.random.default_rng(2)
    e = [run_alone(quantised_residuals(machine, problem, rng)) for _ in range(-(-draws // DRAWS))]
    e = np.concatenate(e)[:draws]
    return e - e.mean(axis=0)


@dataclass(frozen=True)
class _SimulatedLogs:
    """Logs simulated with quantisation that may be the measured one.

    Args:
        points: Coordinates at which they were simulated, along the k directions that take part, (draws, k).
        residuals: The measured log less each, over the noise: all rows, or projections of them, (draws, q).
        noise: Covariance of the sensor noise that they lack, (q, q), or its diagonal.
    """

    points: Float[np.ndarray, "draws k"]
    residuals: Float[np.ndarray, "draws q"]
    noise: np.ndarray

    def design_matrix(self, about: Float[np.ndarray, " k"]) -> Float[np.ndarray, "draws 1+k"]:
        """Return the design matrix of the linear regression: ones, and offsets from `about`."""
        return np.column_stack([np.ones(len(self.points)), self.points - about])

    def projected(self, basis: Float[np.ndarray, "rows q"]) -> _SimulatedLogs:
        """Return the logs projected on the columns of a basis."""
        return _SimulatedLogs(self.points, self.residuals @ basis, (basis.T * self.noise) @ basis)

    @classmethod
    def pooled(cls, several: list[_SimulatedLogs]) -> _SimulatedLogs:
        """Return the logs of several passes together, with the mean of their noise."""
        noise = np.average([s.noise for s in several], axis=0, weights=[len(s.points) for s in several])
        return cls(
            np.concatenate([s.points for s in several]),
            np.concatenate([s.residuals for s in several]),
            noise,
        )


@dataclass(frozen=True)
class _SummaryStatistics:
    """Summary statistics of a log: the Gauss-Newton step of the fit along its directions.

    The initial position within its first count is no unknown here, because each log has another one:
    as an unknown it would count twice, and could go beyond that count.

    Args:
        problem: The problem with quantisation in its loop.
        resolution: Position resolution of each encoder [m or rad].
        axes: Directions of the machine's unknowns alone, as columns, the best identified first, (p, p).
        count: Number k of those that take part.
        point: The optimum of the fit along them, (p,).
        noise: Standard deviation of its residual, by which residuals are divided.
        residual: Residual of the measured log over the noise, (rows,).
        jacobian: Its Jacobian along the r directions that take part, with initial positions, (rows, r).
        step: Matrix of the Gauss-Newton step from a residual, (r, rows).
        along: Matrix from the r directions to the k directions of the machine's unknowns, (k, r).
        shifts: Whether unknowns of the reference shift the log in time.
    """

    problem: Problem
    resolution: Float[np.ndarray, " k"]
    axes: Float[np.ndarray, "p p"]
    count: int
    point: Float[np.ndarray, " p"]
    noise: float
    residual: Float[np.ndarray, " rows"]
    jacobian: Float[np.ndarray, "rows r"]
    step: Float[np.ndarray, "r rows"]
    along: Float[np.ndarray, "k r"]
    shifts: bool

    @classmethod
    def of(cls, machine: Machine, fit: SubspaceFit) -> _SummaryStatistics:
        """Build the statistics of a fit whose minimum is in the coordinates of all directions."""
        problem, p = fit.problem, len(fit.problem.places)
        noise = problem.noise(fit.minimum, fit.count)
        over = np.asarray(fit.minimum.jacobian) / noise
        r = max(fit.count, int(np.sum(np.linalg.norm(over, axis=0) > _LEAST_SLOPE)))
        jacobian, of_unknowns = over[:, :r], over @ fit.vectors.T[:, :p]
        step = np.linalg.solve(jacobian.T @ jacobian + np.eye(r), jacobian.T)
        _, slopes, axes = np.linalg.svd(np.linalg.qr(of_unknowns, mode="r"))
        count = int(np.sum(slopes > _LEAST_SLOPE))
        return cls(
            problem=_with_quantisation(machine, problem),
            resolution=_resolutions(machine, problem),
            axes=axes.T,
            count=count,
            point=axes @ fit.point[:p],
            noise=noise,
            residual=np.asarray(fit.minimum.residual).ravel() / noise,
            jacobian=jacobian,
            step=step,
            along=axes[:count] @ fit.vectors[:p, :r],
            shifts=machine.unknown_reference is not None and bool(machine.unknown_reference.names),
        )

    def simulated(
        self, centre: Float[np.ndarray, " k"], off: Float[np.ndarray, "draws k"], rng: np.random.Generator
    ) -> Steps[_SimulatedLogs]:
        """Simulate logs at `DRAWS` points and return those that may be the measured one.

        Directions that do not take part are drawn from their prior, whatever their value in the fit, and the
        initial position anywhere within its first count.

        Args:
            centre: Centre of the points along the directions that take part, (k,).
            off: Offset of each point from it, (draws, k).
            rng: Source of the other coordinates.
        """
        starts = rng.uniform(-0.5, 0.5, (DRAWS, self.resolution.size)) * self.resolution
        z = rng.standard_normal((DRAWS, self.point.size))
        z[:, : self.count] = centre + off
        w = np.zeros((DRAWS, self.problem.prior.base.size))
        # In whitened coordinates, not in those of the directions: one compiled call serves any number.
        w[:, : self.point.size] = z @ self.axes.T
        e, shape = (yield from residuals_at(self.problem, w, starts)), self.problem.measured.shape

        finite = np.all(np.isfinite(e), axis=1)
        e, z = e[finite] / self.noise, z[finite, : self.count]
        if not len(e):
            return _SimulatedLogs(z, e, np.zeros(e.shape[1]))

        measured = self._after_refit(self.residual[None]).reshape(shape)
        noise, accepted = _missing_noise(self._after_refit(e - self.residual).reshape(-1, *shape), measured)
        return _SimulatedLogs(z[accepted], e[accepted], np.broadcast_to(noise, shape).ravel())

    def basis(self, logs: _SimulatedLogs, about: Float[np.ndarray, " k"]) -> Float[np.ndarray, "rows q"]:
        """Return the basis in which logs are compared: all samples, or half as many as there are logs.

        The correlation between samples shows how quantisation moved the identifiable directions. For a long
        log there are too few draws to estimate it, and errors of the model would show in it first. Logs that
        shift in time are not linear in their points. Both are compared in the columns of the Jacobian only.
        """
        columns = np.linalg.qr(self.jacobian)[0]
        rows, most = self.residual.size, len(logs.points) // 2
        if rows > _SHORT_LOG or self.shifts:
            return columns
        return np.eye(rows) if rows <= most else _dominant_basis(logs, about, columns, most)

    def _after_refit(self, e: Float[np.ndarray, "draws rows"]) -> Float[np.ndarray, "draws rows"]:
        """Return residuals after one Gauss-Newton step of the fit to each."""
        return e - e @ self.step.T @ self.jacobian.T


def fit_with_quantisation(
    machine: Machine, fit: SubspaceFit
) -> Steps[tuple[SubspaceFit, SubspacePrecision | None]]:
    """Compute the posterior given the quantisation of the loop, and the directions that stay identifiable.

    Args:
        machine: The machine, whose sensor quantises.
        fit: The fit, of at least one direction; its minimum in the coordinates of all directions.

    Returns:
        The fit at the maximum of the posterior, in uncorrelated directions, the best identified first, with
        cost and residual of the fit without quantisation; and its precision, or None if too many simulated
        logs ran away or no direction is identifiable.

    Source:
        Wood (2010), "Statistical inference for noisy nonlinear ecological dynamic systems": the synthetic
        likelihood, normal with simulated mean and covariance. Here the mean is linear in the point, and the
        prior is normal. Logs that cannot be the measured one are rejected, as in Beaumont, Zhang and Balding
        (2002), "Approximate Bayesian computation in population genetics". The factor for a covariance from
        few draws: Dodelson and Schneider (2013), "The effect of covariance estimator error on cosmological
        parameter constraints".
    """
    statistics, rng = _SummaryStatistics.of(machine, fit), np.random.default_rng(0)
    k = statistics.count
    if not k:
        return replace(fit, count=0), None

    # A first pass at the fit itself: its scatter sets the width of the box. Its offsets are zero, but are
    # drawn all the same, which the later random numbers depend on.
    centre = statistics.point[:k].copy()
    logs = yield from statistics.simulated(centre, rng.uniform(-1.0, 1.0, (DRAWS, k)) * np.zeros(k), rng)
    if len(logs.points) < _FEWEST:
        return replace(fit, count=0), None
    moved = logs.projected((statistics.along @ statistics.step).T)
    width = _FIRST_BOX * np.sqrt(np.var(moved.residuals, axis=0) + np.diag(moved.noise))
    box = np.minimum(width, _MOST)

    point, covariance = centre, np.zeros((k, k))
    basis, passes = np.zeros((statistics.residual.size, 0)), []
    for number in range(_PASSES):
        if number < _SETTLING:
            off = rng.uniform(-1.0, 1.0, (DRAWS, k)) * box
        else:
            # From the posterior and no wider: the regression is linear only over a small region.
            off = rng.multivariate_normal(np.zeros(k), covariance, DRAWS, method="eigh")
        logs = yield from statistics.simulated(centre, off, rng)
        if len(logs.points) < _FEWEST:
            return replace(fit, count=0), None

        if number <= _SETTLING:
            # Logs from farther away lie on another line: only those of settled passes are pooled.
            basis, passes = statistics.basis(logs, centre), []
        passes.append(logs.projected(basis))
        point, covariance = _regression_posterior(_SimulatedLogs.pooled(passes), centre)
        step = point - centre
        centre = centre + np.clip(step, -box, box)
        wanted = np.maximum(_BOX * np.sqrt(np.diag(covariance)), np.abs(step))
        box = np.clip(wanted, _NARROWER * box, np.minimum(_WIDER * box, _MOST))
    return _in_uncorrelated_directions(fit, statistics, point, covariance)


def _regression_posterior(
    logs: _SimulatedLogs, about: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Return mean and covariance of the posterior from a linear regression of logs on their points.

    Args:
        logs: The simulated logs.
        about: Point about which the regression is linear, (k,).
    """
    rows, (n, q), k = logs.design_matrix(about), logs.residuals.shape, about.size
    kept = np.ones(n, bool)
    line, scatter = np.zeros((1 + k, q)), np.zeros((q, q))
    for _ in range(_ITERATIONS):
        line = np.linalg.lstsq(rows[kept], logs.residuals[kept])[0]
        off = logs.residuals - rows @ line
        scatter = off[kept].T @ off[kept] / (kept.sum() - k - 1) + logs.noise
        scatter[np.diag_indices(q)] += _JITTER
        distance = np.sum(off * np.linalg.solve(scatter, off.T).T, axis=1)
        kept = distance < q + _OUTLIER * np.sqrt(2 * q)

    weighted = np.linalg.solve(scatter, line[1:].T)
    covariance = np.linalg.inv(line[1:] @ weighted + np.eye(k))
    point = about - covariance @ (weighted.T @ line[0] + about)
    # The scatter is an estimate from a finite number of draws, and weights by it achieve less than they
    # promise.
    spare = max(kept.sum() - q, 5)
    return point, (1.0 + (q - k) * (spare - 2) / ((spare - 1) * (spare - 4))) * covariance


def _dominant_basis(
    logs: _SimulatedLogs, about: Float[np.ndarray, " k"], columns: Float[np.ndarray, "rows r"], most: int
) -> Float[np.ndarray, "rows q"]:
    """Return the columns of the Jacobian followed by the principal components of the scatter beside them."""
    rows = logs.design_matrix(about)
    beside = logs.residuals - rows @ np.linalg.lstsq(rows, logs.residuals)[0]
    beside -= (beside @ columns) @ columns.T
    power, vectors = np.linalg.eigh(beside @ beside.T)
    least = np.sort(power)[-max(1, most - columns.shape[1])]
    dominant = power >= max(least, _JITTER * power[-1])
    return np.column_stack([columns, beside.T @ vectors[:, dominant] / np.sqrt(power[dominant])])


def _in_uncorrelated_directions(
    fit: SubspaceFit,
    statistics: _SummaryStatistics,
    point: Float[np.ndarray, " k"],
    covariance: Float[np.ndarray, "k k"],
) -> tuple[SubspaceFit, SubspacePrecision | None]:
    """Return the fit at the posterior's mean in directions that are uncorrelated, and their precision.

    Args:
        fit: The fit without quantisation.
        statistics: Its summary statistics.
        point: Mean of the posterior along the directions that take part, (k,).
        covariance: Covariance of the posterior along them, (k, k).
    """
    k, p, q = statistics.count, statistics.point.size, len(fit.vectors)
    # Initial positions stand behind the machine's unknowns, each a separate direction.
    vectors, variances = np.eye(q), np.eye(q)
    vectors[:p, :p], variances[:k, :k] = statistics.axes, covariance
    whitened = vectors @ variances @ vectors.T

    variances, turned = np.linalg.eigh(covariance)
    vectors[:, :k] = with_definite_signs(vectors[:, :k] @ turned)
    w, jacobian = fit.point.copy(), np.asarray(fit.minimum.jacobian) @ fit.vectors.T
    w[:p] = statistics.axes @ np.concatenate([point, np.zeros(p - k)])
    minimum = replace(fit.minimum, theta=vectors.T @ w, jacobian=jacobian @ vectors)
    count = int(np.sum(np.sqrt(variances) <= KEPT_STD))
    ended = replace(fit, vectors=vectors, count=count, minimum=minimum)
    if not count:
        return ended, None
    precision = precision_of_directions(ended)
    covariance = np.diag(variances[:count])
    return ended, replace(precision, covariance=covariance, whitened_covariance=whitened, kind=ROUNDING)


def _missing_noise(
    simulated: Float[np.ndarray, "draws time k"], measured: Float[np.ndarray, "time k"]
) -> tuple[Float[np.ndarray, " k"], Bool[np.ndarray, " draws"]]:
    """Return the variance of the white sensor noise that simulated logs lack, and the accepted logs.

    With this noise the residual of the simulated logs has as much power as that of the measured one. A log
    with more power from quantisation alone is rejected: noise only adds power. If hardly any log has less,
    the `_CLOSEST` logs of least power are accepted.

    Args:
        simulated: Residuals of the simulated logs after a refit.
        measured: Residual of the measured log after a refit.
    """
    wanted, power = np.mean(measured**2, axis=0), np.mean(simulated**2, axis=1)
    over = np.max(power / np.maximum(wanted, np.finfo(float).tiny), axis=1)
    least = min(_CLOSEST, len(over)) - 1
    accepted = over <= max(1.0, np.partition(over, least)[least])
    return np.mean(np.maximum(wanted - power[accepted], _LEAST_NOISE * wanted), axis=0), accepted
