"""The columns of a raw log by quantity: chosen by name, and by their values if names say nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.first_case.balance import has_direction
from jaxid.first_case.two_encoders import TwoEncoders, without_load
from jaxid.first_case.words import D_ENDINGS, FORCES, PHASES, Meaning, meaning_of_joint
from jaxid.logs.log import MINIMUM_SAMPLES
from jaxid.logs.readers.dialect import split_unit
from jaxid.logs.rough_inertia import correlation
from jaxid.logs.units import fits, parse_unit

# Sampling rate that a case states if the log has no time.
NO_TIME_RATE = 1000.0
# Correlation with the position, and ratio of strokes, up to which a second position has the same course.
_SAME_COURSE, _SAME_SIZE = 0.95, 1.25
# Correlation with the position from which a wanted value without a quantity counts as a reference.
_FOLLOWED = 0.5
# Correlation with the position from which a column whose integral is that position is its velocity.
_INTEGRATED = 0.9
# Part of its peak below which a force without a sign comes at its least, if it is a magnitude.
_NEAR_ZERO = 0.05
# Most columns without a known meaning that are listed.
_LISTED = 6
# Order in which forces are chosen. A measured current comes before a wanted torque, which a robot's
# controller may have computed by a model of its own, without friction.
_RANK = {kind: k for k, kind in enumerate(FORCES)}
_MEASURED = ("torque", "force", "current")


@dataclass(frozen=True)
class Column:
    """One column of a raw log.

    Attributes:
        meaning: Meaning of its name.
        values: Its values, those without a reading interpolated.
        unit: Unit that the file or the name states; empty: none.
    """

    meaning: Meaning
    values: Float[np.ndarray, " rows"]
    unit: str

    @property
    def name(self) -> str:
        """Name of the column in [log]."""
        return self.meaning.name

    @property
    def moves(self) -> bool:
        """True if the values are not all the same."""
        return bool(np.ptp(self.values) > 0)


@dataclass(frozen=True)
class Chosen:
    """The columns of a log by quantity, in the order of the joints.

    Attributes:
        time: The time; None: there is none.
        position, velocity, force, reference: Columns by joint; empty: there are none.
        driven: Places of the joints that the forces belong to; None: there is one for each joint.
        loose_forces: Forces of a log of several joints that has not one for each of them.
        load: Position of a load whose motor has an encoder too; None: there is none.
        joints: Words that name the joints; an empty text for a single one.
        said: Lines on choices that names do not show.
        questions: Doubts, by quantity.
    """

    time: Column | None
    position: tuple[Column, ...] = ()
    velocity: tuple[Column, ...] = ()
    force: tuple[Column, ...] = ()
    reference: tuple[Column, ...] = ()
    driven: tuple[int, ...] | None = None
    loose_forces: tuple[Column, ...] = ()
    load: Column | None = None
    joints: tuple[str, ...] = ("",)
    said: tuple[str, ...] = ()
    questions: Mapping[str, str] = field(default_factory=dict)

    def only(self, joint: int) -> Chosen:
        """Return the columns of one joint."""
        parts = {
            q: getattr(self, q)[joint : joint + 1] for q in ("position", "velocity", "force", "reference")
        }
        return replace(self, **parts, joints=self.joints[joint : joint + 1])


def columns_of(
    data: Mapping[str, Float[np.ndarray, "rows 1"]],
    units: Mapping[str, str],
    time: str,
    joints: Sequence[str] = (),
) -> list[Column]:
    """Return the columns of a table with the meaning of their names.

    Args:
        data: Columns by name.
        units: Units that the file states, by name.
        time: Name of the time if the format has one of its own; empty otherwise.
        joints: Names of a robot's joints, which names of columns may hold.
    """
    out = []
    for name, values in data.items():
        meaning = meaning_of_joint(name, joints)
        if time:
            quantity = (
                "time" if name == time else "passed over" if meaning.quantity == "time" else meaning.quantity
            )
            meaning = replace(meaning, quantity=quantity)
        unit = units.get(name, "") or meaning.unit or split_unit(name)[1]
        if meaning.quantity in FORCES and not fits(parse_unit(unit), "force") and _of_motion(unit):
            # The angle of a load is no load, and a command in degrees is a wanted position.
            beside = ("load",) if meaning.quantity == "load" else ()
            wanted = meaning.reference or meaning.quantity == "command"
            meaning = replace(meaning, quantity="", reference=wanted, joint=(*meaning.joint, *beside))
        flat = values[:, 0]
        known = np.isfinite(flat)
        if np.count_nonzero(known) < 2:
            continue
        rows = np.arange(flat.size)
        filled = flat if known.all() else np.interp(rows, rows[known], flat[known])
        out.append(Column(meaning, filled, unit))
    out = [_as_acceleration(column, out) for column in out]
    return _with_joints_by_symbol([_derived_or_desired(column, out) for column in out])


def _as_acceleration(column: Column, columns: Sequence[Column]) -> Column:
    """Return a column called alpha as an acceleration, if a position and a velocity stand beside it.

    Beside theta and theta_dot it is the second angle of a pendulum, and so it is in degrees.
    """
    meaning = column.meaning
    if meaning.symbol != "alpha" or meaning.quantity != "position" or column.unit:
        return column
    measured = [c for c in columns if c is not column and not c.meaning.reference]
    others = [c.meaning for c in measured if c.meaning.symbol != "alpha"]
    speeds = [m for m in others if m.quantity == "velocity" and not m.symbol]
    own = [c for c in measured if c.meaning.symbol == "alpha" and c.meaning.quantity == "velocity"]
    if own or not speeds or not any(m.quantity == "position" for m in others):
        return column
    return replace(column, meaning=replace(meaning, quantity="acceleration"))


def _derived_or_desired(column: Column, columns: Sequence[Column]) -> Column:
    """Return a column called xd as the velocity of x, or as its wanted value, by the values of both.

    A wanted value has the course of the position, and the integral of a velocity has it.
    """
    symbol = D_ENDINGS.get(column.name.casefold())
    if symbol is None or column.meaning.quantity:
        return column
    of_symbol = [c for c in columns if c.meaning.symbol == symbol and c.meaning.quantity == "position"]
    measured = [c.values for c in of_symbol if not c.meaning.reference]
    if len(measured) != 1:
        return column
    [position] = measured
    rows = np.linspace(-1.0, 1.0, position.size)
    integral = np.cumsum(column.values)
    # The constant of integration, an offset and a trend of the readings say nothing.
    alike = correlation(*(x - np.polyval(np.polyfit(rows, x, 1), rows) for x in (integral, position)))
    meaning = replace(column.meaning, joint=(), symbol=symbol)
    if alike > _INTEGRATED:
        return replace(column, meaning=replace(meaning, quantity="velocity"))
    if correlation(column.values, position) > _INTEGRATED:
        return replace(column, meaning=replace(meaning, quantity="position", reference=True))
    return column


def _with_joints_by_symbol(columns: list[Column]) -> list[Column]:
    """Return columns with the symbols of coordinates as names of joints, where several positions have one."""

    def named(column: Column) -> bool:
        return bool(column.meaning.symbol and not column.meaning.joint)

    moving = [c.meaning for c in columns if named(c) and c.meaning.quantity in ("position", "velocity")]
    symbols = {m.symbol for m in moving if not m.reference}
    if len(symbols) < 2:
        return columns
    by_symbol = lambda c: replace(c, meaning=replace(c.meaning, joint=(c.meaning.symbol,)))
    return [by_symbol(c) if named(c) else c for c in columns]


def _of_motion(unit: str) -> str:
    """Return "position" or "velocity" if a unit is one of these; else an empty text."""
    found = parse_unit(unit) if unit else None
    return next((q for q in ("position", "velocity") if fits(found, q)), "")


def choose(columns: Sequence[Column], where: str, *, of_robot: bool = False) -> Chosen:
    """Choose the columns of a machine's log.

    Args:
        columns: All columns of the log.
        where: The log, for messages.
        of_robot: Whether the joints are those of a robot's file, so that two positions are of two joints.

    Raises:
        InputError: If no column can be the position or the velocity of a joint.
    """
    if not columns:
        what = f"is too short: no column has two numbers; at least {MINIMUM_SAMPLES} samples are needed"
        raise InputError(what, where=where, hint="log for longer, or export the log again")
    said: list[str] = []
    questions: dict[str, str] = {}
    time = _time(columns, said, questions)
    rest = [c for c in columns if c is not time and c.meaning.quantity not in ("time", "passed over")]
    rest = _without_phases(rest, said)
    if not any(c.meaning.quantity in ("position", "velocity") for c in rest):
        rest = _named_by_unit(rest)
    split = TwoEncoders(rest, None) if of_robot else without_load(rest)
    rest = split.columns
    said += [f"'{c.name}' is not used: it is of the load behind the coupling" for c in split.left_out]

    position, spare = _by_joint(rest, "position")
    velocity, _ = _by_joint(rest, "velocity")
    if not position and not velocity:
        rest = _named_by_unit(rest)
        position, spare = _by_joint(rest, "position")
        velocity, _ = _by_joint(rest, "velocity")
    if not position and not velocity:
        position = _smoothest(rest, said, questions, where)
    joints = tuple(position or velocity)
    used = [*position.values(), *velocity.values()]
    others = [c for c in rest if not any(c is u for u in used)]
    force, loose_forces = _forces(others, joints, position, said, questions)
    others = [c for c in others if not any(c is u for u in force.values())]
    reference = _references(others, position, spare, said, questions)
    velocity = _matched(velocity, joints)
    said += _unused(rest, [*used, *force.values(), *reference.values()])

    return Chosen(
        time=time,
        position=tuple(position.values()),
        velocity=tuple(velocity.values()),
        force=tuple(force.values()),
        reference=tuple(reference.values()),
        loose_forces=loose_forces,
        load=split.load,
        joints=joints,
        said=tuple(said),
        questions=questions,
    )


def _without_phases(columns: Sequence[Column], said: list[str]) -> list[Column]:
    """Return columns without the currents and voltages of a motor's phases, of which there are several."""

    def of_phase(column: Column) -> bool:
        meaning = column.meaning
        return meaning.quantity in ("current", "voltage") and bool(PHASES & {*meaning.joint})

    found = [c for c in columns if of_phase(c)]
    if len({phase for c in found for phase in PHASES & {*c.meaning.joint}}) < 2:
        return [*columns]
    names = ", ".join(f"'{c.name}'" for c in found)
    said.append(f"{names} are not used: no phase of a motor shows its torque by itself; its q current does")
    return [c for c in columns if not of_phase(c)]


