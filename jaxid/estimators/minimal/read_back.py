"""Parameters from the coefficients of a minimal model, and a test of whether they can be those of a plant.

Both are small weighted least-squares problems with exact derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.effects.friction import ViscousFriction
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform, levenberg_marquardt
from jaxid.estimators.minimal.basis import Basis, chi_of
from jaxid.estimators.minimal.models import Structure
from jaxid.estimators.minimal.statistics import Constraint, MinimalFit, chance
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Parameters, scatter
from jaxid.numerics.lanes import SolveRequest, Steps

# A singular value of the scaled slopes below this, relative to the largest, is a rounding error.
_RANK = 1e-6
# Friction laws by which joints are compared: in proportion to the velocity, and dry.
_VISCOUS, _SLIDING = "viscous", "sliding"


@dataclass(frozen=True)
class Model:
    """A minimal model of a machine.

    Args:
        structure: The structure of the model: its nonzero coefficients.
        basis: The basis of the unknown coefficients.
        known: Values of the known coefficients, (known,).
        guess: Values of the unknown coefficients at the guesses, (terms,).
    """

    structure: Structure
    basis: Basis
    known: Float[np.ndarray, " known"]
    guess: Float[np.ndarray, " terms"]

    @property
    def maps(self) -> tuple[np.ndarray, np.ndarray]:
        """The arguments `gather` and `constant` of `chi_of`."""
        return self.basis.gather, self.basis.constant


@eqx.filter_jit
def read_back(
    plant: Plant,
    places: tuple,
    structure: Structure,
    maps: tuple[Array, Array],
    target: Array,
    root: Array,
    rest: Array,
    theta: Array,
    transform: Transform,
    bounds: tuple[Array, Array],
) -> tuple[Minimum, Array, Array]:
    """Fit the parameters whose chi is nearest to a target.

    Args:
        plant: The plant.
        places: Paths of the unknowns in it.
        structure: The structure of the model.
        maps: Arguments `gather` and `constant` of `chi_of`.
        target: The fitted chi, (k,).
        root: Upper triangular weight of the difference of chi, (k, k).
        rest: Norm of the residual that no coefficients explain; the solver's tolerance is relative to it.
        theta: Start of the parameters, (p,).
        transform: Scale of the solver.
        bounds: Bounds on the parameters, (p,) each.

    Returns:
        The minimum, its chi, and the derivatives of chi in the parameters, (k, p).
    """

    def chi(theta: Array) -> Array:
        return chi_of(scatter(places, plant, theta), structure, *maps)

    def residual(theta: Array) -> Array:
        return jnp.append(root @ (chi(theta) - target), rest)

    fit = levenberg_marquardt(residual, theta, transform, *bounds)
    return fit, chi(fit.theta), jax.jacfwd(chi)(fit.theta)


def constraint_steps(
    plant: Plant, parameters: Parameters, model: Model, fit: MinimalFit, theta: np.ndarray, slopes: np.ndarray
) -> Steps[Constraint | None]:
    """Test whether the coefficients can be those of a plant, if there are more of them than parameters.

    If there are not, friction of hidden joints is regrouped with that of the measured ones first, as
    published.

    Args:
        plant: The plant.
        parameters: Its unknowns.
        model: The model.
        fit: The fit of its coefficients.
        theta: The fitted parameters, (p,).
        slopes: Derivatives of chi in the parameters, (k, p).

    Returns:
        The test; None if no coefficient is to spare, or a coefficient is not identifiable.
    """
    covariance = fit.precision.covariance
    if not np.all(np.isfinite(covariance)):
        return None
    pinned: tuple[int, ...] = ()
    freedom = len(fit.chi) - _rank(slopes, covariance, theta)
    form = model.structure.form
    if freedom == 0:
        # With an acceleration the coefficients are the parameters themselves.
        pinned = () if form.accelerated else _regroupable(plant, parameters, form.hidden)
        if not pinned:
            return None

    # Fit the remaining parameters to the coefficients, with the regrouped ones at zero.
    rest = tuple(k for k in range(len(theta)) if k not in pinned)
    bare = parameters.insert(plant, np.where(np.isin(np.arange(len(theta)), pinned), 0.0, theta))
    part = Parameters(tuple(parameters.free[k] for k in rest))
    wide = np.full(len(rest), np.inf)
    # By chance chi may belong to a parameter beyond its bound, which is not tested here.
    transform = Transform.of(part)
    floor = np.where(transform.log, part.bounds[0], -wide)
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    minimum, _, slopes = yield SolveRequest(
        read_back,
        (
            bare,
            part.places,
            model.structure,
            model.maps,
            fit.chi,
            root,
            np.asarray(1.0),
            theta[list(rest)],
            transform,
            (floor, wide),
        ),
    )
    freedom = len(fit.chi) - _rank(np.asarray(slopes), covariance, np.asarray(minimum.theta))
    if freedom == 0:
        return None
    square = max(2 * float(minimum.cost) - 1.0, 0.0)
    names = tuple(parameters.names[k] for k in pinned)
    return Constraint(square, freedom, chance(square, freedom), names)


def _rank(slopes: np.ndarray, covariance: np.ndarray, theta: np.ndarray) -> int:
    """Return the rank of the slopes of chi over its standard deviations, with columns of unit length."""
    scaled = slopes / np.sqrt(np.diag(covariance))[:, None]
    norm = np.linalg.norm(scaled, axis=0)
    return int(np.linalg.matrix_rank(scaled[:, norm > 0] / norm[norm > 0], tol=_RANK))


def _regroupable(plant: Plant, parameters: Parameters, hidden: tuple[int, ...]) -> tuple[int, ...]:
    """Return the indices of unknown friction of hidden joints of a kind that a measured joint has too."""
    kinds = [_friction(plant, f.path, f.index) for f in parameters.free]
    measured = {kind for kind, joint in (k for k in kinds if k is not None) if joint not in hidden}
    return tuple(k for k, at in enumerate(kinds) if at is not None and at[1] in hidden and at[0] in measured)


def _friction(plant: Plant, path: tuple, index: int | tuple[int, int] | None) -> tuple[str, int] | None:
    """Return kind and joint of the friction whose strength an unknown is; None for other unknowns."""
    if path[0] == "effects":
        effect = plant.effects[path[1]]
        if effect.port >= plant.joints:
            return None
        if effect.viscous_coefficient is not None:
            return _VISCOUS, effect.port
        return (_SLIDING, effect.port) if effect.sliding_level is not None else None
    for joint in range(plant.joints):
        if plant.equivalent_parameter(ViscousFriction, joint) == (path[0], index):
            return _VISCOUS, joint
    return None
