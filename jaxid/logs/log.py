"""Measured logs: the columns that a case names, checked and in SI units."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.errors import InputError, suggest
from jaxid.logs.jitter import with_even_rows
from jaxid.logs.late import taken_back
from jaxid.logs.readers import read_table
from jaxid.logs.readers.array_files import Columns
from jaxid.logs.readers.rows import Rows
from jaxid.logs.readers.table import Assumed, Table
from jaxid.logs.resample import Readings, readings_of, resampled
from jaxid.logs.timebase import TimeBase, time_base
from jaxid.logs.units import Frame, converted
from jaxid.logs.wrap import find_wrap, joined
from jaxid.names import HOLDS, OPTIONAL_COLUMNS, RESAMPLINGS, STEADY_COLUMNS
from jaxid.settings import LogTable, log_table

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

# Chosen: with fewer samples nothing remains after filtering and trimming.
MINIMUM_SAMPLES = 50
# Period of a log without a force from which on it is probably not that of the servo's own loop [s].
SLOW_LOOP = 2.5e-3
# Chosen, in any unit: beyond it a number is damaged, and its powers overflow.
_LARGEST = 1e30
# No shape here: columns may be flat, and `Log` checks their lengths.
Column = np.ndarray


@dataclass(frozen=True)
class SteadyRows:
    """Precision of the rows of a table of steady speeds.

    Attributes:
        scatter: Standard deviation of the force in each row, or of one reading of it if `count` is given, in
            units of the command, (rows, drives); None: not known.
        count: Number of readings of which each row is the mean, (rows,); None: not known.
    """

    scatter: Float[np.ndarray, "rows drives"] | None = None
    count: Float[np.ndarray, " rows"] | None = None

    @property
    def std(self) -> Float[np.ndarray, "rows drives"] | None:
        """Standard deviation of the force of each row, in units of the command; None: not known."""
        if self.scatter is None or self.count is None:
            return self.scatter
        return self.scatter / np.sqrt(self.count)[:, None]


@dataclass(frozen=True)
class Log:
    """One measured or simulated log; its arrays are read-only float64 copies.

    Time is kept as (samples,), all other columns as (samples, width); flat columns are accepted.

    Attributes:
        time: Time [s], from the start of the file.
        position: Positions [m or rad], a column a joint; NaN throughout for a joint without an encoder. None
            with `velocity` given: the integral of the velocity, which starts at zero.
        force: The logged command, before the known gain of the actuator; None: zero, as none was logged.
        velocity: Measured velocity [m/s or rad/s].
        acceleration: Measured acceleration [m/s^2 or rad/s^2].
        reference: Reference of the controller [m or rad].
        load_position: Position behind a flexible coupling [m or rad].
        load_acceleration: Acceleration behind a flexible coupling [m/s^2 or rad/s^2].
        temperature: Temperature, in the unit of the file.
        effort: Current or load of each drive, in the unit of the file.
        hold: Shape of the command between samples, one of `HOLDS`.
        rows: Rows of the file, 0-based and half open; (0, 0) means all.
        source: Origin of the log, for messages.
        assumed: Everything that was assumed to read it.
        table: The `[log]` table by which it was read; None: it was not read from a file.
        integrated: Whether the velocity was measured, and the position is its integral.
        steady: Precision of the rows of a table of steady speeds; None: the rows are samples over time.
        others: Stretches of rows of the same file that gaps separate from this one, first and end.
        clipped: Mask of the rows in which a force was larger than recorded, (samples, drives); None: none.
        counted: Whether each position holds whole numbers only, before it was resampled; empty: as it is.
    """

    time: Column
    position: Column | Any
    force: Column | Any
    velocity: Column | None = None
    acceleration: Column | None = None
    reference: Column | None = None
    load_position: Column | None = None
    load_acceleration: Column | None = None
    temperature: Column | None = None
    effort: Column | None = None
    hold: str = "zero_order"
    rows: tuple[int, int] = (0, 0)
    source: str = "log"
    assumed: tuple[Assumed, ...] = ()
    table: LogTable | None = None
    integrated: bool = False
    steady: SteadyRows | None = None
    others: tuple[tuple[int, int], ...] = ()
    clipped: Bool[np.ndarray, "samples drives"] | None = None
    counted: tuple[bool, ...] = ()

    def __post_init__(self):
        """Copy the arrays, make them read-only and check that they fit together.

        Raises:
            InputError: If lengths differ, `hold` is unknown, or there is neither position nor velocity.
        """
        time = _frozen(np.ravel(self.time))
        object.__setattr__(self, "time", time)
        if self.position is None:
            if self.velocity is None:
                hint = "give position, or velocity if only that was measured"
                raise InputError("neither position nor velocity is given", where=self.source, hint=hint)
            object.__setattr__(self, "position", integral(time, self.velocity))
            object.__setattr__(self, "integrated", True)
        if self.force is None:
            drives = np.asarray(self.position if self.reference is None else self.reference)
            width = drives.shape[1] if drives.ndim == 2 else 1
            object.__setattr__(self, "force", np.zeros((time.size, width)))
        for name in ("position", "force", *OPTIONAL_COLUMNS):
            given = getattr(self, name)
            if given is None:
                continue
            values = np.asarray(given, dtype=np.float64)
            values = _frozen(values[:, None] if values.ndim == 1 else values)
            if len(values) != time.size:
                what = f"unequal lengths: time {time.size}, {name} {len(values)}"
                raise InputError(what, where=self.source, hint="cut them to the same samples")
            object.__setattr__(self, name, values)
        if self.hold not in HOLDS:
            what, hint = f"hold = '{self.hold}' is unknown", suggest(self.hold, HOLDS)
            raise InputError(what, where=self.source, hint=hint)
        if self.rows == (0, 0):
            object.__setattr__(self, "rows", (0, time.size))

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.time.size

    @property
    def resampled(self) -> bool:
        """True if the samples are not the rows of the file."""
        return any(a.setting in ("resample", "doubled_rows") for a in self.assumed)

    @property
    def measured(self) -> tuple[bool, ...]:
        """Mask of the joints with an encoder."""
        return tuple(bool(m) for m in ~np.isnan(self.position[0]))

    def need_every_encoder(self, method: str) -> None:
        """Refuse a log in which a joint has no encoder, for a method that needs its position.

        Raises:
            InputError: If a joint has no encoder.
        """
        if not all(self.measured):
            raise InputError(
                f"joint {self.measured.index(False) + 1} has no position, which {method} needs",
                where=self.source,
                hint="name its column (load_position), or use output_error",
            )

    @property
    def readings(self) -> Float[np.ndarray, "samples joints"]:
        """Readings of the sensors of motion: positions, or velocities if only these were measured."""
        return self.velocity if self.integrated and self.velocity is not None else self.filled

    @property
    def filled(self) -> Float[np.ndarray, "samples joints"]:
        """Positions, with the mean of the other joints in place of those without an encoder."""
        if all(self.measured):
            return self.position
        others = np.nanmean(self.position, axis=1, keepdims=True)
        return np.where(self.measured, self.position, others)

    @property
    def readings_of_speed(self) -> Float[np.ndarray, "samples joints"]:
        """Measured velocities of a log that has them."""
        assert self.velocity is not None, "only logs with a velocity are asked"
        return self.velocity

    @property
    def passive(self) -> bool:
        """True if no force drives the machine: it was not logged, or it is zero throughout."""
        return not self.force.any()

    @property
    def stepped(self) -> bool:
        """True if every force is constant, and one of them drives: a step that began with the log."""
        return not self.passive and not np.ptp(self.force, axis=0).any()

    @property
    def period(self) -> float:
        """Sampling period [s].

        It is the mean step, which for the even sampling that `read_log` requires is the
        median without its rounding (2e-5 on the time stamps of one real log).
        """
        return float((self.time[-1] - self.time[0]) / (self.samples - 1))

    @property
    def rate_hz(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.period


def steady_log(
    groups: dict[str, np.ndarray],
    names: Mapping[str, list[str]],
    content: Table,
    table: LogTable,
    frame: Frame,
    path: Path,
) -> Log:
    """Return a table of steady speeds as a log, whose time is the number of the row.

    Args:
        groups: Columns by quantity, (rows, width) each.
        names: Names of the columns by quantity.
        content: The table as its reader gave it.
        table: The `[log]` table.
        frame: The machine, on which the conversion of units depends.
        path: The file, for messages.

    Raises:
        InputError: If a unit does not go with the machine, or a scatter or number of samples is not positive.
    """
    groups = dict(groups)
    apart = {name: groups.pop(name) for name in STEADY_COLUMNS if name in groups}
    for name, values in apart.items():
        if not np.all(values > 0):
            row = content.rows[0] + int(np.flatnonzero(~np.all(values > 0, axis=1))[0])
            hint = f"correct the row, or leave {name} out"
            raise InputError(f"{name} is not positive in row {row}", where=str(path), hint=hint)

    own, units = converted(groups, names, content.units, table, frame, str(path))
    spread = None
    if "scatter" in apart:
        # The scatter is in the unit of the force, whose sign does not matter.
        of_force = {"force": apart["scatter"]}
        turned = replace(table, sign=None)
        spread = np.abs(converted(of_force, names, content.units, turned, frame, str(path))[0]["force"])

    count = apart["samples"][:, 0] if "samples" in apart else None
    said = []
    resting = int(np.sum(~own["velocity"].any(axis=1)))
    if resting:
        what = "dry friction is undetermined at rest, so that they do not count"
        said.append(Assumed("rows at rest", resting, what))

    return Log(
        time=np.arange(len(own["velocity"]), dtype=float),
        position=np.zeros_like(own["velocity"]),
        velocity=own["velocity"],
        force=own["force"],
        temperature=own.get("temperature"),
        rows=content.rows,
        source=str(path),
        assumed=(*content.assumed, *units, *said),
        table=table,
        steady=SteadyRows(spread, count),
    )


def integral(time: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the integral of a velocity by the trapezoidal rule, from zero.

    Args:
        time: Time [s], (samples,).
        velocity: Velocities [m/s or rad/s], (samples,) or (samples, joints).
    """
    v = np.asarray(velocity, dtype=np.float64)
    v = v[:, None] if v.ndim == 1 else v
    if len(v) != time.size:
        # The log itself refuses unequal lengths.
        return np.zeros_like(v)
    steps = 0.5 * (v[1:] + v[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, v.shape[1])), np.cumsum(steps, axis=0)])