def _time(columns: Sequence[Column], said: list[str], questions: dict[str, str]) -> Column | None:
    """Return the column of the time: by name, or the only one that rises steadily."""

    def rises(column: Column) -> bool:
        steps = np.diff(column.values)
        return bool(column.moves and np.mean(steps >= 0) > 0.99)

    named = [c for c in columns if c.meaning.quantity == "time" and rises(c)]
    if named:
        others = ", ".join(f"'{c.name}'" for c in named[1:])
        said += [f"time is '{named[0].name}'; {others} rise(s) as well"] if others else []
        return named[0]
    steady = [c for c in columns if not c.meaning.quantity and rises(c) and _steady(c.values)]
    if steady:
        said.append(f"time is '{steady[0].name}': it alone rises by equal steps")
        return steady[0]
    said.append(f"the log has no time: {NO_TIME_RATE:g} samples a second are assumed")
    questions["time"] = "the log has no time. Which sampling rate has it?"
    return None


def _steady(values: np.ndarray) -> bool:
    steps = np.diff(values)
    return bool(np.ptp(steps) <= 0.5 * np.median(steps))


def _by_joint(columns: Sequence[Column], quantity: str) -> tuple[dict[str, Column], dict[str, Column]]:
    """Return the measured columns of a quantity by joint, and a second one of the same joint, if there is."""
    found = [c for c in columns if c.meaning.quantity == quantity and not c.meaning.reference]
    first: dict[str, Column] = {}
    second: dict[str, Column] = {}
    for column in found:
        key = " ".join(column.meaning.joint)
        if key not in first:
            first[key] = column
        elif key not in second and _same_course(column.values, first[key].values):
            # The wanted course is the smoother of two.
            wanted = min(first[key], column, key=lambda c: float(np.std(np.diff(c.values, 3))))
            first[key], second[key] = (column if wanted is first[key] else first[key]), wanted
        elif quantity == "position" and not _same_course(column.values, first[key].values):
            first[f"{key} {column.name}".strip()] = column
    if len(first) > 1:
        # A column that stands still beside others that move is a setting.
        first = {key: c for key, c in first.items() if c.moves} or first
    return first, second


