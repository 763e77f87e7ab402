"""Precision of estimated parameters: covariance under coloured noise, and what is identifiable."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float

from jaxid.numerics.coloured_noise import NoiseModel, cross_sandwich, sandwich
from jaxid.numerics.directions import held, named_directions
from jaxid.numerics.full_hessian import hessian_covariance

# A combination of parameters counts as unidentifiable if its standard deviation, expressed as force or
# position, exceeds this part of the measured signal.
_UNIDENTIFIABLE = 0.5
# An eigenvalue of the scaled information below this part of the largest one is rounding.
_ROUNDING = 1e-12
# Kinds of covariance in results, and in words where its numbers come from.
GAUSS_NEWTON, FULL_HESSIAN = "gauss_newton", "full_hessian"
POSTERIOR, LAPLACE, ROUNDING = "posterior_draws", "laplace", "simulated_rounding"
FISHER, WINDOWED = "fisher_information", "window_noise"
# Matrices that a full Hessian stands in place of, in words.
_PLAIN = {GAUSS_NEWTON: "the Gauss-Newton matrix", FISHER: "Fisher's information"}
KINDS = {
    GAUSS_NEWTON: "the Gauss-Newton matrix and the colour of the residual",
    FULL_HESSIAN: "the full Hessian and the colour of the residual",
    POSTERIOR: "draws from the posterior and the colour of the residual",
    LAPLACE: "the Gauss-Newton matrix with the prior, and the colour of the residual",
    ROUNDING: "simulated rounding of the readings",
    WINDOWED: "the noise and the friction at halts that each window holds",
    FISHER: "the Fisher information of the innovations, widened where these are coloured",
}


@dataclass(frozen=True)
class Precision:
    """Precision of the parameters from a Jacobian and a residual.

    Args:
        covariance: Covariance of the identifiable parameters, (p, p); rows of the others are NaN.
        identifiable: Mask of the identifiable parameters, (p,).
        unidentifiable: Unidentifiable combinations, each a dictionary from name to weight
            in the scaled parameters.
        information: Eigenvalues of the scaled information matrix, relative to the largest, (p,).
        kind: Kind of the covariance, one of `KINDS`; empty if the method has its own.
        curvature: Smallest and largest ratio of the full Hessian to Gauss-Newton's over all directions, (2,);
            None if no Hessian was computed.
        equivalent_variance: Variance of the white residual that would give each parameter its variance by
            Gauss-Newton, (p,) [unit of the residual, squared]; None if not computed.
    """

    covariance: Float[np.ndarray, "p p"]
    identifiable: Bool[np.ndarray, " p"]
    unidentifiable: list[dict[str, float]]
    information: Float[np.ndarray, " p"]
    kind: str = ""
    curvature: Float[np.ndarray, " 2"] | None = None
    equivalent_variance: Float[np.ndarray, " p"] | None = None

    @classmethod
    def unknown(cls, names: list[str]) -> Precision:
        """Return the precision of a fit of which nothing is identifiable."""
        p = len(names)
        return cls(np.full((p, p), np.nan), np.zeros(p, bool), [{n: 1.0} for n in names], np.zeros(p))

    @property
    def std(self) -> Float[np.ndarray, " p"]:
        """Standard deviations, (p,); NaN for parameters that are not identifiable."""
        return np.sqrt(np.diag(self.covariance))

    def widened(self, factor: Float[np.ndarray, " p"]) -> Precision:
        """Return the precision with each standard deviation multiplied by a factor, (p,)."""
        white = self.equivalent_variance
        return replace(
            self,
            covariance=self.covariance * np.outer(factor, factor),
            equivalent_variance=None if white is None else white * factor**2,
        )

    def with_error(self, change: Float[np.ndarray, " p"]) -> Precision:
        """Return the precision with one more error, independent of the others.

        Args:
            change: Change of the values by one standard deviation of the error, (p,).
        """
        whole, white = self.covariance + np.outer(change, change), self.equivalent_variance
        if white is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.diag(whole) / np.diag(self.covariance)
            white = white * np.where(np.isfinite(ratio), ratio, 1.0)
        return replace(self, covariance=whole, equivalent_variance=white)

    def first(self, names: list[str]) -> Precision:
        """Return the precision of the first parameters, which have these names, without the nuisances."""
        p = len(names)
        kept = [c for c in self.unidentifiable if any(n in names for n in c)]
        return replace(
            self,
            covariance=self.covariance[:p, :p],
            identifiable=self.identifiable[:p],
            unidentifiable=kept,
            equivalent_variance=None if self.equivalent_variance is None else self.equivalent_variance[:p],
        )

    def with_at_least(self, covariance: Float[np.ndarray, "p p"]) -> Precision:
        """Return the precision with another covariance, or a larger multiple where this one's std is larger.

        Args:
            covariance: Covariance of all parameters, (p, p); that of a parameter that is not identifiable is
                not taken over.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = self.std / np.sqrt(np.diag(covariance))
        factor = np.where(np.isfinite(factor), np.maximum(factor, 1.0), 1.0)
        both = np.outer(self.identifiable, self.identifiable)
        whole = np.where(both, covariance * np.outer(factor, factor), self.covariance)
        white = self.equivalent_variance
        if white is not None:
            white = white * np.where(self.identifiable, np.diag(whole) / np.diag(self.covariance), 1.0)
        return replace(self, covariance=whole, equivalent_variance=white)

    def at_least(self, std: Float[np.ndarray, " p"]) -> Precision:
        """Return the precision with standard deviations of at least these, (p,); NaN sets no limit."""
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = std / self.std
        return self.widened(np.where(np.isfinite(factor), np.maximum(factor, 1.0), 1.0))

    def beside(self, std: float) -> Precision:
        """Return the precision with one more parameter, whose standard deviation is known independently."""
        p = len(self.covariance)
        covariance = np.zeros((p + 1, p + 1))
        covariance[:p, :p], covariance[p, p] = self.covariance, std**2
        return Precision(
            covariance, np.append(self.identifiable, True), self.unidentifiable, self.information
        )


