"""Values of a case that may be known or unknown."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from jaxid.model.parameter import ParameterInfo
from jaxid.schema import (
    Key,
    Keys,
    Reader,
    Spot,
    count,
    either,
    list_of,
    number,
    read_table,
    schema_of,
    shown,
)


@dataclass(frozen=True)
class Value:
    """One number of a machine.

    Args:
        guess: Known value, or start of a fit.
        free: Whether the value is unknown and will be identified.
        lower, upper: Bounds of an unknown value.
        true: Value for simulations; None: `guess`.
    """

    guess: float
    free: bool = False
    lower: float = -math.inf
    upper: float = math.inf
    true: float | None = None

    def start(self, at_truth: bool) -> float:
        """Return the guess; or the true value, if it is asked for and there is one."""
        return self.true if at_truth and self.true is not None else self.guess


def value_keys(info: ParameterInfo) -> Keys:
    """Return the keys of an unknown value of a parameter."""
    signed = number(info.sign)
    return {
        "guess": Key(signed, "value that the fit starts from", True),
        "min": Key(number(), "lower bound"),
        "max": Key(number(), "upper bound"),
        "true": Key(signed, "value that simulate and study use in place of the guess"),
    }


def value_reader(info: ParameterInfo) -> Reader:
    """Return the reader of one value of a parameter."""
    return Reader(lambda value, spot: read_value(value, info, spot), value_schema(info))


def value_schema(info: ParameterInfo) -> dict[str, Any]:
    """Return the JSON Schema of one value of a parameter: a number, or a table with its guess."""
    if info.known:
        return dict(number(info.sign).schema)
    return either(number(info.sign).schema, schema_of(value_keys(info)))


def values_schema(info: ParameterInfo) -> dict[str, Any]:
    """Return the JSON Schema of values for several places: one for all, a list, or a table of lists."""
    table = schema_of(value_keys(info))
    table["properties"] = {name: either(entry, list_of(entry)) for name, entry in table["properties"].items()}
    one = number(info.sign).schema
    return (
        either(one, list_of(value_schema(info)))
        if info.known
        else either(one, table, list_of(value_schema(info)))
    )


def read_value(value: Any, info: ParameterInfo, spot: Spot) -> Value:
    """Read one value of a parameter.

    Args:
        value: `3.0`, or a table of guess, min, max, true.
        info: The parameter.
        spot: Position of the value, for messages.

    Raises:
        InputError: If it is not a finite number, has the wrong sign, or lies outside of its bounds.
    """
    signed = number(info.sign)
    if isinstance(value, list):
        raise spot.refuse(value, "is a list", "this parameter takes one value")
    if isinstance(value, dict) and info.known:
        hint = f"give the number, and let an effect in the drive (actuator_gain) be unknown: {info.doc}"
        raise spot.refuse(value, "must be a known number", hint)
    if not isinstance(value, dict):
        if isinstance(value, bool) or not isinstance(value, int | float):
            hint = "give a number if it is known, { guess = ... } if it is not"
            raise spot.refuse(value, "is not a number", hint)
        return Value(signed(value, spot))
    given = read_table(value, value_keys(info), spot)
    lower, upper = given.get("min", -math.inf), given.get("max", math.inf)
    if lower > upper:
        raise spot.refuse(value, f"has min {lower:g} above max {upper:g}", "exchange min and max")
    if lower == upper:
        hint = f"give the number itself: {spot.key} = {shown(lower)}"
        raise spot.refuse(value, "has min equal to max, which leaves nothing to identify", hint)
    if not lower <= given["guess"] <= upper:
        hint = f"move guess into [{lower:g}, {upper:g}], or widen min and max"
        raise spot.refuse(value, f"has its guess {given['guess']:g} outside of min and max", hint)
    return Value(given["guess"], True, lower, upper, given.get("true"))


def read_values(
    value: Any, info: ParameterInfo, places: int, spot: Spot, what: str = "joint"
) -> tuple[Value, ...]:
    """Read the values of several places: one for all of them, or a list.

    Args:
        value: A value, a list of values, or a table of lists.
        info: The parameter.
        places: Number of places.
        spot: Position of the value, for messages.
        what: Noun of a place, for messages.

    Returns:
        One value a place.

    Raises:
        InputError: If a list is not as long as there are places, or an entry cannot be.
    """
    if isinstance(value, dict):
        lists = {key: entry for key, entry in value.items() if isinstance(entry, list)}
        for key, entries in lists.items():
            _check_length(entries, places, spot.inside(key), what)
        if lists:
            rows = range(places)
            value = [{k: v[i] if k in lists else v for k, v in value.items()} for i in rows]
    if not isinstance(value, list):
        return (read_value(value, info, spot),) * places
    _check_length(value, places, spot, what)
    return tuple(read_value(v, info, spot.entry(k)) for k, v in enumerate(value, start=1))


def _check_length(value: list, places: int, spot: Spot, what: str) -> None:
    if len(value) != places:
        hint = f"give one value, or {places} in a list: one a {what}"
        raise spot.refuse(value, f"has {count(len(value), 'entry', 'entries')}", hint)
