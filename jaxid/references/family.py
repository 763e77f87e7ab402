"""What a family of references declares, and how a table of the case is read against it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from jaxid.errors import InputError, suggest

if TYPE_CHECKING:
    from jaxid.model.plant import Plant

REQUIRED = object()
Shape = Literal["number", "whole", "flag", "text", "list", "range", "points"]


@dataclass(frozen=True)
class Key:
    """One parameter of a family.

    Attributes:
        doc: What it means.
        unit: Its unit; "position" stands for that of the axis.
        default: Taken where the table has none; `REQUIRED` where it must be given.
        shape: A number, a whole number, a flag, text, or a list of numbers; a range: two numbers, the
            lower negative, the upper positive, or one for both; points: a list of lists, one number a joint,
            for all joints together.
        minimum: Smallest value allowed.
        positive: Whether zero is refused as well.
        choices: The texts allowed; empty for any.
        shortest: Fewest entries of a list.
    """

    doc: str
    unit: str = ""
    default: Any = REQUIRED
    shape: Shape = "number"
    minimum: float = -math.inf
    positive: bool = False
    choices: tuple[str, ...] = ()
    shortest: int = 1


@dataclass(frozen=True)
class Grid:
    """The instants at which a reference is wanted, and what else a family may need.

    Attributes:
        rate_hz: Samples per second.
        samples: Number of samples; the first is at time zero.
        base_dir: Folder that relative file names start from.
        joint: 0-based joint, so that random ones differ.
        where: File and table, for messages.
        plant: What is to follow, for a family that asks for its kinematics; None where it is not known.
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
        """An error that names the table."""
        return InputError(what, where=self.where, hint=hint)


@dataclass(frozen=True)
class Family:
    """One kind of reference.

    Attributes:
        kind: Its name in a case.
        doc: One line for the user.
        keys: Every parameter allowed, by name.
        sample: From the values of one joint to its positions at the grid's instants; or, where
            `together`, from those of all joints to theirs, (samples, joints).
        unknown: Parameters that may be unknown, and are then fitted by `output_error`.
        follow: As `sample`, from values and instants [s] as JAX's arrays; where any may be unknown.
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
        place = f"{where} kind = '{self.kind}'"
        for name in given:
            if name not in self.keys:
                hint = suggest(name, self.keys)
                raise InputError(f"unknown key '{name}'", where=place, hint=hint)
        spread = {}
        for name, key in self.keys.items():
            if name in given:
                spread[name] = _by_joint(name, key, given[name], place)
            elif key.default is REQUIRED:
                hint = f"add {name}" + (f" [{key.unit}]" if key.unit else "") + f": {key.doc}"
                raise InputError(f"'{name}' is missing", where=place, hint=hint)
            else:
                spread[name] = [key.default]
        joints = max(len(values) for values in spread.values())
        for name, key in self.keys.items():
            if key.shape == "points" and spread[name][0] is not None:
                joints = max(joints, spread[name][0].shape[1])
        for name, values in spread.items():
            points = self.keys[name].shape == "points" and values[0] is not None
            count = values[0].shape[1] if points else len(values)
            if count != joints and (points or count != 1):
                hint = f"{'' if points else 'one value for all, or '}{joints} as in the longest list"
                raise InputError(f"'{name}' has {count} joints", where=place, hint=hint)
        return [
            {name: values[joint % len(values)] for name, values in spread.items()} for joint in range(joints)
        ]


def _by_joint(name: str, key: Key, value: Any, place: str) -> list[Any]:
    """One checked value a joint; a list (of lists, where the key is a list) holds several."""
    several = isinstance(value, list | tuple) and len(value) > 0
    if key.shape == "list":
        several = several and all(isinstance(entry, list | tuple) for entry in value)
    if key.shape == "range" and several:
        pair = len(value) == 2 and all(_is_number(entry) for entry in value) and min(value) < 0
        several = not pair
    if key.shape == "points":
        several = False
    return [_checked(name, key, one, place) for one in (value if several else [value])]


def _checked(name: str, key: Key, value: Any, place: str) -> Any:
    if key.shape == "list":
        if not isinstance(value, list | tuple) or len(value) < key.shortest:
            hint = f"give a list of at least {key.shortest}, or a list of such lists by joint"
            raise InputError(f"{name} = {value!r} is too short", where=place, hint=hint)
        return np.array([_number(name, key, one, place) for one in value])
    if key.shape == "range":
        pair = value if isinstance(value, list | tuple) else (value, value)
        if len(pair) == 2 and all(_is_number(entry) for entry in pair):
            low, high = pair if isinstance(value, list | tuple) else (-value, value)
            if low < 0 < high:
                return np.array([low, high], dtype=float)
        hint = f"give [lower, upper], the lower negative, or one positive number for both [{key.unit}]"
        raise InputError(f"{name} = {value!r} is no range about zero", where=place, hint=hint)
    if key.shape == "points":
        return _points(name, key, value, place)
    if key.shape == "flag":
        if not isinstance(value, bool):
            raise InputError(f"{name} = {value!r} is no flag", where=place, hint="true or false")
        return value
    if key.shape == "text":
        if not isinstance(value, str) or not value:
            raise InputError(f"{name} = {value!r} is no text", where=place, hint=key.doc)
        if key.choices and value not in key.choices:
            hint = suggest(value, key.choices)
            raise InputError(f"{name} = '{value}' is unknown", where=place, hint=hint)
        return value
    return _number(name, key, value, place)


def _points(name: str, key: Key, value: Any, place: str) -> np.ndarray:
    """A list of points, one number a joint."""
    rows = value if isinstance(value, list | tuple) else ()
    if len(rows) < key.shortest or not all(isinstance(row, list | tuple) and len(row) for row in rows):
        hint = f"give a list of at least {key.shortest} points, e.g. {name} = [[0.1, 0.2], [0.3, 0.1]]"
        raise InputError(f"{name} = {value!r} is no list of points", where=place, hint=hint)
    if len({len(row) for row in rows}) > 1:
        hint = "give each one number a joint"
        raise InputError(f"the points of {name} are of unlike lengths", where=place, hint=hint)
    return np.array([[_number(name, key, one, place) for one in row] for row in rows], dtype=float)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(name: str, key: Key, value: Any, place: str) -> float | int:
    unit = f" {key.unit}" if key.unit else ""
    if not _is_number(value):
        hint = f"give a finite number [{key.unit or '1'}]"
        raise InputError(f"{name} = {value!r} is not a number", where=place, hint=hint)
    if key.shape == "whole" and value != int(value):
        raise InputError(f"{name} = {value!r} is not whole", where=place, hint="round it")
    if value < key.minimum or (key.positive and value <= 0):
        bound = "positive" if key.positive else f"at least {key.minimum:g}{unit}"
        raise InputError(f"{name} = {value:g}{unit}", where=place, hint=f"it must be {bound}")
    return int(value) if key.shape == "whole" else float(value)
