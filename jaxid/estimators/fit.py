"""A fit as a pure function of arrays: plant and data in, a pytree out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers import Controller
from jaxid.errors import InputError, suggest
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform, eliminated
from jaxid.estimators.common.minimise import minimise
from jaxid.estimators.common.minimisers import Minimiser, minimiser_of
from jaxid.estimators.simulated_output import output_residual
from jaxid.model.by_name import Place, parameters_by_name
from jaxid.model.plant import Plant
from jaxid.model.unknowns import leaf, scatter
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import Drive
from jaxid.simulation.replay import Replay
from jaxid.simulation.solvers import AdaptiveStep

# Number of first samples whose slope is the start of a fitted initial velocity.
_SLOPE = 10
# Lower bound of a positive parameter, relative to its start.
_POSITIVE_FLOOR = 1e-9
# Relative difference of sampling steps beyond which a time is not equally spaced.
_UNEQUAL = 1e-6


class Fit(eqx.Module):
    """Result of `fit`: arrays only, so that many fits are one tree with a leading axis.

    Args:
        plant: The plant with its estimates.
        theta: Estimates in the order of the free parameters, (p,).
        covariance: Covariance of the estimates for a white residual, (p, p).
        cost: Half the sum of the squared residual [m^2 or rad^2].
        converged: Whether the cost can fall no further.
        steps: Steps of the minimiser.
        residual: Measured minus simulated position, (time, n); zero where there is no reading.
        position, velocity: Initial state, (n,) each.
    """

    plant: Plant
    theta: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    cost: Float[Array, ""]
    converged: Array
    steps: Array
    residual: Float[Array, "time n"]
    position: Float[Array, " n"]
    velocity: Float[Array, " n"]

    @property
    def std(self) -> Float[Array, " p"]:
        """Standard deviations of the estimates."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))


def parameter_names(plant: Plant) -> tuple[str, ...]:
    """Return the names of all parameters of a plant and its effects, as results and `fit` use them."""
    return tuple(parameters_by_name(plant))


def fit(
    plant: Plant,
    free: Sequence[str] | Callable[[Plant], object],
    time: Float[Array, " time"] | float,
    position: Float[Array, "time n"],
    force: Float[Array, "time m"] | None = None,
    *,
    start: Float[Array, " p"] | None = None,
    initial: tuple[Array, Array] | None = None,
    controller: Controller | None = None,
    reference: Float[Array, "time m"] | None = None,
    gain: Array | float = 1.0,
    hold: str = "zero_order",
    substeps: int = 1,
    sticks: bool = True,
    solver: str | None = None,
    minimiser: str | Minimiser | None = None,
) -> Fit:
    """Fit parameters of a plant so that its simulated position matches the measured one.

    A pure function of its arrays: vmap it over data, starts or plants, jit it, differentiate `theta` (by the
    implicit function theorem). It is the output-error fit of `identify` without its automatic choices: the
    caller chooses start, integration and initial state, and the covariance is that for a white residual.

    Args:
        plant: The plant; the free parameters start at its values.
        free: Names of the free parameters, see `parameter_names`, or a function that picks leaves of a plant,
            as of `equinox.tree_at`.
        time: Sample times in equal steps, (time,), or the sampling period [s]; no traced array.
        position: Measured positions, (time, n) or (time,) [m or rad]; NaN where there is no reading.
        force: Measured commands that drive the plant, (time, m) or (time,); in a closed loop not used.
        start: Values at which the free parameters start, (p,); absent: those of the plant.
        initial: Position and velocity at the first sample, (n,) each; absent: fitted with the parameters.
        controller: Sampled law that closes the loop; its period is the sampling period.
        reference: Reference of that loop, (time, m) or (time,).
        gain: Declared force per unit of the command, a number or (m,).
        hold: Course of the command between samples: "zero_order" or "linear".
        substeps: Integration steps per sample.
        sticks: Whether dry friction sticks exactly; else its sign is smoothed by the plant's `sharpness`.
        solver: One of `jaxid.names.SOLVERS` in place of fixed steps; smooths dry friction.
        minimiser: One of `jaxid.names.MINIMISERS`, or a solver of optimistix.

    Returns:
        The estimates, their covariance and the residual.

    Raises:
        InputError: If a name, a shape or an option is wrong.
    """
    measured = _columns(position)
    places, signs = _places(plant, free)
    theta = _gathered(places, plant) if start is None else jnp.asarray(start, dtype=jnp.float64)
    if theta.shape != (len(places),):
        raise InputError(f"start has shape {theta.shape} for {len(places)} free parameters")

    period = _period(time, len(measured))
    replay = _replay(plant, period, measured, force, initial, controller, reference, gain, hold)
    step = None if solver is None else AdaptiveStep.sized(solver, 1.0, 1.0)
    drive = replace(replay.drive, substeps=substeps, set_valued=sticks and solver is None, solver=step)
    replay = replace(replay, drive=drive)

    minimum = _minimum(replay, plant, places, signs, theta, measured, initial is None, minimiser)
    counts = jnp.isfinite(measured)
    n, nuisance = measured.shape[1], minimum.theta.size - len(places)
    theta, moved = minimum.theta[: len(places)], minimum.theta[len(places) :]
    moved = moved if nuisance else jnp.zeros(2 * n)
    return Fit(
        plant=scatter(places, plant, theta),
        theta=theta,
        covariance=_covariance(minimum.jacobian, minimum.cost, jnp.sum(counts))[: len(places), : len(places)],
        cost=minimum.cost,
        converged=minimum.converged,
        steps=minimum.steps,
        residual=minimum.residual.reshape(measured.shape),
        position=replay.position + moved[:n],
        velocity=replay.velocity + moved[n:],
    )


