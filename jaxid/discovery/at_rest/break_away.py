"""Break-away friction, estimated from the moments in which a joint starts from rest.

Samples at rest give no balance of forces, only a bound, so the search in the force domain cannot find an
effect that acts at rest. Every start from rest is simulated separately, from the measured position at rest
and under the logged command. The level follows from the moment at which the joint breaks loose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.discovery.at_rest.departures import Starts, force_noise_at_rest, starts_from_rest
from jaxid.effects.friction import StaticFriction
from jaxid.estimators.estimate import Estimate
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.parameter import as_array
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics.kept import kept_jit
from jaxid.session import OpenedLog
from jaxid.simulation.loops import Drive, open_loop
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import TooStiffError, needed_steps

# Fewest starts from which a level can be estimated.
_FEWEST = 3
# Number of levels that are tried at once, twice: over the range of the log, then between the neighbours of
# the best; and number of folds of the cross-validation.
_LEVELS = 40
_FOLDS = 4
# A level must be confirmed with this many times the integration steps: with one step a sample, the error of
# integration may look like a late start if the readings are fine.
_FINER = 8
# A start shows its moment and its initial acceleration, and the error of the model is common to all samples
# that follow: so many of them count as independent.
_INDEPENDENT = 3
# For the better of two definitions of a rest. A likelihood ratio on held-out starts exceeds one over this
# with at most this probability, whatever its distribution (Markov).
_FALSE_POSITIVE = 0.5e-3
# The velocity of a Stribeck curve must be at least this many times the slowest that counts as motion.
_RESOLVED = 2.0
# Part of its squared residual that the median start must lose.
_RELEVANT = 0.15
# Standard deviations that noise of the logged force reaches before a start. It sets a simulated joint in
# motion early: a lift of 26 kg without break-away friction seemed to have a level of 2.3 of them.
_PEAK = 4.0


@dataclass(frozen=True)
class BreakAway:
    """A level above sliding friction, estimated from starts.

    Args:
        level: Posterior mean [N or N m].
        std: Its standard deviation [N or N m].
        evidence: Held-out gain in log-likelihood over a model without it [nats].
        threshold: Evidence that noise alone exceeds once in a thousand logs [nats].
        closed: Part of its squared residual that the median start loses.
        times: Times at which the joint left its rests in the first log [s].
        count: Number of starts in all logs.
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
        """True if the level is positive, significant and relevant."""
        return self.level > 0.0 and self.evidence > self.threshold and self.closed > _RELEVANT


def break_away(
    estimate: Estimate, runs: Sequence[OpenedLog], joints: Sequence[int] = (0,)
) -> list[BreakAway | str]:
    """Estimate the level of break-away friction above Coulomb's from the starts from rest of some logs.

    Args:
        estimate: The model without it; its parameters move within their covariance.
        runs: The logs. The first one defines a rest; those with another hold or rate are not used.
        joints: Indices from 0, each examined separately.

    Returns:
        By joint the estimated level, or a reason why there is none.
    """
    machine = estimate.machine
    log = runs[0].log
    unknown = [
        _reason_against(machine, log) or _unresolved_friction(estimate, runs[0].data, j) for j in joints
    ]
    try:
        steps = needed_steps(machine, log)
    except TooStiffError:
        return ["the resulting model is too stiff to be simulated"] * len(joints)

    known = [j for j, why in zip(joints, unknown, strict=True) if not why]
    comparable = [r for r in runs if r.log.hold == log.hold and abs(r.log.period / log.period - 1) < 1e-3]
    noise = position_noise(machine, log)
    cuts, lengths = starts_from_rest(machine, comparable, noise, known) if known else ([], [])
    enough = [[s for s in of_joint if s.count >= _FEWEST] for of_joint in cuts]
    largest = max((s.count for of_joint in enough for s in of_joint), default=1)
    trial = _Trial(
        estimate=estimate, log=log, joints=known, steps=steps, padded=2 ** int(np.ceil(np.log2(largest)))
    )

    results: dict[int, BreakAway | str] = {}
    for k, joint in enumerate(known):
        result: BreakAway | str = f"there are fewer than {_FEWEST} starts from a rest that the readings show"
        for finer in (1, _FINER):
            judged = []
            for starts in enough[k]:
                fits = trial.fits(k, starts, float(noise[joint]), lengths[k], finer, result)
                leaves = np.asarray(starts.time + (starts.still - 1) * log.period)
                judged.append(_judge(*fits, leaves[np.asarray(starts.log) == 0]))
            if not judged:
                break
            result = best = max(judged, key=lambda b: b.evidence)
            if not best.holds:
                break
            peak = _PEAK * max(force_noise_at_rest(machine, log, s, joint) for s in enough[k])
            if best.level <= peak:
                result = _lost_in_noise(peak, machine.unit("force", joint))
                break
            # Above them, a level is too large by a part of these peaks.
            result = replace(best, std=float(np.hypot(best.std, peak / 2)))
        results[joint] = result
    return [why or results[j] for j, why in zip(joints, unknown, strict=True)]


