"""Measured logs: the columns that a case names, checked and in SI units."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError, suggest
from jaxid.logs.readers import read_columns
from jaxid.logs.readers.array_files import Columns
from jaxid.logs.readers.rows import Rows
from jaxid.logs.timebase import sound_time

HOLDS = ("zero_order", "linear", "band_limited")
OPTIONAL_COLUMNS = (
    "velocity",
    "acceleration",
    "reference",
    "load_position",
    "load_acceleration",
    "temperature",
)
LOG_KEYS = ("time", "sample_rate", "position", "force", "hold", "rows", *OPTIONAL_COLUMNS)
# Chosen: fewer samples than this leave nothing after filtering and trimming.
MINIMUM_SAMPLES = 50
# No shape here: columns may come flat, and `Log` itself says what does not fit.
Column = np.ndarray


@dataclass(frozen=True)
class Log:
    """One measured or simulated log; its arrays are float64 copies that cannot be written.

    Time is kept as (samples,), all else as (samples, width); flat columns may be given.

    Attributes:
        time: Time [s], from where the file starts.
        position: Positions [m or rad], a column a joint; NaN throughout where a joint has no encoder.
        force: The logged command, before the known gain of the actuator.
        velocity: Measured velocity [m/s or rad/s].
        acceleration: Measured acceleration [m/s^2 or rad/s^2].
        reference: What the controller was asked to follow [m or rad].
        load_position: Position behind a flexible coupling [m or rad].
        load_acceleration: Acceleration behind a flexible coupling [m/s^2 or rad/s^2].
        temperature: Temperature, in the unit of the file.
        hold: How the command runs between samples, one of `HOLDS`.
        rows: Rows of the file, 0-based and half open; (0, 0) stands for all.
        source: Where the log came from, for messages.
    """

    time: Column
    position: Column
    force: Column
    velocity: Column | None = None
    acceleration: Column | None = None
    reference: Column | None = None
    load_position: Column | None = None
    load_acceleration: Column | None = None
    temperature: Column | None = None
    hold: str = "zero_order"
    rows: tuple[int, int] = (0, 0)
    source: str = "log"

    def __post_init__(self):
        """Copy the arrays, freeze them and check that they belong together.

        Raises:
            InputError: If lengths differ or `hold` is unknown.
        """
        time = _frozen(np.ravel(self.time))
        object.__setattr__(self, "time", time)
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
    def measured(self) -> tuple[bool, ...]:
        """Which joints have an encoder."""
        return tuple(bool(m) for m in ~np.isnan(self.position[0]))

    def need_every_encoder(self, method: str) -> None:
        """Refuse a log in which a joint has no encoder, for a method that needs its position.

        Raises:
            InputError: If there is one.
        """
        if not all(self.measured):
            raise InputError(
                f"joint {self.measured.index(False) + 1} has no position, which {method} needs",
                where=self.source,
                hint="name its column (load_position), or use output_error",
            )

    @property
    def filled(self) -> Float[np.ndarray, "samples joints"]:
        """Positions in which joints without an encoder stand where the others are, on average."""
        if all(self.measured):
            return self.position
        others = np.nanmean(self.position, axis=1, keepdims=True)
        return np.where(self.measured, self.position, others)

    @property
    def period(self) -> float:
        """Sampling period [s].

        The mean step, which for the even sampling that `read_log` insists on is the
        median without its rounding (2e-5 on the time stamps of one real log).
        """
        return float((self.time[-1] - self.time[0]) / (self.samples - 1))

    @property
    def rate_hz(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.period


def with_load(log: Log, load: int | None, joints: int) -> Log:
    """The log with a column of positions for each joint, that of the load where it belongs.

    Args:
        log: Of a plant's encoders: all joints in `position`, or all but the load, which stands in
            `load_position` or has none.
        load: Joint behind an elastic coupling, 0-based; None: every joint has its encoder.
        joints: How many there are.

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
                hint="leave it out, or let position name the motor's column alone",
            )
        return log
    if width != joints - 1:
        raise InputError(
            f"position has {width} columns where {joints - 1} or {joints} belong",
            where=log.source,
            hint="name the motor's column, and the load's as load_position where it has one",
        )
    column = np.full(log.samples, np.nan) if log.load_position is None else log.load_position[:, 0]
    return replace(log, position=np.insert(log.position, load, column, axis=1), load_position=None)


def _frozen(values: Any) -> np.ndarray:
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def read_log(
    path: str | Path,
    columns: dict[str, Any],
    *,
    joints: int | None = 1,
    drives: int | None = None,
    read: Callable[[Path, list[str], Rows | None], Columns] = read_columns,
) -> Log:
    """Read a log and refuse what no estimator could use.

    Args:
        path: A `.csv`, `.npz`, `.mat` or `.parquet` file.
        columns: The `[log]` table of a case: names of columns by quantity, and
            `sample_rate` [Hz] where there is no time, `hold`, `rows`.
        joints: Number of positions expected; None takes what there is.
        drives: Number of forces and references expected; None: no more than positions.
        read: Function that reads named columns, for a source other than a file.

    Returns:
        The log.

    Raises:
        InputError: If a key, the file, a column, a cell or the time base is unsound.
    """
    path = Path(path)
    _check_keys(columns)
    names = {key: _names(columns, key) for key in _wanted(columns)}
    _check_distinct(names)
    rows = _rows(columns)
    data, rows = read(path, [name for group in names.values() for name in group], rows)
    _check_finite(data, rows[0], path)
    groups = {key: np.concatenate([data[name] for name in group], axis=1) for key, group in names.items()}
    _check_widths(groups, names, joints, drives, path)
    samples = rows[1] - rows[0]
    if samples < MINIMUM_SAMPLES:
        hint = f"at least {MINIMUM_SAMPLES} are needed: log for longer, or widen rows"
        raise InputError(f"is too short: {samples} samples", where=str(path), hint=hint)
    time = _time(groups.pop("time", None), columns, rows, path)
    hold = columns.get("hold", "zero_order")
    return Log(time=time, hold=hold, rows=rows, source=str(path), **groups)


