"""Precision of a fit within a prior: of each identifiable direction, and of each unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import Array
from jaxid.estimators.common.profile import BETTER, OFFSETS, falls_below, profile_entry, profiled
from jaxid.estimators.within_prior.posterior import (
    laplace_covariance,
    maximum_a_posteriori,
    negative_log_posterior,
)
from jaxid.estimators.within_prior.problem import Compared
from jaxid.estimators.within_prior.subspace import SubspaceFit
from jaxid.machine import Machine
from jaxid.numerics.full_hessian import full_hessian
from jaxid.numerics.lanes import Steps
from jaxid.numerics.precision import GAUSS_NEWTON, LAPLACE, Precision
from jaxid.numerics.rows import Rows, assess_together

# An unknown is identifiable if its posterior standard deviation is below this, in those of its prior.
_IDENTIFIABLE_STD = 0.5
# Least eigenvalue of a covariance, relative to the largest, that is more than rounding.
_LEAST = 1e-15
# Entries of a unit vector below this are omitted from the named combination.
_NEGLIGIBLE = 0.1


@eqx.filter_jit
def cost_hessian(compared: Compared, sharpness: Array, vectors: Array, z: Array) -> Array:
    """Return the full Hessian of the cost in the coordinates of some directions, (k, k).

    Args:
        compared: The residual, half of whose sum of squares is the cost.
        sharpness: Sharpness of the smoothed sign.
        vectors: Directions as columns, (q, k).
        z: Coordinates of the point, (k,).
    """
    return full_hessian(compared.at_sharpness(sharpness).along(vectors), z)


@dataclass(frozen=True)
class SubspacePrecision:
    """Precision of the fitted directions.

    Args:
        covariance: Covariance of their coordinates, (r, r).
        white_std: Standard deviations from the log alone, as if the noise were white, (r,).
        information: Eigenvalues of the scaled information matrix, see `jaxid.numerics.precision.Precision`.
        whitened_covariance: Posterior covariance of all unknowns in whitened coordinates, (q, q); None: that
            of the fitted directions, and the prior along the others.
        kind: Kind of the covariance, one of `jaxid.numerics.precision.KINDS`.
        curvature: Smallest and largest ratio of the full Hessian to Gauss-Newton's, see
            `jaxid.numerics.precision.Precision`.
    """

    covariance: np.ndarray
    white_std: np.ndarray
    information: np.ndarray
    whitened_covariance: np.ndarray | None = None
    kind: str = GAUSS_NEWTON
    curvature: np.ndarray | None = None

    @property
    def std(self) -> np.ndarray:
        """Standard deviations of the directions' coordinates, (r,)."""
        return np.sqrt(np.diag(self.covariance))


def precision_of_directions(fit: SubspaceFit) -> SubspacePrecision:
    """Compute the precision of the fitted directions from the log alone, with the residual's colour.

    Args:
        fit: The fit, of at least one direction.
    """
    r = fit.count
    coloured = assess_together(
        [f"direction {k + 1}" for k in range(r)],
        rows_of(fit),
        np.ones(r),
        crossed=fit.problem.on == "both",
    )

    # The triangular factor keeps digits that the normal matrix loses: the precision of directions differs by
    # factors of a million.
    triangle = np.linalg.qr(np.asarray(fit.minimum.jacobian)[:, :r], mode="r")
    white = fit.problem.noise(fit.minimum, r) * np.linalg.norm(np.linalg.inv(triangle), axis=1)

    # A colour that is estimated from a hundred samples is itself uncertain: the standard deviation is never
    # less than with white noise.
    larger = np.maximum(1.0, white / coloured.std)
    return SubspacePrecision(coloured.covariance * np.outer(larger, larger), white, coloured.information)


def rows_of(fit: SubspaceFit) -> list[Rows]:
    """Return the weighted residual of each log, with its Jacobian in the fitted directions."""
    problem, r = fit.problem, fit.count
    shape, counts, deviation = problem.measured.shape, problem.weight > 0, problem.deviation
    jacobian = np.asarray(fit.minimum.jacobian).reshape(*shape, -1)[..., :r]
    e = np.asarray(fit.minimum.residual).reshape(shape)
    return [
        Rows(jacobian[rows], e[rows], counts[rows], float(np.linalg.norm(deviation[rows])))
        for rows in problem.slices
    ]


