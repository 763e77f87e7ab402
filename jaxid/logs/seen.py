"""Everything that was seen of a log when it was read, in words with the statement that settles it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.readers.table import Assumed
from jaxid.settings import LogTable

# Settings that are keys of [log].
_KEYS = ("separator", "decimal", "resample", "resample_method", "rows", "episode", "unwrap")
# Deviation of a step that still counts as even, see `jaxid.logs.timebase`.
_EVEN = "even to 1 %"


@dataclass(frozen=True)
class Sight:
    """One thing that was seen of a log.

    Attributes:
        about: "time", "units", "text" (separator, decimal sign, header) or "wrap".
        text: A sentence on it.
        say: Statement for [log] that settles it; empty: there is none.
    """

    about: str
    text: str
    say: str = ""

    def __str__(self) -> str:
        """Format it as one line."""
        return f"{self.about}: {self.text}" + (f": say `{self.say}`" if self.say else "")


def sights_of(log: Log, findings: Sequence[Finding] = ()) -> list[Sight]:
    """Return everything that was seen when a log was read: the time first, then units, text and wraps.

    Args:
        log: The log.
        findings: Doubts on it; those on its time, its units and its wraps are sights as well.
    """
    given = [_sight(assumed) for assumed in log.assumed]
    doubts = [Sight(f.about, f"{f.what}; {f.hint}") for f in findings if f.about]
    order = ("time", "units", "wrap", "text")
    return [_time(log), *sorted([*given, *_stated(log.table), *doubts], key=lambda s: order.index(s.about))]


def _time(log: Log) -> Sight:
    settings = {a.setting for a in log.assumed}
    how = "after resampling" if log.resampled else _EVEN
    how = "with jitter" if "uneven_time" in settings and not log.resampled else how
    how = "with rows taken as even" if "even_rows" in settings and not log.resampled else how
    return Sight(
        "time", f"{log.samples} samples, one every {_period(log.period)} ({log.rate_hz:.6g} Hz), {how}"
    )


def _period(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.6g} {unit}"
    return f"{seconds:.6g} s"


def _stated(table: LogTable | None) -> list[Sight]:
    """Return the units that the case states, and how late it says that forces were logged."""
    units = {} if table is None else dict(table.units or {})
    seen = [
        Sight(
            "time" if q == "time" else "units",
            f"{q} is converted from {_listed(unit)}, as [log] units states",
        )
        for q, unit in units.items()
    ]
    for key, what in (("lag", "freed from a low-pass of"), ("delay", "shifted back by")):
        late = {} if table is None else dict(getattr(table, key) or {})
        for q, times in late.items():
            shown = ", ".join(_period(t) for t in (times if isinstance(times, tuple) else (times,)))
            seen.append(Sight("time", f"{q} is {what} {shown}, as [log] {key} states"))
    return seen


def _listed(unit: Any) -> str:
    return unit if isinstance(unit, str) else ", ".join(dict.fromkeys(unit))


def _sight(assumed: Assumed) -> Sight:
    """Return one setting that the file or the data decided, as a sentence."""
    setting, value, reason = assumed.setting, assumed.value, assumed.reason
    say = statement_of(assumed)
    if setting.startswith("units."):
        quantity = setting.partition(".")[2]
        about = "time" if quantity == "time" else "units"
        known = "not known" not in reason
        return Sight(about, f"{quantity} is in {value} ({reason})", say if known else "")
    if setting == "even_rows":
        return Sight("time", f"one row every {_period(1 / value)}, {value:g} {reason}", say)
    if setting == "resample":
        return Sight("time", f"resampled to {value:g} {reason}", say)
    if setting == "unwrap":
        return Sight("wrap", reason, say)
    if setting in ("separator", "decimal", "thousands", "header", "rows_below_header", "sheet"):
        return Sight("text", reason, say)
    if setting.startswith("column"):
        return Sight("time", f"{setting}: {reason}")
    about = "time"
    text = reason if setting in ("doubled_rows", "uneven_time", "rows") else f"{setting} {value}: {reason}"
    return Sight(about, text, say)


def statement_of(assumed: Assumed) -> str:
    """Return the statement for [log] that takes the place of an assumption; empty if there is none."""
    setting, value = assumed.setting, assumed.value
    if setting.startswith("units."):
        return f'units = {{ {setting.partition(".")[2]} = "{value}" }}'
    if setting not in _KEYS:
        return ""
    if isinstance(value, str):
        text = value.replace("\t", "\\t")
        return f'{setting} = "{text}"'
    if isinstance(value, bool):
        return f"{setting} = {str(value).lower()}"
    return f"{setting} = {np.asarray(value).tolist()}"