def with_load(log: Log, load: int | None, joints: int) -> Log:
    """Return the log with a column of positions for each joint, that of the load included.

    Args:
        log: Log of a plant's encoders: all joints in `position`, or all but the load, whose position is in
            `load_position` or not measured.
        load: Index of the joint behind an elastic coupling, from 0; None: every joint has its encoder.
        joints: Number of joints of the plant.

    Raises:
        InputError: If the load is given twice, or columns are missing.
    """
    if load is None:
        return log
    width = log.position.shape[1]
    if width == joints:
        if log.load_position is not None:
            raise InputError(
                "load_position is given beside the positions of all joints",
                where=log.source,
                hint="remove load_position, or let position name the motor's column alone",
            )
        return log
    if width != joints - 1:
        raise InputError(
            f"position has {width} columns, expected {joints - 1} or {joints}",
            where=log.source,
            hint="name the motor's column, and the load's as load_position if it has one",
        )
    column = np.full(log.samples, np.nan) if log.load_position is None else log.load_position[:, 0]
    return replace(log, position=np.insert(log.position, load, column, axis=1), load_position=None)


def _frozen(values: Any) -> np.ndarray:
    """Return a read-only float64 copy."""
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def read_log(
    path: str | Path,
    columns: LogTable | Mapping[str, Any],
    *,
    joints: int | None = 1,
    drives: int | None = None,
    frame: Frame | None = None,
    read: Callable[[Path, list[str], Rows | None], Columns | Table] | None = None,
) -> Log:
    """Read a log, and refuse one that no estimator could use.

    Columns are converted to SI units, and uneven or unequal samples are resampled to one rate; all of this
    stands in `assumed` of the log.

    Args:
        path: The file; its suffix, or `format` of the table, determines the reader.
        columns: The `[log]` table of a case: names of columns by quantity; `sample_rate` [Hz] if there is no
            time; `hold`, `rows`, `units` and how to resample.
        joints: Expected number of positions; None accepts any.
        drives: Expected number of forces and references; None: at most as many as positions.
        frame: The machine, on which the conversion of units depends; None: nothing is known of it.
        read: Function that reads named columns, for a source other than a file.

    Returns:
        The log.

    Raises:
        InputError: If a key, the file, a column, a cell or the time base is unsound.
    """
    path = Path(path)
    table = log_table(columns)
    names = _names(table)
    _check_distinct(names)
    wanted = [name for group in names.values() for name in group]
    stretch = one_stretch(table, str(path))
    content = read_table(path, wanted, stretch, table) if read is None else read(path, wanted, stretch)
    content = content if isinstance(content, Table) else Table(*content)
    data, rows = content.columns, content.rows
    _check_finite(data, rows[0], path, content.sparse if table.resample is None else set(data) - {table.time})

    groups = {
        key: data[group[0]] if len(group) == 1 else np.concatenate([data[name] for name in group], axis=1)
        for key, group in names.items()
    }
    _check_widths(groups, names, joints, drives, path)
    if table.kind == "steady":
        return steady_log(groups, names, content, table, Frame() if frame is None else frame, path)
    if rows[1] - rows[0] < MINIMUM_SAMPLES:
        raise _too_short(rows[1] - rows[0], path)
    wraps: list[Assumed] = []
    if table.unwrap and "position" in groups:
        # A turn is one of the column's unit.
        wraps = _joins(groups["position"], table.unwrap)
        position, reference = joined(groups["position"], groups.get("reference"), table.unwrap)
        groups |= {"position": position} | ({} if reference is None else {"reference": reference})
    frame = Frame() if frame is None else frame
    groups, units = converted(groups, names, content.units, table, frame, str(path))
    groups, absent = _completed(groups, joints, drives)
    counted = _counted(groups["position"]) if "position" in groups else ()
    time, groups, rows, timing, others = _at_one_rate(groups, table, rows, path)
    if time.size < MINIMUM_SAMPLES:
        raise _too_short(time.size, path)
    groups = taken_back(groups, time, table, str(path))
    return Log(
        time=time,
        hold=HOLDS[0] if table.hold is None else table.hold,
        rows=rows,
        source=str(path),
        assumed=(*content.assumed, *absent, *units, *wraps, *timing),
        table=table,
        others=others,
        counted=counted,
        **{"position": None, **groups},
    )


