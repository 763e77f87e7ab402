"""Readers for the keys of a case file: each checks one value or says what is wrong with it.

A table is declared as names and `Key`s; `read_table` refuses what is not declared.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from jaxid.errors import InputError, suggest

# Chosen: longer values are cut in messages, which stay on one line of a terminal.
_LONGEST_SHOWN = 60


@dataclass(frozen=True)
class Spot:
    """Where in a case file something stands.

    Args:
        file: Name of the case file.
        table: As it is written there: "[plant]", "[[effects]] 2 (cogging)"; empty at the top.
        key: Name of the key.
    """

    file: str
    table: str = ""
    key: str = ""

    def fault(self, what: str, hint: str) -> InputError:
        """An error that names file, table and key."""
        where = f"{self.file}, {self.table}" if self.table else self.file
        return InputError(f"{self.key} {what}".strip(), where=where, hint=hint)

    def refuse(self, value: Any, what: str, hint: str) -> InputError:
        """An error that also shows the value."""
        return self.fault(f"= {shown(value)} {what}", hint)

    def at(self, key: str) -> Spot:
        """A key of the same table."""
        return replace(self, key=key)

    def entry(self, index: int) -> Spot:
        """One entry of a list, counted from 1."""
        return replace(self, key=f"{self.key}[{index}]")

    def inside(self, key: str) -> Spot:
        """A key of the table that is this key's value."""
        return replace(self, key=f"{self.key}.{key}")


Reader = Callable[[Any, Spot], Any]


@dataclass(frozen=True)
class Key:
    """One key of a table.

    Args:
        read: Checks the value and returns it, or raises `InputError`.
        doc: What it means, with unit or example; for the hint where it is missing.
        required: Whether it must be there.
    """

    read: Reader
    doc: str = ""
    required: bool = False


Keys = Mapping[str, Key]


def read_table(table: Any, keys: Keys, spot: Spot) -> dict[str, Any]:
    """Check a table against the keys that it may have.

    Args:
        table: What stands in the file.
        keys: Every key allowed.
        spot: Where it stands; with a key where the table is the value of one.

    Returns:
        The checked values of the keys that are given.

    Raises:
        InputError: If a key is unknown, missing, or has a value that it cannot have.
    """
    at = spot.inside if spot.key else spot.at
    if not isinstance(table, dict):
        hint = f"write {{ {', '.join(keys)} }}" if spot.key else "write it as one table"
        raise spot.fault(f"{'= ' if spot.key else ''}{shown(table)} is not a table", hint)
    for name in table:
        if name not in keys:
            has = "has an " if spot.key else ""
            raise spot.fault(f"{has}unknown key '{name}'", nearest(name, keys, table))
    for name, key in keys.items():
        if key.required and name not in table:
            raise spot.fault(f"'{name}' is missing", f"add {name}: {key.doc}")
    return {name: keys[name].read(value, at(name)) for name, value in table.items()}


def nearest(name: str, keys: Iterable[str], table: Mapping[str, Any]) -> str:
    """Help with an unknown key: the nearest one that the table does not have yet, and all keys."""
    keys = list(keys)
    absent = [key for key in keys if key not in table]
    if difflib.get_close_matches(name.casefold(), absent, n=1):
        return suggest(name, absent + [key for key in keys if key in table], limit=len(keys))
    return f"there is: {', '.join(keys)}"


def shown(value: Any) -> str:
    """A value as TOML would write it, cut to what fits a message."""
    text = _toml(value)
    return text if len(text) <= _LONGEST_SHOWN else text[:_LONGEST_SHOWN] + "..."


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return str(value)


_DEMANDS: dict[str, tuple[Callable[[float], bool], str]] = {
    "free": (lambda x: True, ""),
    "nonnegative": (lambda x: x >= 0, "is negative; it must be >= 0"),
    "positive": (lambda x: x > 0, "is not positive; it must be > 0"),
    "negative": (lambda x: x < 0, "is not negative; it must be < 0"),
    "nonzero": (lambda x: x != 0, "is zero; it must not be 0"),
}


def number(sign: str = "free") -> Reader:
    """A finite number; `sign` is "free", "nonnegative", "positive", "negative" or "nonzero"."""
    holds, demand = _DEMANDS[sign]

    def read(value: Any, spot: Spot) -> float:
        if isinstance(value, dict):
            raise spot.refuse(value, "must be a known number", "give the number, without guess")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise spot.refuse(value, "is not a number", f"give a number, e.g. {spot.key} = 1.0")
        # A whole number of TOML may be too long for a float.
        if abs(value) > 1e300 or not math.isfinite(value):
            raise spot.refuse(value, "is not a finite number", "give a finite one, in SI units")
        if not holds(value):
            what, hint = demand.split("; ")
            raise spot.refuse(value, what, hint)
        return float(value)

    return read


def whole(minimum: int) -> Reader:
    """A whole number of at least `minimum`."""

    def read(value: Any, spot: Spot) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            hint = f"give a whole number, e.g. {spot.key} = {max(minimum, 1)}"
            raise spot.refuse(value, "is not a whole number", hint)
        if value < minimum:
            raise spot.refuse(value, "is too small", f"it must be at least {minimum}")
        return value

    return read


