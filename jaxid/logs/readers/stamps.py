"""Time stamps written as text: ISO 8601, day before month with dots, and times of day, in seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

_TIME = r"(?P<time>\d{1,2}:\d{2}(:\d{2}([.,:]\d{1,9})?)?)"
_ZONE = r"\s*(?P<zone>Z|[+-]\d{2}:?\d{2})?"
_FORMS = (
    re.compile(rf"(?P<year>\d{{4}})[-/](?P<month>\d{{1,2}})[-/](?P<day>\d{{1,2}})([T ]\s*{_TIME})?{_ZONE}"),
    re.compile(rf"(?P<day>\d{{1,2}})\.(?P<month>\d{{1,2}})\.(?P<year>\d{{4}})([T ]\s*{_TIME})?{_ZONE}"),
    re.compile(_TIME),
)
_DAY = 86400 * 10**9


def is_stamp(cell: str) -> bool:
    """Check whether a cell is a date, a time of day, or both."""
    # A quick look first: most cells are numbers.
    if ":" not in cell and cell.count("-") < 2 and cell.count(".") < 2 and cell.count("/") < 2:
        return False
    return any(form.fullmatch(cell) for form in _FORMS)


def seconds_of(cells: Sequence[str]) -> tuple[Float[np.ndarray, " samples"], int]:
    """Return the time of stamps since the midnight before the first of them [s].

    Times of day go on past midnight. Offsets from UTC are taken off.

    Args:
        cells: Stamps of one form, as text.

    Returns:
        Times [s]; NaN for the first cell that is no stamp, and the number of readable cells before it.

    Source:
        ISO 8601 for the order of year, month and day and for the offset.
    """
    form = next((f for f in _FORMS if f.fullmatch(cells[0])), None) if cells else None
    if form is None:
        return np.full(len(cells), np.nan), 0
    dated = "year" in form.groupindex
    dates, times, zones = [], [], []
    for cell in cells:
        match = form.fullmatch(cell)
        if match is None:
            break
        times.append((match["time"] or "0:0") if dated else match["time"])
        if dated:
            dates.append(f"{match['year']}-{match['month']:0>2}-{match['day']:0>2}")
            zones.append(_offset(match["zone"]))
    of_day = np.array([_of_day(time) for time in times], dtype=np.int64)
    if dated:
        try:
            days = np.array(dates, dtype="datetime64[D]").astype(np.int64)
        except ValueError:
            return np.full(len(cells), np.nan), 0
        nanoseconds = (days - days[0]) * _DAY + of_day - np.array(zones, dtype=np.int64)
    else:
        nanoseconds = of_day + _DAY * np.cumsum(np.diff(of_day, prepend=of_day[:1]) < -_DAY // 2)
    out = np.full(len(cells), np.nan)
    out[: len(times)] = nanoseconds / 1e9
    return out, len(times)


def _of_day(time: str) -> int:
    """Return a time of day [ns]."""
    hour, minute, *rest = re.split(r"[:,.]", time)
    second = int(rest[0]) if rest else 0
    fraction = int(rest[1].ljust(9, "0")) if len(rest) > 1 else 0
    return ((int(hour) * 60 + int(minute)) * 60 + second) * 10**9 + fraction


def _offset(zone: str | None) -> int:
    """Return an offset from UTC [ns]."""
    if not zone or zone == "Z":
        return 0
    hours, minutes = int(zone[1:3]), int(zone[-2:])
    return (1 if zone[0] == "+" else -1) * (hours * 60 + minutes) * 60 * 10**9