def _minimum(
    replay: Replay,
    plant: Plant,
    places: tuple,
    signs: Sequence[str],
    theta: Array,
    measured: Array,
    fits_initial: bool,
    minimiser: str | Minimiser | None,
) -> Minimum:
    """Minimise the residual in position over the parameters, followed by changes of the initial state.

    Args:
        replay: The run.
        plant: The plant.
        places, signs: Place and sign of each free parameter.
        theta: Parameters at the start, (p,).
        measured: Measured positions, (time, n); NaN where there is no reading.
        fits_initial: Whether the initial positions and velocities are unknown.
        minimiser: Minimiser of `fit`.
    """
    nuisance = 2 * measured.shape[1] if fits_initial else 0
    wide = jnp.full(nuisance, jnp.inf)
    transform = Transform(np.array([*(s == "positive" for s in signs), *[False] * nuisance], dtype=bool))
    floors = {"free": -np.inf, "nonnegative": 0.0, "positive": _POSITIVE_FLOOR}
    floor = jnp.asarray([floors[s] for s in signs])
    lower = jnp.where(np.array([s == "positive" for s in signs]), floor * jnp.abs(theta), floor)

    counts = jnp.isfinite(measured)
    residual = output_residual(
        replay, places, plant, jnp.where(counts, measured, 0.0), counts.astype(jnp.float64)
    )
    return minimise(
        residual,
        jnp.concatenate([theta, jnp.zeros(nuisance)]),
        transform,
        jnp.concatenate([lower, -wide]),
        jnp.concatenate([jnp.full(len(places), jnp.inf), wide]),
        minimiser=minimiser_of(minimiser),
    )


def _covariance(jacobian: Float[Array, "rows p"], cost: Array, samples: Array) -> Float[Array, "p p"]:
    """Return the covariance for a white residual; infinite for an unknown without effect."""
    norm = jnp.linalg.norm(jacobian, axis=0)
    scale = jnp.where(norm > 0, norm, 1.0)
    size = scale.size
    normal = (jacobian / scale).T @ (jacobian / scale)
    inverse = eliminated(normal + jnp.diag(jnp.where(norm > 0, 0.0, 1.0)), jnp.eye(size))
    variance = 2.0 * cost / jnp.maximum(samples - size, 1)
    covariance = variance * inverse / jnp.outer(scale, scale)
    return jnp.where(jnp.diag(norm > 0) | ~jnp.eye(size, dtype=bool), covariance, jnp.inf)


