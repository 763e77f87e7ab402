"""Columns of Excel workbooks."""

from __future__ import annotations

import contextlib
import datetime
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError, cause, suggest
from jaxid.logs.readers.dialect import split_unit
from jaxid.logs.readers.extras import need
from jaxid.logs.readers.rows import Rows, resolve_rows
from jaxid.logs.readers.stamps import is_stamp
from jaxid.logs.readers.table import Assumed, Table

# Rows in which a header is looked for, and rows of text that may stand below it.
_HEADER, _BELOW = 50, 5
# The last row of a sheet in Excel, and the most that a workbook may unpack to [bytes]; chosen: all rows with
# 20 columns. XML of numbers packs 5 to 30 times, so what packs better than this is no log.
_ROWS, _UNPACKED, _PACKED = 2**20, 2**30, 200


def read_excel(path: Path, names: list[str], rows: Rows | None) -> Table:
    """Read columns of the first sheet whose header has them; see `read_table`. Needs openpyxl."""
    with _opened(path) as book:
        return _of_book(book, path, names, rows)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a workbook, and close it whatever happens.

    Raises:
        InputError: If the file is no workbook, or is damaged.
    """
    openpyxl = need("openpyxl", path, "Excel")
    try:
        _need_size(path)
        # Opened here, since openpyxl leaves a file open that it cannot read. Its warnings on styles and such
        # do not matter.
        with path.open("rb") as file, warnings.catch_warnings(action="ignore"):
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            with contextlib.closing(book):
                yield book
    except (InputError, OSError):
        raise
    except Exception as error:
        # A damaged archive raises errors of many kinds, also while its rows are read.
        what = f"cannot be read ({cause(error)})"
        raise InputError(what, where=str(path), hint="is it an .xlsx file? save it again") from error


def _need_size(path: Path) -> None:
    """Refuse a workbook that unpacks to more than any log, before it is unpacked."""
    with zipfile.ZipFile(path) as archive:
        # No more than these sizes is unpacked, however much the data would expand to.
        size = sum(info.file_size for info in archive.infolist())
    if size > _UNPACKED or size > max(_PACKED * path.stat().st_size, 2**26):
        what = f"unpacks from {path.stat().st_size / 2**20:.3g} to {size / 2**20:.4g} MiB"
        hint = f"at most {_UNPACKED / 2**20:g} MiB, and {_PACKED} times its size: save the log as CSV"
        raise InputError(what, where=str(path), hint=hint)


def _rows(sheet: Any, path: Path) -> Iterator[Sequence[Any]]:
    """Yield the rows of a sheet, whatever size the sheet states of itself: programs write a wrong one."""
    sheet.reset_dimensions()
    for k, row in enumerate(sheet.iter_rows(values_only=True)):
        if k >= _ROWS:
            what = f"sheet '{sheet.title[:40]}' has a row after {_ROWS}, the last one of Excel"
            raise InputError(what, where=str(path), hint="save it again")
        yield row


def header_of_book(path: Path) -> list[str]:
    """Return the widest header of a workbook: a row of text with numbers soon below it, in any sheet.

    Raises:
        InputError: If the file is no workbook.
    """
    best: list[str] = []
    with _opened(path) as book:
        for sheet in book.worksheets:
            rows = list(islice(_rows(sheet, path), _HEADER + _BELOW + 1))
            numbers = [any(_is_number(c) for c in row) for row in rows]
            for k, row in enumerate(rows[:_HEADER]):
                header = ["" if c is None else str(c).strip() for c in row]
                if any(numbers[k + 1 : k + 2 + _BELOW]) and not numbers[k] and _width(header) > _width(best):
                    best = header
    return best


def _width(header: Sequence[str]) -> int:
    return sum(map(bool, header))


def _of_book(book: Any, path: Path, names: list[str], rows: Rows | None) -> Table:
    known: list[str] = []
    for sheet in book.worksheets:
        below = _rows(sheet, path)
        top = list(islice(below, _HEADER))
        for k, row in enumerate(top):
            header = ["" if c is None else str(c).strip() for c in row]
            known = header if sum(map(bool, header)) > sum(map(bool, known)) else known
            if all(_places(name, header) for name in names):
                said = [Assumed("sheet", sheet.title, "the first one with these columns")]
                said = said if len(book.worksheets) > 1 else []
                return _of_sheet(chain(top[k + 1 :], below), k, header, path, names, rows, said)
    missing = next((name for name in names if not _places(name, known)), names[0])
    raise InputError(
        f"no sheet has the column '{missing}'",
        where=str(path),
        hint=suggest(missing, [n for n in known if n]),
    )


def _places(name: str, header: Sequence[str]) -> list[int]:
    exact = [k for k, known in enumerate(header) if known == name]
    return exact or [k for k, known in enumerate(header) if split_unit(known)[0] == name]


def _of_sheet(
    cells: Iterable[Sequence[Any]],
    at: int,
    header: Sequence[str],
    path: Path,
    names: Sequence[str],
    rows: Rows | None,
    said: list[Assumed],
) -> Table:
    """Read the columns from the rows below a header."""
    columns: dict[str, int] = {}
    for name in names:
        found = _places(name, header)
        if len(found) > 1:
            raise InputError(f"has {len(found)} columns '{name}'", where=str(path), hint="rename one of them")
        columns[name] = found[0]

    filled = (row for row in cells if any(c is not None for c in row))
    first_rows = list(islice(filled, _BELOW + 1))
    below = 0
    while below < min(_BELOW, len(first_rows)) and not any(_is_number(c) for c in first_rows[below]):
        below += 1

    units = {name: split_unit(header[k])[1] for name, k in columns.items()}
    if below:
        shown = ", ".join(str(c) for c in first_rows[0] if c is not None)[:40]
        what = f"{below} row(s) below the header hold no numbers, the first is '{shown}'"
        said.append(Assumed("rows_below_header", below, what))
        units = {n: u or str(_cell(first_rows[0], columns[n]) or "").strip("[]() ") for n, u in units.items()}
    if at:
        said.append(Assumed("header", at, f"{at} row(s) above the header are no data"))
    # Only the wanted cells are kept: a sheet may have thousands of columns.
    body = [tuple(_cell(row, k) for k in columns.values()) for row in chain(first_rows[below:], filled)]
    if not body:
        raise InputError("is empty below its header", where=str(path), hint="export the log again")

    first, end = resolve_rows(rows, len(body), path)
    out, sparse = {}, set()
    for place, name in enumerate(columns):
        values = [row[place] for row in body[first:end]]
        out[name] = _numbers(values, name, first, path)[:, None]
        sparse |= {name} if any(v is None for v in values) else set()
    return Table(out, (first, end), {n: u for n, u in units.items() if u}, tuple(said), frozenset(sparse))


def _cell(row: Sequence[Any], k: int) -> Any:
    """Return a cell of a row; None if the row ends before it."""
    return row[k] if k < len(row) else None


def _is_number(cell: Any) -> bool:
    kinds = int | float | datetime.datetime | datetime.time | datetime.timedelta
    return isinstance(cell, kinds) and not isinstance(cell, bool)


def _numbers(values: Sequence[Any], name: str, first: int, path: Path) -> np.ndarray:
    """Return cells as numbers; dates and times as seconds since the first one."""
    out = np.empty(len(values))
    begin = next((v for v in values if v is not None), None)
    for k, value in enumerate(values):
        if value is None:
            out[k] = np.nan
        elif isinstance(value, datetime.datetime) and isinstance(begin, datetime.datetime):
            out[k] = (value - begin).total_seconds()
        elif isinstance(value, datetime.time):
            out[k] = ((value.hour * 60 + value.minute) * 60 + value.second) + value.microsecond * 1e-6
        elif isinstance(value, datetime.timedelta):
            out[k] = value.total_seconds()
        elif isinstance(value, int | float) and not isinstance(value, bool):
            out[k] = value
        else:
            text = str(value)
            hint = "format the column as numbers in Excel, and save it again"
            hint = "format the column as date or time in Excel" if is_stamp(text) else hint
            where = f"{path}, column '{name}', row {first + k} (0-based)"
            raise InputError(f"'{text[:40]}' is text", where=where, hint=hint)
    return out
