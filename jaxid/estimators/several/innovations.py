"""Maximum likelihood of the innovations of several logs, each with its noise: prediction error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.estimators.common.scoring import Scored
from jaxid.estimators.common.shapes import shape_starts
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.innovations import Innovations
from jaxid.estimators.innovations import fit as evaluated
from jaxid.estimators.prediction_error import (
    BLIND,
    LAGS,
    PAIRS,
    REJECTS,
    SCREENING,
    Likelihood,
    likelihood_of,
    needed_numerics,
    whiteness,
)
from jaxid.estimators.several.descent import Descent, Model, descent_steps
from jaxid.estimators.several.force import stacked
from jaxid.estimators.several.parts import Part, by_log, parts_of
from jaxid.estimators.several.weights import disagreement
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.misspecified import std_under_misspecification, widening
from jaxid.numerics.precision import FISHER, Rows, assess_together
from jaxid.session import Session
from jaxid.simulation.sensor_noise import force_noise

# Rise of the log-likelihood [nats] below which a fit has converged, and most evaluations; as for one log.
_TOLERANCE, _STEPS, _DAMPING = 1e-5, 80, 1e-3
# A noise within this part above its floor rests there.
_AT_FLOOR = 1e-3


@dataclass(frozen=True)
class _Member:
    """Likelihood of one log among those of all.

    Args:
        part: The log with its machine.
        at: Its likelihood and the start of its noise.
        problem: The likelihood with the present bounds.
    """

    part: Part
    at: Likelihood
    problem: Innovations

    @property
    def noises(self) -> int:
        """Number of noises, of the force and of the readings."""
        return self.at.noise.size


@dataclass(frozen=True)
class _Fit:
    """The likelihood of all logs, by the unknowns and the noise of each log on the scale of the solver.

    Args:
        session: Case and logs.
        members: The likelihoods of the logs.
    """

    session: Session
    members: tuple[_Member, ...]

    @property
    def unknowns(self) -> int:
        """Number of unknowns of all logs, without noise."""
        return len(self.session.machine.parameters.free)

    def places(self) -> list[np.ndarray]:
        """Return the places of each log's unknowns and noises among those of all."""
        end, out = self.unknowns, []
        for member in self.members:
            out.append(np.concatenate([member.part.index, np.arange(end, end + member.noises)]))
            end += member.noises
        return out

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds on the scale of the solver."""
        size = self.unknowns + sum(m.noises for m in self.members)
        lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
        for member, place in zip(self.members, self.places(), strict=True):
            low, high = member.problem.transform.bounds(*member.problem.bounds)
            lower[place] = np.concatenate([np.asarray(low), member.problem.low])
            upper[place] = np.concatenate([np.asarray(high), member.problem.high])
        return lower, upper

    def inward(self, theta: np.ndarray, noises: Sequence[np.ndarray]) -> np.ndarray:
        """Return physical values and noises on the scale of the solver."""
        x = np.zeros(self.unknowns + sum(m.noises for m in self.members))
        for member, place, noise in zip(self.members, self.places(), noises, strict=True):
            own = np.clip(theta[member.part.index], *member.problem.bounds)
            x[place] = np.concatenate([np.asarray(member.problem.transform.inward(own)), noise])
        return x

    def theta(self, x: np.ndarray) -> np.ndarray:
        """Return the physical values of the unknowns."""
        theta = np.zeros(self.unknowns)
        for member, place in zip(self.members, self.places(), strict=True):
            own = member.part.index
            theta[own] = np.asarray(member.problem.transform.outward(x[place[: own.size]]))
        return theta

    def noises(self, x: np.ndarray) -> list[np.ndarray]:
        """Return the logarithms of the noise of each log."""
        return [
            x[place[member.part.index.size :]]
            for member, place in zip(self.members, self.places(), strict=True)
        ]

    def evaluate(self, x: np.ndarray) -> Steps[Model]:
        """Compute the negative log-likelihood with its gradient and information."""
        cost, gradient, normal = 0.0, np.zeros(x.size), np.zeros((x.size, x.size))
        found = []
        for member, place in zip(self.members, self.places(), strict=True):
            scored = yield from _scored(member.problem, x[place], member.part.index.size)
            found.append(scored)
            cost += float(scored.cost)
            gradient[place] += np.asarray(scored.gradient)
            normal[np.ix_(place, place)] += _information(scored)
        return Model(cost, gradient, normal, found)

    def fit(self, x: np.ndarray, most: int = _STEPS) -> Steps[Descent]:
        """Maximise the likelihood from a start."""
        options = {"tolerance": (0.0, _TOLERANCE), "max_steps": most, "damping": _DAMPING}
        return (yield from descent_steps(self.evaluate, x, self.bounds, **options))


def _scored(problem: Innovations, x: np.ndarray, p: int) -> Steps[Scored]:
    """Evaluate the likelihood of one log on the scale of the solver."""
    theta = np.asarray(problem.transform.outward(x[:p]))
    scored = yield SolveRequest(evaluated, (problem, theta, x[p:], np.asarray(1)))
    return scored


def _information(scored: Scored) -> np.ndarray:
    """Return the information, on a variance the observed one where that exceeds the expected one."""
    q = scored.x.size
    rows, logs = np.asarray(scored.mean).reshape(-1, q), np.asarray(scored.log_variance).reshape(-1, q)
    weight = np.maximum(np.square(np.asarray(scored.z)).ravel(), 1.0)[:, None]
    return rows.T @ rows + 0.5 * logs.T @ (weight * logs)


def prediction_error_steps(session: Session, *, start: np.ndarray | None = None) -> Steps[Estimate]:
    """Fit the unknowns to several logs by maximum likelihood; see `jaxid.estimators.prediction_error`.

    Args:
        session: Case and logs.
        start: A start beside the guesses, for example from inverse dynamics, (p,).

    Raises:
        InputError: If too few readings of a log count.
    """
    machine, parts = session.machine, parts_of(session)
    own = [None if start is None else start[part.index] for part in parts]
    chosen = [needed_numerics(p.machine, p.run.log, s) for p, s in zip(parts, own, strict=True)]
    most = max(n.substeps for n in chosen)
    members = []
    for part, at, numerics in zip(parts, own, chosen, strict=True):
        rest = np.asarray(part.run.data.recipe.rest_velocity)
        numerics = replace(numerics, substeps=most)
        made = likelihood_of(part.machine, part.run.log, start=at, numerics=numerics, rest_velocity=rest)
        members.append(_Member(part, made, made.problem))
    fit = _Fit(session, tuple(members))

    noises = [member.at.noise for member in members]
    guess = machine.parameters.guess
    shapes = shape_starts(machine, guess)
    starts = [guess, *shapes] if shapes or start is None else []
    if start is not None:
        starts.insert(0, np.clip(start, *machine.parameters.bounds))
    x, steps = fit.inward(starts[0], noises), 0
    if len(starts) > 1:
        trials = []
        for at in starts:
            trials.append((yield from fit.fit(fit.inward(at, noises), SCREENING)))
        x = min(trials, key=lambda trial: np.nan_to_num(trial.model.cost, nan=np.inf)).x
        steps = sum(trial.steps for trial in trials)

    found = None
    for k in range(len(members[0].at.floors)):
        lowered = [replace(m, problem=m.problem._replace(low=m.at.floors[k])) for m in fit.members]
        fit = replace(fit, members=tuple(lowered))
        found = yield from fit.fit(x)
        x, steps = found.x, steps + found.steps
        above = [
            np.all(noise[: m.at.force.size] > m.at.floors[k][: m.at.force.size] + _AT_FLOOR)
            for noise, m in zip(fit.noises(x), fit.members, strict=True)
        ]
        if all(above) or not found.model.finite:
            break
    assert found is not None, "there is at least one floor"

    sure = [m.at.sticks_surely(noise) for m, noise in zip(fit.members, fit.noises(x), strict=True)]
    if any(sure):
        finer = [
            replace(m, problem=m.at.at_rest_too(m.problem)) if s else m
            for m, s in zip(fit.members, sure, strict=True)
        ]
        fit = replace(fit, members=tuple(finer))
        found = yield from fit.fit(x)
        x, steps = found.x, steps + found.steps

    theta = fit.theta(x)
    if found.converged:
        theta = yield from _corrected_steps(fit, x)
    return _estimate(fit, found, theta, steps)


def _corrected_steps(fit: _Fit, x: np.ndarray) -> Steps[np.ndarray]:
    """Remove the bias by noise with which the commands were read, as for one log; return the estimates."""
    gradient, information = np.zeros(x.size), np.zeros((x.size, x.size))
    read_any = False
    rng = np.random.default_rng(0)
    for member, place in zip(fit.members, fit.places(), strict=True):
        p, m = member.part.index.size, member.at.force.size
        own = x[place].copy()
        stated = force_noise(member.part.machine, member.part.run.data)
        read = np.zeros(m) if member.at.applied is not None else np.minimum(stated, np.exp(own[p : p + m]))
        more = bool(np.any(read > 0))
        read_any |= more
        if more:
            own[p : p + m] += 0.5 * np.log1p((read / np.exp(own[p : p + m])) ** 2)
        at_fit = yield from _scored(member.problem, own, p)
        information[np.ix_(place, place)] += np.asarray(at_fit.information)
        if not more:
            continue
        kalman = member.problem.kalman
        command, every = np.asarray(kalman.command), kalman.every
        gradients = []
        for _ in range(PAIRS):
            noise = read * rng.standard_normal((len(command[::every]), m))
            noise = np.repeat(noise, every, axis=0)[: len(command)]
            for sign in (1.0, -1.0):
                shifted = eqx.tree_at(lambda k: k.command, kalman, command + sign * noise)
                scored = yield from _scored(member.problem._replace(kalman=shifted), own, p)
                gradients.append(np.asarray(scored.gradient))
        gradient[place] += np.mean(gradients, axis=0)
    if not read_any or not (np.all(np.isfinite(information)) and np.all(np.isfinite(gradient))):
        return fit.theta(x)
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information / np.outer(size, size), rcond=BLIND, hermitian=True)
    shift = -inverse @ (gradient / size) / size
    moved = x.copy()
    moved[: fit.unknowns] -= shift[: fit.unknowns]
    return np.clip(fit.theta(moved), *fit.session.machine.parameters.bounds)


def _estimate(fit: _Fit, found: Descent, theta: np.ndarray, steps: int) -> Estimate:
    machine = fit.session.machine
    names, natural = machine.parameters.names, np.where(theta != 0, theta, 1.0)
    logs, p_values, noises = [], [], []
    for member, scored, noise in zip(fit.members, found.model.content, fit.noises(found.x), strict=True):
        problem, own = member.problem, member.part.index.size
        counts, z = np.asarray(problem.counts), np.asarray(scored.z)
        fitted = problem.transform.outward(scored.x[:own])
        rows = problem.transform.physical(np.asarray(scored.mean)[..., :own].reshape(z.size, own), fitted)
        slopes = member.part.widened(np.asarray(rows).reshape(*z.shape, own), theta.size)
        effect = np.linalg.norm((slopes * natural).reshape(z.size, -1), axis=0)
        logs.append(Rows(slopes, z, counts, float(np.max(effect, initial=0.0))))
        p_values.append([whiteness(e[c]) for e, c in zip(z.T, counts.T, strict=True)])
        drives = member.at.force.size
        noises.append({"force": np.exp(noise[:drives]), "position": np.exp(noise[drives:])})
    plain = replace(assess_together(names, logs, natural), kind=FISHER)
    jacobian, z, counts = stacked(logs)
    notes = ["noise of the force and of the readings was estimated for each log, with the unknowns"]
    if min(min(p) for p in p_values) < REJECTS:
        notes.append(
            "the innovations are not white (rounding, coloured noise or an incomplete model): the standard "
            "deviations are widened accordingly"
        )
    notes += disagreement(logs, int(plain.identifiable.sum()))
    entries: list[dict[str, Any]] = [
        {"samples": int(log.counts.sum()), "noise": noise, "whiteness": {"lags": LAGS, "p": p}}
        for log, noise, p in zip(logs, noises, p_values, strict=True)
    ]
    converged = found.converged and bool(np.all(np.isfinite(theta)))
    return Estimate(
        method="prediction_error",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=plain.widened(widening(plain, jacobian, z, counts, [len(log.residual) for log in logs])),
        converged=converged,
        message="converged" if converged else f"no convergence within {steps} steps",
        residual=np.where(counts, z, np.nan),
        samples=int(counts.sum()),
        steps=steps,
        notes=tuple(notes),
        details={**by_log([m.part for m in fit.members], entries), "log_likelihood": -found.model.cost},
        std_misspecified=std_under_misspecification(jacobian, z, counts),
    )
