"""Keys of a case: what each may hold, how it is read, and the same as a JSON Schema.

A table is declared by `Key`s, one for each name. A table whose keys do not depend on a kind is a frozen
dataclass with fields made by `key`; `read_settings` builds it. Unknown keys and impossible values raise
`InputError`: one line with file, table, key and a hint.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from jaxid.errors import InputError, suggest

# Chosen: longer values are cut in messages, which stay on one line of a terminal.
_LONGEST_SHOWN = 60


@dataclass(frozen=True)
class Counts:
    """Numbers of joints and drives, against which the lengths of lists are checked.

    Args:
        joints: Number of joints of the plant.
        drives: Number of driven joints.
        names: Names of the joints, if a URDF file gives them.
    """

    joints: int = 1
    drives: int = 1
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Spot:
    """Position of a value in a case.

    Args:
        file: Name of the case file; "case" for a case that is a dict.
        table: Table as it is written there: "[plant]", "[[effects]] 2 (cogging)"; empty at the top.
        key: Name of the key.
        folder: Folder from which relative file names start.
        counts: Numbers of joints and drives; None: lists may have any length.
    """

    file: str
    table: str = ""
    key: str = ""
    folder: Path = Path()
    counts: Counts | None = None

    def fault(self, what: str, hint: str) -> InputError:
        """Return an error that names file, table and key."""
        where = ", ".join(part for part in (self.file, self.table) if part)
        return InputError(f"{self.key} {what}".strip(), where=where, hint=hint)

    def refuse(self, value: Any, what: str, hint: str) -> InputError:
        """Return an error that also shows the value."""
        return self.fault(f"= {shown(value)} {what}", hint)

    def under(self, table: str) -> Spot:
        """Return the position of a table of the same case."""
        return replace(self, table=table, key="")

    def at(self, key: str) -> Spot:
        """Return the position of a key of the same table."""
        return replace(self, key=key)

    def entry(self, index: int) -> Spot:
        """Return the position of one entry of a list, counted from 1."""
        return replace(self, key=f"{self.key}[{index}]")

    def inside(self, key: str) -> Spot:
        """Return the position of a key of the table that is this key's value."""
        return replace(self, key=f"{self.key}.{key}")


@dataclass(frozen=True)
class Reader:
    """A check of one value, and the same check as a JSON Schema.

    Args:
        check: Return the value as it is used, or raise `InputError`.
        schema: JSON Schema of the values that it takes; empty: any.
    """

    check: Callable[[Any, Spot], Any]
    schema: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, value: Any, spot: Spot) -> Any:
        """Check a value.

        Args:
            value: The value as TOML gives it.
            spot: Position of the value, for messages.

        Raises:
            InputError: If the value is impossible.
        """
        return self.check(value, spot)


def is_list(value: Any) -> bool:
    """Return whether a value is a list (or a tuple, in a case that is a dict)."""
    return isinstance(value, list | tuple)


def _stands_alone(value: Any) -> bool:
    return not (is_list(value) and len(value) > 0)


@dataclass(frozen=True)
class Key:
    """One key of a table.

    Args:
        read: Check of the value.
        doc: Meaning of the key; part of the hint if it is missing.
        required: Whether the table must have it.
        unit: Unit of the value; "position" stands for the unit of the joint.
        default: Value if the table does not have it.
        note: Effect of an absent key.
        single: Whether a value of a reference stands for all joints; other values are lists by joint.
    """

    read: Reader
    doc: str = ""
    required: bool = False
    unit: str = ""
    default: Any = None
    note: str = ""
    single: Callable[[Any], bool] = _stands_alone

    @property
    def described(self) -> str:
        """Meaning of the key with its unit, and the effect of its absence."""
        unit = f" [{self.unit}]" if self.unit else ""
        return f"{self.doc}{unit}" + (f"; absent: {self.note}" if self.note else "")


Keys = Mapping[str, Key]


