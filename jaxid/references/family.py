"""Families of references: their keys, and the reading of a table of the case."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.errors import InputError, suggest
from jaxid.schema import (
    Key,
    Reader,
    Spot,
    either,
    is_list,
    list_of,
    number,
    schema_of,
    several,
)

if TYPE_CHECKING:
    from jaxid.model.plant import Plant


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number_list(shortest: int = 1) -> Reader:
    """Return the reader of a list of numbers, which becomes an array."""
    read = several(number(), shortest=shortest)
    return Reader(lambda value, spot: np.array(read(value, spot)), read.schema)


def is_number_list(value: Any) -> bool:
    """Check that a value is one list of numbers, rather than a list of such lists by joint."""
    return not (is_list(value) and len(value) > 0 and all(is_list(entry) for entry in value))


def _about_zero(value: Any, spot: Spot) -> np.ndarray:
    pair = value if is_list(value) else (value, value)
    if len(pair) == 2 and all(_is_number(entry) for entry in pair):
        low, high = pair if is_list(value) else (-value, value)
        if low < 0 < high:
            return np.array([low, high], dtype=float)
    hint = "give [lower, upper], the lower negative, or one positive number for both"
    raise spot.refuse(value, "is not a range about zero", hint)


# Two numbers, the lower negative and the upper positive, or one positive number for both ends.
about_zero = Reader(
    _about_zero, either({"type": "number", "exclusiveMinimum": 0}, list_of({"type": "number"}, 2, 2))
)


def is_about_zero(value: Any) -> bool:
    """Check that a value is one range about zero, rather than a list of them by joint."""
    listed = is_list(value) and len(value) > 0
    pair = listed and len(value) == 2 and all(_is_number(entry) for entry in value) and min(value) < 0
    return not listed or pair


def point_list(shortest: int = 1) -> Reader:
    """Return the reader of a list of points, each with one number for every joint, which becomes a matrix."""
    read_row = several(number())

    def read(value: Any, spot: Spot) -> np.ndarray:
        rows = value if is_list(value) else ()
        if len(rows) < shortest or not all(is_list(row) and len(row) for row in rows):
            hint = f"give a list of at least {shortest}, e.g. {spot.key} = [[0.1, 0.2], [0.3, 0.1]]"
            raise spot.refuse(value, "is not a list of points", hint)
        if len({len(row) for row in rows}) > 1:
            raise spot.refuse(value, "has points of different lengths", "give each one number a joint")
        return np.array([read_row(row, spot.entry(k)) for k, row in enumerate(rows, start=1)], dtype=float)

    return Reader(read, list_of(list_of({"type": "number"}), shortest))


def for_all_joints(value: Any) -> bool:
    """Return that a value is never a list by joint."""
    return True


@dataclass(frozen=True)
class Grid:
    """The instants of a reference, and the context that a family may need.

    Attributes:
        rate_hz: Samples per second.
        samples: Number of samples; the first is at time zero.
        base_dir: Folder that relative file names start from.
        joint: 0-based joint, so that random ones differ.
        where: File and table, for messages.
        plant: Plant that follows, for a family that needs its kinematics; None: not known.
    """

    rate_hz: float | int
    samples: int
    base_dir: Path
    joint: int
    where: str
    plant: Plant | None = None

    @property
    def time(self) -> np.ndarray:
        """The instants [s]."""
        return np.arange(self.samples) / self.rate_hz

    @property
    def duration(self) -> float:
        """Time that the samples stand for [s], the last period included."""
        return self.samples / self.rate_hz

    def fault(self, what: str, hint: str) -> InputError:
        """Return an error that names the table."""
        return InputError(what, where=self.where, hint=hint)


@dataclass(frozen=True)
class Family:
    """One kind of reference.

    Attributes:
        kind: Name of the family in a case.
        doc: One line for the user.
        keys: All allowed parameters by name.
        sample: Function from the values of one joint to its positions at the grid's instants; with
            `together`, from the values of all joints to their positions, (samples, joints).
        unknown: Parameters that may be unknown, and are then fitted by `output_error`.
        follow: Like `sample`, with values and instants [s] as JAX arrays; for families with unknowns.
        together: Whether the joints are sampled together.
    """

    kind: str
    doc: str
    keys: Mapping[str, Key]
    sample: Callable[[Any, Grid], np.ndarray]
    unknown: tuple[str, ...] = ()
    follow: Callable[[Mapping[str, Any], Any], Any] | None = None
    together: bool = False

    def read(self, table: Mapping[str, Any], where: str) -> list[dict[str, Any]]:
        """Check a table and spread it over the joints.

        Args:
            table: The table of the case; `kind` is passed over.
            where: File and table, for messages.

        Returns:
            The values of each joint, defaults filled in.

        Raises:
            InputError: If a key is unknown, missing or has a value that cannot be.
        """
        given = {name: value for name, value in table.items() if name != "kind"}
        spot = Spot(f"{where} kind = '{self.kind}'")
        for name in given:
            if name not in self.keys:
                raise spot.fault(f"unknown key '{name}'", suggest(name, self.keys))
        spread = {name: _by_joint(name, key, given, spot) for name, key in self.keys.items()}

        # Points hold one number for every joint; else the longest list gives the number of joints.
        matrices = {n for n, v in spread.items() if v[0] is not None and np.ndim(v[0]) == 2}
        widths = {n: v[0].shape[1] if n in matrices else len(v) for n, v in spread.items()}
        joints = max(widths.values())
        for name, width in widths.items():
            if width != joints and (name in matrices or width != 1):
                alone = "" if name in matrices else "one value for all, or "
                hint = f"give {alone}{joints} as in the longest list"
                raise spot.fault(f"'{name}' has {width} joints", hint)
        return [
            {name: values[joint % len(values)] for name, values in spread.items()} for joint in range(joints)
        ]

    @property
    def schema(self) -> dict[str, Any]:
        """Return the JSON Schema of a table of this kind: a value, a list by joint, or an unknown."""
        unknown = {"type": "object", "required": ["guess"]}
        out = schema_of(self.keys, self.doc)
        for name, entry in out["properties"].items():
            if self.keys[name].single is for_all_joints:
                continue
            about = {k: entry.pop(k) for k in ("description", "default") if k in entry}
            kinds = [entry, list_of(entry), *([unknown] if name in self.unknown else [])]
            out["properties"][name] = {**either(*kinds), **about}
        out["properties"] = {"kind": {"const": self.kind}, **out["properties"]}
        out["required"] = ["kind", *out.get("required", [])]
        return out


def _by_joint(name: str, key: Key, given: Mapping[str, Any], spot: Spot) -> list[Any]:
    """Return one checked value a joint, or a single one for all joints."""
    if name not in given:
        if key.required:
            raise spot.fault(f"'{name}' is missing", f"add {name}: {key.described}")
        return [key.default]
    value, at = given[name], spot.at(name)
    if key.single(value):
        return [key.read(value, at)]
    return [key.read(one, at.entry(k)) for k, one in enumerate(value, start=1)]
