"""Algebraic identification over one window of a log: least squares, and the paper's four other forms.

All forms use the rows of `jaxid.estimators.algebraic.online`: for each joint and sample the balance, weighted
by (t - t0)^2 and integrated twice, as columns of the unknowns and the value b for unknowns of zero.

Source:
    Wi, Ri, Ri & Ri, (14)-(25), after Beltran-Carbajal & Silva-Navarro (2015). As printed, (18) lacks
    its subscripts and (19) its bars: the integrals are of |Delta_j| and |Delta|, which hides signs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.integrate
import scipy.sparse.csgraph
from jaxtyping import Bool, Float

from jaxid.errors import InputError
from jaxid.estimators.algebraic.online import Online, window_rows
from jaxid.estimators.estimate import Estimate
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared, lasting
from jaxid.machine import Machine
from jaxid.model.unknowns import Free
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Precision, assess

# A matrix whose scaled condition number is above this is singular to rounding errors.
_SINGULAR = 1e12
# Shortest interval of one direction, in samples.
_SHORTEST = 12
# Consecutive samples for which a joint must have moved for its rows to count: before that, start-up errors
# of the quadrature are as large as the effect of damping and springs.
_LONG_ENOUGH = 40

Window = tuple[float, float]
# Rows of one joint: the columns of its unknowns, and b.
Rows = tuple[Float[np.ndarray, "time k"], Float[np.ndarray, " time"]]


@dataclass(frozen=True)
class Stretch:
    """The part of a log that a window covers.

    Args:
        position: Measured positions, (time, n) [m or rad].
        command: Logged commands, (time, m).
        online: The recursion that computes the rows.
        moving: Mask of the samples before which the joint moves faster than at rest, (time, n).
        direction: Sign of the velocity of those samples, zero for the others, (time, n).
    """

    position: Float[np.ndarray, "time n"]
    command: Float[np.ndarray, "time m"]
    online: Online
    moving: Bool[np.ndarray, "time n"]
    direction: Float[np.ndarray, "time n"]

    @classmethod
    def of(cls, machine: Machine, log: Log, data: Prepared, window: Window | None) -> Stretch:
        """Cut a window out of a log; with a stated cut-off the positions are the filtered ones.

        Args:
            machine: The machine whose unknowns are estimated.
            log: The log.
            data: The filtered log.
            window: Start and end [s]; None: the whole log.

        Raises:
            InputError: If the window leaves the log or holds too few samples, the command is not held,
                or the balance is not linear in the unknowns.
        """
        if log.hold != "zero_order":
            raise InputError(
                f"one window needs a command that is held between samples, and [log] hold is {log.hold}",
                where=log.source,
                hint="leave out [algebraic] window, or use inverse_dynamics",
            )

        start, end = window or (log.time[0], log.time[-1])
        # A log of 0.1 s ends one sample before 0.1 s.
        if start < log.time[0] - 1.5 * log.period or end > log.time[-1] + 1.5 * log.period:
            raise InputError(
                f"[algebraic] window = [{start:g}, {end:g}] s is not within the log, which runs from "
                f"{log.time[0]:g} to {log.time[-1]:g} s",
                where=log.source,
                hint="choose a window within the log",
            )
        inside = (log.time >= start - 1e-9) & (log.time <= end + 1e-9)
        if inside.sum() < 4 * _SHORTEST:
            raise InputError(
                f"[algebraic] window = [{start:g}, {end:g}] s holds {int(inside.sum())} samples",
                where=log.source,
                hint=f"choose a window of at least {4 * _SHORTEST} samples",
            )

        recipe = data.recipe
        position = (data.q if recipe.keeps_reversals else log.position)[inside]
        velocity = np.diff(data.q[inside], axis=0, prepend=data.q[inside][:1]) / log.period
        if recipe.derivatives == "parabolic":
            # This recipe does not filter the position: differences would have twice the noise or more.
            velocity = data.qd[inside]
        fast = np.abs(velocity).max(axis=0)
        still = InputError(
            f"no joint moves between {start:g} and {end:g} s",
            where=log.source,
            hint="choose another [algebraic] window",
        )

        if not fast.any():
            raise still
        online = Online.of(machine, log.period, np.asarray(recipe.rest_velocity), fast)
        rest = online.rest_velocity
        # A filter rings into a rest: a joint moves only if its raw positions change too.
        raw = np.pad(log.position[inside], ((2, 2), (0, 0)), mode="edge")
        moving = (np.abs(velocity) > rest) & (np.abs(raw[4:] - raw[:-4]) / (4 * log.period) > 0.5 * rest)
        if not moving.any():
            raise still
        return cls(position, log.force[inside], online, moving, np.sign(velocity) * moving)

    def rows(self, restart: Bool[np.ndarray, "time n"]) -> SolveRequest:
        """Return the request for the rows, with windows that start at the samples of a mask."""
        return SolveRequest(window_rows, (self.online, self.position, self.command, restart))

    def ages(self, restart: Bool[np.ndarray, "time n"]) -> Float[np.ndarray, "time n"]:
        """Return the time since the start of each joint's window [s]."""
        index = np.arange(len(restart))[:, None]
        last = np.maximum.accumulate(np.where(restart, index, 0), axis=0)
        return self.online.period * (index - last)