def key(
    read: Reader,
    doc: str,
    *,
    unit: str = "",
    default: Any = None,
    required: bool = False,
    note: str = "",
) -> Any:
    """Declare a field of a settings dataclass as a key of its table.

    Args:
        read: Check of the value.
        doc: Meaning of the key.
        unit: Unit of the value.
        default: Value if the key is absent; None means that something else decides, see `note`.
        required: Whether the table must have the key.
        note: Effect of an absent key whose default is None.
    """
    metadata = {"key": Key(read, doc, required, unit, default, note)}
    return field(metadata=metadata) if required else field(default=default, metadata=metadata)


def keys_of(cls: type) -> dict[str, Key]:
    """Return the keys of a settings dataclass, in the order of its fields."""
    return {f.name: f.metadata["key"] for f in fields(cls) if "key" in f.metadata}


Settings = TypeVar("Settings")


def read_settings(cls: type[Settings], table: Any, spot: Spot) -> Settings:
    """Read a table as a settings dataclass.

    Args:
        cls: The dataclass; its fields are made by `key`.
        table: Contents of the table.
        spot: Position of the table.

    Raises:
        InputError: If a key is unknown, missing, or has an impossible value.
    """
    return cls(**read_table(table, keys_of(cls), spot))


def stated(settings: Any) -> dict[str, Any]:
    """Return the fields of a settings dataclass that differ from None."""
    values = {f.name: getattr(settings, f.name) for f in fields(settings)}
    return {name: value for name, value in values.items() if value is not None}


def read_table(table: Any, keys: Keys, spot: Spot) -> dict[str, Any]:
    """Check a table against the keys that it may have.

    Args:
        table: Contents of the table.
        keys: All keys that are allowed.
        spot: Position of the table; with a key if the table is the value of one.

    Returns:
        The checked values of the keys that are given.

    Raises:
        InputError: If a key is unknown, missing, or has an impossible value.
    """
    at = spot.inside if spot.key else spot.at
    if not isinstance(table, dict):
        hint = f"write {{ {', '.join(keys)} }}" if spot.key else "write it as one table"
        raise spot.fault(f"{'= ' if spot.key else ''}{shown(table)} is not a table", hint)
    for name in table:
        if name not in keys:
            has = "has an " if spot.key else ""
            raise spot.fault(f"{has}unknown key '{name}'", nearest(name, keys, table))
    for name, entry in keys.items():
        if entry.required and name not in table:
            raise spot.fault(f"'{name}' is missing", f"add {name}: {entry.described}")
    return {name: keys[name].read(value, at(name)) for name, value in table.items()}


def nearest(name: str, keys: Iterable[str], table: Mapping[str, Any]) -> str:
    """Return the hint for an unknown key: the nearest one that the table does not have yet, and all keys."""
    keys = list(keys)
    absent = [key for key in keys if key not in table]
    if difflib.get_close_matches(name.casefold(), absent, n=1):
        return suggest(name, absent + [key for key in keys if key in table], limit=len(keys))
    return f"there is: {', '.join(keys)}"


def shown(value: Any) -> str:
    """Return a value as TOML would write it, cut to the length of a message."""
    text = _toml(value)
    return text if len(text) <= _LONGEST_SHOWN else text[:_LONGEST_SHOWN] + "..."


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if is_list(value):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return str(value)


# By sign: the condition, the message with its hint, and the same as a JSON Schema.
_DEMANDS: dict[str, tuple[Callable[[float], bool], str, dict[str, Any]]] = {
    "free": (lambda x: True, "", {}),
    "nonnegative": (lambda x: x >= 0, "is negative; it must be >= 0", {"minimum": 0}),
    "positive": (lambda x: x > 0, "is not positive; it must be > 0", {"exclusiveMinimum": 0}),
    "negative": (lambda x: x < 0, "is not negative; it must be < 0", {"exclusiveMaximum": 0}),
    "nonzero": (lambda x: x != 0, "is zero; it must not be 0", {"not": {"const": 0}}),
}


def number(sign: str = "free") -> Reader:
    """Return the reader of a finite number.

    Args:
        sign: "free", "nonnegative", "positive", "negative" or "nonzero".
    """
    holds, demand, schema = _DEMANDS[sign]

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

    return Reader(read, {"type": "number", **schema})