def assess(
    names: list[str],
    jacobian: Float[np.ndarray, "time n p"],
    residual: Float[np.ndarray, "time n"],
    counts: Bool[np.ndarray, "time n"],
    signal: float,
    scale: Float[np.ndarray, " p"],
    hessian: Float[np.ndarray, "p p"] | None = None,
    crossed: bool = False,
    solved: Float[np.ndarray, "p p"] | None = None,
    covariance: scipy.sparse.csr_array | None = None,
) -> Precision:
    """Return the precision of a least-squares fit under coloured noise, with its unidentifiable directions.

    Args:
        names: Names of the p parameters.
        jacobian: Jacobian of the residual, (time, n, p).
        residual: Residual at the fit, (time, n).
        counts: Mask of the samples that count, (time, n).
        signal: 2-norm of the measured signal that the residual belongs to.
        scale: Natural size of each parameter, (p,), which decides whether its column counts as zero.
        hessian: Full Hessian of half the sum of squares, for the covariance by `hessian_covariance`, (p, p).
            It is not used if it is not positive definite; `kind` of the result says which matrix was.
        solved: Matrix of the equations that gave the estimate, (p, p), if it is not J'J, as with weights or
            instruments.
        crossed: Whether the columns of the residual have common noise, such as a reading and the command
            that a loop computes from it; otherwise they count as independent.
        covariance: Covariance of the residual at the samples that count, if it is known.

    Returns:
        The precision. Without a known covariance each column of the residual gets an autoregressive noise
        model.
    """
    if not names:
        return Precision(np.zeros((0, 0)), np.zeros(0, bool), [], np.zeros(0))
    rows = jacobian if counts.all() else np.where(counts[..., None], jacobian, 0.0)
    flat, meat = (
        rows.reshape(-1, len(names)),
        gradient_covariance(rows, residual, counts, crossed, covariance),
    )
    found = assess_from_sums(names, flat.T @ flat, meat, signal, scale, hessian, solved)
    return found if covariance is None else replace(found, kind=WINDOWED)


def gradient_covariance(
    rows: Float[np.ndarray, "time n p"],
    residual: Float[np.ndarray, "time n"],
    counts: Bool[np.ndarray, "time n"],
    crossed: bool,
    covariance: scipy.sparse.csr_array | None = None,
) -> Float[np.ndarray, "p p"]:
    """Return J'RJ, the covariance of the gradient, for a Jacobian that is zero where nothing counts."""
    if covariance is not None:
        return rows[counts].T @ (covariance @ rows[counts])
    meat = np.zeros((rows.shape[-1], rows.shape[-1]))
    noises = [NoiseModel.fit(e, c) for e, c in zip(residual.T, counts.T, strict=True)]
    for i, noise in enumerate(noises):
        # In a chain of many masses each balance contains few of the unknowns.
        own = np.flatnonzero(np.any(rows[:, i] != 0, axis=0))
        meat[np.ix_(own, own)] += sandwich(rows[:, i, own], noise)
    for i, j in itertools.combinations(range(len(noises)) if crossed else (), 2):
        if noises[i].innovation > 0 and noises[j].innovation > 0:
            pair = [(rows[:, k], noises[k], residual[:, k]) for k in (i, j)]
            both = cross_sandwich(*zip(*pair, strict=True))
            meat += both + both.T
    return meat


def assess_from_sums(
    names: list[str],
    gram: Float[np.ndarray, "p p"],
    meat: Float[np.ndarray, "p p"],
    signal: float,
    scale: Float[np.ndarray, " p"],
    hessian: Float[np.ndarray, "p p"] | None = None,
    solved: Float[np.ndarray, "p p"] | None = None,
) -> Precision:
    """Return the precision of a least-squares fit from its sums over the samples.

    Args:
        names: Names of the p parameters.
        gram: Matrix J'J, with J the Jacobian of the residual, (p, p).
        meat: Matrix J'RJ, with R the covariance of the residual, (p, p).
        signal, scale, hessian, solved: See `assess`.
    """
    norm = np.sqrt(np.diag(gram))
    # A column that is not finite says nothing, and would make all others not finite too.
    dead = ~np.isfinite(norm) | (norm * np.abs(scale) <= 1e-9 * signal)
    norm = np.where(dead, 1.0, norm)
    normal = (gram if solved is None else solved) / np.outer(norm, norm)
    normal[dead] = 0.0
    normal[:, dead] = 0.0
    meat = meat / np.outer(norm, norm)
    meat[dead] = 0.0
    meat[:, dead] = 0.0
    if np.all(dead) or not np.all(np.isfinite(normal)) or not np.all(np.isfinite(meat)):
        return Precision.unknown(names)
    return precision_of_matrices(names, normal, meat, norm, signal, hessian)


