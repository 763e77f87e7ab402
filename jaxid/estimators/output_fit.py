"""Least squares of the simulated output of one log or of several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform
from jaxid.estimators.common.minimise import failure_text, minimise
from jaxid.estimators.common.minimisers import Minimiser, minimiser_name, minimiser_of
from jaxid.estimators.several.descent import Descent, Model, descent_steps
from jaxid.estimators.several.parts import Part, Scale
from jaxid.estimators.several.sums import summed
from jaxid.estimators.several.weights import descended_steps, start_weights
from jaxid.estimators.simulated_output import (
    choose_numerics,
    forgets,
    measured_output,
    output_residual,
)
from jaxid.gap import SHORT
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.full_hessian import full_hessian
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps, solved_together
from jaxid.numerics.rows import Rows
from jaxid.simulation.kalman import rounded_readings
from jaxid.simulation.noisy_loop import ReadingNoise
from jaxid.simulation.replay import (
    Numerics,
    Replay,
    from_rest,
    make_replay,
    stands_still,
    with_fitted_start,
)
from jaxid.simulation.sensor_noise import position_noise

# The start of an open-loop run is fitted with the unknowns only if the residual's RMS is within this
# factor of the position noise. Otherwise the error of the model would bias the start, which the first
# samples determine far better.
NOISE_LIMITED = 3.0
_DIVERGED = "the simulation diverged from these starting values"
# Part of the cost by which a fit of several logs has converged, and its most evaluations, as of one log.
TOLERANCE, _MOST = 1e-12, 60
# Logs from which on those of one length are simulated side by side; fewer are so with those of other runs.
_MANY = 4


@kept_jit
def fit_alone(
    replay: Replay,
    places: tuple,
    plant: Plant,
    measured: Array,
    weight: Array,
    theta: Array,
    transform: Transform,
    bounds: tuple[Array, Array],
    on: str,
    active: Array,
    minimiser: Minimiser | None,
) -> Minimum:
    """Fit the output of one log, in one compiled call."""
    residual = output_residual(replay, places, plant, measured, weight, on)
    return minimise(residual, theta, transform, *bounds, active, minimiser)


@kept_jit
def _linearised(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array, on: str
) -> tuple[Array, Array]:
    """Return the weighted residual of the output, (time, k), and its Jacobian, (time, k, unknowns)."""
    residual = output_residual(replay, places, plant, measured, weight, on)

    def both(theta: Array) -> tuple[Array, Array]:
        e = residual(theta)
        return e, e

    jacobian, e = jax.jacfwd(both, has_aux=True)(theta)
    return e, jacobian


@kept_jit
def _hessian(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array, on: str
) -> Array:
    return full_hessian(output_residual(replay, places, plant, measured, weight, on), theta)


@kept_jit
def output_residuals(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array, on: str
) -> Array:
    """Return the weighted residual of the output, (time, k)."""
    return output_residual(replay, places, plant, measured, weight, on)(theta)


@dataclass(frozen=True)
class Output:
    """Output of one log that is compared with its simulation.

    Args:
        part: The log with its machine at the start of the fit.
        numerics: Settings of the integration.
        replay: The simulation.
        measured: Measured output, (time, k).
        weight: Factor of each residual, zero where it does not count, (time, k).
        stays: Whether the start is that of the log, or rest, and never an unknown.
        width: Number of changes of the start that are unknowns or zero.
        start: Whether they are unknowns.
        noise: Noise of the encoder in the loop; None: the loop is simulated without noise.
    """

    part: Part
    numerics: Numerics
    replay: Replay
    measured: np.ndarray
    weight: np.ndarray
    stays: bool
    width: int
    start: bool = False
    noise: ReadingNoise | None = None

    @classmethod
    def of(
        cls, part: Part, numerics: Numerics, on: str, alone: bool, noise: ReadingNoise | None = None
    ) -> Output:
        """Return the output of a log, alone or among others, whose simulation starts as the log does."""
        replay = make_replay(part.machine, part.log, numerics)
        # The guesses' error at a break-away from rest would become a velocity of the start.
        if replay.controller is None and replay.restart is None and stands_still(part.log):
            replay = from_rest(replay)
        else:
            replay = with_fitted_start(replay, part.machine.plant, part.log)
        if noise is not None:
            replay = noise.on(replay)
        looped = replay.controller is not None
        stays = bool(numerics.segment) or (looped and part.log.samples > SHORT)
        # Among others every start has columns: the noise by which a log counts leaves out what they explain.
        width = 0 if stays and alone else 2 * part.log.position.shape[1]
        return cls(part, numerics, replay, *measured_and_weight(part, on), stays, width, noise=noise)

    @property
    def looped(self) -> bool:
        """True if the simulation runs in closed loop."""
        return self.replay.controller is not None

    @property
    def counts(self) -> np.ndarray:
        """Mask of the outputs that count, (time, k)."""
        return self.weight > 0

    @property
    def signal(self) -> float:
        """2-norm of the measured output about its mean."""
        return float(np.linalg.norm(self.weight * (self.measured - self.measured.mean(axis=0))))

    def arguments(self, theta: np.ndarray, start: np.ndarray) -> tuple:
        """Return the arguments of compiled code at values of all unknowns, and of the start."""
        machine, own = self.part.machine, np.concatenate([theta[self.part.index], start])
        return self.replay, machine.parameters.places, machine.plant, self.measured, self.weight, own

    def forgets(self, theta: np.ndarray) -> bool:
        """Check that a fitted delay is longer than the past commands that are kept."""
        return forgets(self.part.machine, self.numerics, theta[self.part.index])

    def with_longer_delay(self) -> Output:
        """Return the output with a simulation that keeps twice as many past commands."""
        numerics = replace(self.numerics, longest_delay=2 * self.numerics.longest_delay)
        replay = make_replay(self.part.machine, self.part.log, numerics)
        replay = replay if self.noise is None else self.noise.on(replay)
        return replace(self, numerics=numerics, replay=replay)


def measured_and_weight(part: Part, on: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the measured output of a log, and the factors of its residuals."""
    measured, counts = measured_output(part.machine, part.log, on)
    weight = np.tile(counts.astype(float), (len(measured), 1))
    if part.log.passive and on == "position":
        # A free motion ends at rest, where one rounding error stands in every reading.
        weight = weight * rounded_readings(part.machine, part.log)
    return measured, weight


