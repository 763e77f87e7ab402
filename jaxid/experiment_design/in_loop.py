"""Design the experiment in a loop that identifies a case's unknowns best, by the information of its log."""

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
from jaxid.estimators.within_prior.fit import expected_covariance_steps
from jaxid.estimators.within_prior.prior import Prior
from jaxid.estimators.within_prior.problem import Problem, WeightedResidual
from jaxid.estimators.within_prior.quantisation import omits_quantisation
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
from jaxid.simulation.replay import Replay, with_sensor

# Relative width of the guesses if the case states none.
PRIOR = 0.5
# A tour reaches its speed within this part of the stroke; sines go up to this part of the rate.
_RUN_UP, _FASTEST = 0.02, 0.1
# Number of most informative starts that are improved, and evaluations for each.
_IMPROVED, _EVALUATIONS = 2, 25
# Part of the controller's limit that the command may use: a saturated loop is open.
_UNSATURATED = 0.95
_BEYOND = 1e6
# Weight of the cost of limits beside the information.
_STERN = 100.0
# Integration steps between two ticks at most: more of them cost time, and the design does not improve.
_STEPS = 8
# Sharpness at which an experiment is designed: friction that sticks exactly has no gradient in the reference.
SHARPNESS = 0.1


@dataclass(frozen=True)
class Design:
    """An experiment, and its expected result.

    Args:
        machine: The machine at the guesses.
        signal: "reference" or "input".
        time: Ticks [s].
        values: The signal at the ticks, (ticks, m).
        std: Expected standard deviations relative to the guess, the prior included, (p,). For an unknown that
            may be zero: absolute deviation divided by the guess.
        plain: The same quantities for a tour from end to end at several speeds, (p,).
        nats: Information gained over the prior, by the design and by the tour [nats].
        limits: Limits within which the design keeps.
        peaks: Extremes of the motion.
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
        """Return time and signal as CSV for `[reference] kind = "csv"` or `[input]`, with every digit."""
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
            f"{self.time[-1]:.3g} s, speed up to {_formatted(self.peaks.speed)}, "
            f"command up to {_formatted(self.peaks.force)}"
        )
        return "\n".join(lines)


def _formatted(values: np.ndarray) -> str:
    """Format some numbers with three digits."""
    return ", ".join(f"{v:.3g}" for v in np.ravel(values))


def design_in_loop(case: Case, progress: Callable[[str], None]) -> Design:
    """Find the signal with the largest information determinant, by gradients through the simulation.

    Args:
        case: The case, with the tables that `jaxid.design` requires.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If no experiment keeps within the limits.
    """
    problem = LoopDesign.of(case)
    signals = informative_signals(problem, case.where, progress)
    progress("computing the expected precision of each")
    return problem.designed(signals)


def informative_signals(
    problem: LoopDesign,
    where: str,
    progress: Callable[[str], None],
    most: int = _IMPROVED,
    evaluations: int = _EVALUATIONS,
) -> list[Float[np.ndarray, "ticks m"]]:
    """Return signals within the limits: those from which the search starts, and those that it ends with.

    Args:
        problem: The design.
        where: The case, for messages.
        progress: Called with a line of text at every stage.
        most: Number of most informative starts that are improved.
        evaluations: Largest number of evaluations for each of them.

    Raises:
        InputError: If no experiment keeps within the limits.
    """
    progress("evaluating sines and tours")

    def both(p: np.ndarray) -> tuple[float, np.ndarray]:
        return _value_and_slope(problem, p)

    # Starts are within the limits: from outside a descent leads back to the limits, not to information.
    starts = [p for p in map(problem.within, problem.starts) if p is not None]
    if not starts:
        raise InputError(
            "no experiment within the limits was found",
            where=f"{where}, [limits]",
            hint="widen them, or check the loop's gains: every trial exceeded them, whatever its amplitude",
        )

    values = [both(p) for p in starts]
    ranked = sorted(range(len(starts)), key=lambda k: values[k][0])[:most]
    optima = []
    for k in ranked:
        progress("improving the most informative")
        optima.append(improved(both, starts[k], values[k], evaluations)[1])
    kept = [p for p in (*starts, *map(problem.within, optima)) if p is not None]
    return [problem.shapes.signal(p) for p in kept]


@dataclass(frozen=True)
class LoopDesign:
    """Machine, noise, prior and family of signals of a design.

    A signal of fewer rows than the loop has ticks is held for `replay.every` ticks.

    Args:
        machine: The machine at the guesses.
        replay: Run of the loop or the open drive, without its signal.
        weight: One over the noise of each compared column, rounding through the loop included, (rows, k).
        direct_share: Part of that noise that is not rounding through the loop, (k,).
        prior: Prior of the unknowns.
        on: Compared quantities: "position", "force" or "both".
        limits: Limits of the experiment.
        shapes: Family of signals.
        starts: Numbers of the signals from which a design starts.
        known: Information without the experiment, in units of the prior, (p, p); None: that of the prior.
    """

    machine: Machine
    replay: Replay
    weight: np.ndarray
    direct_share: np.ndarray
    prior: Prior
    on: str
    limits: Limits
    shapes: Shapes
    starts: list[np.ndarray]
    known: np.ndarray | None = None

    @classmethod
    def of(cls, case: Case) -> LoopDesign:
        rate, duration = sampling_of(case)
        machine = build_machine(case, period=1 / rate)
        limits = limits_of(case, machine)
        period = machine.hold_period or 1 / rate
        every = max(1, round(1 / (rate * period)))
        ticks = (round(duration * rate) - 1) * every + 1
        speed = float(limits.speed.max())
        plant = machine.plant.smoothed(np.asarray(SHARPNESS), np.asarray(speed))
        machine = machine.with_plant(plant, machine.parameters)
        shapes, starts = family(machine, limits, ticks, period)

        start = np.broadcast_to(case.simulation.initial_position, case.plant.joints)
        refuse_impossible(plant, start[None], f"{case.where}, [simulation] initial_position")
        width = PRIOR if case.within_prior is None else case.within_prior.prior
        problem = cls(
            machine=machine,
            replay=empty_replay(machine, start, ticks, period, every),
            weight=np.zeros(0),
            direct_share=np.zeros(0),
            prior=Prior.of(machine, width, np.zeros(0)),
            on=(case.within_prior or case.output_error).on,
            limits=limits,
            shapes=shapes,
            starts=starts,
        )
        # The noise depends on the loop: rounding passes through it.
        direct, whole = _noise_levels(case, problem)
        weight = np.tile(1.0 / whole, (len(range(0, ticks, every)), 1))
        return replace(problem, weight=weight, direct_share=direct / whole)

    def run(self, signal: Array, sensor: Sensor | None = None) -> Replay:
        """Return the run of the machine under a signal."""
        replay = self.replay if sensor is None else with_sensor(self.replay, sensor)
        return replayed_under(replay, self.machine.plant, jnp.asarray(signal))

    def peaks(self, signal: np.ndarray) -> Peaks:
        """Return the extremes of the motion under a signal."""
        run = _trajectory(at_every_tick(self.run(signal)), self.machine.plant)
        return Peaks.of(*(np.asarray(x) for x in (run.position, run.velocity, run.command)))

    def within(self, p: np.ndarray) -> np.ndarray | None:
        """Return numbers of a signal at the largest amplitude within the limits; None if there is none."""
        kept = kept_within(self.limits, self.shapes, p, self.peaks)
        return None if kept is None else kept[0]

    def expected(self, signal: np.ndarray) -> np.ndarray:
        """Return the expected covariance of the unknowns after a signal, in units of the prior, (p, p).

        If readings are quantised, it is that of a log simulated at the guesses: see `fit_with_quantisation`.
        """
        problem = Problem(
            replay=replayed_under(self.replay, self.machine.plant, jnp.asarray(signal)),
            places=self.machine.parameters.places,
            plant=self.machine.plant,
            measured=np.zeros(self.weight.shape),
            weight=self.weight,
            prior=self.prior,
            on=self.on,
            sharpnesses=(np.asarray(self.machine.plant.smoothing.sharpness),),
            encoders=tuple(range(self.replay.position.size)),
        )
        if not omits_quantisation(self.machine, problem):
            information = np.asarray(_information(*self.args(), jnp.asarray(signal)))
            return np.linalg.inv(np.eye(len(information)) + information)
        return run_alone(expected_covariance_steps(self.machine, problem, self.direct_share))

    def args(self) -> tuple:
        """Return the arguments of the compiled functions, in order."""
        unknown = self.machine.parameters
        return (self.replay, unknown.places, self.machine.plant, self.weight, self.prior, self.on)

    def designed(self, signals: list[np.ndarray]) -> Design:
        """Choose the most informative of some signals, with its expected precision and that of the first."""
        covariances = [self.expected(x) for x in signals]
        gained = [-0.5 * float(np.linalg.slogdet(covariance)[1]) for covariance in covariances]
        best = int(np.argmax(gained))
        std, plain = (np.sqrt(np.diag(covariances[k])) * self.relative for k in (best, 0))
        signal = signals[best]
        return Design(
            machine=self.machine,
            signal="reference" if self.replay.controller is not None else "input",
            time=float(self.replay.drive.period) * np.arange(len(signal)),
            values=signal,
            std=std,
            plain=plain,
            nats=(gained[best], gained[0]),
            limits=self.limits,
            peaks=self.peaks(signal),
        )

    @property
    def relative(self) -> np.ndarray:
        """Width of the prior relative to the guess, (p,)."""
        return np.where(self.prior.log, 1.0, 1.0 / np.abs(self.prior.base)) * self.prior.scale


def empty_replay(
    machine: Machine, start: np.ndarray, ticks: int, period: float, every: int, longest_delay: int = 0
) -> Replay:
    """Build the run of a machine from rest, with a signal of zeros.

    Args:
        machine: The machine at the guesses.
        start: Position at the start, (n,).
        ticks: Number of ticks of the signal.
        period: Time between ticks [s].
        every: Number of ticks in a sample of the log.
        longest_delay: Ticks of past command that are kept for delays.
    """
    n, m = start.size, machine.gain.size
    none = np.zeros((ticks, m))
    controller = machine.controller
    looped = controller is not None
    # The command may exceed the saturation during the search, since a saturated command has no gradient; the
    # cost of limits keeps it within.
    if controller is not None and controller.limit is not None:
        controller = replace(controller, limit=_BEYOND * jnp.asarray(controller.limit))
    drive = Drive(machine.gain, period, "zero_order", 1, True, longest_delay)
    replay = Replay(
        drive=drive,
        controller=controller,
        sensor=Sensor(),
        reference=none if looped else None,
        disturbance=np.zeros((ticks, 1)) if looped else None,
        command=None if looped else none,
        position=start.astype(float),
        velocity=np.zeros(n),
        restart=None,
        every=every,
        follow=np.eye(n),
    )
    q = jnp.asarray(replay.position)[None]
    steps = needed_substeps(machine.plant, drive, q, jnp.zeros_like(q), jnp.zeros((1, m)))
    return replace(replay, drive=replace(drive, substeps=min(steps, _STEPS)))


def limits_of(case: Case, machine: Machine) -> Limits:
    """Take the limits that a case states; a force that is not stated follows from the controller's limit."""
    table, n, m = case.limits, case.plant.joints, machine.gain.size
    if machine.controller is None and table.force is None:
        raise InputError("[limits] has no force", where=case.where, hint="add force = ... to [limits]")
    low, high = np.broadcast_to(np.asarray(table.stroke, float), (n, 2)).T
    saturation = None if machine.controller is None else machine.controller.limit
    force = table.force
    if force is None:
        force = np.inf if saturation is None else _UNSATURATED * np.asarray(saturation)
    return Limits(
        low=np.array(low),
        high=np.array(high),
        speed=np.broadcast_to(np.asarray(table.speed, float), n).astype(float),
        force=np.broadcast_to(force, m).astype(float),
        stated=tuple(stated(table)),
    )


