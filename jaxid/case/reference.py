"""[reference] and [input] of a case."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxid.case.entries import read_kind
from jaxid.case.values import Value, read_value
from jaxid.model.parameter import ParameterInfo
from jaxid.schema import Key, Spot


def read_signal(name: str, tables: Mapping[str, Any], drives: int, root: Spot) -> dict[str, Any] | None:
    """Read [reference] or [input], checked by the family that it names.

    Returns:
        The table; None if it is absent or empty.

    Raises:
        InputError: If a key is unknown, missing or impossible, or has values for another number of joints.
    """
    if not tables.get(name):
        return None
    # Each family imports numpy, which cases without a signal do without.
    from jaxid.references import REFERENCES

    table, spot = tables[name], root.under(f"[{name}]")
    kind = read_kind(table, REFERENCES, spot)
    read = REFERENCES[kind].read(table, f"{root.file}, [{name}]")
    if len(read) not in (1, drives):
        raise spot.fault(f"has values for {len(read)} joints", f"the plant drives {drives}")
    return dict(table)


def read_unknown_reference(
    tables: Mapping[str, Any], drives: int, root: Spot
) -> tuple[dict[str, Any], dict[str, Value]]:
    """Read the unknowns of [reference].

    Returns:
        [reference] at its guesses (an empty dict if nothing is unknown), and the unknowns by name.

    Raises:
        InputError: If something is unknown that cannot be, or the reference is not one that can be fitted.
    """
    table, spot = tables.get("reference", {}), root.under("[reference]")
    given = {k: v for k, v in table.items() if isinstance(v, dict)}
    if not given:
        return {}, {}
    from jaxid.references import REFERENCES

    family = REFERENCES[read_kind(table, REFERENCES, spot)]
    for name in given:
        if name not in family.unknown:
            hint = f"of {family.kind} may be: {', '.join(family.unknown) or 'nothing'}"
            raise spot.at(name).fault("cannot be unknown", f"give a number; unknown {hint}")
    if drives > 1:
        hint = "log it, and name its columns in [log]"
        raise spot.fault("is unknown, of a plant with several drives", hint)
    if table.get("repeat", True):
        raise spot.fault("is unknown, and has no end", "add repeat = false")
    if "reference" in tables.get("log", {}):
        hint = "leave reference out of [log], or give numbers in [reference]"
        raise spot.fault("has unknowns, and [log] names a column for it", hint)
    unknown = {k: read_value(v, info_of(family.keys[k]), spot.at(k)) for k, v in given.items()}
    return {"reference": {**table, **{k: v.guess for k, v in unknown.items()}}}, unknown


def info_of(key: Key) -> ParameterInfo:
    """Return a number of a reference as a parameter."""
    over, _, under = key.unit.partition("/")
    words = {"": "", "s": "time", "s^2": "time2", "s^3": "time3"}
    dimension = f"{over}/{words[under]}" if under else words.get(over, over)
    schema = key.read.schema
    sign = "positive" if "exclusiveMinimum" in schema else "nonnegative" if "minimum" in schema else "free"
    return ParameterInfo(dimension, sign, key.doc)
