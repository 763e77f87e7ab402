"""The dialect of a text table: header row, separator, decimal sign, groups of digits, units and metadata."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from jaxid.errors import InputError, suggest
from jaxid.logs.readers.stamps import is_stamp
from jaxid.logs.readers.table import Assumed
from jaxid.names import SEPARATORS

# One or more blanks.
WHITESPACE = " "
_NAMES = {";": "semicolon", "\t": "tab", ",": "comma", "|": "bar", WHITESPACE: "blanks"}
# Lines in which a header is looked for: the longest block of metadata known has 40 (LabVIEW, TwinCAT Scope).
_LINES = 200
# Rows between header and data: units, descriptions, and the metadata of a TwinCAT Scope's channels.
_MOST_BELOW = 25
# Most characters of a cell that a message repeats.
SHOWN = 40
# Signs between groups of three digits: of English, German, Swiss and French numbers.
GROUPS = (",", ".", "'", "\u2019", "\u00a0", "\u202f")
_COMMENTS = ("#", "%", "//")
_UNIT = re.compile(r"(?P<name>.*?\S)\s*(?:\[(?P<square>[^\[\]]*)\]|\((?P<round>[^()]*)\))\s*$")
_NUMBER = re.compile(r"[+-]?[\d.,'\u2019\u00a0\u202f]+([eE][+-]?\d+)?")
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?P<sign>[^\d])\d{3}(?:(?P=sign)\d{3})*")


@dataclass(frozen=True)
class Dialect:
    """The writing of a text table.

    Attributes:
        header: Names of the columns, units included.
        units: Units by column; empty: none is stated.
        separator: Sign between cells, one of `jaxid.names.SEPARATORS`.
        decimal: Sign before the decimals.
        groups: Signs between groups of three digits.
        below: Lines of the file before the first row of data, blank ones included.
        assumed: Everything that the file decided.
    """

    header: tuple[str, ...]
    units: tuple[str, ...]
    separator: str
    decimal: str
    groups: str
    below: int
    assumed: tuple[Assumed, ...]

    def find_all(self, name: str) -> list[int]:
        """Return all columns of a name, which may leave out the unit that the header adds."""
        return _places(name, self.header)

    def find(self, name: str, path: Path) -> int:
        """Return the column of a name.

        Raises:
            InputError: If there is no such column, or more than one.
        """
        found = self.find_all(name)
        if not found:
            hint = suggest(name, [known for known in self.header if known])
            raise InputError(f"has no column '{name}'", where=str(path), hint=hint)
        if len(found) > 1:
            what = f"has {len(found)} columns '{name}'"
            raise InputError(what, where=str(path), hint="rename one of them")
        return found[0]

    @property
    def named(self) -> int:
        """Number of columns up to the last one that has a name."""
        return max((k for k, name in enumerate(self.header) if name), default=len(self.header) - 1) + 1


def find_dialect(
    sample: str,
    tail: str,
    names: Sequence[str],
    path: Path,
    *,
    separator: str | None = None,
    decimal: str | None = None,
) -> Dialect:
    """Find the dialect of a table in which some names are columns.

    Args:
        sample: Beginning of the file, whole lines.
        tail: Lines from all over the file, for the decimal sign.
        names: Names of columns that the header must have; empty: any header.
        path: The file, for messages.
        separator: Sign between cells that the user states; None: found.
        decimal: Decimal sign that the user states; None: found.

    Raises:
        InputError: If there is no header, or no row below it.
    """
    lines = sample.split("\n")[: _LINES + _MOST_BELOW]
    if not any(line.strip() for line in lines if not line.lstrip().startswith("#")):
        raise InputError("is empty", where=str(path), hint="export the log again")
    at, sep = _header(lines[:_LINES], names, path, separator)
    header = tuple(cells_of(bare(lines[at]), sep))
    data, between = _first_row(lines, at, sep, header)
    if data is None:
        raise InputError("is empty below its header", where=str(path), hint="export the log again")
    units = _units(header, [cells_of(line, sep) for line in between])
    rows = [cells_of(line, sep) for line in [*lines[data:], *tail.split("\n")] if line.strip()]
    cells = [cell for row in rows for cell in row if cell and not is_stamp(cell)]
    sign, groups, doubt = (decimal, _grouping(cells, decimal), "") if decimal else _decimal(cells, sep)

    assumed = []
    if separator is None and sep != ",":
        assumed.append(Assumed("separator", sep, f"the {_NAMES[sep]} parts the header's cells"))
    if sign == "," and decimal is None:
        assumed.append(Assumed("decimal", ",", doubt or "a comma stands before the decimals"))
    if groups:
        assumed.append(Assumed("thousands", groups, "these signs stand between groups of three digits"))
    above = [line for line in lines[:at] if line.strip()]
    if above:
        what = f"{len(above)} line(s) above the header are no data, the first is '{above[0][:SHOWN].strip()}'"
        assumed.append(Assumed("header", at, what))
    if between:
        shown = ", ".join(cell for cell in cells_of(between[0], sep) if cell)[:SHOWN]
        what = f"{len(between)} row(s) below the header hold no numbers, the first is '{shown}'"
        assumed.append(Assumed("rows_below_header", len(between), what))
    return Dialect(header, units, sep, sign, groups, data, tuple(assumed))


def cells_of(line: str, separator: str) -> list[str]:
    """Split a line into cells; quotes are respected."""
    if separator == WHITESPACE and '"' not in line:
        return line.split()
    skip = separator == WHITESPACE
    line = line.strip() if skip else line
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=skip), [])]


def bare(line: str) -> str:
    """Return a header without the sign of a comment before it."""
    line = line.strip("\ufeff")
    for sign in _COMMENTS:
        if line.lstrip().startswith(sign):
            return line.lstrip().removeprefix(sign).lstrip(" #")
    return line


def split_unit(name: str) -> tuple[str, str]:
    """Split a name as "Lage [mm]" or "Lage (mm)" into the bare name and the unit; empty if there is none."""
    match = _UNIT.match(name)
    if match is None:
        return name, ""
    unit = match["square"] if match["square"] is not None else match["round"]
    return match["name"], unit.strip()


def number(cell: str) -> float | None:
    """Return the number in a cell; None if it is not a number."""
    try:
        return float(cell)
    except ValueError:
        return None


def grouped(cell: str, sign: str, decimal: str) -> bool:
    """Check for a number whose digits before the decimal sign are in groups of three."""
    form = rf"[+-]?[1-9]\d{{0,2}}({re.escape(sign)}\d{{3}})+({re.escape(decimal)}\d*)?"
    return sign in cell and re.fullmatch(form, cell) is not None


def _places(name: str, header: Sequence[str]) -> list[int]:
    exact = [k for k, known in enumerate(header) if known == name]
    return exact or [k for k, known in enumerate(header) if name and split_unit(known)[0] == name]


def _header(lines: Sequence[str], names: Sequence[str], path: Path, stated: str | None) -> tuple[int, str]:
    """Return the line of the header and its separator: the first line that has all the names."""
    separators = (stated,) if stated else SEPARATORS
    best: tuple[int, int, str] | None = None
    for k, line in enumerate(lines):
        for sep in separators if line.strip() else ():
            cells = cells_of(bare(line), sep)
            score = sum(bool(_places(name, cells)) for name in names)
            if score > (0 if best is None else best[0]):
                best = (score, k, sep)
        if best is not None and best[0] == len(names):
            break
    return _likely_header(lines, path, separators) if best is None else best[1:]


def _likely_header(lines: Sequence[str], path: Path, separators: Iterable[str]) -> tuple[int, str]:
    """Return the last line of text above the first rows of numbers, and its separator."""
    kept = [(k, line) for k, line in enumerate(lines) if line.strip()]
    for (k, line), (_, following) in pairwise(kept):
        for sep in separators:
            cells, below = cells_of(bare(line), sep), cells_of(following, sep)
            if len(below) > 1 and len(cells) >= len(below) - 1 and _numeric(below) and not _numeric(cells):
                return k, sep
    k, line = next((k, line) for k, line in kept if not line.lstrip().startswith("#"))
    sep = max(separators, key=line.count)
    if _numeric(cells_of(line, sep)):
        hint = "add a first row with the names of the columns"
        raise InputError(f"no header row: it begins '{line[:SHOWN]}'", where=str(path), hint=hint)
    return k, sep


def _numeric(cells: Sequence[str]) -> bool:
    """Check that all cells that are not empty are numbers or stamps of time, and that some are there."""
    return any(cells) and all(_readable(cell) for cell in cells if cell)


def _readable(cell: str) -> bool:
    return number(cell) is not None or number(_plain(cell)) is not None or is_stamp(cell)


def _plain(cell: str) -> str:
    """Return a number in any national writing without its groups, and with a point."""
    cell = "".join(c for c in cell if c not in GROUPS[2:])
    if "," in cell and "." in cell:
        last = max(",", ".", key=cell.rindex)
        cell = cell.replace("." if last == "," else ",", "")
    elif cell.count(",") > 1 or cell.count(".") > 1:
        cell = cell.replace(",", "").replace(".", "")
    return cell.replace(",", ".")


def _first_row(
    lines: Sequence[str], at: int, sep: str, header: Sequence[str]
) -> tuple[int | None, list[str]]:
    """Return the line of the first row of data, and the lines without numbers between it and the header."""
    between = []
    for k in range(at + 1, len(lines)):
        if not lines[k].strip() or lines[k].lstrip().startswith("#"):
            continue
        cells = cells_of(lines[k], sep)
        text = any(cells) and not any(_readable(cell) for cell in cells if cell)
        if not (text or _is_key(cells, header)) or len(between) == _MOST_BELOW:
            return k, between
        between.append(lines[k])
    return None, between


def _is_key(cells: Sequence[str], header: Sequence[str]) -> bool:
    """Check for a row of a TwinCAT Scope's metadata: one key before each value, as "Name" in the header."""
    keys, of_header = {*cells[::2]} - {""}, {*header[::2]} - {""}
    return len(keys) == 1 and of_header == {"Name"} and not _readable(next(iter(keys)))


