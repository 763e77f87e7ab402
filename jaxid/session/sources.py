"""Logs that are to be fitted, before they are read: names, files, and stretches of rows."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxid.case.case import Case
from jaxid.case.log_entries import FitEntry
from jaxid.errors import InputError
from jaxid.logs.in_memory import LogLike
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.own_values import OwnValues
from jaxid.session.opened import Logs
from jaxid.settings import Disturbance, LogTable


def one_table(case: Case, log: Logs) -> LogLike:
    """Return the only log of a command, for a case whose log is a table of steady speeds.

    Raises:
        InputError: If there are several, none, or the case has [[fit]].
    """
    logs: list[Any] = list(log) if isinstance(log, list | tuple) else [] if log is None else [log]
    if len(logs) != 1 or case.fits:
        hint = "put all speeds into one table"
        raise InputError('kind = "steady" takes one table', where=f"{case.where}, [log]", hint=hint)
    return logs[0]


@dataclass(frozen=True)
class Source:
    """A log to fit, before it is read.

    Args:
        name: Name of the log in results.
        log: The log, its file, or a table.
        columns: Its columns, of one stretch; None: those of [log].
        disturbance: Signal that was added to the controller's command.
        entry: The entry of the case that it takes its values from; None: none.
        reference_hold: Course of the reference that is stated for this log only.
        whole: Name of the log of which this is a piece.
        own: Values that hold in this log only; None: there are none.
        found: Whether it is a stretch between gaps, which nobody named.
    """

    name: str
    log: LogLike
    columns: LogTable | None
    disturbance: Disturbance | str | None
    entry: FitEntry | None = None
    reference_hold: str | None = None
    whole: str = ""
    own: OwnValues | None = None
    found: bool = False

    def machine(self, machine: Machine) -> Machine:
        """Return a machine with the values of this log."""
        return machine if self.own is None else self.own.machine(machine)


def sources_of(case: Case, log: Logs) -> list[Source]:
    """Return the logs to fit: those of a command, with the entries of [[fit]] that name them, and the others.

    Raises:
        InputError: If there is none, or an entry lacks its log.
    """
    logs: list[Any] = [] if log is None else list(log) if isinstance(log, list | tuple) else [log]
    if not logs and not case.fits:
        hint = "name a log, or add [[fit]] with log to the case"
        raise InputError("there is no log to fit", where=case.where, hint=hint)
    _check_once([log for log in logs if isinstance(log, str | Path)])
    found = [*_named_sources(case, logs)]
    taken = {source.entry.name for source in found if source.entry is not None}
    found += _other_sources(case, taken)
    return _in_pieces(case, found)


def _named_sources(case: Case, logs: Sequence[Any]) -> Iterator[Source]:
    """Yield the logs of a command, each with the entries of [[fit]] that name it."""
    disturbance = None if case.controller is None else case.controller.disturbance
    alone = len(logs) == 1 and not case.fits
    for k, log in enumerate(logs):
        entries = [e for e in case.fits if _names(e, log) or (k == 0 and e.log is None)]
        if entries:
            yield from (_of_entry(e, log) for e in entries)
        else:
            yield Source("fit" if alone else _name_of(log, k), log, None, disturbance)


def _other_sources(case: Case, taken: Collection[str]) -> Iterator[Source]:
    """Yield the entries of [[fit]] that no log of a command has taken.

    Raises:
        InputError: If one of them lacks its log.
    """
    for entry in case.fits:
        if entry.name in taken:
            continue
        if entry.log is None:
            what, hint = "has no log, and none was named", "add log, or name a log for the command"
            raise InputError(what, where=f"{case.where}, [[fit]] {entry.name}", hint=hint)
        yield _of_entry(entry, entry.log)


def _in_pieces(case: Case, sources: Sequence[Source]) -> list[Source]:
    """Return sources under different names, each divided into the stretches of rows that are stated."""
    names: set[str] = set()
    out = []
    for source in sources:
        name = unlike(source.name, names, source.log)
        names.add(name)
        columns = source.columns
        if columns is None and not isinstance(source.log, Log):
            columns = case.columns
        pieces = [(name, None)] if columns is None else pieces_of(name, columns)
        whole = len(pieces) == 1 and source.columns is None
        out += [
            replace(source, name=piece, whole=name, columns=None if whole else table)
            for piece, table in pieces
        ]
    return out


def _check_once(files: Sequence[str | Path]) -> None:
    """Refuse a log that is named twice: its information would count twice."""
    known = [Path(file).resolve() for file in files]
    for k, file in enumerate(known):
        if file in known[:k]:
            hint = "name each log once; stretches of one are rows = [[first, end], ...] in [log]"
            raise InputError("is named twice", where=str(files[k]), hint=hint)


def _names(entry: FitEntry, log: Any) -> bool:
    """Check that a log of a command is the file of an entry."""
    return entry.log is not None and isinstance(log, str | Path) and Path(log).name == entry.log.name


def _of_entry(entry: FitEntry, log: LogLike) -> Source:
    hold = entry.columns.reference_hold
    return Source(entry.name, log, entry.columns, entry.disturbance, entry, hold)


def _name_of(log: Any, number: int) -> str:
    """Return the name of a log in results: that of its file, or its number."""
    if isinstance(log, Log):
        log = log.source
    return Path(log).stem if isinstance(log, str | Path) else f"log {number + 1}"


def unlike(name: str, names: Collection[str], log: Any = None) -> str:
    """Return a name that no other log has: with that of its folder, or with a mark."""
    if name in names and isinstance(log, str | Path):
        name = f"{Path(log).resolve().parent.name}/{name}"
    while name in names:
        name += "'"
    return name


def pieces_of(name: str, columns: LogTable) -> list[tuple[str, LogTable]]:
    """Return name and table of each stretch of rows of a log."""
    if columns.rows is None or isinstance(columns.rows[0], int):
        return [(name, columns)]
    stretches: Any = columns.rows
    return [
        (f"{name}, rows {first} to {end}", replace(columns, rows=(first, end))) for first, end in stretches
    ]


def between_gaps(source: Source, log: Log) -> list[Source]:
    """Return the stretches of a log that gaps separate, the longest first; the log itself if it has none."""
    if not log.others or log.table is None or isinstance(source.log, Log):
        return [source]
    return [
        replace(
            source,
            name=f"{source.name}, rows {first} to {end}",
            columns=replace(log.table, rows=(first, end)),
            found=k > 0,
        )
        for k, (first, end) in enumerate([log.rows, *log.others])
    ]
