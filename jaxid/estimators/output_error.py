"""Gradient-based fit of the simulated to the measured position, of one log or of several.

The simulation runs in closed loop if the controller is known, else in open loop over the whole log. If an
error would grow without bound, it runs in segments that restart from the log. Each log has its start and its
noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform
from jaxid.estimators.common.minimise import failure_text, minimise
from jaxid.estimators.common.minimisers import Minimiser, minimiser_name, minimiser_of
from jaxid.estimators.common.profile import need_names
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_profile import profile_steps
from jaxid.estimators.round_the_loop import shift_steps
from jaxid.estimators.several.descent import Descent, Model, descent_steps
from jaxid.estimators.several.parts import Part, Scale, by_log
from jaxid.estimators.several.sums import shares, stacked, summed
from jaxid.estimators.several.weights import descended_steps, disagreement, start_weights
from jaxid.estimators.simulated_output import (
    choose_numerics,
    forgets,
    kept_delay,
    measured_output,
    need_loop,
    need_output_force,
    notes_of,
    output_residual,
)
from jaxid.gap import SHORT
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import REFERENCE
from jaxid.numerics import filters as signals
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone, solved_together
from jaxid.numerics.misspecified import std_under_misspecification
from jaxid.numerics.precision import Precision, Rows, assess_together, full_hessian, hessian_notes
from jaxid.simulation.kalman import rounded_readings
from jaxid.simulation.noisy_loop import ReadingNoise
from jaxid.simulation.replay import (
    Numerics,
    Replay,
    from_rest,
    make_replay,
    start_shows,
    with_fitted_start,
)
from jaxid.simulation.sensor_noise import position_noise

# The start of an open-loop run is fitted with the unknowns only if the residual's RMS is within this
# factor of the position noise. Otherwise the error of the model would bias the start, which the first
# samples determine far better.
_NOISE_LIMITED = 3.0
# A freed start of a loop is kept if it lowers the cost by this many times what chance does.
_CLEARLY = 10.0
_DIVERGED = "the simulation diverged from these starting values"
# Part of the cost by which a fit of several logs has converged, and its most evaluations, as of one log.
_TOLERANCE, _MOST = 1e-12, 60
# Logs from which on those of one length are simulated side by side; fewer are so with those of other runs.
_MANY = 4


@kept_jit
def _fit(
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
def _residual(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array, on: str
) -> Array:
    return output_residual(replay, places, plant, measured, weight, on)(theta)


def output_error(
    machine: Machine,
    log: Log,
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    hessian: bool = False,
    profile: Sequence[str] = (),
    on: str = "position",
    minimiser: str | Minimiser | None = None,
) -> Estimate:
    """Fit the unknowns so that the simulated position, or force, matches the measured one.

    Args:
        machine: The machine; its controller closes the loop.
        log: The log with the measured output.
        start: Start of the fit in place of the guesses, for example from `inverse_dynamics`, (p,).
        numerics: Settings of the integration; None: chosen from plant and log.
        hessian: Whether the covariance uses the full Hessian in place of Gauss-Newton's; see
            `jaxid.numerics.precision.hessian_covariance`.
        profile: Names of the unknowns whose profile likelihood is computed; see
            `jaxid.estimators.common.profile`.
        on: One of `jaxid.names.OUTPUTS`. With "both" each column is divided by the standard deviation of its
            residual in a fit of position. A fit of the force needs a closed loop.
        minimiser: One of `jaxid.estimators.common.minimisers.MINIMISERS`, or a solver of optimistix; None:
            `jaxid.estimators.common.levenberg_marquardt`.

    Returns:
        The estimate; its covariance accounts for a coloured residual.

    Raises:
        InputError: If the force is fitted without a closed loop, or the minimiser or a name in `profile` is
            not known.
    """
    return run_alone(
        output_error_steps(
            machine,
            log,
            start=start,
            numerics=numerics,
            hessian=hessian,
            profile=profile,
            on=on,
            minimiser=minimiser,
        )
    )


@dataclass(frozen=True)
class _Output:
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
    ) -> _Output:
        """Return the output of a log, alone or among others, whose simulation starts as the log does."""
        replay = make_replay(part.machine, part.log, numerics)
        replay = with_fitted_start(replay, part.machine.plant, part.log)
        if noise is not None:
            replay = noise.on(replay)
        looped = replay.controller is not None
        stays = bool(numerics.segment) or (looped and part.log.samples > SHORT)
        # Among others every start has columns: the noise by which a log counts leaves out what they explain.
        width = 0 if stays and alone else 2 * part.log.position.shape[1]
        return cls(part, numerics, replay, *_measured(part, on), stays, width, noise=noise)

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

    def with_longer_delay(self) -> _Output:
        """Return the output with a simulation that keeps twice as many past commands."""
        numerics = replace(self.numerics, longest_delay=2 * self.numerics.longest_delay)
        replay = make_replay(self.part.machine, self.part.log, numerics)
        replay = replay if self.noise is None else self.noise.on(replay)
        return replace(self, numerics=numerics, replay=replay)


def _measured(part: Part, on: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the measured output of a log, and the factors of its residuals."""
    measured, counts = measured_output(part.machine, part.log, on)
    weight = np.tile(counts.astype(float), (len(measured), 1))
    if part.log.passive and on == "position":
        # A free motion ends at rest, where one rounding error stands in every reading.
        weight = weight * rounded_readings(part.machine, part.log)
    return measured, weight


