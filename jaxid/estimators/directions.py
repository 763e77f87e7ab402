"""Output error in the directions that a log tells; the rest stays at its prior.

A short log cannot tell all unknowns. Fitted all the same they run away along what is flat, and what is
told goes with them. Here each guess is a prior of a stated relative width; combinations of unknowns that
the log tells better than that are fitted, the others are held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxid.errors import InputError
from jaxid.estimators.least_squares import Minimum, Transform, levenberg_marquardt
from jaxid.estimators.output_error import choose_numerics, measured_output, notes_of, output_residual
from jaxid.estimators.result import Estimate
from jaxid.estimators.steps import Solve, Steps
from jaxid.io.log import Log
from jaxid.machine import Machine
from jaxid.model import Plant
from jaxid.precision import Precision, assess, full_hessian
from jaxid.replay import Numerics, Replay, from_rest, make_replay
from jaxid.sensors import Sensor

# A direction is fitted where its standard deviation is below this part of the prior's; one that was stays
# up to the second.
_TOLD_TWICE, _STAYS = 0.5, 0.6
# Directions change with the point at which they are read: most rounds, in how many of them they are read
# anew, and what ends them.
_ROUNDS, _READ = 6, 3
# In parts of the variance of one sample.
_SETTLED = 0.02
# Farther from its guess than so many priors no unknown is taken.
_FAR = 8.0
# A parameter is told where what is left of its prior is less than this.
_TOLD = 0.5
# Two starts end at one optimum where their costs differ by less than this.
_SAME = 1e-3
# Entries of a combination below this are left out when it is named.
_NEGLIGIBLE = 0.1
# Friction that rises with speeding up lets a velocity stand, and costs have a kink wherever it does: such
# a machine is fitted with that rounded over these parts of it. At most so many evaluations at each.
_LADDER = (1.0, 0.3, 0.1)
_A_RUNG = 25
# Draws of where a motor stands within its first count, and the least part of a residual that is noise.
_DRAWS = 32
_OWN = 0.1
# No pull towards the guesses.
_NONE = np.zeros(())
# A profile is taken at so many standard deviations of the quadratic picture.
_PROFILED = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])


class Prior(eqx.Module):
    """Guesses and how far from them the unknowns may be: physical values, and in units of that.

    What must be positive is log-normal about its guess, the rest normal.
    """

    base: Float[Array, " p"]
    scale: Float[Array, " p"]
    log: Bool[Array, " p"]
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]

    def outward(self, w: Float[Array, " p"]) -> Float[Array, " p"]:
        """Physical values, within their bounds."""
        moved = jnp.where(self.log, self.base * jnp.exp(self.scale * w), self.base + self.scale * w)
        return jnp.clip(moved, self.lower, self.upper)

    def inward(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """In units of the prior."""
        ratio = np.where(self.log, np.maximum(theta, 1e-300) / np.where(self.log, self.base, 1.0), 1.0)
        return np.where(self.log, np.log(ratio), theta - self.base) / self.scale

    def slope(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Physical change for a change of one prior."""
        return np.where(self.log, theta, 1.0) * self.scale

    @classmethod
    def of(cls, machine: Machine, width: float, nuisance: Float[np.ndarray, " k"]) -> Prior:
        """Of a machine's guesses, a relative width around each, and of nuisances about zero.

        Raises:
            InputError: If a guess is zero, of which nothing can be a part.
        """
        free = machine.parameters.free
        for f in free:
            if f.guess == 0.0:
                raise InputError(
                    f"{f.name} has a guess of zero, which a relative prior says nothing of",
                    where="[output_error] prior", mend="give it a guess of its natural size",
                )
        guess, (lower, upper) = machine.parameters.guess, machine.parameters.bounds
        log = Transform.of(machine.parameters).log
        none = np.zeros(nuisance.size)
        return cls(
            np.concatenate([guess, none]),
            np.concatenate([np.where(log, width, width * np.abs(guess)), nuisance]),
            np.concatenate([log, none.astype(bool)]),
            np.concatenate([lower, none - np.inf]), np.concatenate([upper, none + np.inf]),
        )