def family(
    machine: Machine, limits: Limits, ticks: int, period: float, acceleration: np.ndarray | None = None
) -> tuple[Shapes, list[np.ndarray]]:
    """Build the family of signals within the limits, and the starts of the search: the tour first.

    Args:
        machine: The machine.
        limits: Limits of the experiment.
        ticks: Number of values of a signal.
        period: Time between two of them [s].
        acceleration: Largest acceleration of a reference by drive, (m,); None: no limit.
    """
    speed, looped = float(limits.speed.max()), machine.controller is not None
    if looped:
        ends = (limits.low, limits.high, limits.speed * period)
        low, high, step = (np.asarray(machine.plant.at_drives(x)) for x in ends)
    else:
        low, high, step = -limits.force, limits.force, np.full(limits.force.shape, np.inf)

    stroke = float((high - low).max())
    pace = speed if looped else 20 * stroke / (ticks * period)
    hardest = pace**2 / (_RUN_UP * stroke)
    if acceleration is not None:
        hardest = min(hardest, float(acceleration.max()))
    fastest = min(hardest / (2 * np.pi * pace), _FASTEST / period)
    functions, weights = basis(ticks, period, fastest, (stroke, pace, hardest), None)
    curve = None if acceleration is None else acceleration * period**2
    shapes = Shapes.within(functions, low, high, step, curve)
    return shapes, [shapes.numbers(w) for w in weights]