def odd(minimum: int) -> Reader:
    """An odd whole number of at least `minimum`, which is odd."""
    read_whole = whole(minimum)

    def read(value: Any, spot: Spot) -> int:
        value = read_whole(value, spot)
        if value % 2 == 0:
            raise spot.refuse(value, "is even", f"it must be odd, e.g. {spot.key} = {value + 1}")
        return value

    return read


def flag(value: Any, spot: Spot) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise spot.refuse(value, "is neither true nor false", "write true or false, without quotes")
    return value


def text(value: Any, spot: Spot) -> str:
    """Text that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise spot.refuse(value, "is not a text", f'write {spot.key} = "..."')
    return value


def choice(known: Iterable[str]) -> Reader:
    """One of some names."""
    names = list(known)

    def read(value: Any, spot: Spot) -> str:
        name = text(value, spot)
        if name in names:
            return name
        raise spot.refuse(name, "is unknown", suggest(name, names))

    return read


def several(read: Reader, *, shortest: int = 1, longest: int | None = None) -> Reader:
    """A list of such values, as a tuple."""

    def read_list(value: Any, spot: Spot) -> tuple:
        if not isinstance(value, list) or len(value) < shortest:
            hint = f"give a list of at least {shortest} in [ ]"
            short = isinstance(value, list)
            what = f"has {count(len(value), 'entry', 'entries')}" if short else "is not a list"
            raise spot.refuse(value, what if value != [] else "is empty", hint)
        if longest is not None and len(value) > longest:
            raise spot.refuse(value, f"has {len(value)} entries", f"give at most {longest}")
        return tuple(read(v, spot.entry(k)) for k, v in enumerate(value, start=1))

    return read_list


def by_joint(read: Reader, joints: int, what: str = "joint") -> Reader:
    """One value for all joints (or drives), or a list with one a joint (a tuple then)."""

    def read_either(value: Any, spot: Spot) -> Any:
        if not isinstance(value, list):
            return read(value, spot)
        if len(value) != joints:
            hint = f"give {count(joints, 'value')}, one a {what}"
            raise spot.refuse(value, f"has {count(len(value), 'entry', 'entries')}", hint)
        return several(read)(value, spot)

    return read_either


def span() -> Reader:
    """Two numbers, the lower first."""
    ends = several(number(), shortest=2)

    def read(value: Any, spot: Spot) -> tuple[float, float]:
        pair = ends(value, spot)
        if len(pair) != 2 or not pair[0] < pair[1]:
            hint = f"give the lower end and the upper, e.g. {spot.key} = [0.0, 0.2]"
            raise spot.refuse(value, "is not a range", hint)
        return pair

    return read


def stretch(joints: int) -> Reader:
    """Two numbers, the lower first, for all joints; or a list with two a joint."""
    read_pair = span()

    def read_either(value: Any, spot: Spot) -> Any:
        if isinstance(value, list) and any(isinstance(v, list) for v in value):
            return by_joint(read_pair, joints)(value, spot)
        return read_pair(value, spot)

    return read_either


def columns(joints: int, what: str = "joint", names: tuple[str, ...] = ()) -> Reader:
    """Names of columns: one (which may hold a matrix), or one a joint or drive; as they are written.

    Where the joints have names, these may stand in front: { elbow = "q3", ... }, in any order.
    """

    def read(value: Any, spot: Spot) -> str | list[str]:
        if names and isinstance(value, dict):
            lost = [name for name in names if name not in value]
            if lost:
                hint = f"add {lost[0]} = <its column>; the joints are {', '.join(names)}"
                raise spot.fault(f"names no column for joint '{lost[0]}'", hint)
            other = [name for name in value if name not in names]
            if other:
                raise spot.fault(f"names a joint '{other[0]}', which there is not", suggest(other[0], names))
            value = [value[name] for name in names]
        if isinstance(value, list) and value:
            given = several(text)(value, spot)
            if len(given) not in (1, joints) or len(set(given)) < len(given):
                listed = f" ({', '.join(names)})" if names else ""
                hint = f"name {count(joints, 'column')}, one a {what}{listed}, each once"
                raise spot.refuse(value, f"does not fit {count(joints, what)}", hint)
            return list(given)
        if not isinstance(value, str) or not value:
            hint = f'give the name of a column: {spot.key} = "..."'
            raise spot.refuse(value, "names no column", hint)
        return value

    return read


def rows(value: Any, spot: Spot) -> list[int]:
    """First row and end: 0-based, half open."""
    hint = "give two whole numbers, first and end (0-based, half open), e.g. rows = [0, 25000]"
    if (
        not isinstance(value, list)
        or len(value) != 2
        or not all(isinstance(v, int) and not isinstance(v, bool) for v in value)
        or not 0 <= value[0] < value[1]
    ):
        raise spot.refuse(value, "is not a range of rows", hint)
    return value


def inline(keys: Keys) -> Reader:
    """A table of its own, with these keys."""
    return lambda value, spot: read_table(value, keys, spot)


def either_text(read: Reader) -> Reader:
    """Text, or what `read` takes."""
    return lambda value, spot: (text if isinstance(value, str) else read)(value, spot)


def count(number: int, one: str, many: str = "") -> str:
    """A count and its noun: "1 joint", "2 joints"."""
    return f"{number} {one}" if number == 1 else f"{number} {many or one + 's'}"
