"""Design trajectories along which the forces identify the unknowns best, without simulation of the loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from jaxid.arms.base_parameters import independent
from jaxid.arrays import Array
from jaxid.build import build_machine
from jaxid.case.case import Case
from jaxid.dynamics.residuals import balance_along
from jaxid.errors import InputError
from jaxid.experiment_design.improve import improved
from jaxid.experiment_design.shapes import largest
from jaxid.files import signal_csv, write_whole
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.scene import sampling_of
from jaxid.settings import DesignTable

# Samples in each period of the fastest harmonic while a trajectory is sought, and room for peaks in between.
_FINE, _ROOM = 20, 0.02
# Number of trajectories that are drawn, number of them that are improved, and evaluations for each.
_DRAWN, _IMPROVED, _EVALUATIONS = 20, 2, 150
# Width of the smoothed sign relative to the largest speed: with a smaller width, dry friction has no gradient
# between the samples.
_SHARPNESS = 0.03
# Weight of a force near its limit, and the part of the limit at which the cost begins.
_STERN, _FROM = 100.0, 0.95


@dataclass(frozen=True)
class Excitation:
    """A trajectory, and the expected result of a log along it.

    Args:
        machine: The machine at the guesses.
        time: Ticks [s].
        position, velocity, acceleration: Motion at the ticks, (ticks, n).
        force: Force of the motion at the guesses [N or N m], (ticks, n).
        criterion: The criterion that was optimised, "determinant" or "condition".
        condition: Condition number of the regressor with columns of norm one, for the best of the drawn
            trajectories and for this one.
        nats: Gain over that drawn trajectory in half the logarithm of the information's determinant [nats].
        identified: Names of the unknowns in the regressor; others are linear combinations of these in every
            motion.
        std: Expected standard deviations of these, (identified,); None if the noise of the force is not known
            or zero.
    """

    machine: Machine
    time: Float[np.ndarray, " ticks"]
    position: Float[np.ndarray, "ticks n"]
    velocity: Float[np.ndarray, "ticks n"]
    acceleration: Float[np.ndarray, "ticks n"]
    force: Float[np.ndarray, "ticks n"]
    criterion: str
    condition: tuple[float, float]
    nats: float
    identified: tuple[str, ...]
    std: Float[np.ndarray, " identified"] | None

    signal = "reference"

    @property
    def values(self) -> Float[np.ndarray, "ticks n"]:
        """Values of the signal: the positions, (ticks, n)."""
        return self.position

    def csv(self) -> str:
        """Return time and positions as CSV text for `[reference] kind = "csv"`, with every digit."""
        return signal_csv(self.signal, self.time, self.position)

    def save(self, path: str | Path) -> Path:
        """Write time and positions as CSV, whole or not at all."""
        write_whole(Path(path), self.csv())
        return Path(path)

    def __str__(self) -> str:
        def peaks(x: np.ndarray) -> str:
            return ", ".join(f"{v:.3g}" for v in np.abs(x).max(axis=0))

        lines = []
        if self.std is not None:
            width = max(map(len, self.identified))
            lines.append(f"{'parameter':<{width}}  expected standard deviation")
            lines += [f"{n:<{width}}  {s:.3g}" for n, s in zip(self.identified, self.std, strict=True)]
        lines.append(
            f"condition number {self.condition[1]:.4g}, of the best that was drawn {self.condition[0]:.4g}; "
            f"{self.nats:.1f} nats more than that one; {len(self.identified)} of "
            f"{len(self.machine.parameters.names)} unknowns counted"
        )
        lines.append(
            f"{self.time[-1]:.3g} s, speed up to {peaks(self.velocity)}, acceleration up to "
            f"{peaks(self.acceleration)}, force up to {peaks(self.force)}"
        )
        return "\n".join(lines)


class _Series(eqx.Module):
    """Fourier series by joint, at rest at the start of a period and within limits for any numbers.

    Args:
        basis: Position, velocity and acceleration of the basis functions, (3, time, k).
        fine: The same over one period, at the instants that its fastest harmonic requires: limits are applied
            there, so that a trajectory does not depend on the instants of `basis`.
        low, high: Ends of the stroke, (n,).
        speed, acceleration: Largest magnitudes, (n,); infinite without a limit.
    """

    basis: Float[Array, "3 time k"]
    fine: Float[Array, "3 fine k"]
    low: Array
    high: Array
    speed: Array
    acceleration: Array

    @classmethod
    def within(
        cls, time: np.ndarray, base_hz: float, harmonics: int, bounds: tuple[np.ndarray, ...]
    ) -> _Series:
        """Build a family at some instants; `bounds` holds low, high, speed and acceleration."""
        k = np.arange(1, harmonics + 1)
        omega = 2 * np.pi * base_hz * k
        # Combinations with zero velocity and zero acceleration at the start.
        rest = np.zeros((2, 2 * harmonics))
        rest[0, :harmonics] = 1.0
        rest[1, harmonics:] = k
        kept = scipy.linalg.null_space(rest)

        def basis(time: np.ndarray) -> Array:
            s, c = np.sin(omega * time[:, None]), np.cos(omega * time[:, None])
            parts = ((s, c), (omega * c, -omega * s), (-(omega**2) * s, -(omega**2) * c))
            # Each harmonic has the same peak speed.
            return jnp.asarray(np.stack([np.hstack(x) / np.tile(k, 2) for x in parts]) @ kept)

        fine = basis(_instants(base_hz, harmonics))
        return cls(basis(time), fine, *(jnp.asarray(x, dtype=float) for x in bounds))

    @property
    def size(self) -> int:
        """Number of numbers that define a trajectory."""
        return self.low.size * (self.basis.shape[2] + 1)

    def __call__(self, p: Float[Array, " p"]) -> tuple[Array, Array, Array]:
        """Compute position, velocity and acceleration, (time, n) each, from weights by joint and centres."""
        n, k = self.low.size, self.basis.shape[2]
        weights = p[: n * k].reshape(n, k).T
        x, v, a = self.fine @ weights
        half = 0.5 * (self.high - self.low)
        centre = self.low + half * (1 + 0.8 * jnp.tanh(p[n * k :]))
        parts = (
            x / (self.high - centre),
            x / (self.low - centre),
            v / self.speed,
            -v / self.speed,
            a / self.acceleration,
            -a / self.acceleration,
        )
        scale = (1 - _ROOM) / largest(jnp.concatenate(parts))
        x, v, a = self.basis @ weights
        return centre + scale * x, scale * v, scale * a


def _instants(base_hz: float, harmonics: int) -> np.ndarray:
    """Return the instants of one period, sampled for its fastest harmonic."""
    return np.arange(_FINE * harmonics) / (_FINE * harmonics * base_hz)


class _ReferenceProblem(eqx.Module):
    """Plant, family of trajectories and weights of a design.

    Args:
        plant: The plant with smooth friction.
        theta: Unknowns at the guesses, (p,).
        series: Family of trajectories.
        weight: Weight of each joint's force, (n,).
        scale: Norms of the used columns of the regressor.
        columns: Indices of the unknowns whose columns are used.
        force: Largest force of each drive, (m,).
        period: Time between instants [s].
        places: Places of the unknowns in the plant.
        driven: Whether an effect depends on the command.
        criterion: "determinant" or "condition".
    """

    plant: Plant
    theta: Array
    series: _Series
    weight: Array
    scale: Array
    columns: Array
    force: Array
    period: float
    places: tuple = eqx.field(static=True)
    driven: bool = eqx.field(static=True)
    criterion: str = eqx.field(static=True)


def excite(case: Case, progress: Callable[[str], None] = lambda text: None) -> Excitation:
    """Find the trajectory whose log would identify a case's unknowns best, at its guesses, if it is followed.

    The regressor is the Jacobian of the balance along the trajectory. Fourier series within the stroke, speed
    and acceleration, at rest at both ends of a period, are drawn. The best are improved by gradients of the
    condition number of the regressor with columns of norm one, or of the logarithm of the determinant of the
    information (D-optimal). Rows are weighted by the noise of the force if it is known, else by its size.

    Args:
        case: A case with [simulation] duration and sample_rate and [limits] stroke and speed.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If the case lacks any of these, if no force depends on an unknown, if the plant cannot
            reach the stroke, or if no trajectory keeps within the force.

    Source:
        Swevers et al. (1997), IEEE Trans. Robotics and Automation 13(5), for the series and the determinant;
        Gautier & Khalil (1992), IJRR 11(4), for the condition number. The start at rest is ours.
    """
    where = case.where
    rate, duration = sampling_of(case)
    machine = build_machine(case, period=1 / rate)
    base_hz, harmonics = _frequencies(case, rate, duration)
    bounds = _bounds(case)
    plant = machine.plant.smoothed(jnp.asarray(_SHARPNESS), jnp.asarray(bounds[2].max()))
    machine = machine.with_plant(plant, machine.parameters)
    problem, known = _problem(case, machine, base_hz, harmonics, bounds)

    progress("drawing trajectories")
    draws = np.random.default_rng(0).normal(size=(_DRAWN, problem.series.size))
    problem = _with_scales(problem, draws, known, where)

    def both(p: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = _loss(jnp.asarray(p), problem)
        return _finite_or_worst(np.asarray(value), np.asarray(slope))

    values = [both(p) for p in draws]
    ranked = sorted(range(_DRAWN), key=lambda k: values[k][0])
    optima = []
    for k in ranked[:_IMPROVED]:
        progress("improving the most informative")
        optima.append(improved(both, draws[k], values[k], _EVALUATIONS))
    best = min(optima, key=lambda f: f[0])[1]

    # The result is sampled at the rate of the log.
    ticks = np.arange(round(duration * rate)) / rate
    sampled = (_Series.within(ticks, base_hz, harmonics, bounds), 1 / rate)
    whole = eqx.tree_at(lambda b: (b.series, b.period), problem, sampled)
    return _judged(whole, machine, ticks, (draws[ranked[0]], best), known, where)


def _frequencies(case: Case, rate: float, duration: float) -> tuple[float, int]:
    """Return the base frequency [Hz] and the number of harmonics of a case, and check that they fit."""
    settings, where = case.design or DesignTable(), f"{case.where}, [design]"
    base_hz, harmonics = settings.base_frequency_hz or 1 / duration, settings.harmonics
    if base_hz * duration < 1 - 1e-9:
        hint = f"leave it out, or lengthen [simulation] duration to {1.001 / base_hz:.4g} s"
        what = "base_frequency_hz has no whole period in the experiment"
        raise InputError(what, where=where, hint=hint)
    if 2 * base_hz * harmonics >= rate:
        what = f"harmonic {harmonics} is beyond half the sample_rate"
        raise InputError(what, where=where, hint="lower harmonics or base_frequency_hz")
    return base_hz, harmonics


def _bounds(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return low and high end of the stroke, speed and acceleration of a case, (n,) each."""
    n = case.plant.joints
    low, high = np.broadcast_to(np.asarray(case.limits.stroke, float), (n, 2)).T
    speed = np.broadcast_to(np.asarray(case.limits.speed, float), n)
    stated = (case.design or DesignTable()).acceleration
    acceleration = np.broadcast_to(np.asarray(np.inf if stated is None else stated, float), n)
    return low, high, speed, acceleration