@dataclass(frozen=True)
class _Trial:
    """The trial of all joints: one compiled plant with break-away friction at each of them.

    Args:
        estimate: The model without break-away friction.
        log: A log, for sampling time and hold of all logs.
        joints: Indices of the joints that are examined.
        steps: Integration steps in a sample.
        padded: Number of starts in a compiled call.
    """

    estimate: Estimate
    log: Log
    joints: list[int]
    steps: int
    padded: int

    def fits(
        self, which: int, starts: Starts, noise: float, length: int, finer: int, before: BreakAway | str
    ) -> tuple[np.ndarray, list[_Fit]]:
        """Fit the starts at levels from zero to the largest that the log allows, densely about the best.

        Args:
            which: Index of the joint that starts, among those of the trial.
            starts: Its starts from rest.
            noise: Standard deviation of its readings.
            length: Number of samples of a start that count.
            finer: Factor on the integration steps.
            before: Estimate with fewer steps: levels from zero to twice that level suffice.

        Returns:
            The levels, the first of which is zero, and a fit at each.
        """
        machine, count = self.estimate.machine, starts.count
        filled = starts.padded(self.padded)
        drive = Drive(np.asarray(machine.gain), self.log.period, self.log.hold, finer * self.steps, True)
        plant = machine.plant
        for joint in self.joints:
            plant = with_break_away(plant, 0.0, joint)
        prior = _prior(self.estimate)
        places, theta = machine.parameters.places, np.asarray(self.estimate.theta)

        def at(levels: np.ndarray) -> list[_Fit]:
            by_joint = np.asarray(levels)[:, None] * np.eye(len(self.joints))[which]
            both = _runs(plant, places, drive, filled, np.asarray(self.joints[which]), by_joint, theta)
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
        # An even number of levels between the neighbours, so that the best is not tried twice.
        ends = coarse[max(best - 1, 0)], coarse[min(best + 1, _LEVELS - 1)]
        fine = np.linspace(*ends, _LEVELS + 2)[1:-1]
        return np.concatenate([coarse, fine]), [*fits, *at(fine)]


def with_break_away(plant: Plant, level: float, joint: int) -> Plant:
    """Return a plant with a break-away friction of a level [N or N m] at a joint."""
    return plant.with_effect(StaticFriction(level=as_array(level), port=joint))


def _lost_in_noise(peak: float, unit: str) -> str:
    """Explain why a level cannot be separated from noise of the logged force."""
    noise = f"noise of the logged force, which reaches {peak:.2g} {unit}"
    return f"{noise}, starts a simulated joint early, as if the machine's broke away late"


def _reason_against(machine: Machine, log: Log) -> str:
    """Explain why the moment of a start cannot be simulated; empty if it can."""
    if all(e.sliding_level is None for e in machine.plant.effects):
        return "there is no sliding friction that it could stand above"
    if not machine.plant.starts_alone:
        return "the forces between the joints exceed the force that keeps one at rest"
    for e in machine.plant.effects:
        if e.adds_force and e.initial_state(jnp.zeros(())) is not None:
            return f"the state of {e.kind} at rest is not known"
    if machine.controller is not None and machine.controller.period < 0.9 * log.period:
        return "the command between the log's samples is not known"
    if log.hold == "band_limited":
        return "the command between the log's samples has no corner"
    return ""


def _unresolved_friction(estimate: Estimate, data: Prepared, joint: int) -> str:
    """Explain why friction just above rest, which delays starts too, is not resolved; empty if it is."""
    machine = estimate.machine
    for k, effect in enumerate(machine.plant.effects):
        velocity = effect.stribeck_velocity
        if velocity is None or effect.port != joint:
            continue
        free = zip(machine.parameters.free, estimate.identifiable, strict=True)
        identifiable = all(t for f, t in free if f.path[:2] == ("effects", k))
        if (
            not identifiable
            or float(getattr(effect, velocity)) < _RESOLVED * data.recipe.rest_velocity[joint]
        ):
            return f"{effect.kind} is not resolved by the samples that move"
    return ""