@dataclass(frozen=True)
class Problem:
    """What is compared, as arrays.

    Args:
        replay: The loop, or the input.
        places, plant: Of the unknowns.
        measured, weight: (time, k).
        prior: Of the unknowns, nuisances behind them.
        on: What of the simulation is compared.
    """

    replay: Replay
    places: tuple
    plant: Plant
    measured: np.ndarray
    weight: np.ndarray
    prior: Prior
    on: str

    @property
    def args(self) -> tuple:
        """For the compiled functions."""
        return (self.replay, self.places, self.plant, self.measured, self.weight, self.prior, self.on)

    @property
    def ladder(self) -> list[np.ndarray]:
        """Sharpnesses at which to fit, one after the other."""
        n, m = self.replay.position.size, self.replay.drive.gain.size
        none, u = jnp.zeros(n), jnp.zeros(m)
        own = self.plant.initial_states(u)
        rises = self.plant.balance(none, none, none, u, jnp.zeros(()), own).rises
        return [np.asarray(s) for s in (_LADDER if rises else (self.plant.sharpness,))]


def _residual_of(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, prior: Prior, on: str,
    vectors: Array,
) -> Any:
    """Residual as a function of the directions' coordinates."""
    physical = output_residual(replay, places, plant, measured, weight, on)
    # Behind the unknowns stand positions at the start; velocities there are known to be those of the log.
    still = jnp.zeros(prior.base.size - len(places))
    return lambda z: physical(jnp.concatenate([prior.outward(vectors @ z), still]))


def _descent(*args: Any) -> Minimum:
    """Down the cost; `pull`, the noise that a prior is held against, keeps the way near the guesses."""
    replay, places, plant, *rest, sharpness, pull, vectors, z, active = args
    bound = jnp.full(z.shape, _FAR)
    linear = Transform(np.zeros(z.shape, bool))
    compared = _residual_of(replay, places, replace(plant, sharpness=sharpness), *rest, vectors)
    residual = lambda z: jnp.concatenate([compared(z).ravel(), pull * z])
    tolerance = 0.1 * _SETTLED / rest[0].shape[0]
    found = levenberg_marquardt(
        residual, z, linear, -bound, bound, active, max_steps=_A_RUNG, tolerance=tolerance
    )
    e = found.residual[: -z.size]
    return replace(
        found, residual=e, jacobian=found.jacobian[: -z.size], cost=0.5 * jnp.sum(e * e),
    )


@eqx.filter_jit
def _fit(*args: Any) -> Minimum:
    return _descent(*args)


@eqx.filter_jit
def _fit_each(*args: Any) -> tuple[Array, Array, Array, Array]:
    """From many starts, or with many things held: coordinates, cost, convergence and steps of each."""
    *problem, vectors, z, active = args

    def one(z: Array, active: Array) -> tuple:
        found = _descent(*problem, vectors, z, active)
        return found.theta, found.cost, found.converged, found.steps

    return eqx.filter_vmap(one)(z, active)


@eqx.filter_jit
def _hessian(*args: Any) -> Array:
    """Of the cost, in the directions' coordinates."""
    *problem, vectors, z = args
    return full_hessian(_residual_of(*problem, vectors), z)


@dataclass(frozen=True)
class _Found:
    """Where the rounds ended: problem, directions (columns), how many are fitted, and the minimum."""

    problem: Problem
    vectors: np.ndarray
    count: int
    minimum: Minimum
    evaluations: int
    settled: bool


