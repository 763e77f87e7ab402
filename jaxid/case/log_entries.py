"""The logs that a case names: [log], and the entries of [[fit]] and [[validation]]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxid.case.tables import fit_keys, validation_keys
from jaxid.schema import Spot, keys_of, read_table
from jaxid.settings import Disturbance, LogTable, log_table


@dataclass(frozen=True)
class Validation:
    """One of [[validation]].

    Args:
        name: Name in results.
        log: Its file; None: the fitted log.
        columns: Its [log] table, complete: for `jaxid.logs.log.read_log`.
        disturbance: The controller's on this log: a square wave, or the name of a column.
        known: Values of parameters that are known in this log, by their names in results.
    """

    name: str
    log: Path | None
    columns: LogTable
    disturbance: Disturbance | str | None = None
    known: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class FitEntry(Validation):
    """One of [[fit]]: a log that is fitted with the others.

    Its `log` is None if it takes the first log of the command.
    """


def log_of(tables: Mapping[str, Any], root: Spot) -> LogTable | None:
    """Read the table [log]; None if there is none.

    Raises:
        InputError: If a key is unknown or impossible, or two time bases are given.
    """
    if "log" not in tables:
        return None
    return _time_base(log_table(tables["log"], root.under("[log]")), root.under("[log]"))


def validations_of(tables: Mapping[str, Any], root: Spot) -> tuple[Validation, ...]:
    """Read the entries of [[validation]].

    Raises:
        InputError: If a key is unknown or impossible, a name is taken, or an entry is the fitted log.
    """
    out: list[Validation] = []
    for k, table in enumerate(tables.get("validation", []), start=1):
        spot = root.under(f"[[validation]] {k}")
        given = read_table(table, validation_keys(), spot)
        _check_name(given["name"], out, spot)
        if "log" not in given and "rows" not in table:
            hint = "add log = <its file>, or rows that the fit does not use"
            raise spot.fault("this validation log is identical to the fitted log", hint)
        log = root.folder / given["log"] if "log" in given else None
        out.append(
            Validation(given["name"], log, *_of_log(tables, table, given, spot, same_file=log is None))
        )
    return tuple(out)


def fits_of(tables: Mapping[str, Any], root: Spot) -> tuple[FitEntry, ...]:
    """Read the entries of [[fit]].

    Raises:
        InputError: If a key is unknown or impossible, a name is taken, or an entry names no log.
    """
    out: list[FitEntry] = []
    for k, table in enumerate(tables.get("fit", []), start=1):
        spot = root.under(f"[[fit]] {k}")
        given = read_table(table, fit_keys(), spot)
        if "name" not in given and "log" not in given:
            raise spot.fault("has neither name nor log", "add log = <its file>, or name for the first LOG")
        log = root.folder / given["log"] if "log" in given else None
        name = given["name"] if log is None else given.get("name", log.stem)
        if log is not None and "name" not in given and name in [entry.name for entry in out]:
            name = f"{log.parent.name}/{name}"
        _check_name(name, out, spot)
        out.append(FitEntry(name, log, *_of_log(tables, table, given, spot, same_file=log is None)))
    return tuple(out)


def _check_name(name: str, others: Sequence[Validation], spot: Spot) -> None:
    """Refuse the name of another entry."""
    if name in [entry.name for entry in others]:
        raise spot.at("name").refuse(name, "is taken", "give each a different name")


def _of_log(
    tables: Mapping[str, Any],
    table: Mapping[str, Any],
    given: Mapping[str, Any],
    spot: Spot,
    *,
    same_file: bool,
) -> tuple[LogTable, Disturbance | str | None, Mapping[str, float | tuple[float, ...]]]:
    """Return columns, disturbance and known values of an entry that names a log."""
    columns = {name: table[name] for name in keys_of(LogTable) if name in table}
    merged = log_table(_merged(tables.get("log", {}), columns, same_file=same_file), spot)
    of_fit = (tables.get("controller") or {}).get("disturbance")
    disturbance = given["disturbance"] if "disturbance" in given else _disturbance(of_fit)
    return _time_base(merged, spot), disturbance, given.get("set", {})


def _time_base(table: LogTable, spot: Spot) -> LogTable:
    """Return the table of a log; refuse two time bases."""
    if table.time is not None and table.sample_rate is not None:
        raise spot.fault("both time and sample_rate are given", "keep one of them")
    return table


def _disturbance(given: Any) -> Disturbance | str | None:
    """Return the disturbance of [controller], which was checked there."""
    return Disturbance(**{k: float(v) for k, v in given.items()}) if isinstance(given, dict) else given


def _merged(base: Mapping[str, Any], columns: Mapping[str, Any], *, same_file: bool) -> dict[str, Any]:
    """Return [log] with the keys that differ; rows of one file mean nothing in another."""
    dropped = set() if same_file else {"rows"}
    # One time base takes the place of the other.
    dropped |= {"time"} if "sample_rate" in columns else set()
    dropped |= {"sample_rate"} if "time" in columns else set()
    return {**{key: value for key, value in base.items() if key not in dropped}, **columns}