def _problem(
    case: Case, machine: Machine, base_hz: float, harmonics: int, bounds: tuple[np.ndarray, ...]
) -> tuple[_ReferenceProblem, bool]:
    """Set up the design of a case, and return if the noise of the forces is known."""
    plant, gain = machine.plant, np.abs(machine.gain)
    time = _instants(base_hz, harmonics)
    largest_command = np.inf if case.limits.force is None else case.limits.force
    force = gain * np.broadcast_to(largest_command, machine.gain.shape)
    p = len(machine.parameters.free)
    weight, known = np.ones(case.plant.joints), False
    noise = machine.sensor.force_noise
    if noise is not None and np.all(np.asarray(noise) > 0) and plant.actuated is None:
        weight, known = 1.0 / (gain * np.asarray(noise)), True
    problem = _ReferenceProblem(
        plant=plant,
        theta=jnp.asarray(machine.parameters.guess),
        series=_Series.within(time, base_hz, harmonics, bounds),
        weight=jnp.asarray(weight),
        scale=jnp.ones(p),
        columns=jnp.arange(p),
        force=jnp.asarray(force),
        period=time[1],
        places=machine.parameters.places,
        driven=any(e.in_drive for e in plant.effects),
        criterion=(case.design or DesignTable()).criterion,
    )
    return problem, known


