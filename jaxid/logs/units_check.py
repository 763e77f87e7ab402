"""Find quantities that disagree by the factor of a common error of units.

Both sides of a comparison pass through the same running means, which keep a law between the two quantities
and remove noise.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.rough_inertia import correlation, implied_inertia, ratio_of_strokes, smooth, windows

# One number for all joints or channels, or one for each.
ByJoint = float | int | Sequence[float | int] | np.ndarray
_DEGREES = 180.0 / math.pi
_RPM = 30.0 / math.pi
# Chosen: a motion is hardly logged with a period beyond the first [s], and never beyond the second.
_SLOW, _SLOWEST = 0.5, 10.0
# A period [s] as this one is half a millisecond, written in microseconds.
_MICRO = 500.0
# The same in nanoseconds.
_NANO = 500_000.0
# Chosen: two columns with a smaller correlation are not the same quantity in two units.
_SIMILAR = 0.9
# Chosen: a reference that is so many times the position, or so small a part of it, is not the position's.
_ABSURD = 10.0
# Chosen: a position so many strokes away from its reference has another zero, or hangs on a load. Weight
# holds a joint of the SO-101 arm away by up to 0.25 strokes of its command.
_FAR_APART = 0.35


# Units by their names in these messages.
_NAMED = {
    "milliseconds": "ms",
    "microseconds": "us",
    "nanoseconds": "ns",
    "millimetres": "mm",
    "micrometres": "um",
    "degrees": "deg",
    "milliradians": "mrad",
    "mm/s": "mm/s",
    "mrad/s": "mrad/s",
    "degrees/s": "deg/s",
    "revolutions per minute": "rpm",
    "revolutions per second": "rev/s",
    "kilonewtons": "kN",
    "kN m": "kN m",
    "encoder counts": "count",
}
_LOOKS = re.compile(
    r"(time|position|velocity|reference|force|torque) (?:looks )?like ([^,:?]+?)(?=,| or | while |\?|$)"
)


def how_to_say(text: str, otherwise: str) -> str:
    """Return the units that a case states so that a quantity that looks like another unit is converted.

    Args:
        text: Message with parts such as "position looks like millimetres".
        otherwise: Hint for a text without such a part.
    """
    found = [(q.replace("torque", "force"), _NAMED.get(unit)) for q, unit in _LOOKS.findall(text)]
    said = [f'units = {{ {quantity} = "{unit}" }}' for quantity, unit in found if unit]
    return f"if so, say {' or '.join(dict.fromkeys(said))} in [log]" if said else otherwise


@dataclass(frozen=True)
class _Slip:
    """A common factor and its explanation; `motion` if it applies to one kind of axis only."""

    factor: float
    text: str
    motion: str = ""
    severity: str = "error"

    def matches(self, ratio: float, motion: str, spread: float) -> bool:
        """Check that a ratio is this factor, up to a spread."""
        near = abs(math.log(ratio / self.factor)) < math.log(spread)
        return near and self.motion in ("", motion)


# Velocity column over the derivative of the position column.
_VELOCITY = (
    _Slip(1e3, "velocity looks like mm/s, or time like milliseconds", "linear"),
    _Slip(1e3, "time looks like milliseconds, or velocity like mrad/s", "rotary"),
    _Slip(1e6, "time looks like microseconds"),
    _Slip(1e-3, "position looks like millimetres", "linear"),
    _Slip(1e-3, "position looks like milliradians", "rotary"),
    _Slip(1e-6, "position looks like micrometres", "linear"),
    _Slip(_DEGREES, "velocity looks like degrees/s while position is in radians", "rotary"),
    _Slip(1.0 / _DEGREES, "position looks like degrees", "rotary"),
    _Slip(_RPM, "velocity looks like revolutions per minute", "rotary"),
    _Slip(1.0 / (2.0 * math.pi), "velocity looks like revolutions per second", "rotary"),
    _Slip(60.0, "velocity looks like a quantity per minute"),
)
# Reference over position.
_REFERENCE = (
    _Slip(1e3, "the reference looks like millimetres", "linear"),
    _Slip(1e-3, "position looks like millimetres", "linear"),
    _Slip(1e6, "the reference looks like micrometres", "linear"),
    _Slip(1e-6, "position looks like micrometres", "linear"),
    _Slip(_DEGREES, "the reference looks like degrees", "rotary"),
    _Slip(1.0 / _DEGREES, "position looks like degrees", "rotary"),
)
# Beginning of the finding that the log's inertia is off its guess by a usual error of units.
INERTIA_DOUBT = "the log implies an inertia"
# Inertia implied by the log over the guess of the case. A guess is often wrong by a factor of ten, so a
# factor that a poor guess could also explain is only a warning.
_INERTIA = (
    _Slip(1e-3, "position looks like millimetres, or force like kilonewtons", "linear"),
    _Slip(1e-6, "position looks like micrometres", "linear"),
    _Slip(1.0 / _DEGREES, "position looks like degrees", "rotary", "warning"),
    _Slip(1e-3, "position looks like milliradians, or torque like kN m", "rotary"),
    _Slip(1e3, "force looks like thousandths of its unit (mN, mV)", "", "warning"),
    _Slip(1e6, "time looks like milliseconds"),
    _Slip(1e12, "time looks like microseconds"),
)


def ratio_findings(
    log: Log, motion: str | Sequence[str], path: str, driven: Sequence[int] | np.ndarray | None = None
) -> list[Finding]:
    """Compare the columns for velocity and reference with the position.

    Args:
        log: The log to check.
        motion: "linear" or "rotary", one for all joints or a list by joint.
        path: Name of the log in messages.
        driven: Indices of the joints with a drive, in the order of the references; None: the first ones.
    """
    findings = []
    motions = _by_joint(motion, log)
    references = 0 if log.reference is None else log.reference.shape[1]
    followed = range(references) if driven is None else driven
    reference_of = dict(zip(followed, range(references), strict=False))
    for joint in range(log.position.shape[1]):
        q = log.position[:, joint]
        if np.ptp(q) == 0 or not log.measured[joint]:
            continue
        # A load behind a coupling may have no column for its velocity.
        if log.velocity is not None and joint < log.velocity.shape[1]:
            where = f"{path}, velocity of joint {joint + 1}"
            findings += _compare_velocity(log.velocity[:, joint], q, log.period, motions[joint], where)
        if log.reference is not None and joint in reference_of:
            where = f"{path}, reference of joint {joint + 1}"
            wanted = log.reference[:, reference_of[joint]]
            findings += _compare_reference(wanted, q, motions[joint], where, alone=not log.force.any())
    return findings


def _by_joint(motion: str | Sequence[str], log: Log) -> list[str]:
    """Return the kind of motion of every joint of a log."""
    return [motion] * log.position.shape[1] if isinstance(motion, str) else list(motion)


def _compare_velocity(
    velocity: np.ndarray, q: np.ndarray, period: float, motion: str, where: str
) -> list[Finding]:
    """Compare a velocity with the derivative of the position, in the window in which they agree best."""
    slope = (q[2:] - q[:-2]) / (2.0 * period)
    pairs = [(smooth(velocity[1:-1], w), smooth(slope, w)) for w in windows(q.size)]
    measured, derived = max(pairs, key=lambda pair: abs(correlation(*pair)))
    similarity = correlation(measured, derived)
    if abs(similarity) < _SIMILAR:
        what = f"velocity is not the derivative of position (correlation {similarity:.2f})"
        hint = "check that velocity names the right column, or remove it"
        return [Finding("warning", what, where, hint)]
    if similarity < 0:
        what = "velocity has the opposite sign of the derivative of position"
        return [Finding("error", what, where, "change the sign of one of them, or remove velocity")]
    ratio = float(measured.std() / derived.std())
    return _judge(ratio, _VELOCITY, motion, "velocity is {:.4g} times the derivative", where)


def _compare_reference(
    r: np.ndarray, q: np.ndarray, motion: str, where: str, *, alone: bool
) -> list[Finding]:
    """Compare a reference with the position that follows it.

    Args:
        r, q: Reference and position.
        motion: "linear" or "rotary".
        where: The column, for messages.
        alone: Whether the log has no force, so that the reference drives the simulation.
    """
    similarity = correlation(r, q)
    if np.ptp(r) == 0 or abs(similarity) < _SIMILAR:
        # The loop may be loose, or the reference constant: there is no basis for a verdict.
        return []
    if similarity < 0:
        what = "the reference moves against the position"
        turn = "if it counts in the other direction, turn it by sign = { reference = -1 } in [log]"
        hint = f"{turn}; a sign that is stated there may be wrong"
        return [Finding("error", what, where, hint)]
    ratio = float(r.std() / q.std())
    if not _is_one(ratio):
        way = ratio_of_strokes(q, r).ratio
        ratio = 1.0 / way if way > 0 else ratio
    text = "the reference is {:.4g} times the position"
    findings = _judge(ratio, _REFERENCE, motion, text, where, spread=1.1)
    if not findings:
        return _compare_zero(float(np.mean(q) - np.mean(r)), float(np.ptp(r)), where)
    [finding], unit = findings, "m" if motion == "linear" else "rad"
    example = f'units = {{ position = "{ratio:.4g} {unit}", reference = "{unit}" }}'
    gear = (
        "if one of them is on the motor's side of a gear, multiply in [log] the unit of the position and its "
        f"velocity by {ratio:.4g} ({example}, if no unit is stated)"
    )
    if finding.severity == "error":
        return [replace(finding, hint=f"{finding.hint}; {gear}")]
    absurd = alone and not 1 / _ABSURD < ratio < _ABSURD
    return [replace(finding, severity="error" if absurd else "warning", hint=f"{finding.hint}; {gear}")]


def _compare_zero(apart: float, stroke: float, where: str) -> list[Finding]:
    """Report a reference that the position follows far away from it."""
    if abs(apart) < _FAR_APART * stroke:
        return []
    what = f"the position lies {apart:.4g} from the reference that it follows"
    hint = (
        f"if the two count from different zeros, add {apart:.4g} to the reference by [log] offset; else a "
        "constant load holds the joint away"
    )
    return [Finding("warning", what, where, hint)]


def _is_one(ratio: float) -> bool:
    """Check that a ratio counts as one."""
    return 0.67 < ratio < 1.5


def _judge(
    ratio: float, slips: Sequence[_Slip], motion: str, text: str, where: str, *, spread: float = 1.2
) -> list[Finding]:
    """Report a ratio that is not one: an error if a common slip explains it within a spread."""
    if _is_one(ratio):
        return []
    finding = text.format(ratio)
    for slip in slips:
        if slip.matches(ratio, motion, spread):
            hint = how_to_say(slip.text, "convert all columns to SI units")
            return [Finding("error", f"{finding}: {slip.text}", where, hint, "units")]
    hint = "check the units of both columns"
    return [Finding("warning", f"{finding}, which should be 1", where, hint, "units")]


def time_unit_of(period: float) -> str:
    """Return the unit of a time column in which so much from row to row is a machine's sampling period."""
    if period < _SLOW:
        return "s"
    return "ms" if period < _MICRO else "us" if period < _NANO else "ns"


