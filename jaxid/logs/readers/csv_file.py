"""Columns of a text table: commas, semicolons or tabs, one header row."""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError, suggest
from jaxid.logs.readers.rows import Rows, resolve_rows

# In order of preference if a header has equally many of two of them.
_DELIMITERS = (";", "\t", ",")
# Most characters of a cell that a message repeats.
_SHOWN = 40


def read_csv(
    path: Path, names: list[str], rows: Rows | None
) -> tuple[dict[str, Float[np.ndarray, "samples 1"]], Rows]:
    """Read columns of a CSV file; see `read_columns`.

    NumPy's parser reads the selected lines; if it fails, the lines are examined once more to find the faulty
    cell.
    """
    try:
        return _read(path, names, rows)
    except csv.Error as error:
        raise InputError(f"cannot be read ({error})", where=str(path), hint="export the log again") from error


def _read(
    path: Path, names: list[str], rows: Rows | None
) -> tuple[dict[str, Float[np.ndarray, "samples 1"]], Rows]:
    header, delimiter, body = _split(_text(path), path)
    columns = [_find(name, header, path) for name in names]
    first, end = resolve_rows(rows, len(body), path)
    body = body[first:end]
    _check_widths(body, header, delimiter, first, path)
    if not names:
        return {}, (first, end)
    try:
        values = np.loadtxt(body, delimiter=delimiter, usecols=columns, comments=None, quotechar='"', ndmin=2)
    except ValueError as error:
        _blame(body, names, columns, delimiter, first, path)
        raise InputError(str(error)[:200], where=str(path), hint="export the log again") from error
    return {name: values[:, [k]] for k, name in enumerate(names)}, (first, end)


def _text(path: Path) -> str:
    """Read a text file in UTF-8, UTF-16 or Latin-1."""
    raw = path.read_bytes()
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace")
    if b"\0" in raw:
        what = f"is not a text file: byte {raw.index(0)} is NUL"
        raise InputError(what, where=str(path), hint="export the log as CSV")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Units in a header (a degree sign, a mu) from older Windows software.
        return raw.decode("latin-1")


def _split(text: str, path: Path) -> tuple[list[str], str, list[str]]:
    """Split a table into header cells, delimiter and lines of data, without comments and blank lines."""
    lines = [line for line in text.splitlines() if line and not line.isspace()]
    comments = 0
    while comments < len(lines) and lines[comments].lstrip().startswith("#"):
        comments += 1
    if comments == len(lines):
        raise InputError("is empty", where=str(path), hint="export the log again")

    head, body = lines[comments], lines[comments + 1 :]
    if comments and _is_numeric(head):
        # numpy.savetxt writes its header as the last comment.
        head, body = lines[comments - 1].lstrip(" #"), lines[comments:]
    if _is_numeric(head):
        hint = "add a first row with the names of the columns"
        raise InputError(f"no header row: it begins '{head[:_SHOWN]}'", where=str(path), hint=hint)

    if "#" in text:
        body = [line.split("#", 1)[0] for line in body]
        body = [line for line in body if line and not line.isspace()]
    if not body:
        raise InputError("is empty below its header", where=str(path), hint="export the log again")
    delimiter = max(_DELIMITERS, key=head.count)
    return _cells(head, delimiter), delimiter, body


def _cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells; quotes are respected."""
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]


def _is_numeric(line: str) -> bool:
    """Check that all cells of a line that are not empty are numbers."""
    cells = _cells(line, max(_DELIMITERS, key=line.count))
    return any(cells) and all(_number(cell) is not None for cell in cells if cell)


def _number(cell: str) -> float | None:
    """Return the number in a cell; None if it is not a number."""
    try:
        return float(cell)
    except ValueError:
        return None


def _find(name: str, header: list[str], path: Path) -> int:
    """Return the index of a column, which must occur once in the header."""
    if name not in header:
        hint = suggest(name, [known for known in header if known])
        raise InputError(f"has no column '{name}'", where=str(path), hint=hint)
    if header.count(name) > 1:
        hint = "rename one of them"
        raise InputError(f"has {header.count(name)} columns '{name}'", where=str(path), hint=hint)
    return header.index(name)


def _check_widths(body: list[str], header: list[str], delimiter: str, first: int, path: Path) -> None:
    """Refuse rows that are wider or narrower than the header: their cells may belong to other columns.

    NumPy's parser reads the requested columns only. A decimal comma in a comma-separated file, or a cell that
    is missing, would shift them silently.
    """
    named = max(k for k, name in enumerate(header) if name) + 1 if any(header) else len(header)
    for k, line in enumerate(body):
        if named <= line.count(delimiter) + 1 <= len(header) and '"' not in line:
            continue
        cells = _cells(line, delimiter)
        if len(cells) >= named and not any(cells[len(header) :]):
            continue
        hint = "give one cell for each column; write decimals with a point"
        what = f"row {first + k} has {len(cells)} cells, the header {named}"
        raise InputError(what, where=str(path), hint=hint)


def _blame(
    body: list[str],
    names: list[str],
    columns: list[int],
    delimiter: str,
    first: int,
    path: Path,
) -> None:
    """Raise for the first cell that is not a number."""
    for k, line in enumerate(body):
        cells = _cells(line, delimiter)
        for name, column in zip(names, columns, strict=True):
            cell = cells[column] if column < len(cells) else ""
            if _number(cell) is not None and "_" not in cell:
                continue
            fault = f"'{cell[:_SHOWN]}' is not a number" if cell else "the cell is empty"
            hint = "correct or remove the row, or exclude it by rows = [first, end]"
            if _number(cell.replace(",", ".")) is not None:
                hint = "write decimals with a point"
            where = f"{path}, column '{name}', row {first + k} (0-based)"
            raise InputError(fault, where=where, hint=hint)