def outputs_of(
    parts: Sequence[Part],
    on: str = "position",
    numerics: Numerics | None = None,
    solver: str | None = None,
    noise: Sequence[ReadingNoise | None] | None = None,
) -> tuple[Output, ...]:
    """Return the outputs of all logs; one number of steps serves them, so that they share compiled code.

    Args:
        parts: The logs.
        on: One of `jaxid.names.OUTPUTS`.
        numerics: Settings of the integration; None: chosen from machines and logs.
        solver: One of `jaxid.names.SOLVERS` for chosen settings; None: fixed steps.
        noise: Noise of the encoder in the loop of each log; None: all are simulated without noise.
    """
    chosen = [numerics or choose_numerics(part.machine, part.log, solver=solver) for part in parts]
    most, alone = max(n.substeps for n in chosen), len(parts) == 1
    of_logs = zip(parts, chosen, noise or [None] * len(parts), strict=True)
    return tuple(Output.of(part, replace(n, substeps=most), on, alone, own) for part, n, own in of_logs)


@dataclass(frozen=True)
class FitEnd:
    """End of a fit.

    Args:
        theta: Physical values, (p,).
        starts: Changes of all starts.
        begun: Physical values at which the fit began, (p,).
        cost: Half the weighted sum of squares.
        logs: Residuals of the logs, with Jacobians by all unknowns and all changes of starts.
        weights: Weight of each log.
        converged: Whether the cost can fall no further.
        failure: Reason why it has not converged.
        steps: Number of evaluations.
    """

    theta: np.ndarray
    starts: np.ndarray
    begun: np.ndarray
    cost: float
    logs: list[Rows]
    weights: np.ndarray
    converged: bool
    failure: str
    steps: int

    @property
    def diverged(self) -> bool:
        """True if the simulation diverges where the fit ended, or its derivatives grow without bound."""
        return not (np.isfinite(self.cost) and all(_bounded(log.jacobian) for log in self.logs))


