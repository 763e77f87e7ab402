"""Break-away friction, looked for where it acts: in the moments in which an axis starts from rest.

Samples at rest carry no balance of forces, only a bound, so the search in the force domain cannot
see what acts there. Every start from rest is run again by itself, from the measured position at
rest and under the logged command; the level is read off the moment at which it breaks loose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.discovery.at_rest.departures import Starts, starts_from_rest
from jaxid.effects.friction import StaticFriction
from jaxid.estimators.estimate import Estimate
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.session import OpenedLog
from jaxid.simulation.loops import Drive, open_loop
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import TooStiffError, needed_steps

# Fewest starts that can tell a level from a chance.
_FEWEST = 3
# Levels tried at once, twice: over all that the log allows, then between neighbours of the best.
_LEVELS = 40
_FOLDS = 4
# What is found must stay with so many times the integration steps: what one a sample leave wrong
# may look like a late start where the readings are fine.
_FINER = 8
# A start tells its moment and its vigour, and what the model does wrong there is the same in all
# samples that follow: so many of them count as independent.
_TELLS = 3
# For the better of two definitions of a rest. A likelihood ratio on held-out starts exceeds one over this
# with at most this probability, whatever its distribution (Markov).
_FALSE_POSITIVE = 0.5e-3
# The velocity of a Stribeck curve must exceed the slowest that counts as motion so many times.
_RESOLVED = 2.0
# Part of its squared residual that the median start must lose.
_RELEVANT = 0.15


@dataclass(frozen=True)
class BreakAway:
    """What the starts say of a level above sliding friction.

    Args:
        level: Most likely [N or N m].
        std: Its standard deviation.
        evidence: Held-out gain in log-likelihood over none [nats].
        threshold: What noise alone exceeds once in a thousand.
        closed: Part of its squared residual that the median start loses.
        times: When the joint left its rests in the first log [s].
        count: Starts in all logs.
    """

    level: float
    std: float
    evidence: float
    threshold: float
    closed: float
    times: Float[np.ndarray, " start"]
    count: int

    @property
    def holds(self) -> bool:
        """Whether it is more than chance, and more than a trifle."""
        return self.level > 0.0 and self.evidence > self.threshold and self.closed > _RELEVANT


def break_away(
    estimate: Estimate, runs: Sequence[OpenedLog], joints: Sequence[int] = (0,)
) -> list[BreakAway | str]:
    """Level of break-away friction above Coulomb's that the starts from rest of some logs ask for.

    Args:
        estimate: The model without it; its parameters move within their covariance.
        runs: The logs. What a rest is, the first decides; those held or sampled otherwise are
            left out.
        joints: 0-based, each looked at by itself.

    Returns:
        By joint the finding, or why there is none.
    """
    machine = estimate.machine
    log = runs[0].log
    unknown = [_unknown(machine, log) or _blurred(estimate, runs[0].data, j) for j in joints]
    try:
        steps = needed_steps(machine, log)
    except TooStiffError:
        return ["the model found is too stiff to be simulated"] * len(joints)
    known = [j for j, why in zip(joints, unknown, strict=True) if not why]
    alike = [r for r in runs if r.log.hold == log.hold and abs(r.log.period / log.period - 1) < 1e-3]
    noise = position_noise(machine, log)
    cuts, lengths = starts_from_rest(machine, alike, noise, known) if known else ([], [])
    enough = [[s for s in of_joint if s.count >= _FEWEST] for of_joint in cuts]
    most = max((s.count for of_joint in enough for s in of_joint), default=1)
    trial = _Trial(estimate, log, known, steps, 2 ** int(np.ceil(np.log2(most))))
    few = f"there are fewer than {_FEWEST} starts from a rest that the readings show"
    found: dict[int, BreakAway | str] = {}
    for k, joint in enumerate(known):
        found[joint] = few
        for finer in (1, _FINER):
            judged = []
            for starts in enough[k]:
                fits = trial.fits(k, starts, float(noise[joint]), lengths[k], finer, found[joint])
                leaves = np.asarray(starts.time + (starts.still - 1) * log.period)
                judged.append(_judge(*fits, leaves[np.asarray(starts.log) == 0]))
            found[joint] = max(judged, key=lambda b: b.evidence, default=few)
            if not (judged and found[joint].holds):
                break
    return [why or found[j] for j, why in zip(joints, unknown, strict=True)]


@dataclass(frozen=True)
class _Trial:
    """What all joints share: one compiled plant with break-away friction at each of them.

    Args:
        estimate: The model.
        log: Of the sampling time and hold of all.
        joints: That are looked at.
        steps: Integration steps a sample.
        padded: Starts in a compiled call.
    """

    estimate: Estimate
    log: Log
    joints: list[int]
    steps: int
    padded: int

    def fits(
        self, which: int, starts: Starts, noise: float, length: int, finer: int, before: BreakAway | str
    ) -> tuple[np.ndarray, list[_Fit]]:
        """Fits at levels from none to the most that the log allows, denser about the best.

        Args:
            which: Index of the joint that starts.
            starts: When it does.
            noise: Of its readings.
            length: Samples of a start that count.
            finer: Factor on the integration steps.
            before: What was found with fewer: levels from none to twice that are enough.
        """
        machine, count = self.estimate.machine, starts.count
        filled = starts.padded(self.padded)
        drive = Drive(jnp.asarray(machine.gain), self.log.period, self.log.hold, finer * self.steps, True)
        plant = machine.plant
        for joint in self.joints:
            plant = plant.with_effect(StaticFriction(level=0.0, port=joint))
        prior = _prior(self.estimate)
        places, theta = machine.parameters.places, jnp.asarray(self.estimate.theta)

        def at(levels: np.ndarray) -> list[_Fit]:
            own = jnp.asarray(levels)[:, None] * jnp.asarray(np.eye(len(self.joints))[which])
            both = _runs(plant, places, drive, filled, jnp.asarray(self.joints[which]), own, theta)
            e, jacobian = (np.asarray(a)[:, :count, :length] for a in both)
            return [_Fit(x, j, prior, noise) for x, j in zip(e, jacobian, strict=True)]

        if isinstance(before, BreakAway):
            levels = np.linspace(0.0, 2 * before.level, _LEVELS)
            return levels, at(levels)
        top = float(np.abs(machine.gain * np.asarray(starts.command)).max())
        coarse = np.linspace(0.0, top, _LEVELS)
        fits = at(coarse)
        spread = min(f.spread for f in fits)
        best = int(np.argmin([f.cost(spread) for f in fits]))
        # An even number between the neighbours, so that the best is not tried twice.
        ends = coarse[max(best - 1, 0)], coarse[min(best + 1, _LEVELS - 1)]
        fine = np.linspace(*ends, _LEVELS + 2)[1:-1]
        return np.concatenate([coarse, fine]), [*fits, *at(fine)]


def _unknown(machine: Machine, log: Log) -> str:
    """What of the moment of a start is not known; empty where all is."""
    if all(e.sliding_level is None for e in machine.plant.effects):
        return "there is no sliding friction that it could stand above"
    if machine.plant.coupled:
        return "the joints push one another, by more than what keeps one from starting"
    for e in machine.plant.effects:
        if e.adds_force and e.initial_state(jnp.zeros(())) is not None:
            return f"the state of {e.kind} at rest is not known"
    if machine.controller is not None and machine.controller.period < 0.9 * log.period:
        return "the command between the log's samples is not known"
    if log.hold == "band_limited":
        return "the command between the log's samples has no corner"
    return ""


def _blurred(estimate: Estimate, data: Prepared, joint: int) -> str:
    """Whether friction just above rest is not known, which delays starts too; empty where it is."""
    machine = estimate.machine
    for k, effect in enumerate(machine.plant.effects):
        velocity = effect.stribeck_velocity
        if velocity is None or effect.port != joint:
            continue
        free = zip(machine.parameters.free, estimate.identifiable, strict=True)
        told = all(t for f, t in free if f.path[:2] == ("effects", k))
        if not told or float(getattr(effect, velocity)) < _RESOLVED * data.recipe.rest_velocity[joint]:
            return f"{effect.kind} is not resolved by the samples that move"
    return ""


@eqx.filter_jit
def _runs(
    plant: Plant, places: tuple, drive: Drive, starts: Starts, joint: Array, levels: Array, theta: Array
) -> tuple[Array, Array]:
    """Measured minus simulated position of every start of a joint at every level, and its Jacobian.

    Args:
        levels: (level, k), of the break-away friction that stands last in the plant.

    Returns:
        (level, start, time) and (level, start, time, p), the mean over the samples at rest taken off.
    """
    few = levels.shape[1]

    def run(level: Array, theta: Array) -> Array:
        now = scatter(places, plant, theta)
        now = eqx.tree_at(lambda p: [e.level for e in p.effects[-few:]], now, list(level))

        def one(s: Starts) -> Array:
            run = open_loop(
                now,
                drive,
                s.command,
                s.rest,
                s.velocity,
                start=s.time,
                own=(*s.own, *[None] * few),
                past=s.past,
            )
            e = s.position[:, joint] - run.position[:, joint]
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
        # A start has one weight for all its samples: all that a fit needs of it are its products.
        self.normal = np.einsum("itp,itq->ipq", jacobian, jacobian, optimize=True)
        self.gradient = np.einsum("itp,it->ip", jacobian, e)

    @property
    def spread(self) -> float:
        """Usual RMS of a start's residual, at least the sensor's noise."""
        return float(max(np.sqrt(np.median(np.mean(self.e**2, axis=1))), self.noise))

    def losses(self, spread: float, train: np.ndarray, test: np.ndarray) -> tuple[np.ndarray, float]:
        """Twice the negative log-likelihood of each of some starts after a fit to others.

        Heavy-tailed: a rest that was none must not decide.

        Returns:
            By start, and what the prior charges for the fit.
        """
        e = self.e[train]
        outlying = 1 + np.mean(e**2, axis=1) / spread**2
        weight = _TELLS / e.shape[1] / outlying / spread**2
        normal = np.tensordot(weight, self.normal[train], 1) + self.prior.T @ self.prior
        scale = 1 / np.sqrt(np.diag(normal))
        gradient = scale * (weight @ self.gradient[train])
        step = -scale * np.linalg.solve(normal * np.outer(scale, scale), gradient)
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
    count = len(fits[0].e)
    folds = np.arange(count) % min(_FOLDS, count)
    old, new = [], []
    for k in range(min(_FOLDS, count)):
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
        level,
        float(np.sqrt(variance)),
        0.5 * float(np.sum(old - new)),
        float(-np.log(_FALSE_POSITIVE)),
        _closed(old, new),
        times,
        count,
    )


def _closed(old: np.ndarray, new: np.ndarray) -> float:
    """Part by which the median start comes nearer, in squares above the usual residual."""
    before, after = (np.median(np.expm1(x / _TELLS)) for x in (old, new))
    return float(1 - after / before) if before > 0 else 0.0