def directions_steps(
    machine: Machine, log: Log, *, prior: float, on: str = "position", starts: int = 1,
    others: Sequence[np.ndarray] = (), hessian: bool = False, profile: bool = False,
    numerics: Numerics | None = None,
) -> Steps[Estimate]:
    """Fit what a log tells of the unknowns in the loop, and hold the rest at the guesses.

    Args:
        machine: The machine; its controller closes the loop, which begins at rest.
        log: The log.
        prior: Relative standard deviation of the guesses.
        on: "position", "force" or "both". On the latter two the loop is simulated without rounding of the
            readings: which count a simulated reading falls on is a coin toss for a coarse encoder, and
            a cost with it a bed of needles.
        starts: Starts drawn within `prior` of the guesses, to see that all end alike.
        others: More starts.
        hessian: Take the curvature from the full Hessian in place of Gauss-Newton's.
        profile: Also take profile likelihoods of the fitted directions.
        numerics: How to integrate.

    Returns:
        The estimate. Standard deviations hold what is left of the prior along held directions;
        `details["directions"]` has the combinations with their own.

    Raises:
        InputError: If there is no loop, or a guess is zero.

    Source:
        Precision: Bogdan and Abba, (12)-(27), with the residual's colour where they take white noise.
        (27) lacks the inverse of B: 100 (sigma^2 diag B^-1)^(1/2) / theta.
    """
    numerics = numerics or choose_numerics(machine, log)
    problem = _problem(machine, log, prior, on, numerics)
    found = yield from _rounds(problem, np.zeros(problem.prior.base.size))
    many: dict[str, Any] = {}
    if starts > 1 or len(others):
        given = [problem.prior.inward(_padded(t, problem)) for t in others]
        points = np.array([*given, *_drawn(problem, starts)])
        found = yield from _elsewhere(problem, found, points)
        found, many = yield from _many_starts(found, points)
    p = len(machine.parameters.free)
    r, z = found.count, np.asarray(found.minimum.theta)
    full = None
    if hessian:
        full = np.asarray((yield Solve(_hessian, (*found.problem.args, found.vectors, z))))[:r, :r]
    rounding = yield from _rounding(machine, found)
    precision, stated = _assessed(machine, found, full, rounding)
    if profile:
        yield from _profiles(found, stated)
    theta = np.asarray(found.problem.prior.outward(found.vectors @ z))[:p]
    e = np.asarray(found.minimum.residual).reshape(found.problem.measured.shape)
    counts = found.problem.weight > 0
    converged = bool(found.minimum.converged) and found.settled
    extra = (f"{r} directions of {p} unknowns fitted, the rest held at the guesses",)
    return Estimate(
        method="output_error",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else "the directions that the log tells did not settle",
        residual=np.where(counts, e / np.where(counts, found.problem.weight, 1.0), np.nan),
        samples=int(counts.sum()),
        steps=found.evaluations,
        notes=(*notes_of(machine, numerics, log, on), *extra),
        details={"directions": stated, "criterion_percent": _criterion(found.problem, found.minimum), **many},
    )


def _problem(machine: Machine, log: Log, prior: float, on: str, numerics: Numerics) -> Problem:
    replay = from_rest(make_replay(machine, log, numerics))
    if on != "position":
        replay = eqx.tree_at(lambda r: r.sensor, replay, Sensor(), is_leaf=lambda x: isinstance(x, Sensor))
    measured, counts = measured_output(machine, log, on)
    std = machine.sensor.position_std
    n = log.position.shape[1]
    start = np.zeros(0) if std is None else np.broadcast_to(np.asarray(std), n)
    whole = Prior.of(machine, prior, start)
    weight = np.tile(counts.astype(float), (len(measured), 1))
    return Problem(replay, machine.parameters.places, machine.plant, measured, weight, whole, on)


def _padded(theta: np.ndarray, problem: Problem) -> np.ndarray:
    return np.concatenate([theta, np.zeros(problem.prior.base.size - len(theta))])


def _drawn(problem: Problem, starts: int) -> np.ndarray:
    """Starts within one prior of the guesses, (starts - 1, p); the guesses themselves are the first."""
    size = problem.prior.base.size
    w = np.random.default_rng(0).uniform(-1.0, 1.0, (max(starts - 1, 0), size))
    w[:, len(problem.places) :] = 0.0
    return w