@dataclass(frozen=True)
class _End:
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


@dataclass(frozen=True)
class _Fit:
    """A fit of one log or of several.

    Args:
        machine: Machine of all logs at the start of the fit.
        outputs: The outputs that are compared.
        on: Kind of the outputs, one of `jaxid.names.OUTPUTS`.
        minimiser: A solver of optimistix for one log, or its name; None: jaxid's.
        tolerance: Part of the cost by which a fit of several logs has converged.
    """

    machine: Machine
    outputs: tuple[_Output, ...]
    on: str
    minimiser: str | Minimiser | None = None
    tolerance: float = _TOLERANCE

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

    def changed(self, outputs: Sequence[_Output]) -> _Fit:
        """Return the fit with other outputs."""
        return replace(self, outputs=tuple(outputs))

    def steps(
        self,
        theta: np.ndarray,
        starts: np.ndarray | None = None,
        weights: np.ndarray | None = None,
        active: np.ndarray | None = None,
    ) -> Steps[_End]:
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
        return SolveRequest(_fit, (*problem, transform, self.bounds, self.on, active, solver))

    def _alone(self, theta: np.ndarray, starts: np.ndarray, active: np.ndarray) -> Steps[_End]:
        [output] = self.outputs
        minimum = yield self.alone_at(np.concatenate([theta, starts]), active)
        e = np.asarray(minimum.residual).reshape(output.measured.shape)
        jacobian = np.asarray(minimum.jacobian).reshape(*e.shape, -1)
        p, values = self.unknowns, np.asarray(minimum.theta)
        rows = [Rows(jacobian, e, output.counts, output.signal)]
        failure = _failure(minimum, self.minimiser)
        ended = (np.ones(1), bool(minimum.converged), failure, int(minimum.steps))
        return _End(values[:p], values[p:], theta, float(minimum.cost), rows, *ended)

    def _together(
        self, theta: np.ndarray, starts: np.ndarray, active: np.ndarray, weights: np.ndarray | None
    ) -> Steps[_End]:
        scale, signals = Scale.of(self.machine, more=self.starts), [o.signal for o in self.outputs]
        if weights is None:
            weights = start_weights(signals, [int(o.counts.sum()) for o in self.outputs])

        def fit(x: np.ndarray, weights: np.ndarray) -> Steps[Descent]:
            def evaluate(x: np.ndarray) -> Steps[Model]:
                theta, starts = scale.outward(x)
                logs = yield from self._rows(theta, starts, signals, weights)
                return summed(logs, scale.slope(theta))

            options = {"tolerance": (self.tolerance, 0.0), "max_steps": _MOST, "active": active}
            return (yield from descent_steps(evaluate, x, scale.bounds, **options))

        x = scale.inward(theta, starts)
        descended = self._descended_unforced if self.unforced else descended_steps
        found, weights = yield from descended(fit, x, weights)
        model, finite = found.model, bool(np.isfinite(found.model.cost))
        failure = _DIVERGED if not finite else f"no convergence within {found.steps} steps"
        ended = (weights, found.converged and finite, failure, found.steps)
        return _End(*scale.outward(found.x), theta, model.cost, model.content, *ended)

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

    def noise_limited(self, logs: Sequence[Rows]) -> bool:
        """Check that what is left of every log is at most a few times the noise of its readings."""
        for output, log in zip(self.outputs, logs, strict=True):
            rms = np.sqrt(np.sum(np.square(log.residual)) / max(int(log.counts.sum()), 1))
            if rms > _NOISE_LIMITED * np.max(position_noise(output.part.machine, output.part.log)):
                return False
        return True

    def hessian(self, end: _End) -> Steps[np.ndarray]:
        """Compute the full Hessian of half the weighted sum of squares by the active unknowns."""
        p, q = end.theta.size, self.active.size
        out = np.zeros((q, q))
        for output, place, weight in zip(self.outputs, self.places, end.weights, strict=True):
            arguments = (*output.arguments(end.theta, end.starts[place]), self.on)
            own = np.asarray((yield SolveRequest(_hessian, arguments)))
            index = np.concatenate([output.part.index, p + np.arange(place.start, place.stop)])
            out[np.ix_(index, index)] += float(weight) * own
        return out[np.ix_(self.active, self.active)]


