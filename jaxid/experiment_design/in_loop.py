"""The experiment that tells a case's unknowns best, by the information that its log would hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.build import build_machine
from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.estimators.within_prior.fit import expected_steps
from jaxid.estimators.within_prior.prior import Prior
from jaxid.estimators.within_prior.problem import Problem, residual_of, with_sensor
from jaxid.estimators.within_prior.rounding import rounds
from jaxid.experiment_design.improve import improved
from jaxid.experiment_design.limits import LimitCost, Limits, Peaks, kept_within
from jaxid.experiment_design.shapes import Shapes, basis
from jaxid.files import signal_csv, write_whole
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics.lanes import run_alone
from jaxid.scene import refuse_impossible, sampling_of
from jaxid.schema import stated
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import Drive, needed_substeps
from jaxid.simulation.replay import Replay

# Relative width of the guesses where the case states none.
_PRIOR = 0.5
# A tour reaches its speed within this part of the stroke; sines go up to this part of the rate.
_RUN_UP, _FASTEST = 0.02, 0.1
# Starts that are improved, of those that tell most, and evaluations for each.
_IMPROVED, _EVALUATIONS = 2, 25
# Of the controller's own limit: what saturates is no longer in the loop.
_UNSATURATED = 0.95
_BEYOND = 1e6
# Weight of what goes beyond a limit beside the information.
_STERN = 100.0
# Steps between two ticks: what a design costs grows with them, what it gains does not.
_STEPS = 8
# Sharpness at which an experiment is designed: friction that sticks exactly has no slope in the reference.
_SHARPNESS = 0.1


@dataclass(frozen=True)
class Design:
    """An experiment, and what is expected of it.

    Args:
        machine: The machine at the guesses.
        signal: "reference" or "input".
        time: Ticks [s].
        values: Of the signal, (ticks, m).
        std: Standard deviations that are expected, in parts of the guess (of what may be zero: physical over
            the guess), (p,); what the guesses say included.
        plain: The same of a tour from end to end at several speeds.
        nats: Information gained over the guesses, of the design and of the tour.
        limits: What it keeps to.
        peaks: How far the machine goes.
    """

    machine: Machine
    signal: str
    time: Float[np.ndarray, " ticks"]
    values: Float[np.ndarray, "ticks m"]
    std: Float[np.ndarray, " p"]
    plain: Float[np.ndarray, " p"]
    nats: tuple[float, float]
    limits: Limits
    peaks: Peaks

    def csv(self) -> str:
        """Time and signal as `[reference] kind = "csv"` (or `[input]`) takes them, every digit kept."""
        return signal_csv(self.signal, self.time, self.values)

    def save(self, path: str | Path) -> Path:
        """Write the signal as CSV, whole or not at all."""
        write_whole(Path(path), self.csv())
        return Path(path)

    def __str__(self) -> str:
        names = self.machine.parameters.names
        width = max(len("parameter"), *map(len, names))
        lines = [f"{'parameter':<{width}}  expected  tour      (relative standard deviation)"]
        for name, std, plain in zip(names, self.std, self.plain, strict=True):
            lines.append(f"{name:<{width}}  {std:<8.2%}  {plain:<8.2%}")
        lines.append(
            f"{self.nats[0]:.1f} nats over the guesses, the tour {self.nats[1]:.1f}; "
            f"{self.time[-1]:.3g} s, speed up to {_shown(self.peaks.speed)}, "
            f"command up to {_shown(self.peaks.force)}"
        )
        return "\n".join(lines)


def _shown(values: np.ndarray) -> str:
    return ", ".join(f"{v:.3g}" for v in np.ravel(values))


def design_in_loop(case: Case, progress: Callable[[str], None]) -> Design:
    """Find the signal with the largest information determinant, by gradients through the simulation.

    Args:
        case: The case, with what `jaxid.design` asks of it.
        progress: Called with a line at every stage.

    Raises:
        InputError: If no experiment keeps within the limits.
    """
    bench = _DesignProblem.of(case)
    progress("looking at sines and tours")
    both = lambda p: _valued(bench, p)
    # Within the limits from the beginning: what breaks them is led back to them, not to what tells most.
    starts = [p for p in map(bench.within, bench.starts) if p is not None]
    if not starts:
        raise InputError(
            "no experiment within the limits was found",
            where=f"{case.where}, [limits]",
            hint="widen them, or check the loop's gains: the machine went beyond whatever it was asked",
        )
    known = [both(p) for p in starts]
    ranked = sorted(range(len(starts)), key=lambda k: known[k][0])[:_IMPROVED]
    found = []
    for k in ranked:
        progress("improving the most telling")
        found.append(improved(both, starts[k], known[k], _EVALUATIONS)[1])
    progress("expecting what each will tell")
    kept = [p for p in (*starts, *map(bench.within, found)) if p is not None]
    return bench.designed([bench.shapes.signal(p) for p in kept])


@dataclass(frozen=True)
class _DesignProblem:
    """What a design is tried on."""

    machine: Machine
    replay: Replay
    weight: np.ndarray
    own: np.ndarray
    prior: Prior
    on: str
    limits: Limits
    shapes: Shapes
    starts: list[np.ndarray]

    @classmethod
    def of(cls, case: Case) -> _DesignProblem:
        rate, duration = sampling_of(case)
        machine = build_machine(case, period=1 / rate)
        limits = _limits(case, machine)
        period = machine.hold_period or 1 / rate
        every = max(1, round(1 / (rate * period)))
        ticks = (round(duration * rate) - 1) * every + 1
        speed = float(limits.speed.max())
        plant = replace(machine.plant, velocity_scale=np.asarray(speed), sharpness=np.asarray(_SHARPNESS))
        machine = machine.with_plant(plant, machine.parameters)
        shapes, starts = _family(machine, limits, ticks, period)
        m, n = machine.gain.size, case.plant.joints
        looped = machine.controller is not None
        drive = Drive(machine.gain, period, "zero_order", 1, True)
        none = np.zeros((ticks, m))
        start, undisturbed = np.broadcast_to(case.simulation.initial_position, n), np.zeros((ticks, 1))
        refuse_impossible(plant, start[None], f"{case.where}, [simulation] initial_position")
        inputs = (none, undisturbed, None) if looped else (None, None, none)
        # While an experiment is sought the command may go beyond: a cost without slope leads nowhere.
        free = machine.controller
        if looped and free.limit is not None:
            free = replace(free, limit=_BEYOND * jnp.asarray(free.limit))
        state = (start.astype(float), np.zeros(n))
        replay = Replay(drive, free, Sensor(), *inputs, *state, None, every, np.eye(n))
        q = jnp.asarray(replay.position)[None]
        steps = min(needed_substeps(plant, drive, q, jnp.zeros_like(q), jnp.zeros((1, m))), _STEPS)
        replay = replace(replay, drive=replace(drive, substeps=steps))
        on = (case.within_prior or case.output_error).on
        width = _PRIOR if case.within_prior is None else case.within_prior.prior
        prior = Prior.of(machine, width, np.zeros(0))
        bench = cls(machine, replay, np.zeros(0), np.zeros(0), prior, on, limits, shapes, starts)
        own, whole = _noises(case, bench)
        return replace(bench, weight=np.tile(1.0 / whole, (len(range(0, ticks, every)), 1)), own=own / whole)

    def run(self, signal: Array, sensor: Sensor | None = None) -> Replay:
        """The machine under a signal."""
        replay = self.replay if sensor is None else with_sensor(self.replay, sensor)
        return _under(replay, self.machine.plant, jnp.asarray(signal))

    def peaks(self, signal: np.ndarray) -> Peaks:
        """How far it goes."""
        run = _trajectory(self.run(signal), self.machine.plant)
        return Peaks.of(*(np.asarray(x) for x in (run.position, run.velocity, run.command)))

    def within(self, p: np.ndarray) -> np.ndarray | None:
        """Some numbers, at the largest amplitude at which the machine keeps to its limits."""
        kept = kept_within(self.limits, self.shapes, p, self.peaks)
        return None if kept is None else kept[0]

    def expected(self, signal: np.ndarray) -> np.ndarray:
        """Covariance of the unknowns that a signal's log will leave, in units of the prior, (p, p).

        Where readings round, that which is found of a log simulated at the guesses: see `through_rounding`.
        """
        problem = Problem(
            _under(self.replay, self.machine.plant, jnp.asarray(signal)),
            self.machine.parameters.places,
            self.machine.plant,
            np.zeros(self.weight.shape),
            self.weight,
            self.prior,
            self.on,
            (np.asarray(self.machine.plant.sharpness),),
            tuple(range(self.replay.position.size)),
        )
        if not rounds(self.machine, problem):
            information = np.asarray(_information(*self.args(), jnp.asarray(signal)))
            return np.linalg.inv(np.eye(len(information)) + information)
        return run_alone(expected_steps(self.machine, problem, self.own))

    def args(self) -> tuple:
        """For the compiled functions."""
        unknown = self.machine.parameters
        return (self.replay, unknown.places, self.machine.plant, self.weight, self.prior, self.on)

    def designed(self, signals: list[np.ndarray]) -> Design:
        """The most telling of some signals with what is expected of it, beside the first."""
        left = [self.expected(x) for x in signals]
        gained = [-0.5 * float(np.linalg.slogdet(covariance)[1]) for covariance in left]
        best = int(np.argmax(gained))
        std = [np.sqrt(np.diag(left[k])) * self.relative for k in (best, 0)]
        signal = signals[best]
        time = float(self.replay.drive.period) * np.arange(len(signal))
        name = "reference" if self.replay.controller is not None else "input"
        nats = (gained[best], gained[0])
        return Design(self.machine, name, time, signal, *std, nats, self.limits, self.peaks(signal))

    @property
    def relative(self) -> np.ndarray:
        """A prior as a part of its guess."""
        return np.where(self.prior.log, 1.0, 1.0 / np.abs(self.prior.base)) * self.prior.scale


def _limits(case: Case, machine: Machine) -> Limits:
    """The limits that a case states; the command's is within the controller's where it states none."""
    table, n, m = case.limits, case.plant.joints, machine.gain.size
    low, high = np.broadcast_to(np.asarray(table.stroke, float), (n, 2)).T
    own = None if machine.controller is None else machine.controller.limit
    force = table.force
    if force is None:
        force = np.inf if own is None else _UNSATURATED * np.asarray(own)
    if machine.controller is None and table.force is None:
        raise InputError("[limits] has no force", where=case.where, hint="add force = ... to [limits]")
    return Limits(
        np.array(low),
        np.array(high),
        np.broadcast_to(np.asarray(table.speed, float), n).astype(float),
        np.broadcast_to(force, m).astype(float),
        tuple(stated(table)),
    )


def _family(machine: Machine, limits: Limits, ticks: int, period: float) -> tuple[Shapes, list[np.ndarray]]:
    """Signals within the limits, and where to start: the tour first."""
    speed, looped = float(limits.speed.max()), machine.controller is not None
    if looped:
        ends = (limits.low, limits.high, limits.speed * period)
        low, high, step = (machine.plant.at_drives(x) for x in ends)
    else:
        low, high, step = -limits.force, limits.force, np.full(limits.force.shape, np.inf)
    stroke = float((high - low).max())
    pace = speed if looped else 20 * stroke / (ticks * period)
    hardest = pace**2 / (_RUN_UP * stroke)
    fastest = min(hardest / (2 * np.pi * pace), _FASTEST / period)
    functions, weights = basis(ticks, period, fastest, (stroke, pace, hardest), None)
    shapes = Shapes.within(functions, low, high, step)
    return shapes, [shapes.numbers(w) for w in weights]


def _noises(case: Case, bench: _DesignProblem) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Of what is compared: that of its own, and with what rounding does in the loop to the command."""
    sensor, n, m = bench.machine.sensor, case.plant.joints, bench.machine.gain.size
    std: list[np.ndarray] = []
    more = np.zeros(0)
    if bench.on in ("position", "both"):
        if sensor.position_std is None:
            raise _no_noise(case, "position", "position_noise or position_resolution")
        std.append(np.broadcast_to(np.asarray(sensor.position_std), n))
        more = np.zeros(n)
    if bench.on in ("force", "both"):
        if sensor.force_noise is None:
            raise _no_noise(case, "force", "force_noise")
        signal = bench.shapes.signal(bench.starts[0])
        runs = (_trajectory(bench.run(signal, s), bench.machine.plant) for s in (sensor, Sensor()))
        rounded, exact = (np.asarray(run.command) for run in runs)
        through = np.sqrt(np.mean((rounded - exact) ** 2, axis=0))
        own = np.broadcast_to(np.asarray(sensor.force_noise), m)
        std.append(np.abs(bench.machine.gain) * own)
        more = np.concatenate([more, np.abs(bench.machine.gain) * through])
    own = np.concatenate(std)
    return own, np.hypot(own, more)