def with_prior(
    fit: SubspaceFit, precision: SubspacePrecision, whitened_covariance: np.ndarray, kind: str = LAPLACE
) -> SubspacePrecision:
    """Return the precision with the prior included.

    Args:
        fit: The fit.
        precision: Precision of the fitted directions from the log alone.
        whitened_covariance: Posterior covariance of all unknowns as if the noise were white, (q, q).
        kind: Kind of that covariance, one of `jaxid.numerics.precision.KINDS`.
    """
    fitted = fit.vectors[:, : fit.count]
    # The colour of the noise widens the fitted directions.
    widening = np.eye(len(whitened_covariance))
    widening = widening + (fitted * (precision.std / precision.white_std - 1.0)) @ fitted.T
    covariance = widening @ whitened_covariance @ widening.T
    inner = fitted.T @ covariance @ fitted
    return replace(precision, covariance=inner, whitened_covariance=covariance, kind=kind)


def parameter_precision(
    machine: Machine, fit: SubspaceFit, precision: SubspacePrecision | None
) -> tuple[Precision, list[dict[str, Any]]]:
    """Compute the precision of the parameters, and the entry `directions` of the details.

    Args:
        machine: The machine whose unknowns were fitted.
        fit: The fit.
        precision: Precision of the fitted directions; None if no direction is identifiable.
    """
    problem, r = fit.problem, fit.count
    if precision is None:
        return _nothing_identifiable(machine)

    names = [*machine.parameters.names, *problem.nuisances]
    z = np.asarray(fit.minimum.theta)
    unidentifiable = fit.vectors[:, r:]
    whitened, slope = _whitened_covariance(fit, precision), _slope(fit)
    p = len(problem.places)
    identifiable = np.sqrt(np.diag(whitened))[:p] < _IDENTIFIABLE_STD
    covariance = whitened[:p, :p] * np.outer(slope, slope)
    covariance[~identifiable] = covariance[:, ~identifiable] = np.nan

    stated = [
        {
            "combination": dict(zip(names, fit.vectors[:, k].tolist(), strict=True)),
            "value": float(z[k]),
            "std": float(precision.std[k]),
            "std_white": float(precision.white_std[k]),
        }
        for k in range(r)
    ]
    combinations = [_named(names, v) for v in unidentifiable.T]
    combinations = [c for c in combinations if any(n in c for n in names[:p])]
    return replace(
        Precision(covariance, identifiable, combinations, precision.information),
        kind=precision.kind,
        curvature=precision.curvature,
    ), stated


def _whitened_covariance(fit: SubspaceFit, precision: SubspacePrecision) -> np.ndarray:
    """Return the posterior covariance of all unknowns in whitened coordinates, (q, q)."""
    if precision.whitened_covariance is not None:
        return precision.whitened_covariance
    fitted, unidentifiable = fit.vectors[:, : fit.count], fit.vectors[:, fit.count :]
    return fitted @ precision.covariance @ fitted.T + unidentifiable @ unidentifiable.T


def _slope(fit: SubspaceFit) -> np.ndarray:
    """Return the derivatives of the unknowns in their whitened coordinates at the fit, (p,)."""
    prior = fit.problem.prior
    return prior.slope(np.asarray(prior.outward(fit.point)))[: len(fit.problem.places)]


def information_root(fit: SubspaceFit, precision: SubspacePrecision | None) -> np.ndarray:
    """Return R, with R'R the inverse of the posterior covariance of the unknowns, (p, p).

    Args:
        fit: The fit.
        precision: Precision of the fitted directions; None if no direction is identifiable.
    """
    slope = _slope(fit)
    if precision is None:
        return np.diag(1.0 / slope)
    p = len(slope)
    values, vectors = np.linalg.eigh(_whitened_covariance(fit, precision)[:p, :p])
    return (vectors / np.sqrt(np.maximum(values, _LEAST * values[-1]))).T / slope