def output_error_steps(
    machine: Machine,
    log: Log | Sequence[Part],
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    solver: str | None = None,
    hessian: bool = False,
    profile: Sequence[str] = (),
    on: str = "position",
    minimiser: str | Minimiser | None = None,
    noise: ReadingNoise | None = None,
    tolerance: float = _TOLERANCE,
) -> Steps[Estimate]:
    """Run `output_error` as a generator of solve requests.

    Args:
        machine: Machine of all logs, with their unknowns.
        log: The log, or the parts of several.
        start, numerics, hessian, profile, on, minimiser: See `output_error`.
        solver: One of `jaxid.names.SOLVERS` for the chosen settings of the integration; None: fixed steps.
        noise: Noise of the encoder that the loop of a log alone is simulated with, whose mean readings are
            then compared; None: it is simulated without noise.
        tolerance: Part of the cost by which a fit of several logs has converged.

    Raises:
        InputError: Those of `output_error`; or a profile or a minimiser is asked for with several logs.
    """
    parts = [Part.alone(machine, log)] if isinstance(log, Log) else list(log)
    need_names(profile, machine.parameters.names)
    if len(parts) > 1 and (minimiser_of(minimiser) is not None or profile):
        what = "minimiser" if minimiser_of(minimiser) is not None else "profile"
        raise InputError(f"{what} goes with one log", hint=f"leave {what} out, or name one log")
    if on != "position":
        for part in parts:
            need_loop(part.machine, part.log, f"output_error on {on}", "or fit position")
            need_output_force(part.machine, part.log, on)
    elif parts[0].log.integrated:
        on = "velocity"
    if start is not None:
        machine = machine.with_estimate(start)
        parts = [replace(part, machine=part.at(start)) for part in parts]

    first = "position" if on == "both" else on
    fit = _Fit(machine, _outputs(parts, numerics, solver, first, noise), first, minimiser, tolerance)
    theta = machine.parameters.guess
    if machine.unknown_reference is not None:
        # With a wrong reference the machine's parameters would diverge: fit the reference's unknowns first.
        end = yield from fit.steps(theta, active=_of_course(machine, fit.active))
        theta = end.theta
    end = yield from fit.steps(theta)
    while numerics is None and any(o.forgets(end.theta) for o in fit.outputs):
        # Beyond the past commands that are kept a longer delay has no effect: keep more, and go on.
        fit = fit.changed([o.with_longer_delay() for o in fit.outputs])
        end = yield from fit.steps(end.theta, end.starts, end.weights)
    if on == "both":
        fit = yield from _on_both(fit, end)
        end = yield from fit.steps(end.theta, end.starts)
    fit, end = yield from _with_starts(fit, end)
    return (yield from _estimate(fit, end, hessian, profile))


