"""The likelihood of the innovations of one log or several, each with its noise, and its maximum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.common.scoring import Scored
from jaxid.estimators.innovations import Innovations, fit, fit_steps
from jaxid.estimators.likelihood import Likelihood
from jaxid.estimators.several.descent import Descent, Model, descent_steps
from jaxid.estimators.several.parts import Part
from jaxid.machine import Machine
from jaxid.numerics.lanes import ParallelCalls, Steps
from jaxid.numerics.rows import Rows

# Rise of the log-likelihood [nats] below which a fit of several logs has converged, as of one log.
_TOLERANCE, _DAMPING = 1e-5, 1e-3
# A noise within this part above its floor rests there.
_AT_FLOOR = 1e-3


@dataclass(frozen=True)
class Member:
    """Likelihood of one log among those of all.

    Args:
        part: The log with its machine.
        at: Its likelihood and the start of its noise.
        problem: The likelihood with the present bounds.
        command_noise: Standard deviation with which the command was read, (m,); None: it was logged exactly.
    """

    part: Part
    at: Likelihood
    problem: Innovations
    command_noise: Float[np.ndarray, " m"] | None

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the log."""
        return self.part.index.size

    @property
    def noises(self) -> int:
        """Number of noises, of the force and of the readings."""
        return self.at.noise.size

    @property
    def drives(self) -> int:
        """Number of commands."""
        return len(self.at.force)

    def rests(self, noise: Float[np.ndarray, " q"], floor: Float[np.ndarray, " q"]) -> Bool[np.ndarray, " m"]:
        """Return the mask of the forces whose noise rests at a floor, from their logarithms."""
        return noise[: self.drives] <= floor[: self.drives] + _AT_FLOOR

    def slopes(self, scored: Scored) -> Float[np.ndarray, "time k own"]:
        """Return the derivatives of the innovations, over their standard deviations, by the values in SI."""
        own = self.unknowns
        # The slopes are those at the optimum, before the correction.
        fitted = self.problem.transform.outward(scored.x[:own])
        rows = self.problem.transform.physical(scored.mean[..., :own].reshape(scored.z.size, own), fitted)
        return np.asarray(rows).reshape(*scored.z.shape, own)

    def rows(self, scored: Scored, scale: Float[np.ndarray, " p"]) -> Rows:
        """Return the innovations as residuals of a fit to all logs.

        An unknown is identifiable if its standard deviation changes the innovations less than the largest
        effect of any unknown does.

        Args:
            scored: The likelihood at a fit.
            scale: Natural sizes of the unknowns of all logs.
        """
        slopes = self.part.widened(self.slopes(scored), scale.size)
        with np.errstate(invalid="ignore", over="ignore"):  # if an unknown ran away, the estimate says so
            effect = np.linalg.norm((slopes * scale).reshape(scored.z.size, -1), axis=0)
        largest = float(np.max(effect, initial=0.0))
        return Rows(slopes, np.asarray(scored.z), np.asarray(self.problem.counts), largest)


@dataclass(frozen=True)
class Maximum:
    """End of a fit.

    Args:
        x: Unknowns of all logs, then the noise of each log, on the scale of the solver.
        theta: Physical values, (p,).
        noises: Logarithms of the noise of each log.
        scored: Likelihood of each log there.
        cost: Negative log-likelihood of all logs.
        converged: Whether it can fall no further.
        steps: Number of evaluations.
    """

    x: np.ndarray
    theta: Float[np.ndarray, " p"]
    noises: list[np.ndarray]
    scored: list[Scored]
    cost: float
    converged: bool
    steps: int