@kept_jit
def _runs(
    plant: Plant, places: tuple, drive: Drive, starts: Starts, joint: Array, levels: Array, theta: Array
) -> tuple[Array, Array]:
    """Compute the position error of every start of a joint at every level, and its Jacobian.

    Args:
        plant: The plant, with break-away friction as its last effects.
        places: Places of the unknowns in the plant.
        drive: Gain, hold and integration steps.
        starts: Starts from rest.
        joint: Index of the joint that starts.
        levels: Levels of the last effects, (level, k).
        theta: Values of the unknowns, (p,).

    Returns:
        Measured minus simulated position, (level, start, time), without its mean over the samples at rest;
        and the Jacobian in the unknowns, (level, start, time, p).
    """
    count = levels.shape[1]

    def run(level: Array, theta: Array) -> Array:
        now = scatter(places, plant, theta)
        now = eqx.tree_at(lambda p: [e.level for e in p.effects[-count:]], now, list(level))

        def one(s: Starts) -> Array:
            run = open_loop(
                now,
                drive,
                s.command,
                s.rest,
                s.velocity,
                start=s.time,
                own=(*s.internal_states, *[None] * count),
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
    """Return rows that hold the parameters to their estimate; unidentifiable ones do not move."""
    identifiable = np.asarray(estimate.identifiable)
    size = np.where(estimate.theta != 0, np.abs(estimate.theta), 1.0)
    rows = np.diag(1e6 / size)
    covariance = estimate.precision.covariance[np.ix_(identifiable, identifiable)]
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    rows[np.ix_(identifiable, identifiable)] = (vectors / np.sqrt(np.maximum(values, 1e-12))).T / scale
    return rows


class _Fit:
    """A fit of all starts at one level, with the other parameters moved within their prior."""

    def __init__(self, e: np.ndarray, jacobian: np.ndarray, prior: np.ndarray, noise: float) -> None:
        self.e, self.jacobian, self.prior, self.noise = e, jacobian, prior, noise
        # A start has one weight for all its samples, so a fit needs only sums of products over its samples.
        self.normal = np.einsum("itp,itq->ipq", jacobian, jacobian, optimize=True)
        self.gradient = np.einsum("itp,it->ip", jacobian, e)

    @property
    def spread(self) -> float:
        """Typical RMS of a start's residual, at least the sensor's noise."""
        return float(max(np.sqrt(np.median(np.mean(self.e**2, axis=1))), self.noise))

    def losses(self, spread: float, train: np.ndarray, test: np.ndarray) -> tuple[np.ndarray, float]:
        """Compute twice the negative log-likelihood of each of some starts after a fit to others.

        The likelihood is heavy-tailed, so that a false rest does not decide.

        Returns:
            The loss by start, and the loss of the prior.
        """
        e = self.e[train]
        outlying = 1 + np.mean(e**2, axis=1) / spread**2
        weight = _INDEPENDENT / e.shape[1] / outlying / spread**2
        normal = np.tensordot(weight, self.normal[train], 1) + self.prior.T @ self.prior
        scale = 1 / np.sqrt(np.diag(normal))
        gradient = scale * (weight @ self.gradient[train])
        step = -scale * np.linalg.solve(normal * np.outer(scale, scale), gradient)
        remaining = np.mean((self.e[test] + self.jacobian[test] @ step) ** 2, axis=1)
        return _INDEPENDENT * np.log1p(remaining / spread**2), float(np.sum((self.prior @ step) ** 2))

    def cost(self, spread: float, rows: np.ndarray | None = None) -> float:
        """Return twice the negative log-likelihood of a fit to some starts, by default all."""
        rows = np.arange(len(self.e)) if rows is None else rows
        losses, charge = self.losses(spread, rows, rows)
        return float(losses.sum()) + charge


def _judge(levels: np.ndarray, fits: list[_Fit], times: np.ndarray) -> BreakAway:
    """Compute the held-out evidence, and the level with its deviation; the first level is zero."""
    spread = min(f.spread for f in fits)
    count = len(fits[0].e)

    # Cross-validation: the level is chosen on some folds and judged on another.
    folds = np.arange(count) % min(_FOLDS, count)
    old_losses, new_losses = [], []
    for k in range(min(_FOLDS, count)):
        train, test = np.flatnonzero(folds != k), np.flatnonzero(folds == k)
        chosen = min(fits, key=lambda f: f.cost(spread, train))
        old_losses.append(fits[0].losses(spread, train, test)[0])
        new_losses.append(chosen.losses(spread, train, test)[0])
    old, new = np.concatenate(old_losses), np.concatenate(new_losses)

    # The posterior over levels that are unevenly spaced.
    order = np.argsort(levels)
    cost = np.array([f.cost(spread) for f in fits])[order]
    weight = np.exp(-0.5 * (cost - cost.min())) * np.gradient(levels[order])
    weight /= weight.sum()
    level = float(levels[order] @ weight)
    step = float(np.gradient(levels[order]) @ weight)
    variance = float((levels[order] - level) ** 2 @ weight) + step**2 / 12
    return BreakAway(
        level=level,
        std=float(np.sqrt(variance)),
        evidence=0.5 * float(np.sum(old - new)),
        threshold=float(-np.log(_FALSE_POSITIVE)),
        closed=_closed(old, new),
        times=times,
        count=count,
    )


def _closed(old: np.ndarray, new: np.ndarray) -> float:
    """Return the part by which the squared residual of the median start falls."""
    before, after = (np.median(np.expm1(x / _INDEPENDENT)) for x in (old, new))
    return float(1 - after / before) if before > 0 else 0.0