def _counted(positions: Float[np.ndarray, "samples n"]) -> tuple[bool, ...]:
    """Return whether each position holds whole numbers only; empty cells do not count."""
    return tuple(bool(np.all((q == np.round(q)) | np.isnan(q))) for q in positions.T)


def _completed(
    groups: dict[str, np.ndarray], joints: int | None, drives: int | None
) -> tuple[dict[str, np.ndarray], list[Assumed]]:
    """Return the columns with a force of zero where none was logged, and what was assumed of absent ones."""
    said = []
    if "position" not in groups:
        why = "the log has no position; where it starts is arbitrary, and the noise is that of the velocity"
        said.append(Assumed("position", "integral of velocity", why))
    if "force" not in groups:
        motion = groups.get("position", groups.get("velocity"))
        assert motion is not None, "`log_table` refuses a log without motion"
        width = motion.shape[1] if joints is None else joints
        force = np.zeros((len(motion), width if drives is None else drives))
        groups = {**groups, "force": force}
        said.append(Assumed("force", 0.0, "the log has none"))
    return groups, said


def _joins(position: np.ndarray, stated: bool | float) -> list[Assumed]:
    """Return words on the turns that are found in a log and joined; empty if their size is stated."""
    found = [] if stated is not True else [find_wrap(q) for q in position.T]
    return [
        Assumed(
            "unwrap",
            float(f"{wrap.turn:.9g}"),
            f"the position of joint {joint} jumps by {wrap.name or format(wrap.turn, '.6g')} in "
            f"{wrap.rows.size} row(s): joined",
        )
        for joint, wrap in enumerate(found, start=1)
        if wrap is not None
    ]