def _with_scales(problem: _ReferenceProblem, draws: np.ndarray, known: bool, where: str) -> _ReferenceProblem:
    """Choose independent columns, scale them to norm one, and weight rows by their size if no noise is known.

    The scales are those of the first of some trajectories that the plant can follow.

    Raises:
        InputError: If the plant can follow none, or no column is independent.
    """
    forces = ((p, np.asarray(_along(problem, jnp.asarray(p))[1])) for p in draws)
    first = next(((p, f) for p, f in forces if np.all(np.isfinite(f))), None)
    if first is None:
        raise _out_of_reach(where)
    p, force = first
    if not known:
        size = np.sqrt(np.mean(force**2, axis=0))
        size = np.where(size > 1e-9 * size.max(), size, size.max() or 1.0)
        problem = eqx.tree_at(lambda b: b.weight, problem, jnp.asarray(1.0 / size))
    j = np.asarray(_along(problem, jnp.asarray(p))[0])
    norm = np.linalg.norm(j, axis=0)
    chosen = independent(j / np.where(norm > 1e-9 * norm.max(), norm, np.inf), range(j.shape[1]))
    if not chosen:
        hint = "declare an unknown that moves or resists, in [plant] as it stands"
        raise InputError("no force depends on an unknown", where=where, hint=hint)
    values = (jnp.asarray(norm[chosen]), jnp.asarray(chosen))
    return eqx.tree_at(lambda b: (b.scale, b.columns), problem, values)