def _rounds(problem: Problem, w: np.ndarray, last: bool = False) -> Steps[_Found]:
    """Read the directions, fit along them, and again, each time sharper, until they stay.

    `last`: at the sharpest only, from a point that is near.
    """
    size, spent = problem.prior.base.size, 0
    whole, none = np.eye(size), np.zeros(size, bool)
    ladder = problem.ladder[-1:] if last else problem.ladder
    minimum = yield Solve(_fit, (*problem.args, ladder[0], _NONE, whole, w, none))
    count, cost, settled = 0, np.inf, False
    for rung in range(len(ladder) + _ROUNDS):
        sharpness, before = ladder[min(rung, len(ladder) - 1)], count
        # Directions that change places with one another for ever are taken as they are.
        if rung < len(ladder) + _READ:
            problem = _weighed(problem, minimum)
            here = yield Solve(_fit, (*problem.args, sharpness, _NONE, whole, w, none))
            spent += int(here.steps)
            if not np.all(np.isfinite(here.jacobian)):
                return _Found(problem, whole, count, here, spent, False)
            noise = _noise(problem, here, count)
            vectors, count = _directions(np.asarray(here.jacobian) / noise, count)
        fitted = np.arange(size) < count
        start = np.where(fitted, np.clip(vectors.T @ w, -_FAR, _FAR), 0.0)
        pull = np.asarray(0.0 if sharpness is ladder[-1] else noise)
        minimum = yield Solve(_fit, (*problem.args, sharpness, pull, vectors, start, fitted))
        spent += int(minimum.steps)
        w = vectors @ np.asarray(minimum.theta)
        moved = abs(float(minimum.cost) - cost)
        close = before == count and moved <= _SETTLED / len(problem.measured) * cost
        settled, cost = close and sharpness is ladder[-1], float(minimum.cost)
        if settled or not np.isfinite(cost):
            break
    return _Found(problem, vectors, count, minimum, spent, settled)


def _directions(jacobian: np.ndarray, before: int) -> tuple[np.ndarray, int]:
    """Directions as columns, best told first, and how many are fitted; of a Jacobian over the noise."""
    size = jacobian.shape[1]
    _, values, rows = np.linalg.svd(jacobian, full_matrices=True)
    told = np.zeros(size)
    told[: values.size] = values
    count = int(np.sum(told > 1.0 / _TOLD_TWICE))
    if before > count:
        count = int(np.sum(told[:before] > 1.0 / _STAYS))
    # Eigenvectors come with either sign: the largest entry is taken positive.
    return rows.T * np.sign(rows[np.arange(size), np.argmax(np.abs(rows), axis=1)]), count


def _weighed(problem: Problem, minimum: Minimum) -> Problem:
    """Columns of the residual by their own spread, where there are several."""
    counts = problem.weight[0] > 0
    if counts.sum() == 1:
        return problem
    e = np.asarray(minimum.residual).reshape(problem.measured.shape)[:, counts] / problem.weight[0, counts]
    least = 1e-12 * np.std(problem.measured[:, counts], axis=0)
    row = np.zeros(len(counts))
    row[counts] = 1.0 / np.maximum(np.std(e, axis=0), least)
    return replace(problem, weight=np.tile(row, (len(problem.measured), 1)))


def _noise(problem: Problem, minimum: Minimum, count: int) -> float:
    """Standard deviation of a weighted residual."""
    samples = int(np.sum(problem.weight > 0))
    return float(np.sqrt(2 * float(minimum.cost) / max(samples - count, 1)))


def _elsewhere(problem: Problem, found: _Found, points: np.ndarray) -> Steps[_Found]:
    """The rounds from the best of some points too: a machine that sticks at the guesses shows nothing."""
    size = problem.prior.base.size
    still = (np.eye(size), points, np.zeros((len(points), size), bool))
    _, costs, _, _ = yield Solve(_fit_each, (*problem.args, problem.ladder[0], _NONE, *still))
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    other = yield from _rounds(problem, points[best])
    better = float(other.minimum.cost) < float(found.minimum.cost) * (1 - _SAME)
    return replace(other if better else found, evaluations=found.evaluations + other.evaluations)


