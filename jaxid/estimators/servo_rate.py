"""Choice of the rate of a servo's loop, and of its command between two rows, for a log without a force.

A host sends commands slowly to a servo whose loop is fast. A loop that is simulated at the rate of the log
differentiates over ten times as long, and takes other gains and another delay for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from jaxid.estimators.estimate import INTERVAL, Estimate, misfit, rms_left
from jaxid.estimators.servo_law import Fitted, leaves_clearly_less, leaves_far_more_than_noise
from jaxid.logs.log import SLOW_LOOP
from jaxid.numerics.lanes import Steps

if TYPE_CHECKING:
    from jaxid.session import Session

# Ticks of the loop in a row of the log that are tried first, and then beside more than one.
_FIRST, _MORE = (1, 10), (5, 4, 2, 20)
# Courses of the command between two rows that are tried.
_COURSES = ("zero_order", "band_limited")
# Part by which the periods of logs that are fitted together may differ.
_SAME = 1e-4
# Most ticks a second.
_FASTEST = 4000.0
# Most parts of the shortest row, of which the rows of all logs may be whole multiples.
_PARTS = 20
# RMS that a loop leaves without noise, over that of the best one, up to which it may be the best with noise.
_MAY_BE_BEST = 1.4


@dataclass(frozen=True)
class _Loop:
    """A loop and its fit.

    Args:
        ticks: Ticks in a row of the log; of logs with several periods, in their common part (see `_row`).
        course: Course of the command between two rows.
        estimate: The fit.
    """

    ticks: int
    course: str
    estimate: Estimate

    @property
    def rms(self) -> float:
        """RMS of the position that it leaves [m or rad]."""
        return rms_left(self.estimate)

    def words(self, period: float | None) -> str:
        """Return the loop in words, for a log of some period [s]; None: its own period is stated."""
        if period is None:
            return f"{self.course} commands"
        size = f"{1e3 * period / self.ticks:.3g} ms"
        return size if self.ticks == 1 else f"{size} with {self.course} commands"


def leaves_rate_open(session: Session) -> bool:
    """Check that a case does not state the period of its servos' loop, and that its logs are slow."""
    controller = session.case.controller
    unstated = controller is not None and controller.period is None
    slowest = max(run.log.period for run in (session.fit, *session.more))
    return unstated and _row(session) is not None and slowest > SLOW_LOOP


def leaves_course_open(session: Session) -> bool:
    """Check that a case states the period of a loop faster than its log, and not the command between rows."""
    controller = session.case.controller
    stated = controller is not None and controller.period is not None
    return stated and _one_period(session) and not _states_course(session) and _ticks(session) > 1


def _one_period(session: Session) -> bool:
    """Check that all logs have the same period, so that a loop has the same ticks in a row of each."""
    first = session.fit.log.period
    return all(abs(run.log.period / first - 1) < _SAME for run in session.more)


def _row(session: Session) -> float | None:
    """Return the longest period of which those of all logs are whole multiples [s]; None: it is too short."""
    if _one_period(session):
        return session.fit.log.period
    periods = [run.log.period for run in (session.fit, *session.more)]
    for part in range(1, _PARTS + 1):
        row = min(periods) / part
        if 1 / row > _FASTEST:
            break
        if all(abs(period / row / round(period / row) - 1) < _SAME for period in periods):
            return row
    return None


def _holds(session: Session, ticks: int) -> bool:
    """Check that a log has more than one tick of a loop in a row, so that a course between rows counts."""
    return ticks > 1 or not _one_period(session)


def _ticks(session: Session) -> int:
    """Return the ticks of the loop in a row of the log."""
    assert session.machine.controller is not None, "asked of a servo"
    return round(session.fit.log.period / session.machine.controller.period)


def _states_course(session: Session) -> bool:
    return "reference_hold" in session.case.tables.get("log", {})


def with_rate_of_log(session: Session, fitted: Fitted, *, without_noise: bool = False) -> Steps[Estimate]:
    """Fit loops of several rates and courses of the command, and return the fit that explains the log.

    They are fitted without noise first, and the best of them as usual. If that leaves far more than noise,
    the model is incomplete and shows no rate: the others are not fitted with noise.

    Args:
        session: Case and log; the case `leaves_rate_open` or `leaves_course_open`.
        fitted: Function that fits a session.
        without_noise: Whether no loop is fitted with the noise of its encoder.

    Returns:
        The fit that is clearly the best. If others explain the log about as well, the standard deviations are
        widened so that the 95 % intervals hold their values.
    """
    plain = yield from _loops(session, partial(fitted, without_noise=True))
    best = _best(plain)
    if best is None:
        return (yield from fitted(session, without_noise=without_noise))
    if without_noise:
        return _said(session, best, _equal(best, plain), plain)

    at_best = yield from fitted(_at(session, best.ticks, best.course))
    if not at_best.converged or leaves_far_more_than_noise(session, at_best):
        return _said(session, replace(best, estimate=at_best), _equal(best, plain), plain)

    loops = [replace(best, estimate=at_best)]
    for loop in plain:
        if loop is not best and loop.rms <= _MAY_BE_BEST * best.rms:
            estimate = yield from fitted(_at(session, loop.ticks, loop.course))
            loops += [replace(loop, estimate=estimate)] if estimate.converged else []
    best = min(loops, key=lambda loop: misfit(loop.estimate))
    done = {(loop.ticks, loop.course) for loop in loops}
    others = [loop for loop in plain if (loop.ticks, loop.course) not in done]
    return _said(session, best, _equal(best, loops), [*loops, *others])