def _check_keys(columns: dict[str, Any]) -> None:
    for key in columns:
        if key not in LOG_KEYS:
            raise InputError(f"unknown key '{key}'", where="[log]", hint=suggest(key, LOG_KEYS))
    for key in ("position", "force"):
        if not columns.get(key):
            hint = f'add {key} = "<name of the column>"'
            raise InputError(f"'{key}' is missing", where="[log]", hint=hint)
    hold = columns.get("hold", "zero_order")
    if hold not in HOLDS:
        raise InputError(f"hold = {hold!r} is unknown", where="[log]", hint=suggest(str(hold), HOLDS))
    rate = columns.get("sample_rate")
    if rate is None and not columns.get("time"):
        hint = 'add time = "<name of the column>", or sample_rate = <Hz>'
        raise InputError("neither time nor sample_rate is given", where="[log]", hint=hint)
    if rate is not None and not (_is_number(rate) and 0 < rate < np.inf):
        hint = "give the samples per second, e.g. sample_rate = 1000.0"
        raise InputError(f"sample_rate = {rate!r} is not a rate in Hz", where="[log]", hint=hint)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _wanted(columns: dict[str, Any]) -> list[str]:
    quantities = ("time", "position", "force", *OPTIONAL_COLUMNS)
    return [key for key in quantities if columns.get(key) is not None]


def _names(columns: dict[str, Any], key: str) -> list[str]:
    given = columns[key]
    names = given if isinstance(given, list | tuple) else [given]
    if not names or not all(isinstance(name, str) for name in names):
        hint = "give the name of a column, or a list of names"
        raise InputError(f"{key} = {given!r} names no column", where="[log]", hint=hint)
    if len(set(names)) < len(names):
        hint = "name one column a joint"
        raise InputError(f"{key} names a column twice: {names}", where="[log]", hint=hint)
    return list(names)


def _check_distinct(names: dict[str, list[str]]) -> None:
    """Refuse one column for two quantities; a reference may be what was measured elsewhere."""
    for one, other in (("time", "position"), ("time", "force"), ("force", "position")):
        if set(names.get(one, ())) & set(names.get(other, ())):
            hint = "each quantity has a column of its own"
            raise InputError(f"{one} and {other} are the same column", where="[log]", hint=hint)


def _rows(columns: dict[str, Any]) -> tuple[int, int] | None:
    rows = columns.get("rows")
    if rows is None:
        return None
    if (
        not isinstance(rows, list | tuple)
        or len(rows) != 2
        or not all(isinstance(row, int) and not isinstance(row, bool) for row in rows)
    ):
        hint = "give two whole numbers, first and end (0-based, half open): rows = [0, 25000]"
        raise InputError(f"rows = {rows!r} is no range", where="[log]", hint=hint)
    return (rows[0], rows[1])


def _check_finite(data: dict[str, np.ndarray], first: int, path: Path) -> None:
    for name, values in data.items():
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if not bad.size:
            continue
        kind = "NaN" if np.isnan(values[bad[0]]).any() else "infinite"
        hint = "cut these rows out with rows = [first, end], or interpolate before"
        where = f"{path}, column '{name}'"
        what = f"{bad.size} row(s) are NaN or infinite, the first is row {first + bad[0]} ({kind})"
        raise InputError(what, where=where, hint=hint)


def _check_widths(
    groups: dict[str, np.ndarray],
    names: dict[str, list[str]],
    joints: int | None,
    drives: int | None,
    path: Path,
) -> None:
    """One time, as many positions as joints, and as many forces as drives, or no more than those."""
    expected = groups["position"].shape[1] if joints is None else joints
    most = expected if drives is None else drives
    for key, values in groups.items():
        width, needed, what = values.shape[1], expected, "joint"
        if key == "time":
            needed = 1
        elif key in ("force", "reference"):
            needed, what = most, "joint" if most == expected else "drive"
            if drives is None:
                needed = min(needed, width)
        elif key not in ("position", "velocity", "acceleration"):
            continue
        if width != needed:
            where = f"{path}, [log] {key} = {names[key]}"
            hint = f"name one column a {what}, in the order of the {what}s"
            belongs = most if what == "drive" else needed
            raise InputError(f"{width} column(s) where {belongs} belong", where=where, hint=hint)


def _time(
    column: np.ndarray | None, columns: dict[str, Any], rows: tuple[int, int], path: Path
) -> Float[np.ndarray, " samples"]:
    rate = columns.get("sample_rate")
    if column is None:
        return np.arange(*rows) / float(columns["sample_rate"])
    where = f"{path}, column '{columns['time']}'"
    time = sound_time(column[:, 0], rows[0], where)
    logged = (time.size - 1) / (time[-1] - time[0])
    if rate is not None and abs(logged / rate - 1) > 0.01:
        what = f"the time column says {logged:.6g} Hz, sample_rate says {rate:.6g} Hz"
        hint = "leave one of them out; is time in seconds?"
        raise InputError(what, where=where, hint=hint)
    return time
