"""Least squares on the filtered balance: the residual of inverse dynamics, fitted by its Jacobian.

The regressor is the Jacobian of the residual with respect to the unknowns. Linear unknowns therefore take
one step, and nonlinear ones (a Stribeck velocity, a lag) a few more with the same code.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from jaxid.arrays import Array
from jaxid.estimators.common.joint_weights import joint_weights
from jaxid.estimators.common.levenberg_marquardt import DAMPING, Minimum, Transform, levenberg_marquardt
from jaxid.estimators.common.shapes import other_starts
from jaxid.estimators.estimate import Estimate
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import Effect, carries_force
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Free, scatter
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.numerics.misspecified import std_under_misspecification, widening
from jaxid.numerics.precision import Precision, assess
from jaxid.simulation.force_balance import ForceData, force_residual, sharpened, size_of_force

# Damping of the solver if the balance is linear in all unknowns: a single step then solves it.
_UNDAMPED = 1e-10
# Shares of the dry friction that additional starts put on joints without an encoder.
_SHARES = (0.2, 0.5, 0.8)


@kept_jit
def solve_balance(
    plant: Plant,
    places: tuple,
    data: ForceData,
    theta: Array,
    transform: Transform,
    bounds: tuple[Array, Array],
    damping: float,
) -> tuple[Minimum, Array]:
    """Return the fit, and the 2-norm of the weighted measured force."""

    def residual(theta: Array) -> Array:
        return data.weight * force_residual(scatter(places, plant, theta), data)

    fit = levenberg_marquardt(residual, theta, transform, *bounds, damping=damping)
    return fit, size_of_force(plant, data)


def inverse_dynamics(machine: Machine, data: Prepared, *, start: np.ndarray | None = None) -> Estimate:
    """Fit the unknowns to a prepared log by least squares on the balance of forces.

    The rows of each driven joint count over the RMS of what a first fit leaves of them.

    Args:
        machine: The machine; its guesses matter only for unknowns in which the balance is nonlinear.
        data: The prepared log.
        start: Start of the fit in place of the guesses, (p,).

    Returns:
        The estimate; its covariance accounts for a coloured residual.

    Source:
        Gautier (1986) and Janot, Vandanjon & Gautier (2014) for filtered inverse dynamics; Gautier (1997),
        ICRA, for the weights of joints.
    """
    return run_alone(inverse_dynamics_steps(machine, data, start=start))


def inverse_dynamics_steps(
    machine: Machine, data: Prepared, *, start: np.ndarray | None = None
) -> Steps[Estimate]:
    """Run `inverse_dynamics` as a generator of solve requests."""
    plant = sharpened(machine.plant, data)
    rows = data.fitted
    arrays = ForceData.of(data, rows)
    parameters = machine.parameters
    theta = parameters.guess if start is None else np.asarray(start, dtype=np.float64)
    whole = all(data.measured)
    places, (transform, damping) = parameters.places, linear_scale(machine, whole)
    options = (transform, parameters.bounds, damping)

    fits, size = [], np.zeros(())
    for at in [theta, *other_starts(machine, theta, data.q)]:
        fit, size = yield SolveRequest(solve_balance, (plant, places, arrays, at, *options))
        fits.append(fit)
    # Only jumps of the other joints identify dry friction at a joint without an encoder, and the cost has
    # many local minima.
    for at in [] if whole else _splits(machine, np.asarray(fits[0].theta), data.measured):
        fit, size = yield SolveRequest(solve_balance, (plant, places, arrays, at, *options))
        fits.append(fit)

    costs = [np.nan_to_num(float(f.cost), nan=np.inf) for f in fits]
    # Among the fits that reach the lowest cost, to rounding, prefer one that converged.
    lowest = [f for f, c in zip(fits, costs, strict=True) if c <= min(costs) * (1 + 1e-6)]
    fit = next((f for f in lowest if bool(f.converged)), lowest[0])

    weights = joint_weights(plant, np.asarray(fit.residual).reshape(rows.shape), rows)
    if weights is not None:
        weighted = eqx.tree_at(lambda a: a.weight, arrays, rows * weights)
        # Bodies at the edge of those that can exist have no logarithm to start from.
        at = theta if transform.bodies else fit.theta
        again, its_size = yield SolveRequest(solve_balance, (plant, places, weighted, at, *options))
        sound = np.all(np.isfinite(again.theta)) and np.isfinite(float(again.cost))
        if sound and (bool(again.converged) or not bool(fit.converged)):
            fit, size, arrays = again, its_size, weighted

    e, weight = np.asarray(fit.residual).reshape(rows.shape), np.asarray(arrays.weight)
    jacobian = np.asarray(fit.jacobian).reshape(*rows.shape, -1)
    precision = force_precision(machine, size, np.asarray(fit.theta), e, jacobian, rows)
    if data.faster_loop and np.all(np.isfinite(jacobian)):
        precision = precision.widened(widening(precision, jacobian, e, rows))
    converged = bool(fit.converged) and bool(np.all(np.isfinite(fit.theta)))
    return Estimate(
        method="inverse_dynamics",
        machine=machine.with_estimate(fit.theta),
        theta=np.asarray(fit.theta),
        precision=precision,
        converged=converged,
        message="converged" if converged else f"no convergence within {int(fit.steps)} steps",
        residual=np.where(rows, e / np.where(weight > 0, weight, 1.0), np.nan),
        samples=int(rows.sum()),
        steps=int(fit.steps),
        std_misspecified=std_under_misspecification(jacobian, e, rows),
    )


def linear_scale(machine: Machine, whole: bool = True) -> tuple[Transform, float]:
    """Return a solver's scale on which linear unknowns are not transformed, and its damping.

    On a logarithmic scale a mass that starts at two thirds of its value takes five evaluations instead of
    two. Bounds keep it positive. If all unknowns are linear, no damping is needed. No unknown is linear if
    some joints have no encoder (`whole` is false), because their motion depends on the unknowns.
    """
    linear = linear_unknowns(machine) & whole
    transform = Transform.of(machine.parameters)
    affine = bool(np.all(linear)) and bool(transform.bodies)
    transform = replace(transform, log=transform.log & ~linear, affine=affine)
    return transform, _UNDAMPED if np.all(linear) and not transform.bodies else DAMPING


def linear_unknowns(machine: Machine) -> Bool[np.ndarray, " p"]:
    """Return the mask of the unknowns in which the balance is linear, (p,)."""
    return np.array([_linear(machine.plant, f) for f in machine.parameters.free], dtype=bool)


def _linear(plant: Plant, free: Free) -> bool:
    """Check by the declaration of an unknown that the residual is linear in it."""
    info = _info(plant, free)
    if info is None or not carries_force(info):
        return False
    if free.path[0] != "effects":
        return True
    effect = type(plant.effects[_number(free)])
    return effect.adds_force and effect.initial_state is Effect.initial_state


def _info(plant: Plant, free: Free) -> ParameterInfo | None:
    """Return the declaration of an unknown in its plant or effect."""
    owner = plant.effects[_number(free)] if free.path[0] == "effects" else plant
    return parameters_of(type(owner)).get(str(free.path[-1]))


def _number(free: Free) -> int:
    """Return the index of the effect that has an unknown."""
    number = free.path[1]
    assert isinstance(number, int), "the path of an effect's parameter goes through its number"
    return number


def _splits(machine: Machine, theta: np.ndarray, measured: tuple[bool, ...]) -> list[np.ndarray]:
    """Return starts with other shares of dry friction at joints with and without an encoder."""
    effects = machine.plant.effects
    levels = [
        (k, effects[_number(f)].port)
        for k, f in enumerate(machine.parameters.free)
        if f.path[0] == "effects" and f.path[2] == effects[_number(f)].sliding_level
    ]
    visible = [k for k, port in levels if port < len(measured) and measured[port]]
    hidden = [k for k, port in levels if port < len(measured) and not measured[port]]
    out = []
    for share in _SHARES if visible and hidden else ():
        at = theta.copy()
        total = at[visible].sum() + at[hidden].sum()
        at[hidden], at[visible] = share * total / len(hidden), (1 - share) * total / len(visible)
        out.append(at)
    return out


def force_precision(
    machine: Machine,
    size: Array | float,
    theta: np.ndarray,
    e: np.ndarray,
    jacobian: np.ndarray,
    rows: np.ndarray,
) -> Precision:
    """Return the precision of a fit in the force domain; `size` is the result of `force_size`."""
    guess = machine.parameters.guess
    scale = np.where(guess != 0, guess, 1.0)
    return assess(machine.parameters.names, jacobian, e, rows, float(size), scale)