@dataclass(frozen=True)
class OutputFit:
    """A fit of one log or of several.

    Args:
        machine: Machine of all logs at the start of the fit.
        outputs: The outputs that are compared.
        on: Kind of the outputs, one of `jaxid.names.OUTPUTS`.
        minimiser: A solver of optimistix for one log, or its name; None: jaxid's.
        tolerance: Part of the cost by which a fit of several logs has converged.
    """

    machine: Machine
    outputs: tuple[Output, ...]
    on: str
    minimiser: str | Minimiser | None = None
    tolerance: float = TOLERANCE

    @property
    def unknowns(self) -> int:
        """Number of unknowns without the starts."""
        return len(self.machine.parameters.free)

    @property
    def starts(self) -> int:
        """Number of changes of all starts."""
        return sum(o.width for o in self.outputs)

    @property
    def active(self) -> np.ndarray:
        """Mask of the unknowns that move, with the changes of the starts behind the others."""
        freed = [np.full(o.width, o.start) for o in self.outputs]
        return np.concatenate([np.ones(self.unknowns, bool), *freed])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds on the physical values and the changes of the starts."""
        lower, upper = self.machine.parameters.bounds
        free = np.full(self.starts, np.inf)
        return np.concatenate([lower, -free]), np.concatenate([upper, free])

    @property
    def places(self) -> list[slice]:
        """Places of each log's start among the changes of all starts."""
        ends = np.cumsum([o.width for o in self.outputs])
        return [slice(end - o.width, end) for end, o in zip(ends.tolist(), self.outputs, strict=True)]

    def changed(self, outputs: Sequence[Output]) -> OutputFit:
        """Return the fit with other outputs."""
        return replace(self, outputs=tuple(outputs))

    def steps(
        self,
        theta: np.ndarray,
        starts: np.ndarray | None = None,
        weights: np.ndarray | None = None,
        active: np.ndarray | None = None,
    ) -> Steps[FitEnd]:
        """Fit from some values.

        Args:
            theta: Physical values, (p,).
            starts: Changes of all starts; None: zero.
            weights: Weights of the logs, which then follow from their residuals; None: equal parts.
            active: Mask of the unknowns that move; None: `active` of the fit.
        """
        starts = np.zeros(self.starts) if starts is None else starts
        active = self.active if active is None else active
        if len(self.outputs) == 1:
            return (yield from self._alone(theta, starts, active))
        return (yield from self._together(theta, starts, active, weights))

    def alone_at(self, values: np.ndarray, active: np.ndarray) -> SolveRequest:
        """Return the request that fits the only log from some values, by one compiled call."""
        [output] = self.outputs
        transform = Transform.of(self.machine.parameters)
        transform = replace(transform, log=np.concatenate([transform.log, np.zeros(output.width, bool)]))
        p, solver = self.unknowns, minimiser_of(self.minimiser)
        problem = output.arguments(values[:p], values[p:])
        return SolveRequest(fit_alone, (*problem, transform, self.bounds, self.on, active, solver))

    def _alone(self, theta: np.ndarray, starts: np.ndarray, active: np.ndarray) -> Steps[FitEnd]:
        [output] = self.outputs
        minimum = yield self.alone_at(np.concatenate([theta, starts]), active)
        e = np.asarray(minimum.residual).reshape(output.measured.shape)
        jacobian = np.asarray(minimum.jacobian).reshape(*e.shape, -1)
        p, values = self.unknowns, np.asarray(minimum.theta)
        rows = [Rows(jacobian, e, output.counts, output.signal)]
        # A loop between the limits of its force may stay near the log although it is unstable.
        bounded = _bounded(jacobian)
        failure = _failure(minimum, self.minimiser) if bounded else _DIVERGED
        ended = (np.ones(1), bool(minimum.converged) and bounded, failure, int(minimum.steps))
        return FitEnd(values[:p], values[p:], theta, float(minimum.cost), rows, *ended)

    def _together(
        self, theta: np.ndarray, starts: np.ndarray, active: np.ndarray, weights: np.ndarray | None
    ) -> Steps[FitEnd]:
        scale, signals = Scale.of(self.machine, more=self.starts), [o.signal for o in self.outputs]
        if weights is None:
            weights = start_weights(signals, [int(o.counts.sum()) for o in self.outputs])

        def fit(x: np.ndarray, weights: np.ndarray) -> Steps[Descent]:
            def evaluate(x: np.ndarray) -> Steps[Model]:
                theta, starts = scale.outward(x)
                logs = yield from self._rows(theta, starts, signals, weights)
                return summed(logs, lambda columns: scale.inner(columns, theta))

            options = {**scale.limits(self.tolerance, _MOST), "active": active}
            return (yield from descent_steps(evaluate, x, scale.bounds, **options))

        x = scale.inward(theta, starts)
        descended = self._descended_unforced if self.unforced else descended_steps
        found, weights = yield from descended(fit, x, weights)
        model, finite = found.model, bool(np.isfinite(found.model.cost))
        failure = _DIVERGED if not finite else f"no convergence within {found.steps} steps"
        ended = (weights, found.converged and finite, failure, found.steps)
        return FitEnd(*scale.outward(found.x), theta, model.cost, model.content, *ended)

    def _descended_unforced(
        self, fit: Callable[[np.ndarray, np.ndarray], Steps[Descent]], x: np.ndarray, weights: np.ndarray
    ) -> Steps[tuple[Descent, np.ndarray]]:
        """Descend as `descended_steps` does if the noise limits the fit; else readings weigh alike.

        Without a force the model may be far from complete. Its errors have a colour that is none of the
        noise, and would make a log count for nothing.
        """
        found = yield from fit(x, np.full(len(self.outputs), 1.0 / np.mean(1.0 / weights)))
        if not found.model.finite:
            return found, weights
        if self.noise_limited(found.model.content):
            return (yield from descended_steps(fit, found.x, weights))
        weights = _pooled(found.model.content)
        return (yield from fit(found.x, weights)), weights

    def _rows(
        self, theta: np.ndarray, starts: np.ndarray, signals: Sequence[float], weights: np.ndarray
    ) -> Steps[list[Rows]]:
        logs, p, q = [], theta.size, theta.size + starts.size
        requests = [
            SolveRequest(_linearised, (*output.arguments(theta, starts[place]), self.on))
            for output, place in zip(self.outputs, self.places, strict=True)
        ]
        if len(requests) < _MANY:
            answers = []
            for request in requests:
                answers.append((yield request))
        else:
            answers = yield from solved_together(requests)
        of_logs = zip(self.outputs, self.places, signals, weights, answers, strict=True)
        for output, place, signal, weight, answer in of_logs:
            e, jacobian = (np.asarray(x) for x in answer)
            wide = np.zeros((*e.shape, q))
            own = output.part.index.size
            wide[..., output.part.index] = jacobian[..., :own]
            wide[..., p + place.start : p + place.stop] = jacobian[..., own:]
            logs.append(Rows(wide, e, output.counts, signal, float(weight)))
        return logs

    @property
    def unforced(self) -> bool:
        """True if no log holds the force that drives its loop."""
        return all(o.part.machine.unforced(o.part.log) for o in self.outputs)

    @property
    def pushed(self) -> bool:
        """True if the logged force drives the simulation of every log."""
        return not any(o.looped or o.part.log.passive for o in self.outputs)

    @property
    def shaken(self) -> bool:
        """True if one log is fitted whose noise goes round the loop of several joints."""
        [output, *others] = self.outputs
        return not others and output.looped and output.part.machine.gain.size > 1

    def noise_limited(self, logs: Sequence[Rows]) -> bool:
        """Check that what is left of every log is at most a few times the noise of its readings."""
        for output, log in zip(self.outputs, logs, strict=True):
            rms = np.sqrt(np.sum(np.square(log.residual)) / max(int(log.counts.sum()), 1))
            if rms > NOISE_LIMITED * np.max(position_noise(output.part.machine, output.part.log)):
                return False
        return True

    def hessian(self, end: FitEnd) -> Steps[np.ndarray]:
        """Compute the full Hessian of half the weighted sum of squares by the active unknowns."""
        p, q = end.theta.size, self.active.size
        out = np.zeros((q, q))
        for output, place, weight in zip(self.outputs, self.places, end.weights, strict=True):
            arguments = (*output.arguments(end.theta, end.starts[place]), self.on)
            own = np.asarray((yield SolveRequest(_hessian, arguments)))
            index = np.concatenate([output.part.index, p + np.arange(place.start, place.stop)])
            out[np.ix_(index, index)] += float(weight) * own
        return out[np.ix_(self.active, self.active)]


def _pooled(logs: Sequence[Rows]) -> np.ndarray:
    """Return one over the mean square of all residuals, as the weight of each log."""
    squares = sum(float(np.sum(np.square(log.residual))) for log in logs)
    return np.full(len(logs), sum(int(log.counts.sum()) for log in logs) / max(squares, 1e-300))


def _bounded(jacobian: np.ndarray) -> bool:
    """Check that the squares of derivatives are finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(np.sum(np.square(jacobian))))


def _failure(minimum: Minimum, minimiser: str | Minimiser | None) -> str:
    if not np.isfinite(float(minimum.cost)):
        return _DIVERGED
    if minimum.failure is not None:
        return failure_text(minimum, minimiser_name(minimiser))
    return f"no convergence within {int(minimum.steps)} steps"
