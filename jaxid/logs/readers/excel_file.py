"""Columns of Excel workbooks."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Iterator, Sequence
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
    book = None
    try:
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        yield book
    except (InputError, OSError):
        raise
    except Exception as error:
        # A damaged archive raises errors of many kinds, also while its rows are read.
        what = f"cannot be read ({cause(error)})"
        raise InputError(what, where=str(path), hint="is it an .xlsx file? save it again") from error
    finally:
        if book is not None:
            book.close()


def header_of_book(path: Path) -> list[str]:
    """Return the widest header of a workbook: a row of text with numbers soon below it, in any sheet.

    Raises:
        InputError: If the file is no workbook.
    """
    best: list[str] = []
    with _opened(path) as book:
        for sheet in book.worksheets:
            rows = list(sheet.iter_rows(values_only=True, max_row=_HEADER + _BELOW + 1))
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
        cells = [row for row in sheet.iter_rows(values_only=True)]
        for k, row in enumerate(cells[:_HEADER]):
            header = ["" if c is None else str(c).strip() for c in row]
            known = header if sum(map(bool, header)) > sum(map(bool, known)) else known
            if all(_places(name, header) for name in names):
                said = [Assumed("sheet", sheet.title, "the first one with these columns")]
                return _of_sheet(
                    cells, k, header, path, names, rows, said if len(book.worksheets) > 1 else []
                )
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
    cells: Sequence[Sequence[Any]],
    at: int,
    header: Sequence[str],
    path: Path,
    names: Sequence[str],
    rows: Rows | None,
    said: list[Assumed],
) -> Table:
    """Read the columns below a header."""
    columns: dict[str, int] = {}
    for name in names:
        found = _places(name, header)
        if len(found) > 1:
            raise InputError(f"has {len(found)} columns '{name}'", where=str(path), hint="rename one of them")
        columns[name] = found[0]

    body = [row for row in cells[at + 1 :] if any(c is not None for c in row)]
    below = 0
    while below < min(_BELOW, len(body)) and not any(_is_number(c) for c in body[below]):
        below += 1

    units = {name: split_unit(header[k])[1] for name, k in columns.items()}
    if below:
        shown = ", ".join(str(c) for c in body[0] if c is not None)[:40]
        what = f"{below} row(s) below the header hold no numbers, the first is '{shown}'"
        said.append(Assumed("rows_below_header", below, what))
        units = {n: u or str(body[0][columns[n]] or "").strip("[]() ") for n, u in units.items()}
    if at:
        said.append(Assumed("header", at, f"{at} row(s) above the header are no data"))
    body = body[below:]
    if not body:
        raise InputError("is empty below its header", where=str(path), hint="export the log again")

    first, end = resolve_rows(rows, len(body), path)
    out, sparse = {}, set()
    for name, k in columns.items():
        values = [row[k] if k < len(row) else None for row in body[first:end]]
        out[name] = _numbers(values, name, first, path)[:, None]
        sparse |= {name} if any(v is None for v in values) else set()
    return Table(out, (first, end), {n: u for n, u in units.items() if u}, tuple(said), frozenset(sparse))


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
