"""Fits of one model of a search in its simulated loops, from many starts at once.

The superset of a search is slow to simulate, as each of its effects is computed although most are neutral.
Here a model has only the effects that act, and all starts of a fit are simulated in one compiled call: a
start then costs less than a hundredth of the time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.discovery import candidates as cand
from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.estimators.simulated_output import output_residual
from jaxid.model.plant import Plant
from jaxid.numerics.bounds import presses
from jaxid.numerics.kept import kept_jit
from jaxid.simulation.replay import Replay

# Starts of a compiled call with derivatives, and points of one without them.
_STARTS, _POINTS = 8, 64
# Largest number of steps of a fit, and the relative decrease of the squares at which it has converged.
STEPS, _SAME = 40, 1e-7
# Damping of the first step, factors on it after a step that helps and after one that does not, its range.
_DAMPING, _LESS, _MORE, _LEAST, _LARGEST = 1e-3, 0.2, 5.0, 1e-12, 1e8
# Largest change of the logarithm of an unknown in a step.
_STRIDE = 1.5
# A squared residual beyond this has diverged.
_DIVERGED = 1e60


@dataclass(frozen=True)
class SimulatedLog:
    """A log and the loop of a model along it.

    Args:
        replay: The loop.
        plant: The plant with the effects that act.
        places: Places of its unknowns.
        index: Their indices among the unknowns of the superset.
        view: View of the log on the superset; None: it is the only one.
        measured: Measured position, (time, n).
        weight: Weight of each sample, (time, n), on the scale of the view.
    """

    replay: Replay
    plant: Plant
    places: tuple
    index: np.ndarray
    view: cand.View | None
    measured: Float[np.ndarray, "time n"]
    weight: Float[np.ndarray, "time n"]

    def own(self, thetas: Float[np.ndarray, "starts p"]) -> Float[np.ndarray, "starts k"]:
        """Return the unknowns of this log's plant from all unknowns of the superset."""
        seen = thetas if self.view is None else np.array([self.view.theta(theta) for theta in thetas])
        return seen[:, self.index]


