"""What rounding of readings does to a fit that simulates its loop without: found by simulating it.

In a loop with a coarse encoder the instant at which a reading steps is chaotic, and what it does to the
force is neither small nor white, nor nothing on average. So logs are drawn with it, about where the truth may
be; those that rounding moves more than it moved the measured one do not count; and the others say which log
to expect where, and what scatters about that, sample with sample: the noise by which the truth is told.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.within_prior.precision import DirectionPrecision, precision_of_directions
from jaxid.estimators.within_prior.problem import (
    DRAWN,
    STAYS,
    Problem,
    RoundsResult,
    at_each,
    at_each_soon,
    signed,
)
from jaxid.machine import Machine
from jaxid.numerics.lanes import Precompile, Steps, run_alone
from jaxid.simulation.replay import with_sensor

# Until passes settle logs are drawn so many deviations about the point that was found last, or as far as the
# next is from it, but over this part of the prior at most; from one pass to the next that changes by these
# factors at most. A point never moves by more.
_REACH, _MOST = 2.5, 1.5
_NARROWER, _WIDER = 0.3, 2.0
# Of the first pass, over what logs drawn at the fit itself scatter by.
_FIRST = 4.0
# The log counts along directions whose slope over its noise is more than this, not only along those fitted:
# what is told a little leans on what is told well, and each is seen with the others.
_SEEN = 0.35
# Passes, and those after which drawn logs count together.
_PASSES, _SETTLING = 10, 4
# Logs so far beyond the rest, in deviations of their distance, are of a loop that ran away.
_AWAY, _SIEVED = 6.0, 3
# With fewer that did not run away nothing is told; of the others so many count, even if none can be the log.
_FEWEST, _LIKE = 100, 128
# Samples of a log of which each is compared, at most.
_LONG = 100
# Least part of what a fit leaves that is noise.
_OWN = 0.1
# Of a scatter that is none: of a direction that ended at a bound.
_LEAST = 1e-12


def rounds(machine: Machine, problem: Problem) -> bool:
    """Whether the loop reads by counts that its simulation left out."""
    coarse = machine.sensor.position_resolution is not None and problem.on != "position"
    return coarse and problem.replay.controller is not None


def draws_soon(machine: Machine, problem: Problem) -> Precompile:
    """What `through_rounding` will ask for."""
    return at_each_soon(_rounding(machine, problem))


def rounded(
    machine: Machine, problem: Problem, rng: np.random.Generator
) -> Steps[Float[np.ndarray, "draws rows"]]:
    """Residuals at the guesses with rounding in the loop, from starts within the first count."""
    starts = rng.uniform(-0.5, 0.5, (DRAWN, len(problem.encoders))) * _counts(machine, problem)
    return at_each(_rounding(machine, problem), np.zeros((DRAWN, problem.prior.base.size)), starts)


def _counts(machine: Machine, problem: Problem) -> Float[np.ndarray, " k"]:
    """Counts of the readings, by encoder."""
    each = np.broadcast_to(machine.sensor.position_resolution, problem.replay.position.size)
    return each[[*problem.encoders]]


def _rounding(machine: Machine, problem: Problem) -> Problem:
    """The same with rounding in its loop."""
    return replace(problem, replay=with_sensor(problem.replay, machine.sensor))


def drawn_roundings(machine: Machine, problem: Problem, draws: int) -> Float[np.ndarray, "draws rows"] | None:
    """What rounding does to a residual at the guesses, the start anywhere within its first count.

    Args:
        machine: Its sensor rounds.
        problem: At whose guesses.
        draws: How many, at least.

    Returns:
        Residuals less their mean; None where the loop's readings are not rounded.
    """
    if not rounds(machine, problem):
        return None
    rng = np.random.default_rng(2)
    e = [run_alone(rounded(machine, problem, rng)) for _ in range(-(-draws // DRAWN))]
    e = np.concatenate(e)[:draws]
    return e - e.mean(axis=0)


@dataclass(frozen=True)
class _Drawn:
    """Logs drawn with rounding that may be the measured one.

    Args:
        at: Where, along the directions of which the log says anything, (draws, k).
        left: The measured log less each: of its rows, or numbers made of them, (draws, q).
        noise: Covariance of the noise that they lack, (q, q), or its diagonal.
    """

    at: Float[np.ndarray, "draws k"]
    left: Float[np.ndarray, "draws q"]
    noise: np.ndarray

    def line(self, about: Float[np.ndarray, " k"]) -> Float[np.ndarray, "draws 1+k"]:
        """What logs are taken as a line in."""
        return np.column_stack([np.ones(len(self.at)), self.at - about])

    def along(self, numbers: Float[np.ndarray, "rows q"]) -> _Drawn:
        """In few numbers."""
        return _Drawn(self.at, self.left @ numbers, (numbers.T * self.noise) @ numbers)

    @classmethod
    def together(cls, several: list[_Drawn]) -> _Drawn:
        """As one, the noise that of the mean."""
        noise = np.average([d.noise for d in several], axis=0, weights=[len(d.at) for d in several])
        return cls(np.concatenate([d.at for d in several]), np.concatenate([d.left for d in several]), noise)


@dataclass(frozen=True)
class _Summary:
    """What a fit sees of a log: how far one Gauss-Newton step moves along its directions.

    Where the machine stood within its first count is no unknown here, for each drawn log has its own: as an
    unknown too it would count twice, and lead beyond that count.

    Args:
        problem: With rounding in its loop.
        resolution: Counts of the readings, by encoder.
        axes: Directions of the machine's unknowns alone, the best told first, (p, p).
        count: Of those along which the log says anything, k.
        point: Where the fit ended, along them, (p,).
        noise: Standard deviation of what it left, by which residuals are divided.
        residual: What it left of the measured log, (rows,).
        jacobian: Of that along the r directions of which the log says anything, the start's too, (rows, r).
        step: From a residual to how far that is, (r, rows).
        along: From that to how far it is along the k directions, (k, r).
        shifts: Whether unknowns of the reference move the log in time.
    """

    problem: Problem
    resolution: Float[np.ndarray, " k"]
    axes: Float[np.ndarray, "p p"]
    count: int
    point: Float[np.ndarray, " p"]
    noise: float
    residual: Float[np.ndarray, " rows"]
    jacobian: Float[np.ndarray, "rows r"]
    step: Float[np.ndarray, "r rows"]
    along: Float[np.ndarray, "k r"]
    shifts: bool

    @classmethod
    def of(cls, machine: Machine, found: RoundsResult) -> _Summary:
        """Of a fit; its minimum is in the coordinates of all directions."""
        problem, p = found.problem, len(found.problem.places)
        noise = problem.noise(found.minimum, found.count)
        over = np.asarray(found.minimum.jacobian) / noise
        r = max(found.count, int(np.sum(np.linalg.norm(over, axis=0) > _SEEN)))
        seen, own = over[:, :r], over @ found.vectors.T[:, :p]
        step = np.linalg.solve(seen.T @ seen + np.eye(r), seen.T)
        _, told, axes = np.linalg.svd(np.linalg.qr(own, mode="r"))
        count = int(np.sum(told > _SEEN))
        return cls(
            _rounding(machine, problem),
            _counts(machine, problem),
            axes.T,
            count,
            axes @ found.point[:p],
            noise,
            np.asarray(found.minimum.residual).ravel() / noise,
            seen,
            step,
            axes[:count] @ found.vectors[:p, :r],
            machine.unknown_reference is not None and bool(machine.unknown_reference.names),
        )

    def drawn(
        self, centre: Float[np.ndarray, " k"], off: Float[np.ndarray, "draws k"], rng: np.random.Generator
    ) -> Steps[_Drawn]:
        """Logs at `DRAWN` points off another: those that may be the measured one.

        That of which the log says nothing is anywhere within its prior, wherever the fit left it, and the
        start anywhere within its first count.
        """
        starts = rng.uniform(-0.5, 0.5, (DRAWN, self.resolution.size)) * self.resolution
        z = rng.standard_normal((DRAWN, self.point.size))
        z[:, : self.count] = centre + off
        w = np.zeros((DRAWN, self.problem.prior.base.size))
        # In units of the prior, not of the directions: one compiled call, however many of them there are.
        w[:, : self.point.size] = z @ self.axes.T
        e, shape = (yield from at_each(self.problem, w, starts)), self.problem.measured.shape
        sound = np.all(np.isfinite(e), axis=1)
        e, z = e[sound] / self.noise, z[sound, : self.count]
        if not len(e):
            return _Drawn(z, e, np.zeros(e.shape[1]))
        measured = self._unseen(self.residual[None]).reshape(shape)
        noise, alike = _noise_missing(self._unseen(e - self.residual).reshape(-1, *shape), measured)
        return _Drawn(z[alike], e[alike], np.broadcast_to(noise, shape).ravel())

    def numbers(self, drawn: _Drawn, about: Float[np.ndarray, " k"]) -> Float[np.ndarray, "rows q"]:
        """In which logs are compared: all samples, or half as many as there are logs.

        How rounding moves one sample with each other says how it moved what is told. Of a long log the draws
        do not tell that, and what the model lacks would show in it first; and logs that move in time lie on
        no line. Those are compared in what the fit sees.
        """
        seen, rows, most = np.linalg.qr(self.jacobian)[0], self.residual.size, len(drawn.at) // 2
        if rows > _LONG or self.shifts:
            return seen
        return np.eye(rows) if rows <= most else _leading(drawn, about, seen, most)

    def _unseen(self, left: Float[np.ndarray, "draws rows"]) -> Float[np.ndarray, "draws rows"]:
        """What a fit leaves of such residuals."""
        return left - left @ self.step.T @ self.jacobian.T


def through_rounding(
    machine: Machine, found: RoundsResult
) -> Steps[tuple[RoundsResult, DirectionPrecision | None]]:
    """Where the truth is, given what rounding does to a log, and which directions that leaves told.

    Args:
        machine: Its sensor rounds.
        found: The fit, of one direction at least; its minimum in the coordinates of all directions.

    Returns:
        The fit at that point, its directions such that they are uncorrelated, the best told first, with cost
        and residual those of the fit without rounding; and how well they are told, or None where too many of
        the logs drawn ran away or none is told.

    Source:
        Wood (2010), "Statistical inference for noisy nonlinear ecological dynamic systems": logs are taken as
        normal, of a mean and a covariance that are simulated; here the mean is a line in where they were
        drawn, and guesses count as normal. Logs that cannot be the measured one do not count, as in Beaumont,
        Zhang and Balding (2002), "Approximate Bayesian computation in population genetics". What a covariance
        of few draws adds: Dodelson and Schneider (2013), "The effect of covariance estimator error on
        cosmological parameter constraints".
    """
    summary, rng = _Summary.of(machine, found), np.random.default_rng(0)
    k = summary.count
    if not k:
        return replace(found, count=0), None
    centre, reach, passed = summary.point[:k].copy(), np.zeros(k), []
    covariance = np.zeros((k, k))
    for turn in range(-1, _PASSES):
        if turn < _SETTLING:
            off = rng.uniform(-1.0, 1.0, (DRAWN, k)) * reach
        else:
            # Where the truth may be and no wider: the line is only as straight as what it spans is small.
            off = rng.multivariate_normal(np.zeros(k), covariance, DRAWN, method="eigh")
        drawn = yield from summary.drawn(centre, off, rng)
        if len(drawn.at) < _FEWEST:
            return replace(found, count=0), None
        if turn < 0:
            moved = drawn.along((summary.along @ summary.step).T)
            reach = np.minimum(_FIRST * np.sqrt(np.var(moved.left, axis=0) + np.diag(moved.noise)), _MOST)
            continue
        if turn <= _SETTLING:
            # Logs from farther off lie on another line: only those of settled passes count together.
            numbers, passed = summary.numbers(drawn, centre), []
        passed.append(drawn.along(numbers))
        point, covariance = _where_alike(_Drawn.together(passed), centre)
        step = point - centre
        centre = centre + np.clip(step, -reach, reach)
        wanted = np.maximum(_REACH * np.sqrt(np.diag(covariance)), np.abs(step))
        reach = np.clip(wanted, _NARROWER * reach, np.minimum(_WIDER * reach, _MOST))
    return _told_along_axes(found, summary, point, covariance)


def _where_alike(
    drawn: _Drawn, about: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Where logs are the measured one, guesses counted in, by a line about a point; and the covariance."""
    rows, (n, q), k = drawn.line(about), drawn.left.shape, about.size
    stays = np.ones(n, bool)
    for _ in range(_SIEVED):
        line = np.linalg.lstsq(rows[stays], drawn.left[stays])[0]
        off = drawn.left - rows @ line
        scatter = off[stays].T @ off[stays] / (stays.sum() - k - 1) + drawn.noise
        scatter[np.diag_indices(q)] += _LEAST
        distance = np.sum(off * np.linalg.solve(scatter, off.T).T, axis=1)
        stays = distance < q + _AWAY * np.sqrt(2 * q)
    weighed = np.linalg.solve(scatter, line[1:].T)
    covariance = np.linalg.inv(line[1:] @ weighed + np.eye(k))
    point = about - covariance @ (weighed.T @ line[0] + about)
    # Weights by a scatter that is itself of so many draws only lead to more than they promise.
    spare = max(stays.sum() - q, 5)
    return point, (1.0 + (q - k) * (spare - 2) / ((spare - 1) * (spare - 4))) * covariance