def _many_starts(found: _Found, points: np.ndarray) -> Steps[tuple[_Found, dict[str, Any]]]:
    """The best of many starts, and how many end there."""
    spent = found.evaluations
    for again in (True, False):
        fitted = np.arange(found.vectors.shape[0]) < found.count
        z = np.where(fitted, np.clip(points @ found.vectors, -_FAR, _FAR), 0.0)
        active = np.tile(fitted, (len(z), 1))
        noise = _noise(found.problem, found.minimum, found.count)
        ladder = found.problem.ladder
        for sharpness in ladder:
            pull = np.asarray(0.0 if sharpness is ladder[-1] else noise)
            args = (*found.problem.args, sharpness, pull, found.vectors, z, active)
            z, costs, _, _ = (np.asarray(x) for x in (yield Solve(_fit_each, args)))
        costs = np.where(np.isfinite(costs), costs, np.inf)
        best, cost = int(np.argmin(costs)), float(found.minimum.cost)
        if not again or costs[best] >= cost * (1 - _SAME):
            break
        # Other directions may be told from there.
        other = yield from _rounds(found.problem, found.vectors @ z[best], last=True)
        spent += other.evaluations
        if float(other.minimum.cost) >= cost:
            break
        found = other
    cost = float(found.minimum.cost)
    same = np.append(costs, cost) <= cost * (1 + _SAME)
    stated = {"count": len(same), "same_optimum": int(same.sum())}
    return replace(found, evaluations=spent), {"starts": stated}


@eqx.filter_jit
def _each_start(*args: Any) -> Array:
    *problem, sharpness, vectors, z, offsets = args
    replay, places, plant, *rest = problem
    plant = replace(plant, sharpness=sharpness)
    # What the loop does of a motor that stands elsewhere within its first count.
    moved = lambda offset: eqx.tree_at(lambda r: r.position, replay, replay.position + offset)
    at = lambda offset: _residual_of(moved(offset), places, plant, *rest, vectors)(z)
    return eqx.filter_vmap(at)(offsets)


def _rounding(machine: Machine, found: _Found) -> Steps[np.ndarray | None]:
    """What rounding of readings does to the residual, (draws, time, k); None where none was left out.

    The loop of the estimate is simulated with it from many places within the first count, and without.
    """
    count, problem = machine.sensor.position_resolution, found.problem
    if problem.on == "position" or count is None or problem.replay.controller is None:
        return None
    n = problem.replay.position.size
    offsets = np.random.default_rng(0).uniform(-0.5, 0.5, (_DRAWS, n)) * np.asarray(count)
    rounded = eqx.tree_at(
        lambda r: r.sensor, problem.replay, machine.sensor, is_leaf=lambda x: isinstance(x, Sensor)
    )
    rest = (problem.ladder[-1], found.vectors, np.asarray(found.minimum.theta))
    with_it = yield Solve(_each_start, (rounded, *problem.args[1:], *rest, offsets))
    without = yield Solve(_each_start, (problem.replay, *problem.args[1:], *rest, 0.0 * offsets[:1]))
    return np.asarray(with_it) - np.asarray(without)


def _assessed(
    machine: Machine, found: _Found, hessian: np.ndarray | None, rounding: np.ndarray | None
) -> tuple[Precision, list[dict[str, Any]]]:
    """Precision of the parameters, and of the directions."""
    problem, r = found.problem, found.count
    if r == 0:
        return _nothing_told(machine)
    names = [*machine.parameters.names, *_nuisances(problem)]
    shape, counts = problem.measured.shape, problem.weight > 0
    jacobian = np.asarray(found.minimum.jacobian).reshape(*shape, -1)[..., :r]
    e = np.asarray(found.minimum.residual).reshape(shape)
    deviation = problem.weight * (problem.measured - problem.measured.mean(axis=0))
    signal = float(np.linalg.norm(deviation))
    told = assess(
        [f"direction {k + 1}" for k in range(r)], jacobian, e, counts,
        signal, np.ones(r), hessian, crossed=problem.on == "both",
    )
    z = np.asarray(found.minimum.theta)
    theta = np.asarray(problem.prior.outward(found.vectors @ z))
    flat = jacobian.reshape(-1, r)
    white = _noise(problem, found.minimum, r) * np.sqrt(np.diag(np.linalg.inv(flat.T @ flat)))
    # A colour read off a hundred samples is itself uncertain: never less than white noise would leave.
    larger = np.maximum(1.0, white / told.std)
    of_seen = told.covariance * np.outer(larger, larger)
    if rounding is not None:
        # To first order each draw of it moves the estimate so far; the residual has one draw in it.
        moved = np.stack([np.linalg.lstsq(flat, d.ravel())[0] for d in rounding])
        left = 1.0 - np.mean(rounding**2) * rounding[0].size / np.sum(e**2)
        of_seen = moved.T @ moved / len(moved) + max(left, _OWN) * of_seen
    seen, held = found.vectors[:, :r], found.vectors[:, r:]
    slope = problem.prior.slope(theta)
    whole = seen @ of_seen @ seen.T + held @ held.T
    p = len(problem.places)
    left = np.sqrt(np.diag(whole))[:p]
    identifiable = left < _TOLD
    covariance = (whole * np.outer(slope, slope))[:p, :p]
    covariance[~identifiable] = covariance[:, ~identifiable] = np.nan
    stated = [
        {
            "combination": dict(zip(names, found.vectors[:, k].tolist(), strict=True)), "value": float(z[k]),
            "std": float(np.sqrt(of_seen[k, k])), "std_white": float(white[k]),
        }
        for k in range(r)
    ]
    blind = [c for c in (_named(names, v) for v in held.T) if any(n in c for n in names[:p])]
    return Precision(covariance, identifiable, blind, told.information), stated