def _no_noise(case: Case, what: str, key: str) -> InputError:
    return InputError(
        f"the noise of the {what} is not known",
        where=f"{case.where}, [sensor]",
        hint=f"add {key}: without it no experiment is better than another",
    )


def _under(replay: Replay, plant: Plant, signal: Array) -> Replay:
    """A run under a signal, from rest at its first value in a loop."""
    if replay.controller is None:
        return replace(replay, command=signal)
    start = jnp.asarray(replay.position)
    driven = jnp.asarray(plant.driven(start.size))
    return replace(replay, reference=signal, position=start.at[driven].set(signal[0]))


_trajectory = eqx.filter_jit(lambda replay, plant: replay(plant))


def _sensitivity(
    replay: Replay, places: tuple, plant: Plant, weight: Array, prior: Prior, on: str, signal: Array
) -> Array:
    """Derivative of what is compared over its noise, in units of the prior, (rows, p)."""
    p, none = len(places), jnp.zeros(weight.shape)
    run = residual_of(_under(replay, plant, signal), places, plant, none, weight, prior, on, jnp.eye(p))
    return jax.jacfwd(run)(jnp.zeros(p)).reshape(-1, p)


@eqx.filter_jit
def _information(*args: Any) -> Array:
    j = _sensitivity(*args)
    return j.T @ j


@eqx.filter_jit
def _loss(p: Array, args: tuple, shapes: Shapes, bounds: LimitCost) -> tuple[Array, Array]:
    """Minus the information gained [nats] and what limits cost, with the slope."""
    replay, places, plant, _, prior, _ = args

    def of(p: Array) -> tuple[Array, Array]:
        signal = shapes(p)
        j = _sensitivity(*args, signal)
        gained = 0.5 * jnp.linalg.slogdet(jnp.eye(j.shape[1]) + j.T @ j)[1]
        here = scatter(places, plant, prior.base)
        value = -gained + _STERN * bounds.cost(_under(replay, plant, signal)(here))
        return value, value

    slope, value = jax.jacfwd(of, has_aux=True)(p)
    return value, slope


def _valued(bench: _DesignProblem, p: np.ndarray) -> tuple[float, np.ndarray]:
    value, slope = _loss(jnp.asarray(p), bench.args(), bench.shapes, LimitCost.of(bench.limits))
    good = np.isfinite(value) & np.all(np.isfinite(slope))
    return (float(value), np.asarray(slope)) if good else (1e6, np.zeros_like(p))