def _outputs(
    parts: Sequence[Part],
    numerics: Numerics | None,
    solver: str | None,
    on: str,
    noise: ReadingNoise | None,
) -> tuple[_Output, ...]:
    """Return the outputs of all logs; one number of steps serves them, so that they share compiled code."""
    chosen = [numerics or choose_numerics(part.machine, part.log, solver=solver) for part in parts]
    most, alone = max(n.substeps for n in chosen), len(parts) == 1
    return tuple(
        _Output.of(part, replace(n, substeps=most), on, alone, noise)
        for part, n in zip(parts, chosen, strict=True)
    )


def _of_course(machine: Machine, active: np.ndarray) -> np.ndarray:
    """Return the mask of the unknowns of the reference."""
    own = np.zeros_like(active)
    own[: len(machine.parameters.free)] = [path[0] == REFERENCE for path, _ in machine.parameters.places]
    return own


def _on_both(fit: _Fit, end: _End) -> Steps[_Fit]:
    """Return the fit of position and force, each over the spread of its residual."""
    outputs = []
    for output, place in zip(fit.outputs, fit.places, strict=True):
        measured, weight = _measured(output.part, "both")
        output = replace(output, measured=measured, weight=weight)
        arguments = (*output.arguments(end.theta, end.starts[place]), "both")
        e = np.asarray((yield SolveRequest(_residual, arguments)))
        spread = np.maximum(np.std(e, axis=0), 1e-12 * np.std(measured, axis=0))
        outputs.append(replace(output, weight=weight / spread))
    return replace(fit, outputs=tuple(outputs), on="both")


def _with_starts(fit: _Fit, end: _End) -> Steps[tuple[_Fit, _End]]:
    """Free the starts of the logs for which that is right, and fit again.

    In open loop the start of a log is refitted to the fitted plant, and free if the residual is no larger
    than noise. In a loop it is free on a short log if that explains clearly more than chance; a longer one
    may begin with a jerk from rest, so that its first readings give no velocity.
    """
    outputs = []
    for output, log in zip(fit.outputs, end.logs, strict=True):
        part = output.part
        if output.numerics.segment:
            outputs.append(output)
        elif not output.looped:
            replay = with_fitted_start(output.replay, part.at(end.theta).plant, part.log)
            rms = np.sqrt(np.mean(np.square(log.residual)))
            noise = np.max(position_noise(part.machine, part.log))
            outputs.append(replace(output, replay=replay, start=bool(rms <= _NOISE_LIMITED * noise)))
        elif not output.stays:
            outputs.append(replace(output, start=True))
        else:
            shows = start_shows(log.residual[:, np.any(output.weight > 0, axis=0)])
            outputs.append(replace(output, replay=from_rest(output.replay)) if shows else output)
    if all(new is old for new, old in zip(outputs, fit.outputs, strict=True)):
        return fit, end

    freed, looped = fit.changed(outputs), any(o.looped for o in outputs)
    # A start that is free opens other valleys of a loop's cost: begin where the fit before did.
    again = looped and any(o.start for o in outputs)
    other = yield from freed.steps(end.begun if again else end.theta, end.starts, end.weights)
    if not looped:
        return freed, other

    # In a loop each log keeps what clearly explains it better.
    kept = []
    for old, new, before, after in zip(fit.outputs, outputs, end.logs, other.logs, strict=True):
        unknown = new.part.index.size + new.width
        spare = _CLEARLY * new.width / max(new.measured.size - unknown, 1) if new.start else 0.0
        better = np.sum(after.residual**2) * (1 + spare) < np.sum(before.residual**2)
        kept.append(new if better and other.converged else old)
    if all(a is b for a, b in zip(kept, outputs, strict=True)):
        return freed, other
    if all(a is b for a, b in zip(kept, fit.outputs, strict=True)):
        return fit, end
    fit = fit.changed(kept)
    starts = other.starts.copy()
    for output, place in zip(kept, fit.places, strict=True):
        starts[place] = starts[place] if output.start else 0.0
    return fit, (yield from fit.steps(other.theta, starts, other.weights))