def least_squares_steps(machine: Machine, log: Log, data: Prepared, window: Window | None) -> Steps[Estimate]:
    """Estimate by least squares over all rows of a window; dry friction is a column like any other.

    Args:
        machine: The machine whose unknowns are estimated.
        log: The log.
        data: The filtered log.
        window: Start and end [s]; None: the whole log.
    """
    cut = Stretch.of(machine, log, data, window)
    _, rows = yield cut.rows(~cut.moving)
    rows, owner, p = np.asarray(rows), cut.online.owner, len(machine.parameters.free)

    # Rows shortly after a rest do not count, nor those of joints whose equations hold for zeros.
    rows = np.where(lasting(cut.moving, min(_LONG_ENOUGH, len(rows) // 2) - 1)[..., None], rows, 0.0)
    rows[:, _homogeneous(rows, owner, machine.parameters.guess)] = 0.0
    counts = np.any(rows != 0, axis=-1)

    # A joint's rows are replaced by their triangular factor, in the columns of its unknowns.
    jacobian, b = np.zeros((*counts.shape, p)), rows[..., -1]
    triangles = []
    for i in range(len(owner)):
        used = owner[i] < p
        jacobian[:, i, owner[i][used]] = rows[:, i, :-1][:, used]
        short = np.linalg.qr(np.concatenate([rows[:, i, :-1][:, used], b[:, i, None]], axis=1), mode="r")
        triangles.append(np.zeros((len(short), p + 1)))
        triangles[-1][:, [*owner[i][used], p]] = short
    flat, values = np.split(np.concatenate(triangles), [p], axis=1)
    scale = np.linalg.norm(flat, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    theta = -np.linalg.lstsq(flat / scale, values[:, 0], rcond=1e-13)[0] / scale

    e = jacobian @ theta + b
    names = machine.parameters.names
    size = float(np.linalg.norm(b[counts]))
    precision = assess(names, jacobian, e, counts, size, np.where(theta != 0, theta, 1.0))
    resting = int(counts.size - counts.sum())
    notes = (f"one window of {log.period * (len(rows) - 1):.3g} s; {resting} rows at rest omitted",)
    return _estimate("algebraic", machine, theta, precision, np.where(counts, e, np.nan), notes)


def _homogeneous(rows: np.ndarray, owner: np.ndarray, guess: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Return the mask of the joints whose equations are homogeneous, and solved by unknowns of zero.

    They and the joints that share unknowns with them have no drive and no known parameter. A mass that swings
    freely identifies ratios only, and least squares would return zero for all of them.

    Args:
        rows: Columns of the unknowns and the value b, by sample and joint, (time, n, c + 1).
        owner: Index of the unknown of each column, p for none, (n, c).
        guess: Guesses, which give the size of a row, (p,).
    """
    p, n = len(guess), len(owner)
    stands = np.zeros((n, p), bool)
    for i in range(n):
        stands[i, owner[i][(owner[i] < p) & np.any(rows[:, i, :-1] != 0, axis=0)]] = True
    _, groups = scipy.sparse.csgraph.connected_components(stands @ stands.T, directed=False)
    size = np.abs(rows[..., :-1] * np.append(np.abs(guess), 0.0)[owner]).max(axis=(0, 2))
    given = np.abs(rows[..., -1]).max(axis=0) > 1e-9 * np.where(size > 0, size, np.inf)
    return np.array([not given[groups == g].any() for g in groups])


def single_time(rows: Rows, period: float) -> np.ndarray:
    """Solve the rows and their iterated integrals at the window's end, (15)-(17)."""
    matrix, b = (x[-1] for x in _iterated(*rows, period))
    return _solved(matrix, b)


def ratio(rows: Rows, period: float) -> np.ndarray:
    """Divide twice integrated |Delta_j| by twice integrated |Delta|, (18)-(19): signs are lost."""
    matrix, b = _iterated(*rows, period)
    whole = np.abs(np.linalg.det(matrix))
    if not np.max(whole) > 0:
        return np.full(matrix.shape[-1], np.nan)
    parts = []
    for j in range(matrix.shape[-1]):
        other = matrix.copy()
        other[..., j] = -b
        parts.append(np.abs(np.linalg.det(other)))
    twice = [_integral(_integral(x, period), period)[-1] for x in (*parts, whole)]
    return np.array(twice[:-1]) / twice[-1]


def without_friction(one: Rows, other: Rows, column: int, period: float) -> np.ndarray:
    """Solve the rows of two intervals, the level of friction eliminated between them, (20)-(25).

    The column of friction has the sign of the motion: one formula covers the paper's sum, for opposite
    directions, and its difference, for equal ones.

    Args:
        one, other: Rows of the two intervals.
        column: Index of the friction level among the unknowns.
        period: Sampling time [s].
    """
    others = [k for k in range(one[0].shape[1]) if k != column]
    ends = [tuple(x[-1] for x in _iterated(*rows, period)) for rows in (one, other)]
    (a1, b1), (a2, b2) = ((a[: len(others)], b[: len(others)]) for a, b in ends)
    d1, d2 = a1[:, column], a2[:, column]
    matrix = d2[:, None] * a1[:, others] - d1[:, None] * a2[:, others]
    theta = np.zeros(len(others) + 1)
    theta[others] = _solved(matrix, d2 * b1 - d1 * b2)
    levels = [-(a[0, others] @ theta[others] + b[0]) / a[0, column] for a, b in ((a1, b1), (a2, b2))]
    theta[column] = np.mean(levels)
    return theta


def _iterated(columns: np.ndarray, b: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rows at every sample and their iterated integrals, as many as there are unknowns, (16)."""
    levels = [(columns, b)]
    for _ in range(columns.shape[1] - 1):
        a, value = levels[-1]
        levels.append((_integral(a, period), _integral(value, period)))
    return np.stack([a for a, _ in levels], axis=1), np.stack([b for _, b in levels], axis=1)


def _integral(x: np.ndarray, period: float) -> np.ndarray:
    return scipy.integrate.cumulative_simpson(x, dx=period, axis=0, initial=0.0)


def _solved(matrix: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solve matrix @ theta = -b, scaled by rows and columns; NaN if it is singular."""
    across = np.abs(matrix).max(axis=1, keepdims=True)
    if not np.all(across > 0):
        return np.full(matrix.shape[1], np.nan)
    scaled = matrix / across
    down = np.abs(scaled).max(axis=0)
    if not np.all(down > 0) or np.linalg.cond(scaled / down) > _SINGULAR:
        return np.full(matrix.shape[1], np.nan)
    return np.linalg.solve(scaled / down, -b / across[:, 0]) / down


def joint_by_joint(form: Callable[[Rows, float], np.ndarray], name: str) -> Callable[..., Steps[Estimate]]:
    """Build an estimator that solves each joint's rows separately, from its start to its first rest.

    Unknowns that two joints share (of a spring) are the mean of both. No standard deviation is given.

    Args:
        form: Function that solves rows, given the sampling time.
        name: Name of the method.
    """

    def steps(machine: Machine, log: Log, data: Prepared, window: Window | None) -> Steps[Estimate]:
        cut = Stretch.of(machine, log, data, window)
        restart = ~cut.moving
        _, rows = yield cut.rows(restart)
        ages = cut.ages(restart)
        answers = []
        for i in range(rows.shape[1]):
            begin, end = _first_run(cut.moving[:, i])
            part = slice(begin, end)
            # Rows that do not count yet are zero.
            unknowns, values = _rows_of_joint(cut.online, i, np.asarray(rows)[part, i], ages[part, i])
            answers.append((unknowns, form(values, log.period) if end - begin >= _SHORTEST else None))
        return _merged(name, machine, answers, log)

    return steps


def two_intervals(changed: bool, name: str) -> Callable[..., Steps[Estimate]]:
    """Build an estimator that eliminates friction between two intervals of one direction each.

    Args:
        changed: Take an interval before a reversal and one after it; else both halves of the first interval.
        name: Name of the method.
    """

    def steps(machine: Machine, log: Log, data: Prepared, window: Window | None) -> Steps[Estimate]:
        cut = Stretch.of(machine, log, data, window)
        pairs = [_intervals(d, changed) for d in cut.direction.T]

        # The rows of all joints, once with windows that start at their first interval, once at the second.
        passes = []
        for which in (0, 1):
            restart = np.zeros(cut.moving.shape, bool)
            restart[0] = True
            for i, pair in enumerate(pairs):
                restart[pair[which][0] if pair else 0, i] = True
            passes.append((np.asarray((yield cut.rows(restart))[1]), cut.ages(restart)))

        answers = []
        for i, pair in enumerate(pairs):
            if pair is None:
                answers.append(((), None))
                continue
            both = [
                _rows_of_joint(cut.online, i, rows[a:b, i], ages[a:b, i])
                for (rows, ages), (a, b) in zip(passes, pair, strict=True)
            ]
            unknowns = both[0][0]
            column = [k for k, j in enumerate(unknowns) if _is_friction(machine, machine.parameters.free[j])]
            if len(column) != 1:
                answers.append((unknowns, None))
                continue
            theta = without_friction(both[0][1], both[1][1], column[0], log.period)
            answers.append((unknowns, theta))
        return _merged(name, machine, answers, log)

    return steps


def _is_friction(machine: Machine, free: Free) -> bool:
    return free.effect is not None and machine.plant.effects[free.effect].sliding_level is not None


def _rows_of_joint(
    online: Online, joint: int, rows: np.ndarray, ages: np.ndarray
) -> tuple[tuple[int, ...], Rows]:
    """Return the unknowns in a joint's rows, and the rows as double integrals without their weight.

    Args:
        online: The recursion that computed the rows.
        joint: Index of the joint.
        rows: Its rows over (t - t0)^2, (time, c + 1).
        ages: Time t - t0 since the start of its window, (time,) [s].
    """
    whole = rows * ages[:, None] ** 2
    columns = [c for c, k in enumerate(online.owner[joint]) if k < online.guess.size]
    unknowns = tuple(int(online.owner[joint, c]) for c in columns)
    return unknowns, (whole[:, columns], whole[:, -1])


def _first_run(flags: np.ndarray) -> tuple[int, int]:
    """Return the range of samples of the first run of true entries, and the sample before it."""
    if not flags.any():
        return 0, 0
    begin = int(np.argmax(flags))
    rest = np.flatnonzero(~flags[begin:])
    return max(begin - 1, 0), begin + int(rest[0]) if rest.size else len(flags)


def _intervals(direction: np.ndarray, changed: bool) -> tuple[tuple[int, int], ...] | None:
    """Return two ranges of samples, each in one direction; None if there are none.

    Args:
        direction: Sign of the velocity, zero at rest, (time,).
        changed: Whether the two directions differ; else the ranges are halves of one interval.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0.0], direction, [0.0]])))
    runs = [(a, b, direction[a]) for a, b in zip(edges[:-1], edges[1:], strict=True) if direction[a] != 0]
    if not changed:
        long = [(a, b) for a, b, _ in runs if b - a >= 2 * _SHORTEST]
        if not long:
            return None
        a, b = long[0]
        middle = (a + b) // 2
        return (max(a - 1, 0), middle), (middle, b)
    long = [r for r in runs if r[1] - r[0] >= _SHORTEST]
    for one, other in zip(long[:-1], long[1:], strict=True):
        if one[2] != other[2]:
            return (max(one[0] - 1, 0), one[1]), (other[0], other[1])
    return None


def _merged(name: str, machine: Machine, answers: list[tuple], log: Log) -> Estimate:
    """Merge the solutions of the joints into one estimate, by the mean of each unknown.

    Args:
        name: Name of the method.
        machine: The machine.
        answers: Indices of the unknowns of each joint and their values, None if there is no solution.
        log: The log, for the error message.

    Raises:
        InputError: If no joint has a solution.
    """
    p = len(machine.parameters.free)
    total, times = np.zeros(p), np.zeros(p)
    for unknowns, theta in answers:
        if theta is not None and np.all(np.isfinite(theta)):
            total[list(unknowns)] += theta
            times[list(unknowns)] += 1
    identifiable = times > 0
    if not identifiable.any():
        raise InputError(
            "no joint has an interval on which its equations can be solved",
            where=log.source,
            hint="take a longer window, or use algebraic",
        )

    theta = np.where(identifiable, total / np.maximum(times, 1), machine.parameters.guess)
    unknown = np.full((p, p), np.nan)
    combinations = [{n: 1.0} for n, t in zip(machine.parameters.names, identifiable, strict=True) if not t]
    precision = Precision(unknown, identifiable, combinations, np.full(p, np.nan))

    unsolved = [
        k + 1 for k, (_, theta) in enumerate(answers) if theta is None or not np.all(np.isfinite(theta))
    ]
    notes = ["this form gives no standard deviation"]
    if unsolved:
        notes.append(f"the equations of joint {', '.join(map(str, unsolved))} could not be solved")
    return _estimate(name, machine, theta, precision, np.full((1, len(answers)), np.nan), tuple(notes))


def _estimate(
    name: str,
    machine: Machine,
    theta: np.ndarray,
    precision: Precision,
    e: np.ndarray,
    notes: tuple[str, ...],
) -> Estimate:
    good = bool(np.all(np.isfinite(theta)))
    return Estimate(
        method=name,
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=good,
        message="solved" if good else "the equations are singular",
        residual=e,
        samples=int(np.isfinite(e).sum()),
        steps=1,
        notes=notes,
    )


# Forms that solve the equations of each joint separately, by the name of their method.
FORMS: dict[str, Callable[..., Steps[Estimate]]] = {
    "algebraic_single_time": joint_by_joint(single_time, "algebraic_single_time"),
    "algebraic_ratio": joint_by_joint(ratio, "algebraic_ratio"),
    "algebraic_sign_changed": two_intervals(True, "algebraic_sign_changed"),
    "algebraic_sign_unchanged": two_intervals(False, "algebraic_sign_unchanged"),
}