@dataclass(frozen=True)
class ModelFit:
    """A model that is fitted to logs.

    Args:
        superset: Machine with all candidates.
        logs: The logs with the loops of the model.
    """

    superset: cand.CandidateModel
    logs: tuple[SimulatedLog, ...]

    def squares(self, thetas: Float[np.ndarray, "starts p"]) -> Float[np.ndarray, " starts"]:
        """Return the squared residual at each of several values of all unknowns; infinite if it diverges."""
        total = np.zeros(len(thetas))
        for log in self.logs:
            found = _in_calls(_squares, log, log.own(thetas), _POINTS)
            total += np.concatenate([np.asarray(some) for some in found])[: len(thetas)]
        return np.where(total < _DIVERGED, total, np.inf)

    def linearised(
        self, thetas: Float[np.ndarray, "starts p"], moving: np.ndarray
    ) -> tuple[Float[np.ndarray, "starts rows"], Float[np.ndarray, "starts rows k"]]:
        """Return the weighted residual at each start, and its derivatives by the moving unknowns."""
        residuals, jacobians = [], []
        for log in self.logs:
            found = _in_calls(_linearised, log, log.own(thetas), _STARTS)
            e, columns = (
                np.concatenate([np.asarray(x) for x in some])[: len(thetas)]
                for some in zip(*found, strict=True)
            )
            jacobian = np.zeros((*e.shape, len(moving)))
            for k, own in enumerate(log.index):
                jacobian[..., moving == own] = columns[..., k : k + 1]
            residuals.append(e)
            jacobians.append(jacobian)
        return np.concatenate(residuals, axis=1), np.concatenate(jacobians, axis=1)

    def fit(
        self, thetas: Float[np.ndarray, "starts p"], moving: np.ndarray, *, steps: int = STEPS
    ) -> tuple[Float[np.ndarray, "starts p"], Float[np.ndarray, " starts"]]:
        """Fit some unknowns by least squares from each of several starts.

        Args:
            thetas: All unknowns of the superset at each start.
            moving: Indices of the unknowns to fit.
            steps: Largest number of steps of each fit.

        Returns:
            All unknowns at the end of each fit, and its squared residual.

        Source:
            Marquardt (1963): damping of each unknown by the curvature in it.
        """
        some = cand.free_of(self.superset, moving)
        transform = Transform.of(some)
        lower, upper = (np.asarray(transform.inward(bound)) for bound in some.bounds)

        def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
            values = np.array([np.asarray(transform.outward(one)) for one in x])
            out = thetas.copy()
            out[:, moving] = values
            e, jacobian = self.linearised(out, moving)
            with np.errstate(invalid="ignore", over="ignore"):  # a loop that diverged
                jacobian = jacobian * np.array([np.asarray(transform.slope(one)) for one in values])[:, None]
                squares = np.sum(np.square(e), axis=1)
            good = np.isfinite(squares) & np.all(np.isfinite(jacobian), axis=(1, 2))
            return out, e, jacobian, np.where(good, squares, np.inf)

        inward = np.array([np.asarray(transform.inward(theta[moving])) for theta in thetas])
        x = np.clip(inward, lower, upper)
        out, e, jacobian, squares = at(x)
        damping = np.full(len(x), _DAMPING)
        going = np.isfinite(squares)
        for _ in range(steps):
            if not going.any():
                break
            step = _step(e, jacobian, damping, going, x, lower, upper)
            step = np.where(np.asarray(transform.log), np.clip(step, -_STRIDE, _STRIDE), step)
            tried = np.clip(x + step, lower, upper)
            there, new_e, new_jacobian, new = at(tried)
            better = going & (new < squares)
            settled = np.zeros_like(better)
            settled[better] = squares[better] - new[better] < _SAME * squares[better]
            for old, fresh in ((x, tried), (out, there), (e, new_e), (jacobian, new_jacobian)):
                old[better] = fresh[better]
            squares = np.where(better, new, squares)
            damping = np.clip(np.where(better, _LESS * damping, _MORE * damping), _LEAST, None)
            going &= ~settled & (damping < _LARGEST)
        return out, squares


def _step(
    e: np.ndarray,
    jacobian: np.ndarray,
    damping: np.ndarray,
    going: np.ndarray,
    x: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> Float[np.ndarray, "starts k"]:
    """Return the damped step of each start; unknowns that are held by a bound stay."""
    out = np.zeros_like(x)
    for k in np.flatnonzero(going):
        gradient = jacobian[k].T @ e[k]
        free = ~presses(x[k], gradient, lower, upper)
        columns = jacobian[k][:, free]
        with np.errstate(over="ignore"):  # a column that diverged takes no step
            size = np.linalg.norm(columns, axis=0)
        size = np.where(size > 0, size, 1.0)
        scaled = columns / size
        matrix = scaled.T @ scaled + damping[k] * np.eye(len(size))
        out[k, free] = -np.linalg.solve(matrix, scaled.T @ e[k]) / size
    return out


def _in_calls(function: Any, log: SimulatedLog, points: np.ndarray, count: int) -> list:
    """Return the results of a compiled function at points, in calls of one shape."""
    whole = -(-len(points) // count) * count
    filled = points[np.minimum(np.arange(whole), len(points) - 1)]
    given = (log.replay, log.places, log.plant, log.measured, log.weight)
    return [function(*given, filled[k : k + count]) for k in range(0, whole, count)]


@kept_jit
def _squares(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, points: Array
) -> Array:
    residual = output_residual(replay, places, plant, measured, weight)
    return jax.vmap(lambda theta: jnp.sum(jnp.square(residual(theta))))(points)


@kept_jit
def _linearised(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, points: Array
) -> tuple[Array, Array]:
    residual = output_residual(replay, places, plant, measured, weight)

    # The residual beside its derivatives, so that the loop is traced once.
    def twice(theta: Array) -> tuple[Array, Array]:
        flat = residual(theta).ravel()
        return flat, flat

    columns, e = jax.vmap(jax.jacfwd(twice, has_aux=True))(points)
    return e, columns