def one_stretch(table: LogTable, where: str) -> Rows | None:
    """Return the rows of a log that is read as one; None: all.

    Raises:
        InputError: If the table names several stretches.
    """
    if table.rows is None:
        return None
    first, end = table.rows[0], table.rows[-1]
    if isinstance(first, tuple) or isinstance(end, tuple):
        hint = "several are fitted together by jaxid.identify; name one here"
        raise InputError(f"rows names {len(table.rows)} stretches", where=where, hint=hint)
    return first, end


def _too_short(samples: int, path: Path) -> InputError:
    hint = f"at least {MINIMUM_SAMPLES} are needed: log for longer, or widen rows"
    return InputError(f"is too short: {samples} samples", where=str(path), hint=hint)


def _at_one_rate(
    groups: dict[str, np.ndarray], table: LogTable, rows: Rows, path: Path
) -> tuple[np.ndarray, dict[str, np.ndarray], Rows, list[Assumed], tuple[Rows, ...]]:
    """Bring all columns to one rate.

    Returns:
        Time, columns by quantity, rows of the file, everything that was assumed, and the rows of other
        stretches between gaps.
    """
    column = groups.pop("time", None)
    where = str(path) if column is None else f"{path}, column '{table.time}'"
    if column is None:
        assert table.sample_rate is not None, "`log_table` refuses a log without time and rate"
        stamps = np.arange(*rows) / table.sample_rate
        base = TimeBase(stamps, np.arange(stamps.size), 1.0 / table.sample_rate, True, 0, ())
    else:
        stamps = column[:, 0]
        repeats = np.all([np.all(v[1:] == v[:-1], axis=1) for v in groups.values()], axis=0)
        base = time_base(stamps, rows[0], where, repeats)
        motion = groups.get("position", groups.get("velocity"))
        if not base.even and table.resample is None and motion is not None and np.isfinite(motion).all():
            base = with_even_rows(base, base.of_samples(motion))
        _check_rate(base.time, table, where)
    first, end = base.rows
    kept = (rows[0] + first, rows[0] + end)
    whole = all(np.isfinite(values).all() for values in groups.values())
    plain = base.time.size == stamps.size
    used = groups if plain else {name: base.of_samples(values) for name, values in groups.items()}
    if whole and base.even and table.resample is None:
        return base.time, used, kept, list(base.assumed), base.others

    own = {name: readings_of(base.time, values, name, str(path)) for name, values in used.items()}
    time, made, said = resampled(
        own,
        rate=table.resample,
        period=base.period,
        method=RESAMPLINGS[0] if table.resample_method is None else table.resample_method,
        held=table.hold == "zero_order",
        where=str(path),
    )
    return time, made, kept, [*base.assumed, *_of_rare(own, base), *said], base.others


