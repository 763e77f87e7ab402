"""Break-away friction, looked for where it acts: in the moments in which an axis starts from rest.

Samples at rest carry no balance of forces, only a bound, so the search in the force domain cannot
see what acts there. Every start from rest is run again by itself, from the measured position at
rest and under the logged command; the level is read off the moment at which it breaks loose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Float

from jaxid import signals
from jaxid.controllers import Controller, Tick
from jaxid.effects.friction import StaticFriction
from jaxid.estimators.result import Estimate
from jaxid.io.log import Log
from jaxid.machine import Machine, disturbance_at
from jaxid.model import Plant
from jaxid.parameters import scatter
from jaxid.preprocess import Prepared
from jaxid.readings import drive_own_states
from jaxid.replay import needed_steps
from jaxid.simulation import Drive, open_loop

# Readings that agree within this range, in standard deviations of their noise, are a rest: noise
# alone does otherwise once in a thousand times. There must be as many of them as a reversal
# without sticking could not keep together, and at least so many.
_RANGE = 5.0
_STILL = 3
# Samples that follow a start, at least.
_AFTER = 12
# Fewest starts that can tell a level from a chance, and most that are run.
_FEWEST = 4
_MOST = 120
# Levels tried at once, twice: over all that the log allows, then between neighbours of the best.
_LEVELS = 40
_FOLDS = 4
# A start tells its moment and its vigour, and what the model does wrong there is the same in all
# samples that follow: so many of them count as independent.
_TELLS = 3
# For the better of two definitions of a rest.
_FALSE_POSITIVE = 0.5e-3
# A controller's law is taken for the one that made a log where it gives the logged command back to
# within this many deviations of its noise, or this part of its RMS.
_SAME = 1.5
_NEARLY = 0.02


class Starts(eqx.Module):
    """Moments in which a joint starts from rest, cut out of a log.

    Args:
        command: Logged command, (start, time, m).
        position: Measured, (start, time, n).
        rest: Mean reading at rest, (start, n).
        time: Of the first sample [s], (start,).
        own: Own states of the plant's effects at the first sample.
        still: How many of the samples are at rest.
    """

    command: Array
    position: Array
    rest: Array
    time: Array
    own: tuple
    still: Array

    def padded(self, count: int) -> Starts:
        """With the last start repeated, so that one compiled shape serves any number."""
        more = count - len(self.time)
        spread = eqx.tree_at(lambda s: s.still, self, jnp.full(len(self.time), self.still))
        return jax.tree.map(
            lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], more, axis=0)]), spread
        )


@dataclass(frozen=True)
class BreakAway:
    """What the starts say of a level above sliding friction.

    Args:
        level: Most likely [N or N m].
        std: Its standard deviation.
        evidence: Held-out gain in log-likelihood over none [nats].
        threshold: What noise alone exceeds once in a thousand.
        closed: Part of its squared residual that the median start loses.
        times: Of the starts [s].
    """

    level: float
    std: float
    evidence: float
    threshold: float
    closed: float
    times: Float[np.ndarray, " start"]


def break_away(
    estimate: Estimate, log: Log, data: Prepared, joint: int = 0
) -> BreakAway | None:
    """Level of break-away friction above Coulomb's that the starts from rest of a log ask for.

    Args:
        estimate: The model without it; its parameters move within their covariance.
        log: The log.
        data: The same, prepared.
        joint: 0-based.

    Returns:
        The finding; None where too few starts are seen, or where the state at rest is not known
        (presliding, or a controller faster than the log).
    """
    machine = estimate.machine
    if not _can_tell(machine, log):
        return None
    noise = _noise(machine, log, joint)
    log = replace(log, force=_acted(machine, log))
    stills = sorted(set(_stills(noise, log, data, joint)))
    length = stills[-1] + max(_AFTER, 2 * stills[-1])
    all_starts = [_starts(machine.plant, log, data, noise, n, length, joint) for n in stills]
    enough = [s for s in all_starts if len(s.time) >= _FEWEST]
    most = max((len(s.time) for s in enough), default=0)
    found = []
    for starts in enough:
        levels, fits = _fits(estimate, log, starts, 2 ** int(np.ceil(np.log2(most))), noise, joint)
        found.append(_judge(levels, fits, np.asarray(starts.time)))
    return max(found, key=lambda b: b.evidence, default=None)


def _fits(
    estimate: Estimate, log: Log, starts: Starts, padded: int, noise: float, joint: int
) -> tuple[np.ndarray, list[_Fit]]:
    """Fits at levels from none to the most that the log allows, denser about the best."""
    machine, count = estimate.machine, len(starts.time)
    filled = starts.padded(padded)
    drive = Drive(jnp.asarray(machine.gain), log.period, log.hold, needed_steps(machine, log), True)
    plant = machine.plant.with_effect(StaticFriction(level=0.0, port=joint))
    prior = _prior(estimate)
    places = machine.parameters.places
    theta = jnp.asarray(estimate.theta)

    def at(levels: np.ndarray) -> list[_Fit]:
        both = _runs(plant, places, drive, filled, joint, jnp.asarray(levels), theta)
        e, jacobian = (np.asarray(a)[:, :count] for a in both)
        return [_Fit(x, j, prior, noise) for x, j in zip(e, jacobian, strict=True)]

    top = float(np.abs(machine.gain * np.asarray(starts.command)).max())
    coarse = np.linspace(0.0, top, _LEVELS)
    fits = at(coarse)
    spread = min(f.spread for f in fits)
    best = int(np.argmin([f.cost(spread) for f in fits]))
    # Uneven, so that no level is tried twice.
    fine = np.linspace(coarse[max(best - 1, 0)], coarse[min(best + 1, _LEVELS - 1)], _LEVELS + 3)[1:-2]
    return np.concatenate([coarse, fine]), [*fits, *at(fine)]


def _can_tell(machine: Machine, log: Log) -> bool:
    """Whether what acts at a start is known: no presliding memory, no command between samples."""
    memory = any(
        e.adds_force and e.initial_state(jnp.zeros(())) is not None for e in machine.plant.effects
    )
    faster = machine.controller is not None and machine.controller.period < 0.9 * log.period
    return not memory and not faster and log.hold != "band_limited"


def _acted(machine: Machine, log: Log) -> np.ndarray:
    """The command as it acted: what the controller makes of the readings, noise of the log left out.

    At a start a single noisy sample above the level would set the simulation moving. The logged
    command stands where there is no controller, or one that does not give it back.
    """
    if machine.controller is None or log.reference is None:
        return log.force
    extra = disturbance_at(machine.disturbance, log.time, log)
    arrays = (log.position, log.reference, np.broadcast_to(extra, log.force.shape))
    made = np.asarray(_commands(machine.controller, *(jnp.asarray(a) for a in arrays)))
    size = np.sqrt(np.mean(log.force**2, axis=0))
    stated = machine.sensor.force_noise
    noise = 0.0 if stated is None else np.asarray(stated)
    off = np.sqrt(np.mean((made - log.force) ** 2, axis=0))
    return np.where(off <= np.maximum(_SAME * noise, _NEARLY * size), made, log.force)


@eqx.filter_jit
def _commands(controller: Controller, position: Array, reference: Array, disturbance: Array) -> Array:
    def tick(memory: tuple, now: tuple) -> tuple[tuple, Array]:
        u, memory = controller.command(Tick(*now[:2]), memory, now[2])
        return memory, u

    start = controller.start(position[0], jnp.zeros_like(position[0]), reference[0])
    return jax.lax.scan(tick, start, (position, reference, disturbance))[1]


def _noise(machine: Machine, log: Log, joint: int) -> float:
    stated = machine.sensor.position_std
    each = signals.high_band_std(log.position, log.rate_hz) if stated is None else np.asarray(stated)
    return float(np.broadcast_to(each, log.position.shape[1])[joint])


def _stills(noise: float, log: Log, data: Prepared, joint: int) -> list[int]:
    """Samples that must agree for a rest, if reversals are as quick as is usual, or as slow as any.

    Few find the short rests of a stiff loop, many are needed where motion is slow against noise.
    """
    v, a = data.qd[:, joint], np.abs(data.qdd[:, joint])
    turns = np.flatnonzero(v[1:] * v[:-1] <= 0)
    usual = float(np.sqrt(np.mean(a**2)))
    slow = float(np.quantile(a[turns], 0.25)) if len(turns) else usual
    halves = [np.sqrt(2 * _RANGE * noise / max(x, 1e-300)) / log.period for x in (usual, slow)]
    return [max(_STILL, 1 + 2 * int(np.ceil(min(h, log.samples / 10)))) for h in halves]


def _starts(
    plant: Plant, log: Log, data: Prepared, noise: float, still: int, length: int, joint: int
) -> Starts:
    """Find and cut out where a joint leaves a rest, in the raw readings."""
    after = length - still
    ends = _departures(log.position[:, joint], noise, still, after)
    rows = ends[:, None] + np.arange(1 - still, after + 1)
    own = _own_states(plant, data)
    return Starts(
        jnp.asarray(log.force[rows]), jnp.asarray(log.position[rows]),
        jnp.asarray(log.position[rows[:, :still]].mean(axis=1)),
        jnp.asarray(log.time[rows[:, 0]] - log.time[0]), jax.tree.map(lambda a: a[rows[:, 0]], own),
        jnp.asarray(still),
    )


def _departures(
    q: Float[np.ndarray, " time"], noise: float, still: int, after: int
) -> np.ndarray:
    """Last samples of rests that are followed by motion, spread over the log if there are many."""
    windows = np.lib.stride_tricks.sliding_window_view(q, still)
    agree = np.ptp(windows, axis=1) <= _RANGE * noise
    ends = np.flatnonzero(agree[:-1] & ~agree[1:]) + still - 1
    ends = ends[ends + after < len(q)]
    # Where it has not gone far soon after, it was noise that ended the rest.
    moved = np.abs(q[ends + after] - q[ends]) > 2 * _RANGE * noise
    ends = ends[moved]
    return ends[np.unique(np.linspace(0, len(ends) - 1, min(len(ends), _MOST)).astype(int))]


def _own_states(plant: Plant, data: Prepared) -> tuple:
    arrays = (jnp.asarray(a) for a in (data.q, data.qd, data.qdd, data.force))
    return eqx.filter_jit(drive_own_states)(plant, *arrays, data.period, data.start)


@eqx.filter_jit
def _runs(
    plant: Plant, places: tuple, drive: Drive, starts: Starts, joint: int, levels: Array, theta: Array
) -> tuple[Array, Array]:
    """Measured minus simulated position of every start at every level, and its Jacobian.

    Returns:
        (level, start, time) and (level, start, time, p), the mean over the samples at rest taken off.
    """

    def run(level: Array, theta: Array) -> Array:
        now = scatter(places, plant, theta)
        now = eqx.tree_at(lambda p: p.effects[-1].level, now, level)

        def one(s: Starts) -> Array:
            zero = jnp.zeros_like(s.rest)
            q = open_loop(
                now, drive, s.command, s.rest, zero, start=s.time, own=(*s.own, None)
            ).position[:, joint]
            e = s.position[:, joint] - q
            at_rest = jnp.arange(e.size) < s.still
            return e - jnp.sum(jnp.where(at_rest, e, 0.0)) / s.still

        return jax.vmap(one)(starts)

    def both(level: Array) -> tuple[Array, Array]:
        def doubled(theta: Array) -> tuple[Array, Array]:
            e = run(level, theta)
            return e, e

        jacobian, e = jax.jacfwd(doubled, has_aux=True)(theta)
        return e, jacobian

    return jax.lax.map(both, levels)


def _prior(estimate: Estimate) -> np.ndarray:
    """Rows that hold the parameters to their estimate; those that it cannot tell do not move."""
    told = np.asarray(estimate.identifiable)
    size = np.where(estimate.theta != 0, np.abs(estimate.theta), 1.0)
    rows = np.diag(1e6 / size)
    covariance = estimate.precision.covariance[np.ix_(told, told)]
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    rows[np.ix_(told, told)] = (vectors / np.sqrt(np.maximum(values, 1e-12))).T / scale
    return rows


class _Fit:
    """All starts at one level, the other parameters moved within their prior."""

    def __init__(self, e: np.ndarray, jacobian: np.ndarray, prior: np.ndarray, noise: float) -> None:
        self.e, self.jacobian, self.prior, self.noise = e, jacobian, prior, noise

    @property
    def spread(self) -> float:
        """Usual RMS of a start's residual, at least the sensor's noise."""
        return float(max(np.sqrt(np.median(np.mean(self.e**2, axis=1))), self.noise))

    def losses(
        self, spread: float, train: np.ndarray, test: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Twice the negative log-likelihood of each of some starts after a fit to others.

        Heavy-tailed: a rest that was none must not decide.

        Returns:
            By start, and what the prior charges for the fit.
        """
        p = self.prior.shape[0]
        e, jacobian = self.e[train], self.jacobian[train]
        outlying = 1 + np.mean(e**2, axis=1) / spread**2
        weight = np.sqrt(_TELLS / e.shape[1] / outlying) / spread
        matrix = np.concatenate([(weight[:, None, None] * jacobian).reshape(-1, p), self.prior])
        target = np.concatenate([(weight[:, None] * e).ravel(), np.zeros(p)])
        step = -np.linalg.lstsq(matrix, target, rcond=None)[0]
        left = np.mean((self.e[test] + self.jacobian[test] @ step) ** 2, axis=1)
        return _TELLS * np.log1p(left / spread**2), float(np.sum((self.prior @ step) ** 2))

    def cost(self, spread: float, rows: np.ndarray | None = None) -> float:
        """Twice the negative log-likelihood of a fit to some starts, by default all."""
        rows = np.arange(len(self.e)) if rows is None else rows
        losses, charge = self.losses(spread, rows, rows)
        return float(losses.sum()) + charge