def _estimate(fit: _Fit, end: _End, hessian: bool, profile: Sequence[str]) -> Steps[Estimate]:
    machine, active, p = fit.machine, fit.active, fit.unknowns
    names = [*machine.parameters.names, *[f"start {i}" for i in range(active.size - p)]]
    names = [name for name, moves in zip(names, active, strict=True) if moves]
    moving = [replace(log, jacobian=log.jacobian[..., active]) for log in end.logs]
    values = np.concatenate([end.theta, end.starts])
    x, full = values[active], (yield from fit.hessian(end)) if hessian else None
    precision = assess_together(names, moving, np.where(x != 0, x, 1.0), full, crossed=fit.on == "both")
    precision = precision.first(machine.parameters.names)

    details: dict[str, Any] = {}
    remarks = list(hessian_notes(precision, hessian))
    if profile:
        count = int(np.sum(fit.outputs[0].weight > 0))
        found = (values, end.cost, count, fit.bounds, active)
        details["profiles"], more = yield from profile_steps(fit.alone_at, found, machine, precision, profile)
        remarks += more
    theta = end.theta
    if len(moving) > 1:
        theta, precision, more = yield from _without_noise(fit, end, moving, precision)
        remarks += [*more, *disagreement(moving, int(active.sum()))]
        details |= by_log([o.part for o in fit.outputs], shares(end.logs))
    first = fit.outputs[0]
    notes = notes_of(first.part.machine, first.numerics, first.part.log, fit.on, fit.minimiser)
    return Estimate(
        method="output_error",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=end.converged,
        message="converged" if end.converged else end.failure,
        residual=np.concatenate([np.where(log.counts, log.residual, np.nan) for log in end.logs]),
        samples=sum(int(log.counts.sum()) for log in end.logs),
        steps=end.steps,
        notes=(*notes, *remarks),
        details=details | kept_delay(first.part.machine, first.numerics),
        std_misspecified=std_under_misspecification(*stacked(moving))[:p],
    )


def _without_noise(
    fit: _Fit, end: _End, moving: Sequence[Rows], precision: Precision
) -> Steps[tuple[np.ndarray, Precision, list[str]]]:
    """Remove the bias by noise that goes round the loop, and return estimates, precision and notes.

    It is a small part of the deviations of a log alone. Beside another log, in which something is known to
    differ, it is several of them in the directions that the difference separates.

    Args:
        fit, end: The fit and its end.
        moving: Residual of each log, with the columns of the unknowns that move.
        precision: Precision of the unknowns.
    """
    # No more than the readings show, whatever the case states.
    noise = [
        np.minimum(position_noise(o.part.machine, o.part.log), signals.high_band_std(o.part.log.readings))
        for o in fit.outputs
    ]
    if fit.unforced and not fit.noise_limited(end.logs):
        # Errors of the model move the estimates more, and hide how the noise does.
        return end.theta, precision, []
    looped = all(o.looped for o in fit.outputs) and not any(o.part.log.integrated for o in fit.outputs)
    if not looped or not end.converged or not any(np.any(std > 0) for std in noise):
        return end.theta, precision, []
    arguments = [o.arguments(end.theta, end.starts[p]) for o, p in zip(fit.outputs, fit.places, strict=True)]
    shift = yield from shift_steps(list(zip(arguments, noise, moving, strict=True)), fit.on)
    p, seen = fit.unknowns, precision.identifiable
    if not np.all(np.isfinite(shift.step)) or not np.any(seen):
        return end.theta, precision, []
    step = np.where(seen, shift.step[:p], 0.0)
    theta = np.clip(end.theta + step, *fit.machine.parameters.bounds)
    most = float(np.max(np.abs(step[seen]) / precision.std[seen]))
    note = (
        "the noise of the readings goes round the loop: its effect on the estimates, at most "
        f"{most:.2g} standard deviations, was simulated and removed"
    )
    precision = replace(precision, covariance=precision.covariance + shift.covariance[:p, :p])
    return theta, precision, [note]


def _pooled(logs: Sequence[Rows]) -> np.ndarray:
    """Return one over the mean square of all residuals, as the weight of each log."""
    squares = sum(float(np.sum(np.square(log.residual))) for log in logs)
    return np.full(len(logs), sum(int(log.counts.sum()) for log in logs) / max(squares, 1e-300))


def _failure(minimum: Minimum, minimiser: str | Minimiser | None) -> str:
    if not np.isfinite(float(minimum.cost)):
        return _DIVERGED
    if minimum.failure is not None:
        return failure_text(minimum, minimiser_name(minimiser))
    return f"no convergence within {int(minimum.steps)} steps"
