"""Trajectories along which a machine's forces tell its unknowns best, found without simulating the loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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

# Samples for each period of the fastest harmonic while a trajectory is sought, and room for peaks in between.
_FINE, _ROOM = 20, 0.02
# Trajectories that are drawn, those of them that are improved, and evaluations for each.
_DRAWN, _IMPROVED, _EVALUATIONS = 20, 2, 150
# Width of the smoothed sign over the largest speed: sharper, dry friction has no slope between the samples.
_SHARPNESS = 0.03
# Weight of a force beyond its limit, from this part of it on.
_STERN, _FROM = 100.0, 0.95


@dataclass(frozen=True)
class Excitation:
    """A trajectory, and what is expected of a log along it.

    Args:
        machine: The machine at the guesses.
        time: Ticks [s].
        position, velocity, acceleration: At the ticks, (ticks, n).
        force: That it takes there at the guesses [N or N m], (ticks, n).
        criterion: What was improved: "determinant" or "condition".
        condition: Condition number of the regressor, its columns normed: of the best of the trajectories that
            were drawn, and of this one.
        nats: Logarithm of the root of the information's determinant above that of the same one.
        identified: Names of the unknowns that it counts; any others are sums of these in every motion.
        std: Standard deviations to expect of these, (told,); None where the noise of the force is not known,
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
    std: Float[np.ndarray, " told"] | None

    signal = "reference"

    @property
    def values(self) -> Float[np.ndarray, "ticks n"]:
        """Of the signal: the positions."""
        return self.position

    def csv(self) -> str:
        """Time and positions as `[reference] kind = "csv"` takes them, every digit kept."""
        return signal_csv(self.signal, self.time, self.position)

    def save(self, path: str | Path) -> Path:
        """Write them as CSV, whole or not at all."""
        write_whole(Path(path), self.csv())
        return Path(path)

    def __str__(self) -> str:
        lines = []
        if self.std is not None:
            width = max(map(len, self.identified))
            lines.append(f"{'parameter':<{width}}  expected standard deviation")
            lines += [f"{n:<{width}}  {s:.3g}" for n, s in zip(self.identified, self.std, strict=True)]
        peaks = lambda x: ", ".join(f"{v:.3g}" for v in np.abs(x).max(axis=0))
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
    """Fourier series by joint, at rest where a period begins and within limits whatever the numbers are.

    Args:
        basis: Position, velocity and acceleration of the functions, (3, time, k).
        fine: Likewise over one period, as finely as its fastest harmonic asks: limits hold there, so that a
            trajectory is the same, and keeps to them, whatever the instants.
        low, high: Ends of the stroke, (n,).
        speed, acceleration: Largest ones, (n,); infinite where there is no limit.
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
        """A family at some instants; `bounds`: low, high, speed, acceleration."""
        k = np.arange(1, harmonics + 1)
        omega = 2 * np.pi * base_hz * k
        # Those sums that neither move nor push at the start.
        rest = np.zeros((2, 2 * harmonics))
        rest[0, :harmonics], rest[1, harmonics:] = 1.0, k
        kept = scipy.linalg.null_space(rest)

        def basis(time: np.ndarray) -> Array:
            s, c = np.sin(omega * time[:, None]), np.cos(omega * time[:, None])
            parts = ((s, c), (omega * c, -omega * s), (-(omega**2) * s, -(omega**2) * c))
            # Each harmonic at the same peak speed.
            return jnp.asarray(np.stack([np.hstack(x) / np.tile(k, 2) for x in parts]) @ kept)

        fine = basis(_instants(base_hz, harmonics))
        return cls(basis(time), fine, *(jnp.asarray(x, dtype=float) for x in bounds))

    @property
    def size(self) -> int:
        """How many numbers make a trajectory."""
        return self.low.size * (self.basis.shape[2] + 1)

    def __call__(self, p: Float[Array, " p"]) -> tuple[Array, Array, Array]:
        """Position, velocity, acceleration, (time, n) each, of weights by joint and then centres."""
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
    """One period, sampled for its fastest harmonic."""
    return np.arange(_FINE * harmonics) / (_FINE * harmonics * base_hz)


class _ReferenceProblem(eqx.Module):
    """What a trajectory is tried on."""

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
    """Find the trajectory whose log would tell a case's unknowns best, at its guesses, if it is followed.

    The regressor is the Jacobian of the balance along the trajectory. Fourier series within the stroke, speed
    and acceleration, at rest where a period begins and ends, are drawn; the best are improved by gradients of
    the condition number of the regressor, its columns normed, or of the logarithm of the determinant of the
    information (D-optimal). Rows are weighted by the noise of the force where it is known, else by its size.

    Args:
        case: It needs [simulation] duration and sample_rate and [limits] stroke and speed.
        progress: Called with a line at every stage.

    Raises:
        InputError: If the case lacks any of these, no force depends on an unknown, the plant cannot be in
            its stroke, or no trajectory keeps within the force.

    Source:
        Swevers et al. (1997), IEEE Trans. Robotics and Automation 13(5), for the series and the determinant;
        Gautier & Khalil (1992), IJRR 11(4), for the condition number. The start at rest is ours.
    """
    rate, duration = sampling_of(case)
    machine = build_machine(case, period=1 / rate)
    settings, where = case.design or DesignTable(), case.where
    base_hz, harmonics = settings.base_frequency_hz or 1 / duration, settings.harmonics
    if base_hz * duration < 1 - 1e-9:
        hint = f"leave it out, or lengthen [simulation] duration to {1.001 / base_hz:.4g} s"
        what = "base_frequency_hz has no whole period in the experiment"
        raise InputError(what, where=f"{where}, [design]", hint=hint)
    if 2 * base_hz * harmonics >= rate:
        raise InputError(
            f"harmonic {harmonics} is beyond half the sample_rate",
            where=f"{where}, [design]",
            hint="lower harmonics or base_frequency_hz",
        )
    n = case.plant.joints
    spread = lambda x, k=(): np.broadcast_to(np.asarray(x, float), (n, *k))
    low, high = spread(case.limits.stroke, (2,)).T
    speed = spread(case.limits.speed)
    bounds = (low, high, speed, spread(np.inf if settings.acceleration is None else settings.acceleration))
    plant = replace(machine.plant, velocity_scale=jnp.asarray(speed.max()), sharpness=jnp.asarray(_SHARPNESS))
    machine = machine.with_plant(plant, machine.parameters)
    time = _instants(base_hz, harmonics)
    series = _Series.within(time, base_hz, harmonics, bounds)
    largest_command = np.inf if case.limits.force is None else case.limits.force
    force = np.abs(machine.gain) * np.broadcast_to(largest_command, machine.gain.shape)
    noise = machine.sensor.force_noise
    known = noise is not None and bool(np.all(np.asarray(noise) > 0)) and plant.actuated is None
    p = len(machine.parameters.free)
    bench = _ReferenceProblem(
        plant,
        jnp.asarray(machine.parameters.guess),
        series,
        jnp.asarray(1.0 / (np.abs(machine.gain) * np.asarray(noise)) if known else np.ones(n)),
        jnp.ones(p),
        jnp.arange(p),
        jnp.asarray(force),
        time[1],
        machine.parameters.places,
        any(e.in_drive for e in plant.effects),
        settings.criterion,
    )
    progress("drawing trajectories")
    draws = np.random.default_rng(0).normal(size=(_DRAWN, series.size))
    bench = _scaled(bench, draws, known, where)
    value = lambda p: tuple(np.asarray(x) for x in _loss(jnp.asarray(p), bench))
    both = lambda p: _sound(*value(p))
    valued = [both(p) for p in draws]
    ranked = sorted(range(_DRAWN), key=lambda k: valued[k][0])
    found = []
    for k in ranked[:_IMPROVED]:
        progress("improving the most telling")
        found.append(improved(both, draws[k], valued[k], _EVALUATIONS))
    best = min(found, key=lambda f: f[0])[1]
    ticks = np.arange(round(duration * rate)) / rate
    whole = eqx.tree_at(
        lambda b: (b.series, b.period), bench, (_Series.within(ticks, base_hz, harmonics, bounds), 1 / rate)
    )
    return _judged(whole, machine, ticks, (draws[ranked[0]], best), known, where)


def _scaled(bench: _ReferenceProblem, draws: np.ndarray, known: bool, where: str) -> _ReferenceProblem:
    """With columns of norm one, none that depends on others, and rows of like size if no noise is known.

    On the first of some trajectories that the plant can follow.

    Raises:
        InputError: If it can follow none, or no column is left.
    """
    forces = ((p, np.asarray(_along(bench, jnp.asarray(p))[1])) for p in draws)
    p, force = next(((p, f) for p, f in forces if np.all(np.isfinite(f))), (None, None))
    if p is None:
        raise _out_of_reach(where)
    if not known:
        size = np.sqrt(np.mean(force**2, axis=0))
        size = np.where(size > 1e-9 * size.max(), size, size.max() or 1.0)
        bench = eqx.tree_at(lambda b: b.weight, bench, jnp.asarray(1.0 / size))
    j = np.asarray(_along(bench, jnp.asarray(p))[0])
    norm = np.linalg.norm(j, axis=0)
    chosen = independent(j / np.where(norm > 1e-9 * norm.max(), norm, np.inf), range(j.shape[1]))
    if not chosen:
        hint = "let one be unknown that moves or resists, as [plant] stands"
        raise InputError("no force depends on what is unknown", where=where, hint=hint)
    values = (jnp.asarray(norm[chosen]), jnp.asarray(chosen))
    return eqx.tree_at(lambda b: (b.scale, b.columns), bench, values)


def _out_of_reach(where: str) -> InputError:
    what = "trajectories meet positions that the plant cannot be in"
    return InputError(what, where=f"{where}, [limits]", hint="narrow stroke")


@eqx.filter_jit
def _along(bench: _ReferenceProblem, p: Array) -> tuple[Array, Array, tuple]:
    """Regressor over the noise, (time n, unknowns), force (time, n), and motion of some numbers."""
    motion = bench.series(p)

    def force(theta: Array, u: Array) -> Array:
        plant = scatter(bench.places, bench.plant, theta)
        return balance_along(plant, *motion, u, jnp.asarray(bench.period))[0]

    none = jnp.zeros((motion[0].shape[0], bench.force.size))
    needed = force(bench.theta, none)
    u = bench.plant.at_drives(needed) if bench.driven else none
    j = jax.jacfwd(lambda theta: force(theta, u))(bench.theta) * bench.weight[:, None]
    return j.reshape(-1, bench.theta.size), needed, motion


@eqx.filter_jit
def _loss(p: Array, bench: _ReferenceProblem) -> tuple[Array, Array]:
    """The criterion and what it costs to come near the limit of the force, with the slope."""

    def of(p: Array) -> Array:
        j, force, _ = _along(bench, p)
        j = j[:, bench.columns] / bench.scale
        near = largest(jnp.abs(bench.plant.at_drives(force))) / bench.force
        beyond = jnp.sum(jnp.square(jax.nn.relu(near - _FROM) / (1 - _FROM)))
        value = _condition(j) if bench.criterion == "condition" else -0.5 * jnp.linalg.slogdet(j.T @ j)[1]
        return value + _STERN * beyond

    return jax.value_and_grad(of)(p)


def _condition(j: Array) -> Array:
    """Logarithm of the condition number of a matrix whose columns are normed."""
    j = j / jnp.linalg.norm(j, axis=0)
    values = jnp.linalg.eigvalsh(j.T @ j)
    return 0.5 * (jnp.log(values[-1]) - jnp.log(jnp.maximum(values[0], 1e-300)))


def _sound(value: np.ndarray, slope: np.ndarray) -> tuple[float, np.ndarray]:
    good = np.isfinite(value) & np.all(np.isfinite(slope))
    return (float(value), slope) if good else (1e6, np.zeros_like(slope))


def _judged(
    bench: _ReferenceProblem,
    machine: Machine,
    ticks: np.ndarray,
    numbers: tuple[np.ndarray, np.ndarray],
    known: bool,
    where: str,
) -> Excitation:
    """The trajectory at the rate of the log, beside the one that it began from.

    Raises:
        InputError: If it takes more than the force, or meets positions that the plant cannot be in.
    """
    told, logdets, condition = [], [], []
    for p in numbers:
        j, force, motion = _along(bench, jnp.asarray(p))
        j, force = np.asarray(j)[:, np.asarray(bench.columns)], np.asarray(force)
        told.append(j)
        scaled = j / np.asarray(bench.scale)
        with np.errstate(invalid="ignore"):
            logdets.append(np.linalg.slogdet(scaled.T @ scaled)[1])
        condition.append(float(np.exp(_condition(jnp.asarray(j)))))
    if not np.all(np.isfinite(told[1])):
        raise _out_of_reach(where)
    over = np.abs(np.asarray(bench.plant.at_drives(force))).max(axis=0) > np.asarray(bench.force)
    if np.any(over):
        what = f"every trajectory takes more than the force of drive {int(np.argmax(over)) + 1}"
        hint = "raise force, or lower speed and acceleration"
        raise InputError(what, where=f"{where}, [limits]", hint=hint)
    names = machine.parameters.names
    std = np.sqrt(np.diag(np.linalg.inv(told[1].T @ told[1]))) if known else None
    return Excitation(
        machine,
        ticks,
        *(np.asarray(x) for x in motion),
        force,
        bench.criterion,
        tuple(condition),
        0.5 * (logdets[1] - logdets[0]),
        tuple(names[int(k)] for k in bench.columns),
        std,
    )