def deviations(
    gram: Float[np.ndarray, "runs p p"],
    meat: Float[np.ndarray, "runs p p"],
    signal: Float[np.ndarray, " runs"],
    scale: Float[np.ndarray, "runs p"],
) -> tuple[Float[np.ndarray, "runs p"], Bool[np.ndarray, " runs"]]:
    """Return the standard deviations of many fits, and which of them identify all unknowns.

    The deviations of the others do not count: `assess_from_sums` says what such a fit identifies.

    Args:
        gram, meat, signal, scale: See `assess_from_sums`, of every fit.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        norm = np.sqrt(np.einsum("kii->ki", gram))
        known = np.all(norm * np.abs(scale) > 1e-9 * signal[:, None], axis=1)
        known &= np.all(np.isfinite(gram), axis=(1, 2)) & np.all(np.isfinite(meat), axis=(1, 2))
        norm = np.where(known[:, None], norm, 1.0)
        outer = norm[:, :, None] * norm[:, None]
        normal, meat = (np.where(known[:, None, None], x / outer, np.eye(len(norm.T))) for x in (gram, meat))
        values, vectors = np.linalg.eigh(normal)
        spread = _spread(vectors, meat)
        known &= ~np.any(_blind(values, spread, signal[:, None]), axis=1)
        inverse = (vectors / values[:, None]) @ np.swapaxes(vectors, 1, 2)
        return np.sqrt(np.einsum("kij,kjl,kli->ki", inverse, meat, inverse)) / norm, known


def precision_of_matrices(
    names: list[str],
    normal: Float[np.ndarray, "p p"],
    meat: Float[np.ndarray, "p p"],
    norm: Float[np.ndarray, " p"],
    signal: float,
    hessian: Float[np.ndarray, "p p"] | None,
) -> Precision:
    """Return the precision by the normal matrix, the covariance of the gradient, and the scale of both."""
    values, vectors = np.linalg.eigh(normal)
    blind = _blind(values, _spread(vectors, meat), signal)
    seen, strength = vectors[:, ~blind], values[~blind]
    inverse = seen @ np.diag(1 / strength) @ seen.T if strength.size else 0 * normal
    covariance, kind, curvature = inverse @ meat @ inverse, GAUSS_NEWTON, None
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.diag(covariance) / np.diag(inverse)
    if hessian is not None and strength.size:
        inner = seen.T @ (hessian / np.outer(norm, norm)) @ seen
        curved, curvature = hessian_covariance(np.diag(strength), seen.T @ meat @ seen, inner)
        if curved is not None:
            covariance, kind = seen @ curved @ seen.T, FULL_HESSIAN
    covariance = covariance / np.outer(norm, norm)
    identifiable = ~held(vectors[:, blind])
    covariance[~identifiable] = np.nan
    covariance[:, ~identifiable] = np.nan
    unidentifiable = named_directions(names, vectors[:, blind])
    information = values / max(values[-1], 1e-300)
    return Precision(covariance, identifiable, unidentifiable, information, kind, curvature, white)


def _spread(vectors: Float[np.ndarray, "... p p"], meat: Float[np.ndarray, "... p p"]) -> np.ndarray:
    """Return the standard deviation of the gradient along each direction, (..., p)."""
    return np.sqrt(np.maximum(np.einsum("...ik,...ij,...jk->...k", vectors, meat, vectors), 0.0))


def _blind(values: Float[np.ndarray, "... p"], spread: np.ndarray, signal: np.ndarray | float) -> np.ndarray:
    """Mark the directions that are not identifiable, by the eigenvalues of the information, (..., p)."""
    loud = spread > _UNIDENTIFIABLE * signal * np.maximum(values, 1e-300)
    return (values < _ROUNDING * values[..., -1:]) | loud


def hessian_notes(precision: Precision, asked: bool, plain: str = GAUSS_NEWTON) -> list[str]:
    """Return the note that says which matrix the covariance comes from, if the full Hessian was asked for.

    Args:
        precision: Precision of the unknowns.
        asked: Whether the full Hessian was asked for.
        plain: Kind of the covariance without it.
    """
    if not asked:
        return []
    if precision.curvature is None:
        return ["the full Hessian was not used: no direction is identifiable"]
    low, high = precision.curvature
    if precision.kind != FULL_HESSIAN:
        return [
            "the full Hessian is not positive definite and was not used; the covariance comes from "
            f"{KINDS[precision.kind]}"
        ]
    return [f"the full Hessian is {low:.3g} to {high:.3g} times {_PLAIN[plain]}, by direction"]