def whole(minimum: int) -> Reader:
    """Return the reader of a whole number of at least `minimum`."""

    def read(value: Any, spot: Spot) -> int:
        if isinstance(value, bool) or not isinstance(value, int | float) or value != value // 1:
            hint = f"give a whole number, e.g. {spot.key} = {max(minimum, 1)}"
            raise spot.refuse(value, "is not a whole number", hint)
        if value < minimum:
            raise spot.refuse(value, "is too small", f"it must be at least {minimum}")
        return int(value)

    return Reader(read, {"type": "integer", "minimum": minimum})


def odd(minimum: int) -> Reader:
    """Return the reader of an odd whole number of at least `minimum`, which is odd."""
    read_whole = whole(minimum)

    def read(value: Any, spot: Spot) -> int:
        value = read_whole(value, spot)
        if value % 2 == 0:
            raise spot.refuse(value, "is even", f"it must be odd, e.g. {spot.key} = {value + 1}")
        return value

    return Reader(read, {**read_whole.schema, "not": {"multipleOf": 2}})


def _flag(value: Any, spot: Spot) -> bool:
    if not isinstance(value, bool):
        raise spot.refuse(value, "is neither true nor false", "write true or false, without quotes")
    return value


def _text(value: Any, spot: Spot) -> str:
    if not isinstance(value, str) or not value.strip():
        raise spot.refuse(value, "is not a text", f'write {spot.key} = "..."')
    return value


# True or false.
flag = Reader(_flag, {"type": "boolean"})
# Text that is not empty.
text = Reader(_text, {"type": "string", "pattern": r"\S"})
# Any value: another check reads it.
anything = Reader(lambda value, spot: value)


def choice(known: Iterable[str]) -> Reader:
    """Return the reader of one of some names."""
    names = list(known)

    def read(value: Any, spot: Spot) -> str:
        name = text(value, spot)
        if name in names:
            return name
        raise spot.refuse(name, "is unknown", suggest(name, names))

    return Reader(read, {"enum": names})


def several(read: Reader, *, shortest: int = 1, longest: int | None = None) -> Reader:
    """Return the reader of a list of such values, which becomes a tuple."""

    def read_list(value: Any, spot: Spot) -> tuple:
        if not is_list(value) or len(value) < shortest:
            hint = f"give a list of at least {shortest} in [ ]"
            what = f"has {count(len(value), 'entry', 'entries')}" if is_list(value) else "is not a list"
            raise spot.refuse(value, "is empty" if is_list(value) and not value else what, hint)
        if longest is not None and len(value) > longest:
            raise spot.refuse(value, f"has {len(value)} entries", f"give at most {longest}")
        return tuple(read(v, spot.entry(k)) for k, v in enumerate(value, start=1))

    return Reader(read_list, list_of(read.schema, shortest, longest))


def list_of(schema: Mapping[str, Any], shortest: int = 1, longest: int | None = None) -> dict[str, Any]:
    """Return the JSON Schema of a list."""
    bounds = {"minItems": shortest} | ({} if longest is None else {"maxItems": longest})
    return {"type": "array", "items": dict(schema), **bounds}