def _nothing_identifiable(machine: Machine) -> tuple[Precision, list[dict[str, Any]]]:
    """Return the precision after a log that identifies no direction better than the prior."""
    names = machine.parameters.names
    p = len(names)
    combinations = [{n: 1.0} for n in names]
    return Precision(np.full((p, p), np.nan), np.zeros(p, bool), combinations, np.zeros(0)), []


def _named(names: Sequence[str], vector: np.ndarray) -> dict[str, float]:
    return {n: float(v) for n, v in zip(names, vector, strict=True) if abs(v) > _NEGLIGIBLE}


def add_profiles(fit: SubspaceFit, noise: float, stated: list[dict[str, Any]]) -> Steps[list[str]]:
    """Add a profile likelihood to each direction: the rise of twice the negative log-posterior.

    Args:
        fit: The fit, at the maximum a posteriori.
        noise: Standard deviation of its residual, taken as white.
        stated: The entry `directions` of the details, to which `profile` is added.

    Returns:
        Notes about profiles that fall below the fit.
    """
    notes = []
    for k, direction in enumerate(stated):
        rise = yield from _profile_along(fit, noise, fit.vectors[:, k], direction["std"])
        direction["profile"] = {"at_std": OFFSETS.tolist(), "rise": rise.tolist()}
        notes += [BETTER.format(f"direction {k + 1}")] if falls_below(rise) else []
    return notes


def profiles_of(
    machine: Machine, fit: SubspaceFit, precision: Precision, asked: Sequence[str]
) -> Steps[tuple[dict[str, Any], list[str]]]:
    """Compute the profile of the posterior of some unknowns, and notes about those that have none.

    The rise is divided by the factor by which the residual's colour changes the variance of the unknown.

    Args:
        machine: The machine whose unknowns were fitted.
        fit: The fit, at the maximum a posteriori.
        precision: Precision of the unknowns.
        asked: Names of the unknowns.
    """
    profiles, notes = {}, []
    noise, prior, names = (
        fit.problem.noise(fit.minimum, fit.count),
        fit.problem.prior,
        machine.parameters.names,
    )
    theta, size = np.asarray(prior.outward(fit.point)), fit.point.size
    laplace = laplace_covariance(fit, noise)
    coloured = with_prior(fit, precision_of_directions(fit), laplace).whitened_covariance
    assert coloured is not None, "with_prior gives the covariance of all unknowns"

    for name in asked:
        k = names.index(name)
        if not precision.identifiable[k]:
            notes.append(f"no profile of {name}: it is not identifiable from this log")
            continue
        factor = float(coloured[k, k] / laplace[k, k])
        std = float(precision.std[k] / prior.slope(theta)[k])
        along = np.eye(size)[k]
        rise = (yield from _profile_along(fit, noise, along, std)) / factor
        notes += [BETTER.format(name)] if falls_below(rise) else []
        at = np.array([np.asarray(prior.outward(fit.point + x * std * along))[k] for x in OFFSETS])
        unit = machine.parameters.free[k].unit
        profiles[name] = profile_entry(float(theta[k]), float(precision.std[k]), at, rise, factor, unit)
    if profiles:
        notes.append(
            "profiles: of the posterior, with the priors of the guesses; the residual counts as Gaussian, "
            "and its colour as a constant factor of the variance"
        )
    return profiles, notes


def _profile_along(fit: SubspaceFit, noise: float, along: np.ndarray, std: float) -> Steps[np.ndarray]:
    """Return the rise of twice the negative log-posterior at all offsets along a direction.

    Args:
        fit: The fit, at the maximum a posteriori.
        noise: Standard deviation of its residual, taken as white.
        along: Direction in whitened coordinates, of norm one, (q,).
        std: Standard deviation of the coordinate along it.
    """
    lowest = negative_log_posterior(noise, fit.minimum, fit.point)

    def refit(w: np.ndarray, offset: float) -> Steps[tuple[np.ndarray, float]]:
        w = w + (along @ (fit.point - w) + offset * std) * along
        w, here, _ = yield from maximum_a_posteriori(fit.problem, noise, w, held=along)
        return w, 2 * (negative_log_posterior(noise, here, w) - lowest)

    return (yield from profiled(refit, fit.point))