def period_findings(log: Log, path: str) -> list[Finding]:
    """Find sampling periods that no machine has, whatever the unit of its positions.

    Whole numbers from sample to sample are milliseconds or rows.
    """
    if log.period < _SLOW:
        return []
    whole = bool(np.all(np.abs(log.time - np.round(log.time)) < 1e-6))
    severity = "error" if log.period > _SLOWEST or whole else "warning"
    unit = next(name for name, short in _NAMED.items() if short == time_unit_of(log.period))
    rows = " or rows" if unit == "milliseconds" else ""
    what = f"the sampling period is {log.period:.4g} s: time looks like {unit}{rows}"
    hint = how_to_say(f"time looks like {unit}", "give time in seconds")
    return [Finding(severity, what, f"{path}, time", f"{hint}, or give sample_rate in its place", "time")]


def magnitude_findings(log: Log, motion: str | Sequence[str], path: str) -> list[Finding]:
    """Find strokes and speeds that no machine has.

    Args:
        log: The log, in mechanical units.
        motion: "linear" (m) or "rotary" (rad), of all joints or one for each.
        path: Name of the log in messages.
    """
    findings = []
    motions = _by_joint(motion, log)
    for joint, q in enumerate(log.position.T, start=1):
        if not log.measured[joint - 1]:
            continue
        where = f"{path}, position of joint {joint}"
        span = float(np.ptp(q))
        # A log that got columns for joints without an encoder is judged as it is.
        read = len(log.counted) == log.position.shape[1]
        counted = log.counted[joint - 1] if read else bool(np.all(q == np.round(q)))
        if span >= 100 and counted:
            what = f"position holds whole numbers only, {span:.0f} in all: encoder counts?"
            hint = (
                'say units = { position = "count" } and counts_per_revolution in [log], '
                'or the size of a count: units = { position = "0.5 um" }'
            )
            findings.append(Finding("error", what, where, hint, "units"))
        elif finding := _magnitude(q, log.period, motions[joint - 1], where):
            findings.append(finding)
    return findings