def _nothing_told(machine: Machine) -> tuple[Precision, list[dict[str, Any]]]:
    """Of a log that tells no combination better than the guesses."""
    names = machine.parameters.names
    p = len(names)
    blind = [{n: 1.0} for n in names]
    return Precision(np.full((p, p), np.nan), np.zeros(p, bool), blind, np.zeros(0)), []


def _named(names: Sequence[str], vector: np.ndarray) -> dict[str, float]:
    return {n: float(v) for n, v in zip(names, vector, strict=True) if abs(v) > _NEGLIGIBLE}


def _nuisances(problem: Problem) -> list[str]:
    return [f"start position {k + 1}" for k in range(problem.prior.base.size - len(problem.places))]


def _profiles(found: _Found, stated: list[dict[str, Any]]) -> Steps[None]:
    """Add to each direction its profile: where the cost has risen as 1 and 4 standard deviations say."""
    r, size = found.count, found.vectors.shape[0]
    if not r:
        return
    best = np.asarray(found.minimum.theta)
    z = np.tile(best, (r, _PROFILED.size, 1))
    active = np.tile(np.arange(size) < r, (r, _PROFILED.size, 1))
    for k in range(r):
        z[k, :, k] += _PROFILED * stated[k]["std"]
        active[k, :, k] = False
    flat = (z.reshape(-1, size), active.reshape(-1, size))
    args = (*found.problem.args, found.problem.ladder[-1], _NONE, found.vectors, *flat)
    _, costs, _, _ = yield Solve(_fit_each, args)
    rise = 2 * (np.asarray(costs).reshape(r, -1) - float(found.minimum.cost))
    noise = _noise(found.problem, found.minimum, r) ** 2
    for k in range(r):
        stated[k]["profile"] = {
            "at_std": _PROFILED.tolist(), "rise": (rise[k] / noise).tolist(),
        }


def _criterion(problem: Problem, minimum: Minimum) -> float:
    """(11) of Bogdan and Abba: squared residual over squared deviation from the mean, percent."""
    weight, measured = problem.weight, problem.measured
    spread = np.sum((weight * (measured - measured.mean(axis=0))) ** 2)
    return float(100 * 2 * float(minimum.cost) / spread)


def criterion_steps(
    machine: Machine, log: Log, theta: Float[np.ndarray, " p"], *, on: str = "position",
    numerics: Numerics | None = None,
) -> Steps[float]:
    """Criterion of the same simulation at given unknowns, percent; nothing is fitted."""
    problem = _problem(machine, log, 1.0, on, numerics or choose_numerics(machine, log))
    size = problem.prior.base.size
    w = problem.prior.inward(_padded(theta, problem))
    nothing = (np.eye(size), w, np.zeros(size, bool))
    found = yield Solve(_fit, (*problem.args, problem.ladder[-1], _NONE, *nothing))
    return _criterion(problem, found)