def _same_course(one: np.ndarray, other: np.ndarray) -> bool:
    if np.ptp(one) == 0 or np.ptp(other) == 0:
        return False
    ratio = np.ptp(one) / np.ptp(other)
    return bool(correlation(one, other) > _SAME_COURSE and 1 / _SAME_SIZE < ratio < _SAME_SIZE)


def _roughness(values: np.ndarray) -> float:
    """Return the mean step from row to row over the standard deviation."""
    return float(np.std(np.diff(values)) / values.std()) if values.std() > 0 else np.inf


def _unused(columns: Sequence[Column], used: Sequence[Column]) -> list[str]:
    """Return a line on the columns that a case leaves out because their names say nothing."""
    left = [c.name for c in columns if c.moves and not c.meaning.quantity and not any(c is u for u in used)]
    if not left:
        return []
    more = f" and {len(left) - _LISTED} more" if len(left) > _LISTED else ""
    listed = ", ".join(f"'{name}'" for name in left[:_LISTED])
    return [f"not used, because no name says what they are: {listed}{more}"]


def _named_by_unit(columns: Sequence[Column]) -> list[Column]:
    """Return columns whose names say no quantity with that of their unit, if this is one of a motion."""
    return [
        c
        if c.meaning.quantity or not _of_motion(c.unit)
        else replace(c, meaning=replace(c.meaning, quantity=_of_motion(c.unit)))
        for c in columns
    ]