def either(*schemas: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of a value that one of several takes."""
    return {"anyOf": [dict(s) for s in schemas]}


def by_joint(read: Reader, what: str = "joint") -> Reader:
    """Return the reader of one value for all joints, or of a list with one for each joint (a tuple).

    Args:
        read: Check of one value.
        what: Noun of an entry, for messages.
    """
    return _by_place(read, lambda counts: counts.joints, what)


def by_drive(read: Reader) -> Reader:
    """Return the reader of one value for all drives, or of a list with one for each drive (a tuple)."""
    return _by_place(read, lambda counts: counts.drives, "drive")


def _by_place(read: Reader, places: Callable[[Counts], int], what: str) -> Reader:
    read_list = several(read)

    def read_either(value: Any, spot: Spot) -> Any:
        if not is_list(value):
            return read(value, spot)
        if spot.counts is not None and len(value) != places(spot.counts):
            hint = f"give {count(places(spot.counts), 'value')}, one a {what}"
            raise spot.refuse(value, f"has {count(len(value), 'entry', 'entries')}", hint)
        return read_list(value, spot)

    return Reader(read_either, either(read.schema, read_list.schema))


def square_matrix() -> Reader:
    """Return the reader of rows of numbers, of which no row is shorter than there are drives."""

    def read(value: Any, spot: Spot) -> tuple[tuple[float, ...], ...]:
        shortest = 1 if spot.counts is None else spot.counts.drives
        return several(several(number(), shortest=shortest), shortest=shortest)(value, spot)

    return Reader(read, list_of(list_of(number().schema)))


def span() -> Reader:
    """Return the reader of two numbers, the lower first."""
    ends = several(number(), shortest=2)

    def read(value: Any, spot: Spot) -> tuple[float, float]:
        pair = ends(value, spot)
        if len(pair) != 2 or not pair[0] < pair[1]:
            hint = f"give the lower end and the upper, e.g. {spot.key} = [0.0, 0.2]"
            raise spot.refuse(value, "is not a range", hint)
        return pair

    return Reader(read, list_of(number().schema, 2, 2))


def stretch() -> Reader:
    """Return the reader of a lower and an upper end for all joints, or of a list of such pairs by joint."""
    read_pair = span()
    read_pairs = by_joint(read_pair)

    def read_either(value: Any, spot: Spot) -> Any:
        if is_list(value) and any(is_list(v) for v in value):
            return read_pairs(value, spot)
        return read_pair(value, spot)

    return Reader(read_either, read_pairs.schema)


def columns(what: str = "joint") -> Reader:
    """Return the reader of names of columns: one (which may hold a matrix), or one for each joint or drive.

    If the joints have names, these may stand in front: { elbow = "q3", ... }, in any order.

    Args:
        what: "joint" or "drive".
    """

    def read(value: Any, spot: Spot) -> str | tuple[str, ...]:
        names = () if spot.counts is None else spot.counts.names
        if names and isinstance(value, dict):
            value = _by_name(value, names, spot)
        if is_list(value) and value:
            given = several(text)(value, spot)
            if len(set(given)) < len(given):
                raise spot.refuse(value, "names a column twice", f"name one column a {what}, each once")
            places = None if spot.counts is None else getattr(spot.counts, f"{what}s")
            if places is not None and len(given) not in (1, places):
                listed = f" ({', '.join(names)})" if names else ""
                hint = f"name {count(places, 'column')}, one a {what}{listed}, each once"
                raise spot.refuse(value, f"does not fit {count(places, what)}", hint)
            return given
        if not isinstance(value, str) or not value:
            hint = f'give the name of a column: {spot.key} = "..."'
            raise spot.refuse(value, "names no column", hint)
        return value

    by_name = {"type": "object", "additionalProperties": {"type": "string"}, "minProperties": 1}
    name = {"type": "string", "minLength": 1}
    return Reader(read, either(name, {**list_of(text.schema), "uniqueItems": True}, by_name))


def _by_name(value: dict[str, Any], names: tuple[str, ...], spot: Spot) -> list[Any]:
    """Return the columns of a table of columns by joint, in the order of the joints."""
    missing = [name for name in names if name not in value]
    if missing:
        hint = f"add {missing[0]} = <its column>; the joints are {', '.join(names)}"
        raise spot.fault(f"names no column for joint '{missing[0]}'", hint)
    other = [name for name in value if name not in names]
    if other:
        raise spot.fault(f"names an unknown joint '{other[0]}'", suggest(other[0], names))
    return [value[name] for name in names]


def _rows(value: Any, spot: Spot) -> tuple[int, int]:
    hint = "give two whole numbers, first and end (0-based, half open), e.g. rows = [0, 25000]"
    if (
        not is_list(value)
        or len(value) != 2
        or not all(isinstance(v, int) and not isinstance(v, bool) for v in value)
    ):
        raise spot.refuse(value, "is not a range of rows", hint)
    if not 0 <= value[0] < value[1]:
        raise spot.refuse(value, "is not a range of rows", hint)
    return value[0], value[1]


def _stretches(value: Any, spot: Spot) -> tuple[int, int] | tuple[tuple[int, int], ...]:
    if not (is_list(value) and value and all(is_list(v) for v in value)):
        return _rows(value, spot)
    pieces = tuple(_rows(v, spot.entry(k)) for k, v in enumerate(value, start=1))
    if any(end > first for (_, end), (first, _) in pairwise(pieces)):
        raise spot.refuse(value, "are not in their order, or overlap", "let each begin where one ended")
    return pieces[0] if len(pieces) == 1 else pieces


_STRETCH = list_of({"type": "integer", "minimum": 0}, 2, 2)
# First row and end: 0-based, half open; or a list of such stretches.
rows = Reader(_stretches, either(_STRETCH, list_of(_STRETCH)))


def _numbers_by_name(value: Any, spot: Spot) -> dict[str, float | tuple[float, ...]]:
    hint = f'name each parameter and give its value: {spot.key} = {{ "added_mass.mass" = 2.0 }}'
    if not isinstance(value, Mapping):
        raise spot.refuse(value, "is not an inline table", hint)
    read, out = number(), {}
    for name, given in value.items():
        if isinstance(given, Mapping):
            # Without quotes, TOML takes the point of a name for a table in a table.
            nested = _numbers_by_name(given, spot.inside(str(name)))
            out |= {f"{name}.{inner}": x for inner, x in nested.items()}
        elif is_list(given):
            out[str(name)] = tuple(read(x, spot.inside(f"{name}[{k}]")) for k, x in enumerate(given, start=1))
        else:
            out[str(name)] = read(given, spot.inside(str(name)))
    return out


_NUMBER_OR_LIST = either(number().schema, list_of(number().schema))
# Values of parameters by their names in results; names may be nested tables.
numbers_by_name = Reader(
    _numbers_by_name,
    {"type": "object", "additionalProperties": either(_NUMBER_OR_LIST, {"type": "object"})},
)


def table_of(cls: type) -> Reader:
    """Return the reader of an inline table that becomes a settings dataclass."""
    return Reader(lambda value, spot: read_settings(cls, value, spot), schema_of(keys_of(cls)))


def inline(keys: Keys) -> Reader:
    """Return the reader of an inline table with these keys."""
    return Reader(lambda value, spot: read_table(value, keys, spot), schema_of(keys))


def either_text(read: Reader) -> Reader:
    """Return the reader of a text, or of a value that another reader takes."""
    return Reader(
        lambda value, spot: (text if isinstance(value, str) else read)(value, spot),
        either(text.schema, read.schema),
    )


def by_quantity(read: Reader, quantities: Iterable[str]) -> Reader:
    """Return the reader of an inline table with a value, or a list by column, for quantities of a log."""
    read_list = several(read)

    def read_either(value: Any, spot: Spot) -> Any:
        return read_list(value, spot) if is_list(value) else read(value, spot)

    one = Reader(read_either, either(read.schema, read_list.schema))
    return inline({name: Key(one) for name in quantities})


def _sign(value: Any, spot: Spot) -> float:
    if isinstance(value, bool) or value not in (1, -1):
        raise spot.refuse(value, "is no sign", "give 1 or -1")
    return float(value)


# 1 or -1.
sign = Reader(_sign, {"enum": [1, -1]})

# True or false, or a positive number.
flag_or_positive = Reader(
    lambda value, spot: (_flag if isinstance(value, bool) else number("positive"))(value, spot),
    either({"type": "boolean"}, number("positive").schema),
)


def schema_of(keys: Keys, doc: str = "") -> dict[str, Any]:
    """Return the JSON Schema of a table: types, required keys, descriptions with units, defaults.

    Args:
        keys: All keys that are allowed.
        doc: Description of the table.
    """
    properties = {}
    for name, entry in keys.items():
        properties[name] = dict(entry.read.schema)
        if entry.doc:
            properties[name]["description"] = entry.described
        if entry.default is not None and not entry.required:
            properties[name]["default"] = plain(entry.default)
    required = [name for name, entry in keys.items() if entry.required]
    return {
        "type": "object",
        **({"description": doc} if doc else {}),
        "properties": properties,
        **({"required": required} if required else {}),
        "additionalProperties": False,
    }


def plain(value: Any) -> Any:
    """Return a value by the types of TOML and JSON: lists for tuples and arrays, text for paths."""
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items() if entry is not None}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if is_list(value):
        return [plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


def count(number: int, one: str, many: str = "") -> str:
    """Return a count and its noun: "1 joint", "2 joints"."""
    return f"{number} {one}" if number == 1 else f"{number} {many or one + 's'}"