def _out_of_reach(where: str) -> InputError:
    """Build the error of a stroke that the plant cannot reach."""
    what = "trajectories meet positions that the plant cannot reach"
    return InputError(what, where=f"{where}, [limits]", hint="narrow stroke")


@eqx.filter_jit
def _along(problem: _ReferenceProblem, p: Array) -> tuple[Array, Array, tuple]:
    """Compute the weighted regressor, (time n, unknowns), force, (time, n), and motion of some numbers."""
    motion = problem.series(p)

    def force(theta: Array, u: Array) -> Array:
        plant = scatter(problem.places, problem.plant, theta)
        return balance_along(plant, *motion, u, jnp.asarray(problem.period))[0]

    none = jnp.zeros((motion[0].shape[0], problem.force.size))
    needed = force(problem.theta, none)
    u = problem.plant.at_drives(needed) if problem.driven else none
    j = jax.jacfwd(lambda theta: force(theta, u))(problem.theta) * problem.weight[:, None]
    return j.reshape(-1, problem.theta.size), needed, motion


@eqx.filter_jit
def _loss(p: Array, problem: _ReferenceProblem) -> tuple[Array, Array]:
    """Compute the criterion plus the cost of a force near its limit, and the gradient."""

    def of(p: Array) -> Array:
        j, force, _ = _along(problem, p)
        j = j[:, problem.columns] / problem.scale
        near = largest(jnp.abs(problem.plant.at_drives(force))) / problem.force
        beyond = jnp.sum(jnp.square(jax.nn.relu(near - _FROM) / (1 - _FROM)))
        value = _condition(j) if problem.criterion == "condition" else -0.5 * jnp.linalg.slogdet(j.T @ j)[1]
        return value + _STERN * beyond

    return jax.value_and_grad(of)(p)


def _condition(j: Array) -> Array:
    """Return the logarithm of the condition number of a matrix, its columns scaled to norm one."""
    j = j / jnp.linalg.norm(j, axis=0)
    values = jnp.linalg.eigvalsh(j.T @ j)
    return 0.5 * (jnp.log(values[-1]) - jnp.log(jnp.maximum(values[0], 1e-300)))


def _finite_or_worst(value: np.ndarray, slope: np.ndarray) -> tuple[float, np.ndarray]:
    """Replace the value of a diverged trajectory by the worst one, without direction."""
    good = np.isfinite(value) & np.all(np.isfinite(slope))
    return (float(value), slope) if good else (1e6, np.zeros_like(slope))


def _judged(
    problem: _ReferenceProblem,
    machine: Machine,
    ticks: np.ndarray,
    numbers: tuple[np.ndarray, np.ndarray],
    known: bool,
    where: str,
) -> Excitation:
    """Evaluate the trajectory at the rate of the log, and the one from which it began.

    Raises:
        InputError: If it exceeds the force, or meets positions that the plant cannot reach.
    """
    sensitivities, logdets, condition = [], [], []
    force, motion = None, None
    for p in numbers:
        j, force, motion = _along(problem, jnp.asarray(p))
        j, force = np.asarray(j)[:, np.asarray(problem.columns)], np.asarray(force)
        sensitivities.append(j)
        scaled = j / np.asarray(problem.scale)
        with np.errstate(invalid="ignore"):
            logdets.append(np.linalg.slogdet(scaled.T @ scaled)[1])
        condition.append(float(np.exp(_condition(jnp.asarray(j)))))
    assert force is not None, "two trajectories are given"
    assert motion is not None, "two trajectories are given"

    if not np.all(np.isfinite(sensitivities[1])):
        raise _out_of_reach(where)
    over = np.abs(np.asarray(problem.plant.at_drives(force))).max(axis=0) > np.asarray(problem.force)
    if np.any(over):
        what = f"every trajectory takes more than the force of drive {int(np.argmax(over)) + 1}"
        hint = "raise force, or lower speed and acceleration"
        raise InputError(what, where=f"{where}, [limits]", hint=hint)

    names = machine.parameters.names
    information = sensitivities[1].T @ sensitivities[1]
    position, velocity, acceleration = (np.asarray(x) for x in motion)
    return Excitation(
        machine=machine,
        time=ticks,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        force=force,
        criterion=problem.criterion,
        condition=(condition[0], condition[1]),
        nats=0.5 * (logdets[1] - logdets[0]),
        identified=tuple(names[int(k)] for k in problem.columns),
        std=np.sqrt(np.diag(np.linalg.inv(information))) if known else None,
    )