@dataclass(frozen=True)
class JointLikelihood:
    """The likelihood of all logs, by the unknowns and the noise of each log on the scale of the solver.

    Args:
        machine: Machine of all logs, with their unknowns.
        members: The likelihoods of the logs.
    """

    machine: Machine
    members: tuple[Member, ...]

    @property
    def unknowns(self) -> int:
        """Number of unknowns of all logs, without noise."""
        return len(self.machine.parameters.free)

    @property
    def places(self) -> list[np.ndarray]:
        """Places of each log's unknowns and noises among those of all."""
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
        for member, place in zip(self.members, self.places, strict=True):
            low, high = member.problem.transform.bounds(*member.problem.bounds)
            lower[place] = np.concatenate([np.asarray(low), member.problem.low])
            upper[place] = np.concatenate([np.asarray(high), member.problem.high])
        return lower, upper

    def theta(self, x: np.ndarray) -> Float[np.ndarray, " p"]:
        """Return the physical values of the unknowns."""
        theta = np.zeros(self.unknowns)
        for member, place in zip(self.members, self.places, strict=True):
            own = member.part.index
            theta[own] = np.asarray(member.problem.transform.outward(x[place[: own.size]]))
        return theta

    def above(self, floor: int, end: Maximum) -> bool:
        """Check that the noise of every force has come out above one of the floors."""
        pairs = zip(end.noises, self.members, strict=True)
        return not any(np.any(m.rests(noise, m.at.floors[floor])) for noise, m in pairs)

    def at_floor(self, floor: int) -> JointLikelihood:
        """Return the likelihood with one of the floors of the noise."""
        members = [replace(m, problem=m.problem._replace(low=m.at.floors[floor])) for m in self.members]
        return replace(self, members=tuple(members))

    def at_quietest(self) -> JointLikelihood | None:
        """Return the likelihood with the lowest floors of the noise; None if a log has no lower ones."""
        members = []
        for member in self.members:
            if member.at.quietest is None:
                return None
            members.append(replace(member, problem=member.problem._replace(low=member.at.quietest)))
        return replace(self, members=tuple(members))

    def sticks_surely(self, noises: Sequence[np.ndarray]) -> list[bool]:
        """Check for each log that its noise is so small that it is known when a joint sticks."""
        return [m.at.sticks_surely(noise) for m, noise in zip(self.members, noises, strict=True)]

    def at_rest_too(self, chosen: Sequence[bool]) -> JointLikelihood:
        """Return the likelihood with the samples at rest of the chosen logs."""
        members = [
            replace(m, problem=m.at.at_rest_too(m.problem)) if there else m
            for m, there in zip(self.members, chosen, strict=True)
        ]
        return replace(self, members=tuple(members))

    def fit(self, theta: np.ndarray, noises: Sequence[np.ndarray], most: int) -> Steps[Maximum]:
        """Maximise the likelihood from physical values and logarithms of the noise of each log.

        Args:
            theta: Physical values, (p,).
            noises: Logarithms of the noise of each log.
            most: Largest number of evaluations; one only evaluates the likelihood.
        """
        if len(self.members) == 1:
            [member] = self.members
            scored = yield from fit_steps(member.problem, theta, noises[0], most)
            x, ended = np.asarray(scored.x), (float(scored.cost), bool(scored.converged), int(scored.steps))
            return Maximum(x, self.theta(x), [x[self.unknowns :]], [scored], *ended)
        x = np.zeros(self.unknowns + sum(m.noises for m in self.members))
        for member, place, noise in zip(self.members, self.places, noises, strict=True):
            own = np.clip(theta[member.part.index], *member.problem.bounds)
            x[place] = np.concatenate([np.asarray(member.problem.transform.inward(own)), noise])
        options = {"tolerance": (0.0, _TOLERANCE), "max_steps": most, "damping": _DAMPING}
        found: Descent = yield from descent_steps(self.evaluate, x, self.bounds, **options)
        noises = [found.x[place[m.unknowns :]] for m, place in zip(self.members, self.places, strict=True)]
        ended = (found.model.cost, found.converged and found.model.finite, found.steps)
        return Maximum(found.x, self.theta(found.x), noises, found.model.content, *ended)

    def evaluate(self, x: np.ndarray) -> Steps[Model]:
        """Compute the negative log-likelihood with its gradient and information."""
        found = []
        for member, place in zip(self.members, self.places, strict=True):
            found.append((yield from scored_at(member.problem, x[place], member.unknowns)))
        return self.sum_of(found)

    def sum_of(self, scored: list[Scored]) -> Model:
        """Return the negative log-likelihood of all logs with its gradient and information."""
        size = self.unknowns + sum(m.noises for m in self.members)
        cost, gradient, normal = 0.0, np.zeros(size), np.zeros((size, size))
        for place, one in zip(self.places, scored, strict=True):
            cost += float(one.cost)
            gradient[place] += one.gradient
            normal[np.ix_(place, place)] += _information(one)
        return Model(cost, gradient, normal, scored)


def scored_at(problem: Innovations, x: np.ndarray, p: int) -> Steps[Scored]:
    """Evaluate the likelihood of one log at p unknowns and the noises on the scale of the solver."""
    return (yield from fit_steps(problem, np.asarray(problem.transform.outward(x[:p])), x[p:], 1))


def gradients_together(problems: Sequence[Innovations], x: np.ndarray, p: int) -> Steps[list[np.ndarray]]:
    """Return the gradients of several likelihoods at one point, see `scored_at`.

    Those of joints that push each other are computed in threads, one per core.
    """
    if problems and problems[0].plant.coupled:
        theta = np.asarray(problems[0].transform.outward(x[:p]))
        return (yield ParallelCalls(_gradient, [(problem, theta, x[p:]) for problem in problems]))
    gradients = []
    for problem in problems:
        gradients.append((yield from scored_at(problem, x, p)).gradient)
    return gradients


def _gradient(problem: Innovations, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
    # The slopes of each sample are dropped at once: those of many logs fill the memory.
    return np.asarray(fit(problem, theta, noise, np.asarray(1)).gradient)


def _information(scored: Scored) -> np.ndarray:
    """Return the information, on a variance the observed one where that exceeds the expected one."""
    q = scored.x.size
    rows, logs = np.asarray(scored.mean).reshape(-1, q), np.asarray(scored.log_variance).reshape(-1, q)
    weight = np.maximum(np.square(np.asarray(scored.z)).ravel(), 1.0)[:, None]
    return rows.T @ rows + 0.5 * logs.T @ (weight * logs)