def _noise_levels(case: Case, problem: LoopDesign) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Compute the noise of each compared column, without and with rounding that passes through the loop."""
    sensor, n, m = problem.machine.sensor, case.plant.joints, problem.machine.gain.size
    std: list[np.ndarray] = []
    through_loop = np.zeros(0)
    if problem.on in ("position", "both"):
        if sensor.position_std is None:
            raise no_noise(case, "position", "position_noise or position_resolution")
        std.append(np.broadcast_to(np.asarray(sensor.position_std), n))
        through_loop = np.zeros(n)
    if problem.on in ("force", "both"):
        if sensor.force_noise is None:
            raise no_noise(case, "force", "force_noise")
        force_noise = np.broadcast_to(np.asarray(sensor.force_noise), m)
        std.append(np.abs(problem.machine.gain) * force_noise)

        # Rounded readings change the command: compare a run with the sensor to one without.
        signal = problem.shapes.signal(problem.starts[0])
        runs = (_trajectory(problem.run(signal, s), problem.machine.plant) for s in (sensor, Sensor()))
        rounded, exact = (np.asarray(run.command) for run in runs)
        change = np.sqrt(np.mean((rounded - exact) ** 2, axis=0))
        through_loop = np.concatenate([through_loop, np.abs(problem.machine.gain) * change])
    direct = np.concatenate(std)
    return direct, np.hypot(direct, through_loop)


def no_noise(case: Case, what: str, key: str) -> InputError:
    """Build the error of a case whose noise is not stated."""
    return InputError(
        f"the noise of the {what} is not known",
        where=f"{case.where}, [sensor]",
        hint=f"add {key}: without it no experiment is better than another",
    )


def replayed_under(replay: Replay, plant: Plant, signal: Array) -> Replay:
    """Return a run under a signal, from rest at its first value if it is a loop."""
    if replay.controller is None:
        return replace(replay, command=signal)
    assert replay.disturbance is not None, "a loop has one, which may be zero"
    ticks = replay.disturbance.shape[0]
    if signal.shape[0] < ticks:
        signal = jnp.repeat(signal, replay.every, axis=0)[:ticks]
    start = jnp.asarray(replay.position)
    driven = jnp.asarray(plant.driven(start.size))
    return replace(replay, reference=signal, position=start.at[driven].set(signal[0]))


def at_every_tick(replay: Replay) -> Replay:
    """Return a run with a row for every tick: a joint may be fastest between the rows of a log."""
    return replace(replay, every=1)


_trajectory = eqx.filter_jit(lambda replay, plant: replay(plant))


def _sensitivity(
    replay: Replay, places: tuple, plant: Plant, weight: Array, prior: Prior, on: str, signal: Array
) -> Array:
    """Differentiate the compared quantities over their noise, in units of the prior, (rows, p)."""
    p, none = len(places), jnp.zeros(weight.shape)
    compared = WeightedResidual(
        replay=replayed_under(replay, plant, signal),
        places=places,
        plant=plant,
        measured=none,
        weight=weight,
        prior=prior,
        on=on,
    )
    run = compared.along(jnp.eye(p))
    return jax.jacfwd(run)(jnp.zeros(p)).reshape(-1, p)


@eqx.filter_jit
def _information(*args: Any) -> Array:
    """Compute the information matrix of a signal in units of the prior, (p, p)."""
    j = _sensitivity(*args)
    return j.T @ j


@eqx.filter_jit
def _loss(
    p: Array, args: tuple, shapes: Shapes, bounds: LimitCost, known: Array | None
) -> tuple[Array, Array]:
    """Compute minus the information gained [nats] plus the cost of the limits, and the gradient."""
    replay, places, plant, weight, prior, on = args

    def of(p: Array) -> tuple[Array, Array]:
        signal = shapes(p)
        j = _sensitivity(replay, places, plant, weight, prior, on, signal)
        before = jnp.eye(j.shape[1]) if known is None else known
        gained = 0.5 * jnp.linalg.slogdet(before + j.T @ j)[1]
        here = scatter(places, plant, prior.base)
        whole = at_every_tick(replayed_under(replay, plant, signal))(here)
        value = -gained + _STERN * bounds.cost(whole)
        return value, value

    slope, value = jax.jacfwd(of, has_aux=True)(p)
    return value, slope


def _value_and_slope(problem: LoopDesign, p: np.ndarray) -> tuple[float, np.ndarray]:
    """Evaluate the loss of some numbers; a run that diverged gets the worst value and no direction."""
    value, slope = _loss(
        jnp.asarray(p), problem.args(), problem.shapes, LimitCost.of(problem.limits), problem.known
    )
    good = np.isfinite(value) & np.all(np.isfinite(slope))
    return (float(value), np.asarray(slope)) if good else (1e6, np.zeros_like(p))