def _magnitude(q: np.ndarray, period: float, motion: str, where: str) -> Finding | None:
    """Report a stroke or a speed that no machine has."""
    span = float(np.ptp(q))
    # Over at least ten samples, so that steps of a coarse encoder do not count as speed.
    lag = max(10, q.size // 1000)
    speed = float(np.abs(q[lag:] - q[:-lag]).max() / (lag * period))
    if motion == "linear":
        # Chosen: no axis travels 50 m or runs at 100 m/s; metres written as mm do at once.
        value, limit, absurd = (span, 50.0, 1e4) if span > 50.0 else (speed, 100.0, 1e5)
        what = f"a stroke of {span:.4g} m" if span > 50.0 else f"a speed of {speed:.4g} m/s"
        unit = "millimetres" if span < 1e4 else "micrometres"
    else:
        # Chosen: 1e4 rad/s is 95 000 rpm.
        value, limit, absurd = speed, 1e4, 1e6
        what = f"a speed of {speed:.4g} rad/s"
        unit = "degrees"
    if value <= limit:
        return None
    severity = "error" if value > absurd else "warning"
    hint = how_to_say(f"position looks like {unit}", "convert position to SI units")
    return Finding(severity, f"{what}: position looks like {unit}", where, hint, "units")


def plausible_inertia(
    log: Log,
    guess: ByJoint,
    gain: ByJoint = 1.0,
    *,
    motion: str | Sequence[str] = "linear",
    driven: Sequence[int] | np.ndarray | None = None,
) -> Finding | None:
    """Compare the inertia that the log implies with the guess, by its order of magnitude.

    A finding is made only if the two differ by the factor of a common error of units; a guess may be poor.

    Args:
        log: The log to check.
        guess: Inertia by joint [kg or kg m^2].
        gain: Force per unit of the logged command, by drive.
        motion: "linear" or "rotary", one for all joints or a list by joint.
        driven: Index of the joint of each drive; None: all joints, in their order.

    Returns:
        The finding of the first joint that has one; None if no joint has, or if the joints of the forces are
        not known.
    """
    joints = log.position.shape[1]
    driven = np.arange(joints) if driven is None else driven
    if log.force.shape[1] != len(driven):
        return None
    guesses = np.broadcast_to(np.asarray(guess, dtype=np.float64), joints)
    forces = log.force * np.asarray(gain, dtype=np.float64)
    motions = _by_joint(motion, log)
    for force, joint in zip(forces.T, driven, strict=True):
        without_encoder = np.flatnonzero(~np.array(log.measured))
        others = np.delete(log.position, np.array([joint, *without_encoder]), axis=1)
        rough = implied_inertia(force, log.position[:, joint], log.period, others)
        where = f"{log.source}, joint {joint + 1}"
        span = float(np.ptp(log.position[:, joint]))
        finding = _judge_inertia(rough, float(guesses[joint]), span, motions[joint], where)
        if finding is not None:
            return finding
    return None


def _judge_inertia(rough: float | None, guess: float, span: float, motion: str, where: str) -> Finding | None:
    """Report an implied inertia that differs from the guess by the factor of a common error of units."""
    if rough is None or guess <= 0:
        return None
    for slip in _INERTIA:
        spread = 2.0 if slip.severity == "warning" else 5.0
        if slip.matches(rough / guess, motion, spread):
            what = f"{INERTIA_DOUBT} of about {rough:.2g}, the guess is {guess:.3g}"
            hint = how_to_say(slip.text, "convert the log to SI units")
            hint += "; else check actuator.gain, or correct the guess"
            # A guess may be wrong by a factor of 57; an angle of more than 20 indicates degrees.
            sure = slip.severity == "error" or (slip.motion == "rotary" and span > 20.0)
            return Finding("error" if sure else "warning", f"{what}: {slip.text}", where, hint, "units")
    return None