def _smoothest(
    rest: Sequence[Column], said: list[str], questions: dict[str, str], where: str
) -> dict[str, Column]:
    """Return as position the smoothest of two columns whose names say nothing of it."""
    moving = [c for c in rest if c.moves and c.meaning.quantity != "temperature"]
    if len(moving) != 2:
        listed = ", ".join(f"'{c.name}'" for c in rest[:12]) or "none"
        hint = "rename the columns (q, position, Lage), or write the case by hand, see docs/case_file.md"
        raise InputError(
            f"no column is a position or a velocity by its name: {listed}", where=where, hint=hint
        )
    column = min(moving, key=lambda c: _roughness(c.values))
    said.append(f"position is '{column.name}', the smoother of two columns whose names do not say it")
    questions["position"] = f"is '{column.name}' the position, and not the force?"
    return {"": column}


def _matched(found: Mapping[str, Column], joints: Sequence[str]) -> dict[str, Column]:
    """Return a column for each joint; empty if one has none."""
    if len(joints) == 1 and len(found) == 1:
        return {joints[0]: next(iter(found.values()))}
    return {joint: found[joint] for joint in joints} if set(joints) <= set(found) else {}


def _forces(
    others: Sequence[Column],
    joints: Sequence[str],
    position: Mapping[str, Column],
    said: list[str],
    questions: dict[str, str],
) -> tuple[dict[str, Column], tuple[Column, ...]]:
    """Return the force of each joint, the surest witness of it that the log has; empty if one has none.

    If one of several joints has none, the forces that there are follow.
    """
    known = [c for c in others if c.meaning.quantity in FORCES or _bare_command(c, position)]
    ranked = sorted(known, key=_force_rank)
    usable = []
    for column in ranked:
        joint = " ".join(column.meaning.joint)
        moved = position.get(joint) or (next(iter(position.values())) if len(position) == 1 else None)
        doubt = _no_force(column, moved)
        if doubt:
            said.append(f"'{column.name}' is passed over: {doubt}")
        else:
            usable.append(column)

    of_joint: dict[str, list[Column]] = {}
    for column in usable:
        of_joint.setdefault(" ".join(column.meaning.joint), []).append(column)
    if len(joints) == 1:
        chosen = {joints[0]: usable[0]} if usable else {}
    else:
        chosen = {j: of_joint[j][0] for j in joints if j in of_joint}
        chosen = chosen if len(chosen) == len(joints) else {}

    if not chosen and not known and len(joints) == 1:
        silent = [c for c in others if not c.meaning.quantity and c.moves and not c.meaning.reference]
        silent = [c for c in silent if not any(_same_course(c.values, p.values) for p in position.values())]
        if silent:
            column = max(silent, key=lambda c: _roughness(c.values))
            said.append(f"force is '{column.name}', because no name says force, torque, current or voltage")
            questions["force"] = f"is '{column.name}' the force, or the command of the drive?"
            return {joints[0]: column}, ()
        voltages = [c for c in others if c.meaning.quantity == "voltage" and c.moves]
        return ({joints[0]: voltages[0]} if voltages else {}), ()

    beside = [c for c in usable if not any(c is k for k in chosen.values())]
    if chosen and beside:
        said.append(_beside(tuple(chosen.values()), beside))
    return chosen, () if chosen else tuple(usable)


