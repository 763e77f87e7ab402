"""Simulation of a log with the same filters: a motion without the noise of the sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.best_bodies import best_bodies
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared, prepare
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Parameters, scatter
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.simulation.replay import Numerics, Replay, exact_numerics, make_replay, with_fitted_start

# A simulated position this many times larger than the measured one has diverged.
_RUNAWAY = 1e3
# A run whose RMS distance from the log exceeds this part of the log's standard deviation gives no useful
# instruments.
_LOST = 0.5
# Singular values of the scaled columns below this part of the largest count as zero.
_ROUNDING = 1e-6
# A column below this part of the largest one is rounding.
_CANCELLED = 1e-12
# A fit has converged if a step is smaller than this part of a standard deviation for a white residual.
_SMALL = 1e-2


@dataclass(frozen=True)
class Rerun:
    """A log, ready to be simulated with any values of the unknowns.

    Args:
        machine: The machine; simulated in closed loop if it has a controller, else with the measured force.
        log: The log to simulate.
        data: The prepared log; its recipe filters the simulated motion too.
        replay: Inputs of the simulation.
    """

    machine: Machine
    log: Log
    data: Prepared
    replay: Replay

    @classmethod
    def of(cls, machine: Machine, log: Log, data: Prepared, numerics: Numerics | None = None) -> Rerun:
        """Prepare the simulation of a log.

        Args:
            machine: The machine, with values from which the integration steps are chosen.
            log: The log to simulate.
            data: The prepared log.
            numerics: Settings of the integration; dry friction always
                sticks exactly, because nothing is differentiated. None: chosen from machine and log.

        Raises:
            InputError: If the machine has a controller and the log has no reference.
        """
        numerics = numerics or exact_numerics(machine, log)
        numerics = replace(numerics, set_valued=True, segment=None, solver=None)
        # Rounded readings would add noise to the simulated loop.
        exact = replace(machine, sensor=replace(machine.sensor, position_resolution=None))
        replay = with_fitted_start(make_replay(exact, log, numerics), machine.plant, log)
        return cls(machine, log, data, replay)

    @property
    def looped(self) -> bool:
        """True if the simulation is in closed loop."""
        return self.replay.controller is not None

    def steps(self, theta: np.ndarray, *, own_command: bool) -> Steps[Prepared | None]:
        """Simulate, and prepare the simulated motion like the log.

        Args:
            theta: Values of the unknowns, (p,).
            own_command: Whether the force is that of the simulated loop; otherwise the measured one.

        Returns:
            The simulated motion with its force; None if the simulation diverges.
        """
        places = self.machine.parameters.places
        position, command = yield SolveRequest(_simulated, (self.replay, places, self.machine.plant, theta))
        position = np.asarray(position)
        largest = _RUNAWAY * np.max(np.abs(self.log.filled))
        if not np.all(np.isfinite(position)) or np.max(np.abs(position)) > largest:
            return None
        own = own_command and self.looped
        force = np.asarray(command) if own else self.log.force
        # Joints without an encoder have no readings here either: their motion is completed as for the log.
        position = np.where(self.log.measured, position, np.nan)
        run = replace(self.log, position=position, force=force)
        # The logged force has already passed the running median.
        run = self.data.recipe.cleaned(run) if own else run
        return replace(
            prepare(run, self.machine.gain, self.data.recipe), hold=self.data.hold, steps=self.data.steps
        )


def lost(run: Prepared, log: Log) -> bool:
    """Check that a simulated motion has drifted too far from the measured one."""
    off = np.sqrt(np.mean((run.q - log.filled) ** 2, axis=0))
    return bool(np.any(off > _LOST * np.std(log.filled, axis=0)))


@kept_jit
def _simulated(replay: Replay, places: tuple, plant: Plant, theta: Array) -> tuple[Array, Array]:
    """Return the position, (time, n), and command, (time, m), at the samples of the log."""
    run = replay(scatter(places, plant, theta))
    return run.position, run.command


def best_step(
    parameters: Parameters,
    columns: Float[np.ndarray, "rows p"],
    e: Float[np.ndarray, " rows"],
    theta: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """Return Gauss-Newton's step within bounds, or to the optimal bodies if links must be consistent.

    The set of bodies is convex, so that any fraction of the step is feasible too.

    Args:
        parameters: The unknowns; unidentifiable directions of bodies stay near their guess.
        columns: Jacobian of the residual, (rows, p).
        e: Residual at theta, (rows,).
        theta: Current values of the unknowns, (p,).
    """
    if not parameters.bodies:
        return bounded_step(columns, e, theta, parameters.bounds)
    return best_bodies(parameters, columns, e, theta)[0] - theta


def bounded_step(
    columns: Float[np.ndarray, "rows p"],
    e: Float[np.ndarray, " rows"],
    theta: Float[np.ndarray, " p"],
    bounds: tuple[np.ndarray, np.ndarray],
) -> Float[np.ndarray, " p"]:
    """Return Gauss-Newton's step within bounds.

    An unknown that would pass a bound stops there, and the others adapt. Unidentifiable directions do not
    move.

    Args:
        columns: Jacobian of the residual, (rows, p).
        e: Residual at theta, (rows,).
        theta: Current values of the unknowns, (p,).
        bounds: Lower and upper bounds, (p,) each.
    """
    lower, upper = bounds
    norm = np.linalg.norm(columns, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    step, free = np.zeros(len(theta)), np.ones(len(theta), bool)
    while free.any():
        left = e + columns[:, ~free] @ step[~free]
        step[free] = np.linalg.lstsq((columns / norm)[:, free], -left, rcond=_ROUNDING)[0] / norm[free]
        out = free & ((theta + step < lower) | (theta + step > upper))
        if not out.any():
            break
        step[out] = np.clip(theta + step, lower, upper)[out] - theta[out]
        free &= ~out
    return step


def settled(change: Float[np.ndarray, " rows"], e: Float[np.ndarray, " rows"], size: float) -> bool:
    """Check that a step changes the residual by less than a hundredth of a standard deviation would.

    Args:
        change: Change of the residual by the step, (rows,).
        e: Residual before the step, (rows,).
        size: 2-norm of the force; a change below 10^-10 of it is rounding.
    """
    small = _SMALL * np.linalg.norm(e) / np.sqrt(max(e.size, 1))
    return bool(np.linalg.norm(change) <= max(small, 1e-10 * size))


def span(columns: Float[np.ndarray, "rows p"]) -> Float[np.ndarray, "rows r"]:
    """Return an orthonormal basis of the span of some columns, (rows, r).

    A column that cancels to rounding is no direction.
    """
    norm = np.linalg.norm(columns, axis=0)
    acts = norm > _CANCELLED * np.max(norm, initial=0.0)
    u, s, _ = np.linalg.svd(np.where(acts, columns, 0.0) / np.where(acts, norm, 1.0), full_matrices=False)
    return u[:, s > _ROUNDING * s[0]]