def _of_rare(own: Mapping[str, list[Readings]], base: TimeBase) -> list[Assumed]:
    """Return words on columns that have no reading in some rows."""
    said = []
    for name, columns in own.items():
        absent = base.time.size - min(c.time.size for c in columns)
        if absent:
            rate = 1 / max(c.period for c in columns)
            what = f"it has none in {absent} of {base.time.size} rows, and {rate:.4g} readings a second"
            said.append(Assumed("readings", name, what))
    return said


def _check_rate(time: np.ndarray, table: LogTable, where: str) -> None:
    """Refuse a sampling rate that is not that of the time column."""
    rate = table.sample_rate
    if rate is None:
        return
    logged = (time.size - 1) / (time[-1] - time[0])
    if abs(logged / rate - 1) > 0.01:
        what = f"the time column gives {logged:.6g} Hz, but sample_rate is {rate:.6g} Hz"
        hint = "remove one of them; is time in seconds?"
        raise InputError(what, where=where, hint=hint)


def _names(table: LogTable) -> dict[str, list[str]]:
    """Return the names of columns by quantity."""
    quantities = ("time", "position", "force", *OPTIONAL_COLUMNS, *STEADY_COLUMNS)
    given = {quantity: getattr(table, quantity) for quantity in quantities}
    if given["velocity"] is None:
        given["velocity"] = table.loop_velocity
    return {q: [g] if isinstance(g, str) else list(g) for q, g in given.items() if g is not None}