def _beside(chosen: Sequence[Column], beside: Sequence[Column]) -> str:
    """Return the line on forces that a log has beside those that were chosen."""
    names = [f"'{c.name}'" for c in beside]
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    if len(chosen) == 1:
        return f"force is '{chosen[0].name}'; {', '.join(names[:_LISTED])}{more} could be it as well"
    forces = ", ".join(f"'{c.name}'" for c in chosen)
    return f"forces are {forces}; {', '.join(names[:_LISTED])}{more} could be these as well"


def _force_rank(column: Column) -> tuple[bool, int, bool]:
    kind, wanted = column.meaning.quantity, column.meaning.reference
    return wanted or kind not in _MEASURED, _RANK.get(kind, len(_RANK)), wanted


def _bare_command(column: Column, position: Mapping[str, Column]) -> bool:
    """Check for a wanted value without a quantity that no position follows: the drive's command."""
    if column.meaning.quantity or not column.meaning.reference:
        return False
    joint = " ".join(column.meaning.joint)
    if not column.moves and all(position) and joint and joint not in position:
        return False  # the command of another joint, at rest
    return not any(abs(correlation(column.values, p.values)) > _FOLLOWED for p in position.values())


def _no_force(column: Column, position: Column | None) -> str:
    """Return why a column cannot be the force that moves a position; empty if it can."""
    values = column.values
    if not values.any():
        return "it is zero throughout"
    if not column.moves:
        return ""
    low, high = float(values.min()), float(values.max())
    kind = column.meaning.quantity
    if low < 0 or low > _NEAR_ZERO * high or kind not in ("load", "current", "duty"):
        return ""
    # The current of a drive that always holds a weight is never negative either. A servo's load is unsigned.
    if kind != "load" and position is not None and has_direction(values, position.values):
        return ""
    return "it is never negative, so it is a magnitude without a direction"


def _references(
    others: Sequence[Column],
    position: Mapping[str, Column],
    spare: Mapping[str, Column],
    said: list[str],
    questions: dict[str, str],
) -> dict[str, Column]:
    """Return the reference of each joint; empty if there is none."""
    wanted: dict[str, Column] = {}
    for column in others:
        if column.meaning.reference and column.meaning.quantity in ("position", ""):
            wanted.setdefault(" ".join(column.meaning.joint), column)
    named = _matched(wanted, tuple(position))
    # Small moves may end within the play of a servo; names that count the joints alike then say enough.
    alike = len(named) > 1 and all(_overlap(position[j].values, c.values) for j, c in named.items())
    if alike or (named and all(_follows(position[j].values, c.values) for j, c in named.items())):
        return named
    if position and set(spare) == set(position):
        first = next(iter(spare.values()))
        said.append(f"reference is '{first.name}', which has the course of the position")
        questions["reference"] = f"is '{first.name}' the wanted position, or a second encoder?"
        return dict(spare)
    return {}


def _overlap(position: np.ndarray, reference: np.ndarray) -> bool:
    return bool(max(position.min(), reference.min()) <= min(position.max(), reference.max()))


def _follows(position: np.ndarray, reference: np.ndarray) -> bool:
    moved = np.ptp(position) > 0 and np.ptp(reference) > 0
    return not moved or abs(correlation(position, reference)) > _FOLLOWED
