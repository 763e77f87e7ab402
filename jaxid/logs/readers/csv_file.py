"""Columns of a text table, as spreadsheets, drives and measuring programs write it.

The file is read in parts, so that its memory is that of the columns and of one part. NumPy's parser reads the
numbers of a part; cells that it cannot read are examined one by one.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jaxid.errors import InputError, cause
from jaxid.logs.readers.dialect import (
    GROUPS,
    SHOWN,
    WHITESPACE,
    Dialect,
    cells_of,
    find_dialect,
    grouped,
    number,
)
from jaxid.logs.readers.rows import Rows, resolve_rows
from jaxid.logs.readers.stamps import is_stamp, seconds_of
from jaxid.logs.readers.table import Assumed, Table, on_one_time
from jaxid.settings import LogTable

# Bytes of a part, of the beginning that shows the dialect, and of looks into the rest for its decimal sign.
_PART, _HEAD, _LOOK, _LOOKS = 2**21, 2**18, 2**12, 16
_CONTROLS = bytes(k for k in range(32) if k not in (9, 10)) + b"\x7f"
_ODD = re.compile("[\u0085\u2028\u2029]")
_EMPTY = re.compile(r"\n[ \t]*(?=\n)")


def read_csv(path: Path, names: list[str], rows: Rows | None, settings: LogTable | None = None) -> Table:
    """Read columns of a text table; see `read_table`."""
    try:
        return _Reading(path, names, settings).table(rows)
    except csv.Error as error:
        raise InputError(
            f"cannot be read ({cause(error)})", where=str(path), hint="export the log again"
        ) from error


def dialect_of(path: Path, names: list[str]) -> tuple[Dialect, list[str]]:
    """Return the dialect of a text table, and the lines of its beginning.

    Args:
        path: The file.
        names: Names of columns that the header must have; empty: any header.

    Raises:
        InputError: If it is no text table.
    """
    reading = _Reading(path, names, None)
    return reading.dialect, reading.beginning()


class _Reading:
    """One pass over a file: dialect, then part by part."""

    def __init__(self, path: Path, names: list[str], settings: LogTable | None):
        self._path = path
        raw = _utf8(path)
        self._raw: bytes | None = raw
        with self._open() as file:
            head, tail = _samples(file)
        self._encoding = _encoding_of(head + tail)
        _need_text(head, path)
        self.dialect = find_dialect(
            self._decoded(head),
            self._decoded(tail),
            names,
            path,
            separator=None if settings is None else settings.separator,
            decimal=None if settings is None else settings.decimal,
        )
        self._times = self._of_groups(names, "" if settings is None else settings.time or "")
        self._names = [name for name in names if name not in self._times]
        self._columns = [self.dialect.find(name, path) for name in self._names]
        for name, places in self._times.items():
            self._names += [_nth(name, place) for place in places]
            self._columns += places
        self._sparse: set[str] = set()
        # The first stamp of each column that holds some.
        self._begin: dict[str, str] = {}

    def beginning(self) -> list[str]:
        """Return the first lines of the file."""
        with self._open() as file:
            return self._decoded(_samples(file)[0]).split("\n")

    def _of_groups(self, names: list[str], time: str) -> dict[str, list[int]]:
        """Return the columns of a time that is there several times: each is of the columns to its right."""
        found = self.dialect.find_all(time)
        if time not in names or len(found) < 2:
            return {}
        others = [self.dialect.find(name, self._path) for name in names if name != time]
        left = {max((k for k in found if k < place), default=found[0]) for place in others}
        return {time: sorted(left) or found[:1]}

    def table(self, rows: Rows | None) -> Table:
        """Read the columns."""
        count = sum(text.count("\n") for text in self._parts())
        if not count:
            raise InputError("is empty below its header", where=str(self._path), hint="export the log again")
        first, end = resolve_rows(rows, count, self._path)
        out = [np.empty((end - first, 1)) for _ in self._names]
        at = 0
        for text in self._parts():
            samples = text.count("\n")
            low, high = max(first - at, 0), min(end - at, samples)
            if low < high:
                if (low, high) != (0, samples):
                    text = "\n".join(text.split("\n")[low:high]) + "\n"
                values = self._numbers(text, at + low)
                for column, read in zip(out, values.T, strict=True):
                    column[at + low - first : at + high - first, 0] = read
            at += samples
        read = Table(
            dict(zip(self._names, out, strict=True)),
            (first, end),
            {n: u for n, k in zip(self._names, self._columns, strict=True) if (u := self.dialect.units[k])},
            (*self.dialect.assumed, *self._of_stamps()),
            frozenset(self._sparse),
        )
        for name, places in self._times.items():
            read = _merged(read, name, places, dict(zip(self._names, self._columns, strict=True)))
        return read

    def _of_stamps(self) -> Iterator[Assumed]:
        for name in self._begin:
            yield Assumed(f"column '{name}'", "stamps", "dates or times of day, taken as seconds")

    def _open(self) -> BinaryIO:
        return io.BytesIO(self._raw) if self._raw is not None else self._path.open("rb")

    def _decoded(self, raw: bytes) -> str:
        text = raw.decode(self._encoding, errors="replace").removeprefix("\ufeff")
        return text.replace("\r\n", "\n").replace("\r", "\n")

    def _parts(self) -> Iterator[str]:
        """Return the rows of data, some whole lines at a time, without blank lines and comments."""
        above, kept = self.dialect.below, b""
        with self._open() as file:
            while raw := file.read(_PART):
                raw = kept + raw
                cut = raw.rfind(b"\n") + 1
                if not cut and b"\r" in raw:
                    cut = raw.rfind(b"\r", 0, -1) + 1
                raw, kept = raw[:cut], raw[cut:]
                text, above = self._rows(self._text(raw), above)
                if text:
                    yield text
        text, _ = self._rows(self._text(kept), above)
        if text:
            yield text

    def _text(self, raw: bytes) -> str:
        """Decode a part, and refuse bytes that no text has."""
        if b"\r" in raw:
            raw = raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        try:
            text = raw.decode(self._encoding)
        except UnicodeDecodeError:
            text = raw.decode("latin-1")
        if len(raw.translate(None, _CONTROLS)) < len(raw) or (not text.isascii() and _ODD.search(text)):
            raise self._control(raw)
        return text

    def _control(self, raw: bytes) -> InputError:
        line = next(
            x for x in raw.split(b"\n") if len(x.translate(None, _CONTROLS)) < len(x) or not x.isascii()
        )
        shown = line[:SHOWN].decode("latin-1").encode("unicode_escape").decode()
        what = f"is not a text file: '{shown}' holds a control character"
        return InputError(what, where=str(self._path), hint="export the log as CSV")

    def _rows(self, text: str, above: int) -> tuple[str, int]:
        """Cut the lines above the data, blank lines and comments; return how many are still to be cut."""
        while above and text:
            _, sign, text = text.partition("\n")
            above -= bool(sign)
        if not text:
            return "", above
        text = text if text.endswith("\n") else text + "\n"
        if "#" in text:
            text = "".join(f"{line.split('#', 1)[0]}\n" for line in text[:-1].split("\n"))
        text = _EMPTY.sub("", "\n" + text)[1:]
        # A TwinCAT Scope ends its exports so.
        text = text.removesuffix("EOF\n")
        return text if text.strip() else "", above

    def _numbers(self, text: str, first: int) -> np.ndarray:
        """Read the wanted columns of some rows, (rows, columns)."""
        if self.dialect.separator == WHITESPACE:
            text = "\n".join(WHITESPACE.join(cells_of(line, WHITESPACE)) for line in text.split("\n"))
        self._check_widths(text, first)
        if not self._names:
            return np.empty((text.count("\n"), 0))
        plain = self._plain(text)
        if plain is not None:
            try:
                return self._parsed(plain)
            except ValueError:
                pass
            filled = _with_nan(plain, self.dialect.separator)
            if "nan" not in plain.casefold():
                try:
                    values = self._parsed(filled)
                except ValueError:
                    pass
                else:
                    self._sparse |= {n for k, n in enumerate(self._names) if np.isnan(values[:, k]).any()}
                    return values
        return self._by_cells(text, first)

    def _parsed(self, text: str) -> np.ndarray:
        return np.loadtxt(
            io.StringIO(text),
            delimiter=self.dialect.separator,
            usecols=self._columns,
            comments=None,
            quotechar='"',
            ndmin=2,
        )

    def _plain(self, text: str) -> str | None:
        """Return the rows with decimal points; None if only a look at each cell can do that."""
        dialect = self.dialect
        if dialect.decimal == "." and not dialect.groups:
            return text
        if '"' in text or dialect.separator == "," or ":" in text:
            return None
        for sign in dialect.groups:
            if sign in text:
                # A sign that does not part groups of three may be a decimal sign after all.
                return None
        return text.replace(",", ".") if dialect.decimal == "," and "." not in text else None

    def _check_widths(self, text: str, first: int) -> None:
        """Refuse rows that are wider or narrower than the header: their cells may belong to other columns.

        NumPy's parser reads the requested columns only. A decimal comma in a comma-separated file, or a cell
        that is missing, would shift them silently.
        """
        dialect = self.dialect
        named, width = dialect.named, len(dialect.header)
        if '"' in text:
            odd = list(enumerate(text[:-1].split("\n")))
        else:
            raw = np.frombuffer(text.encode("utf-8"), dtype=np.uint8)
            ends = np.flatnonzero(raw == 10)
            counts = np.searchsorted(np.flatnonzero(raw == ord(dialect.separator)), ends)
            cells = np.diff(counts, prepend=0) + 1
            wrong = np.flatnonzero((cells < named) | (cells > width))
            lines = text.split("\n") if wrong.size else []
            odd = [(int(k), lines[k]) for k in wrong]
        for k, line in odd:
            cells = cells_of(line, dialect.separator)
            if len(cells) >= named and not any(cells[width:]):
                continue
            hint = "give one cell for each column; write decimals with a point"
            what = f"row {first + k} has {len(cells)} cells, the header {named}"
            raise InputError(what, where=str(self._path), hint=hint)

    def _by_cells(self, text: str, first: int) -> np.ndarray:
        """Read the wanted columns cell by cell, and refuse the first one that is no number."""
        rows = [cells_of(line, self.dialect.separator) for line in text[:-1].split("\n")]
        out = np.empty((len(rows), len(self._names)))
        for k, (name, column) in enumerate(zip(self._names, self._columns, strict=True)):
            cells = [row[column] if column < len(row) else "" for row in rows]
            if name in self._begin or is_stamp(cells[0]):
                out[:, k] = self._seconds(cells, name, first)
                continue
            for j, cell in enumerate(cells):
                out[j, k] = self._number(cell, name, first + j)
        return out

    def _seconds(self, cells: list[str], name: str, first: int) -> np.ndarray:
        """Read stamps; those of all parts count from the midnight before the first one."""
        begin = self._begin.setdefault(name, cells[0])
        seconds, read = seconds_of([begin, *cells])
        if read <= len(cells):
            wrong = max(read - 1, 0)
            raise self._fault(cells[wrong], name, first + wrong, "no date or time of its form")
        return seconds[1:]

    def _number(self, cell: str, name: str, row: int) -> float:
        if not cell:
            self._sparse.add(name)
            return np.nan
        dialect, plain = self.dialect, cell
        if dialect.groups or dialect.decimal == ",":
            plain = _ungrouped(cell, dialect)
        value = number(plain)
        if value is None or "_" in cell:
            raise self._fault(cell, name, row, "not a number")
        return value

    def _fault(self, cell: str, name: str, row: int, what: str) -> InputError:
        hint = "correct or remove the row, or exclude it by rows = [first, end]"
        if number(cell.replace(",", ".")) is not None:
            hint = "write all decimals with one sign, or state it as decimal in [log]"
        where = f"{self._path}, column '{name}', row {row} (0-based)"
        return InputError(f"'{cell[:SHOWN]}' is {what}", where=where, hint=hint)


def _nth(name: str, place: int) -> str:
    return f"{name}\0{place}"


def _merged(read: Table, name: str, places: list[int], column: dict[str, int]) -> Table:
    """Give columns with times of their own one time, with NaN where one has no reading."""
    own = {k: read.columns[_nth(name, k)][:, 0] for k in places}
    units = {key: unit for key, unit in read.units.items() if "\0" not in key}
    of_time = [read.units.get(_nth(name, k)) for k in places]
    units |= {name: of_time[0]} if of_time[0] else {}
    values = {key: v for key, v in read.columns.items() if "\0" not in key}
    first, *others = own.values()
    if all(np.array_equal(first, other) for other in others):
        return replace(read, columns={name: first[:, None], **values}, units=units)
    groups = {
        key: (own[max((k for k in places if k < column[key]), default=places[0])], v)
        for key, v in values.items()
    }
    time, columns = on_one_time(groups)
    said = Assumed("time", name, f"{len(places)} columns of that name, each of the columns to its right")
    rows = (read.rows[0], read.rows[0] + time.size)
    sparse = frozenset(columns)
    return Table({name: time[:, None], **columns}, rows, units, (*read.assumed, said), sparse)


def _ungrouped(cell: str, dialect: Dialect) -> str:
    """Return a number with a decimal point and without groups; a text that is no number if it mixes signs."""
    for sign in GROUPS:
        if sign == dialect.decimal or sign not in cell:
            continue
        # Without decimals only a sign that the whole file uses so is one between groups.
        sure = dialect.decimal in cell or sign in dialect.groups
        if not (sure and grouped(cell, sign, dialect.decimal)):
            return f"? {cell}"
        cell = cell.replace(sign, "")
    return cell.replace(dialect.decimal, ".")


def _with_nan(text: str, separator: str) -> str:
    """Return rows in which empty cells are NaN."""
    sep = re.escape(separator)
    return re.sub(rf"(?:(?<={sep})|^)[ ]*(?={sep}|$)", "nan", text[:-1], flags=re.MULTILINE) + "\n"


def _utf8(path: Path) -> bytes | None:
    """Return the content of a file in UTF-16 as UTF-8; None for any other file, which is read in parts."""
    with path.open("rb") as file:
        if file.read(2) not in (b"\xff\xfe", b"\xfe\xff"):
            return None
    return path.read_bytes().decode("utf-16", errors="replace").encode()


def _samples(file: BinaryIO) -> tuple[bytes, bytes]:
    """Return the beginning of a file, and lines from all over the rest."""
    head = file.read(_HEAD)
    if len(head) < _HEAD:
        return head, b""
    head = head[: head.rfind(b"\n") + 1] or head
    size = file.seek(0, io.SEEK_END)
    looks = []
    for k in range(_LOOKS):
        file.seek(len(head) + (size - len(head)) * k // _LOOKS)
        looks.append(file.read(_LOOK).partition(b"\n")[2].rpartition(b"\n")[0])
    return head, b"\n".join(looks)


def _encoding_of(raw: bytes) -> str:
    try:
        raw.decode("utf-8")
    except UnicodeDecodeError:
        # Units in a header (a degree sign, a mu) from older Windows software.
        return "latin-1"
    return "utf-8"


def _need_text(head: bytes, path: Path) -> None:
    """Refuse a file with NUL bytes, which no text has."""
    if b"\0" in head:
        what = f"is not a text file: byte {head.index(0)} is NUL"
        raise InputError(what, where=str(path), hint="export the log as CSV")