def _units(header: Sequence[str], between: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the unit of each column: of its header, else of a row of units below."""
    units = [split_unit(name)[1] for name in header]
    rows = [row for row in between if row and row[0].casefold() in ("unit", "units", "einheit")] or between[
        :1
    ]
    for row in rows:
        for k, cell in enumerate(row[: len(units)]):
            units[k] = units[k] or cell.strip("[]() ")
    return tuple(units)


def _decimal(cells: Sequence[str], sep: str) -> tuple[str, str, str]:
    """Return the decimal sign, the signs between groups of digits, and a word of doubt."""
    numbers = [cell for cell in cells if _NUMBER.fullmatch(cell)]
    both = [cell for cell in numbers if "," in cell and "." in cell]
    if both:
        sign = max(",", ".", key=both[0].rindex)
        return sign, _grouping(numbers, sign), ""
    commas = [cell for cell in numbers if "," in cell]
    if any(cell.count(",") > 1 and _GROUPED.fullmatch(cell) for cell in commas):
        return ".", _grouping(numbers, "."), ""
    if not commas:
        several = any(cell.count(".") > 1 and _GROUPED.fullmatch(cell) for cell in numbers)
        sign = "," if several and sep != "," else "."
        return sign, _grouping(numbers, sign), ""
    doubt = ""
    if all(_GROUPED.fullmatch(cell) for cell in commas):
        doubt = "a comma stands before three digits throughout; if it parts thousands, state decimal = '.'"
    return ",", _grouping(numbers, ","), doubt


def _grouping(numbers: Sequence[str], decimal: str) -> str:
    """Return the signs between groups of three digits that occur."""
    signs = [sign for sign in GROUPS if sign != decimal]
    return "".join(sign for sign in signs if any(grouped(cell, sign, decimal) for cell in numbers))