def _replay(
    plant: Plant,
    period: float,
    measured: Float[Array, "time n"],
    force: Array | None,
    initial: tuple[Array, Array] | None,
    controller: Controller | None,
    reference: Array | None,
    gain: Array | float,
    hold: str,
) -> Replay:
    """Build the run that the data drive; a line through the first samples gives a missing initial state."""
    n = measured.shape[1]
    given, what = (force, "force") if controller is None else (reference, "reference")
    if given is None:
        raise InputError(f"{what} is missing", hint="give force, or controller and reference")
    driving = _columns(given)
    if len(driving) != len(measured):
        raise InputError(f"{what} has {len(driving)} samples and position {len(measured)}")
    if controller is not None and abs(controller.period / period - 1.0) > _UNEQUAL:
        raise InputError(f"the controller's period is {controller.period:g} s and that of time {period:g} s")
    if hold not in ("zero_order", "linear"):
        raise InputError(f"hold {hold!r} is not known", hint=suggest(hold, ("zero_order", "linear")))

    if initial is None:
        head = jnp.nan_to_num(measured[:_SLOPE])
        t = period * (np.arange(len(head)) - (len(head) - 1) / 2)
        q, v = head[0], t @ head / max(float(t @ t), 1e-300)
    else:
        q, v = (jnp.broadcast_to(jnp.asarray(x, dtype=jnp.float64), (n,)) for x in initial)
    gains = jnp.broadcast_to(jnp.asarray(gain, dtype=jnp.float64), (len(plant.driven(n)),))
    closed = controller is not None
    return Replay(
        drive=Drive(gains, period, "zero_order" if closed else hold),
        controller=controller,
        sensor=Sensor(),
        reference=driving if closed else None,
        disturbance=jnp.zeros((len(measured), gains.size)) if closed else None,
        command=None if closed else driving,
        position=q,
        velocity=v,
        restart=None,
        every=1,
        follow=jnp.eye(n),
    )


def _columns(x: Array) -> Float[Array, "time k"]:
    x = jnp.asarray(x, dtype=jnp.float64)
    return x[:, None] if x.ndim == 1 else x


def _period(time: Array | float, samples: int) -> float:
    """Return the sampling period [s], a constant of the compiled code."""
    if isinstance(time, Tracer):
        raise InputError("time is traced", hint="close over it, or give the sampling period as a number")
    stamps = np.asarray(time, dtype=np.float64)
    if stamps.ndim == 0:
        return float(stamps)
    if len(stamps) != samples or samples < 2:
        raise InputError(f"time has {len(stamps)} samples and position {samples}")
    period = float(stamps[-1] - stamps[0]) / (samples - 1)
    if not period > 0 or np.max(np.abs(np.diff(stamps) - period)) > _UNEQUAL * period * samples:
        raise InputError("time does not rise in equal steps", hint="resample the data")
    return period


def _places(
    plant: Plant, free: Sequence[str] | Callable[[Plant], object]
) -> tuple[tuple[Place, ...], tuple[str, ...]]:
    """Return places and signs of the free parameters."""
    every = parameters_by_name(plant)
    if callable(free):
        leaves, structure = jax.tree.flatten(plant)
        numbers = jax.tree.unflatten(structure, range(len(leaves)))
        picked = jax.tree.leaves(free(numbers))
        names = [n for k in picked for n, ((path, _), _) in every.items() if leaf(numbers, path) == k]
        if len({int(leaf(numbers, every[n][0][0])) for n in names}) != len(set(picked)):
            raise InputError("free picks a leaf that is no parameter", hint=", ".join(every))
    else:
        names = [free] if isinstance(free, str) else list(free)
    for name in names:
        if name not in every:
            raise InputError(f"parameter {name!r} is not known", hint=suggest(name, every))
    if not names:
        raise InputError("free names no parameter", hint=f"choose among {', '.join(every)}")
    return tuple(every[n][0] for n in names), tuple(every[n][1].sign for n in names)


def _gathered(places: tuple[Place, ...], plant: Plant) -> Float[Array, " p"]:
    """Return the values at some places of a plant."""
    values = [leaf(plant, path) if index is None else leaf(plant, path)[index] for path, index in places]
    return jnp.stack([jnp.asarray(v, dtype=jnp.float64) for v in values])