def _judge(levels: np.ndarray, fits: list[_Fit], times: np.ndarray) -> BreakAway:
    """Held-out evidence, and the level with its deviation; the first level is none."""
    spread = min(f.spread for f in fits)
    folds = np.arange(len(fits[0].e)) % _FOLDS
    old, new = [], []
    for k in range(_FOLDS):
        train, test = np.flatnonzero(folds != k), np.flatnonzero(folds == k)
        chosen = min(fits, key=lambda f: f.cost(spread, train))
        old.append(fits[0].losses(spread, train, test)[0])
        new.append(chosen.losses(spread, train, test)[0])
    old, new = np.concatenate(old), np.concatenate(new)
    order = np.argsort(levels)
    cost = np.array([f.cost(spread) for f in fits])[order]
    # The posterior over levels that are spaced unevenly.
    weight = np.exp(-0.5 * (cost - cost.min())) * np.gradient(levels[order])
    weight /= weight.sum()
    level = float(levels[order] @ weight)
    step = float(np.gradient(levels[order]) @ weight)
    variance = float((levels[order] - level) ** 2 @ weight) + step**2 / 12
    return BreakAway(
        level, float(np.sqrt(variance)), 0.5 * float(np.sum(old - new)),
        float(scipy.stats.chi2.ppf(1 - _FALSE_POSITIVE, 1) / 2), _closed(old, new), times,
    )


def _closed(old: np.ndarray, new: np.ndarray) -> float:
    """Part by which the median start comes nearer, in squares above the usual residual."""
    before, after = (np.median(np.expm1(x / _TELLS)) for x in (old, new))
    return float(1 - after / before) if before > 0 else 0.0