def _loops(session: Session, fitted: Callable[[Session], Steps[Estimate]]) -> Steps[list[_Loop]]:
    """Return the loops of all rates and courses that converge."""
    courses = (session.machine.reference_hold,) if _states_course(session) else _COURSES
    row, open_rate = _row(session), leaves_rate_open(session)
    loops: list[_Loop] = []

    def tried(ticks: int, course: str) -> Steps[None]:
        if open_rate and row is not None and ticks > 1 and ticks / row > _FASTEST:
            return
        estimate = yield from fitted(_at(session, ticks, course))
        if estimate.converged:
            loops.append(_Loop(ticks, course, estimate))

    for ticks in _FIRST if open_rate else (_ticks(session),):
        for course in courses if _holds(session, ticks) else courses[:1]:
            yield from tried(ticks, course)
    best = _best(loops)
    if open_rate and best is not None and _holds(session, best.ticks):
        for ticks in _MORE:
            yield from tried(ticks, best.course)
    return loops


def _at(session: Session, ticks: int, course: str) -> Session:
    """Return a session whose loop has some ticks in a row of the log."""
    machine = session.machine
    assert machine.controller is not None, "asked of a servo"
    controller = machine.controller
    if leaves_rate_open(session):
        row = _row(session)
        assert row is not None, "checked by leaves_rate_open"
        controller = replace(controller, period=row / ticks)
    return session.with_machine(replace(machine, controller=controller, reference_hold=course))


def _best(loops: list[_Loop]) -> _Loop | None:
    return min(loops, key=lambda loop: misfit(loop.estimate), default=None)


def _equal(best: _Loop, loops: list[_Loop]) -> list[_Loop]:
    """Return the other loops that do not leave clearly more of the log than the best."""
    return [
        loop for loop in loops if loop is not best and not leaves_clearly_less(best.estimate, loop.estimate)
    ]


def _said(session: Session, best: _Loop, equal: list[_Loop], loops: list[_Loop]) -> Estimate:
    """Return the best fit with the choice among its settings and notes.

    Args:
        session: Case and log.
        best: The loop that is taken.
        equal: Loops that explain the log about as well.
        loops: All loops that were fitted.
    """
    period = _row(session) if leaves_rate_open(session) else None
    estimate = best.estimate.holding(*(loop.estimate.theta for loop in equal))
    sizes = "; ".join(
        f"{loop.words(period)} {loop.rms:.3g}" for loop in sorted(loops, key=lambda loop: loop.rms)
    )
    reason = f"RMS that the fitted loops leave: {sizes}"
    if equal:
        named = ", ".join(loop.words(period) for loop in (best, *equal))
        reason = f"{named} explain the log about equally well, and the 95 % intervals hold the values of all"
    settings, what = {}, "the course of the command between two rows"
    if period is not None:
        settings["period"] = {"value": f"{period / best.ticks:.6g} s", "reason": reason}
        what = "the period of the servo's loop"
    if _holds(session, best.ticks):
        settings["reference_hold"] = {"value": best.course, "reason": reason}
    verb = "is" if period is not None else "are"
    note = f"{what} is not stated: {best.words(period)} {verb} taken; {reason}"
    return replace(
        estimate,
        notes=(*estimate.notes, note),
        details={
            **estimate.details,
            **_relative_holding(best, equal),
            "settings": {**estimate.details.get("settings", {}), **settings},
        },
    )


def _relative_holding(best: _Loop, equal: list[_Loop]) -> dict[str, Any]:
    """Return the detail `relative` of the best fit with 95 % intervals that hold the values of others."""
    given = [loop.estimate.details.get("relative") for loop in (best, *equal)]
    if given[0] is None:
        return {}
    values = {}
    for name, entry in given[0]["values"].items():
        others = [of["values"][name]["value"] for of in given[1:] if of is not None and name in of["values"]]
        away = max((abs(other - entry["value"]) for other in others), default=0.0)
        values[name] = entry if not entry["std"] else {**entry, "std": entry["std"] + away / INTERVAL}
    return {"relative": {**given[0], "values": values}}