def _leading(
    drawn: _Drawn, about: Float[np.ndarray, " k"], seen: Float[np.ndarray, "rows r"], most: int
) -> Float[np.ndarray, "rows q"]:
    """Numbers to see logs in: what a fit without rounding sees, and beside it what rounding does most."""
    rows = drawn.line(about)
    beside = drawn.left - rows @ np.linalg.lstsq(rows, drawn.left)[0]
    beside -= (beside @ seen) @ seen.T
    power, which = np.linalg.eigh(beside @ beside.T)
    least = np.sort(power)[-max(1, most - seen.shape[1])]
    leads = power >= max(least, _LEAST * power[-1])
    return np.column_stack([seen, beside.T @ which[:, leads] / np.sqrt(power[leads])])


def _told_along_axes(
    found: RoundsResult,
    summary: _Summary,
    point: Float[np.ndarray, " k"],
    covariance: Float[np.ndarray, "k k"],
) -> tuple[RoundsResult, DirectionPrecision | None]:
    """A fit elsewhere, along directions that are not correlated; those that stay told."""
    k, p, q = summary.count, summary.point.size, len(found.vectors)
    # Starts stand behind the machine's unknowns, each a direction of its own.
    vectors, left = np.eye(q), np.eye(q)
    vectors[:p, :p], left[:k, :k] = summary.axes, covariance
    whole = vectors @ left @ vectors.T
    variances, turned = np.linalg.eigh(covariance)
    vectors[:, :k] = signed(vectors[:, :k] @ turned)
    w, jacobian = found.point.copy(), np.asarray(found.minimum.jacobian) @ found.vectors.T
    w[:p] = summary.axes @ np.concatenate([point, np.zeros(p - k)])
    minimum = replace(found.minimum, theta=vectors.T @ w, jacobian=jacobian @ vectors)
    count = int(np.sum(np.sqrt(variances) <= STAYS))
    ended = replace(found, vectors=vectors, count=count, minimum=minimum)
    if not count:
        return ended, None
    return ended, replace(precision_of_directions(ended), covariance=np.diag(variances[:count]), whole=whole)


def _noise_missing(
    drawn: Float[np.ndarray, "draws time k"], measured: Float[np.ndarray, "time k"]
) -> tuple[Float[np.ndarray, " k"], Bool[np.ndarray, " draws"]]:
    """Variance of white noise with which a fit leaves as much of drawn logs as of the measured; which count.

    A log of which rounding alone leaves more than was measured is another's: noise takes nothing away. Where
    hardly one leaves less, those that leave least are taken, `_LIKE` of them.
    """
    wanted, power = np.mean(measured**2, axis=0), np.mean(drawn**2, axis=1)
    over = np.max(power / np.maximum(wanted, np.finfo(float).tiny), axis=1)
    least = min(_LIKE, len(over)) - 1
    alike = over <= max(1.0, np.partition(over, least)[least])
    return np.mean(np.maximum(wanted - power[alike], _OWN * wanted), axis=0), alike