def _check_distinct(names: dict[str, list[str]]) -> None:
    """Refuse one column for two quantities; only a reference may be measured elsewhere."""
    for one, other in (("time", "position"), ("time", "force"), ("force", "position")):
        if set(names.get(one, ())) & set(names.get(other, ())):
            hint = "give each quantity a separate column"
            raise InputError(f"{one} and {other} are the same column", where="[log]", hint=hint)


def _check_finite(data: dict[str, np.ndarray], first: int, path: Path, sparse: Set[str]) -> None:
    """Refuse columns with values that are NaN, infinite, or too large for their squares to be finite.

    NaN is no reading in the columns of `sparse`.
    """
    for name, values in data.items():
        where = f"{path}, column '{name}'"
        large = np.flatnonzero(np.any((np.abs(values) > _LARGEST) & np.isfinite(values), axis=1))
        if large.size:
            what = f"row {first + large[0]} is {np.abs(values[large[0]]).max():.3g}, which no sensor reads"
            raise InputError(
                what, where=where, hint="correct or remove the row, or exclude it by rows = [first, end]"
            )
        sound = np.isfinite(values) | (np.isnan(values) if name in sparse else False)
        bad = np.flatnonzero(~sound.all(axis=1))
        if not bad.size:
            continue
        kind = "NaN" if np.isnan(values[bad[0]]).any() else "infinite"
        hint = "exclude these rows by rows = [first, end]"
        hint += ", or set resample = <Hz> to interpolate across them" if kind == "NaN" else ""
        what = f"{bad.size} row(s) are NaN or infinite, the first is row {first + bad[0]} ({kind})"
        raise InputError(what, where=where, hint=hint)


def _check_widths(
    groups: dict[str, np.ndarray],
    names: dict[str, list[str]],
    joints: int | None,
    drives: int | None,
    path: Path,
) -> None:
    """Check for one time, as many positions as joints, and as many forces as drives, or at most as joints."""
    moving = "position" if "position" in groups else "velocity"
    expected = groups[moving].shape[1] if joints is None else joints
    drive_count = expected if drives is None else drives
    for key, values in groups.items():
        width, needed, what = values.shape[1], expected, "joint"
        if key == "time":
            needed = 1
        elif key in ("force", "reference", "effort"):
            needed, what = drive_count, "joint" if drive_count == expected else "drive"
            if drives is None:
                needed = min(needed, width)
        elif key not in ("position", "velocity", "acceleration"):
            continue
        if width != needed:
            where = f"{path}, [log] {key} = {names[key]}"
            hint = f"name one column for each {what}, in the order of the {what}s"
            count = drive_count if what == "drive" else needed
            raise InputError(f"{width} column(s), expected {count}", where=where, hint=hint)
