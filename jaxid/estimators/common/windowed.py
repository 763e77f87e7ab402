"""Covariance of least squares whose rows are integrals of a force over windows.

Windows overlap, so that one sample's noise is in several rows. It is known how: each row weighs the noise of
the force at each sample by its kernel, and that of the position by what the balance makes of it. A row with
a halt in it holds an error of the friction besides (see `jaxid.estimators.common.halts`), and counts for as
little as this error allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.stats
from jaxtyping import Bool, Float

from jaxid.estimators.common.halts import dry_friction, errors_at_halts
from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Precision, assess
from jaxid.numerics.rows import Rows
from jaxid.simulation.force_balance import ForceData, sharpened
from jaxid.simulation.sensor_noise import force_noise, linearised_balance, position_noise

# Least variance of a row, as a part of the mean square of its signal: rounding.
_LEAST = 1e-18
# Singular values of the scaled Jacobian below this part of the largest are rounding.
_ROUNDING = 1e-10


@dataclass(frozen=True)
class Kernels:
    """Weights with which the rows of windows hold a force.

    Args:
        values: Weight of the force of each joint at each sample of a row's window, (rows, n, length).
        starts: First sample of each row's window, (rows,).
    """

    values: Float[np.ndarray, "rows n length"]
    starts: Sequence[int] | np.ndarray

    def matrix(self, time: int) -> scipy.sparse.csr_array:
        """Return the weights at all samples of joint 1, then of joint 2 and so on, (rows, n time)."""
        rows, n, length = self.values.shape
        columns = np.asarray(self.starts)[:, None, None] + np.arange(length)
        columns = columns + time * np.arange(n)[:, None]
        index = np.broadcast_to(np.arange(rows)[:, None, None], self.values.shape)
        some = self.values != 0
        entries = (self.values[some], (index[some], columns[some]))
        return scipy.sparse.csr_array(entries, shape=(rows, n * time))


def weights_steps(
    machine: Machine,
    log: Log | None,
    data: Prepared,
    kernels: Kernels,
    fit: Minimum,
    counts: Bool[np.ndarray, "window k"],
    force: float,
) -> Steps[tuple[Float[np.ndarray, "window k"], scipy.sparse.csr_array | None]]:
    """Compute the weights of rows from a fit without them, see `weights_of_rows`.

    They are equal, and the covariance is None, if the noise at this fit is no finite number.

    Args:
        machine: The machine.
        log: The log before preparation, for the noise of its readings; None: these count as exact.
        data: The prepared log.
        kernels: Weights of the force in the rows that count.
        fit: Fit with equal weights.
        counts: Mask of the rows that count.
        force: RMS force of the drives [N or N m].
    """
    theta = np.asarray(fit.theta)
    if not (np.all(np.isfinite(theta)) and np.isfinite(float(fit.cost))):
        return counts.astype(float), None
    covariance = yield from row_covariance_steps(machine.with_estimate(theta), data, kernels, log)
    if not np.all(np.isfinite(covariance.data)):
        return counts.astype(float), None
    return weights_of_rows(_rows_of(fit, counts, force), covariance)


def weighed(
    machine: Machine,
    fit: Minimum,
    counts: Bool[np.ndarray, "window k"],
    weight: Float[np.ndarray, "window k"],
    covariance: scipy.sparse.csr_array | None,
    force: float,
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "window k"], Precision]:
    """Return estimates, residual without weights and precision of a fit with weights.

    Args:
        machine: The machine.
        fit: Fit with weights.
        counts: Mask of the rows that count.
        weight, covariance: Weights, and covariance of the weighted rows, as of `weights_steps`.
        force: RMS force of the drives [N or N m].
    """
    theta, rows = np.asarray(fit.theta), _rows_of(fit, counts, force)
    natural = np.where(theta != 0, theta, 1.0)
    shape = (rows.jacobian, rows.residual, counts, rows.signal)
    precision = assess(machine.parameters.names, *shape, natural, covariance=covariance)
    return theta, rows.residual / np.where(counts, weight, 1.0), precision


def _rows_of(fit: Minimum, counts: Bool[np.ndarray, "window k"], force: float) -> Rows:
    """Return residual and Jacobian at the end of a fit."""
    e = np.asarray(fit.residual).reshape(counts.shape)
    jacobian = np.asarray(fit.jacobian).reshape(*counts.shape, -1)
    return Rows(jacobian, e, counts, float(force * np.sqrt(counts.sum())))


def row_covariance_steps(
    machine: Machine, data: Prepared, kernels: Kernels, log: Log | None
) -> Steps[scipy.sparse.csr_array]:
    """Compute the covariance of rows by the noise of force and readings, and by friction at halts.

    Args:
        machine: The machine at the estimates.
        data: The prepared log.
        kernels: Weights of the force in the rows.
        log: The log before preparation, for the noise of its readings; None: these count as exact.

    Returns:
        The covariance, (rows, rows).
    """
    arrays, (time, n) = ForceData.of(data), data.q.shape
    rest = np.asarray(data.recipe.rest_velocity)
    friction = yield SolveRequest(dry_friction, (sharpened(machine.plant, data), arrays, rest))
    weights = kernels.matrix(time)
    variance = np.square(force_noise(machine, data) * machine.gain)
    of_force = np.sqrt(np.abs(np.asarray(machine.plant.applied(variance, n))))
    parts = [_scaled(weights, of_force, time), weights @ errors_at_halts(data, friction)]
    if log is not None:
        matrices = yield SolveRequest(linearised_balance, (machine.plant, arrays))
        by_ratio = [np.asarray(x) / np.asarray(friction.ratio)[:, None] for x in matrices]
        of_readings = weights @ _force_of_readings(by_ratio, time, data.period, log.integrated)
        parts.append(_scaled(of_readings, position_noise(machine, log), time))
    return scipy.sparse.csr_array(sum(x @ x.T for x in parts))


def _force_of_readings(
    impedance: Sequence[Float[np.ndarray, "n n"]], time: int, period: float, integrated: bool
) -> scipy.sparse.csr_array:
    """Return the force that an error of each reading makes, (n time, n time).

    Args:
        impedance: Mass, damping and stiffness.
        time: Number of samples.
        period: Sampling time [s].
        integrated: Whether the readings are velocities; the position is then as good as exact.
    """
    one, after = scipy.sparse.eye_array(time), scipy.sparse.eye_array(time, k=1)
    slope, bend = 0.5 * (after - after.T) / period, (after + after.T - 2 * one) / period**2
    derivatives = [slope, one] if integrated else [bend, slope, one]
    terms = zip(impedance, derivatives, strict=not integrated)
    return scipy.sparse.csr_array(sum(scipy.sparse.kron(scipy.sparse.csr_array(x), d) for x, d in terms))


def _scaled(
    weights: scipy.sparse.csr_array, std: Float[np.ndarray, " n"], time: int
) -> scipy.sparse.csr_array:
    """Multiply the columns of each joint by its standard deviation."""
    return scipy.sparse.csr_array(weights @ scipy.sparse.kron(np.diag(std), scipy.sparse.eye_array(time)))


def weights_of_rows(
    rows: Rows, covariance: scipy.sparse.csr_array
) -> tuple[Float[np.ndarray, "window k"], scipy.sparse.csr_array]:
    """Return weights by the variance of each row, and the covariance of the rows that they multiply.

    What the residual shows beyond the variance, as of a model that is not complete, is added to all rows
    alike. As it is estimated from few of them, it is enlarged by Student's distribution.

    Args:
        rows: Residual and Jacobian of rows without weights.
        covariance: Covariance of the rows that count.

    Returns:
        Weights, whose mean square is one over the rows that count and zero for the others; and the
        covariance of the weighted rows that count.

    Source:
        Paule and Mandel (1982), Journal of Research of the National Bureau of Standards 87, 377-385, for
        the variance beyond the known one.
    """
    count = int(rows.counts.sum())
    least = _LEAST * rows.signal**2 / max(count, 1)
    more, freedom = _beyond(rows.residual[rows.counts], rows.jacobian[rows.counts], covariance, least)
    factor = 1.0 / np.sqrt(covariance.diagonal() + more)
    factor /= np.sqrt(np.mean(factor**2))
    few = scipy.stats.t.ppf(0.975, freedom) / scipy.stats.norm.ppf(0.975)
    whole, scale = (
        covariance + few**2 * more * scipy.sparse.eye_array(count),
        scipy.sparse.diags_array(factor),
    )
    weight = np.zeros(rows.counts.shape)
    weight[rows.counts] = factor
    return weight, scipy.sparse.csr_array(scale @ whole @ scale)


def _beyond(
    e: Float[np.ndarray, " rows"],
    jacobian: Float[np.ndarray, "rows p"],
    covariance: scipy.sparse.csr_array,
    least: float,
) -> tuple[float, int]:
    """Return the variance of every row beyond the known one, and the degrees of freedom that it is from.

    It is the one with which the weighted sum of squares of the residual is what is expected of it.
    """
    known, size = covariance.diagonal(), np.linalg.norm(jacobian, axis=0)
    jacobian = jacobian / np.where(size > 0, size, 1.0)

    def basis(root: np.ndarray) -> np.ndarray:
        left, values, _ = np.linalg.svd(root[:, None] * jacobian, full_matrices=False)
        return left[:, values > _ROUNDING * max(values[0], 1e-300)]

    def excess(more: float) -> float:
        root = 1.0 / np.sqrt(known + more)
        q = basis(root)
        left = root * e - q @ (q.T @ (root * e))
        scaled = root[:, None] * q
        fitted = np.sum(scaled * (covariance @ scaled)) + more * np.sum(scaled**2)
        return float(left @ left) - (len(e) - float(fitted))

    freedom = max(len(e) - basis(np.ones(len(e))).shape[1], 1)
    most = max(float(e @ e) / freedom, 2 * least) * 10.0
    if excess(least) <= 0:
        return least, freedom
    if excess(most) >= 0:
        return most, freedom
    found = scipy.optimize.brentq(lambda x: excess(np.exp(x)), np.log(least), np.log(most))
    return float(np.exp(found)), freedom  # pyright: ignore[reportCallIssue, reportArgumentType] (stub)
