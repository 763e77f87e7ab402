"""Physical parameters, as fields of plants and effects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp

SIGNS = ("free", "nonnegative", "positive")


@dataclass(frozen=True)
class ParameterInfo:
    """What is known of a parameter before any data.

    Args:
        dimension: For example "force*time/position"; see `jaxid.model.units`.
        sign: "free", "nonnegative" or "positive".
        doc: One line for the tables.
        optional: May be absent (None).
        more: Of a list that is as long as the plant has joints, and so many more; None: no list.
        motion: "linear" or "rotary", of a machine that has both; None: as the case says.
        width: Of a list whose entries are lists, of so many numbers; None: of numbers.
        known: Must be a number: no log tells it from an effect in the drive.
    """

    dimension: str
    sign: str
    doc: str
    optional: bool = False
    more: int | None = None
    motion: str | None = None
    width: int | None = None
    known: bool = False


def parameter(
    dimension: str,
    sign: str,
    doc: str,
    *,
    optional: bool = False,
    more: int | None = None,
    motion: str | None = None,
    width: int | None = None,
    known: bool = False,
) -> Any:
    """Declare a field of a plant or effect as a physical parameter, a float64 array leaf.

    The conversion matters: a Python float is no array leaf and would silently count as known.
    """
    info = ParameterInfo(dimension, sign, doc, optional, more, motion, width, known)
    convert = _optional_array if optional else as_array
    if optional:
        return eqx.field(converter=convert, metadata={"parameter": info}, default=None)
    return eqx.field(converter=convert, metadata={"parameter": info})


def as_array(value: Any) -> Any:
    """A number or list as a float64 array; anything else as it is."""
    # Anything that is neither number nor list passes: JAX fills trees with markers of its own.
    if isinstance(value, (int, float, list, tuple)) and not isinstance(value, bool):
        return jnp.asarray(value, dtype=jnp.float64)
    return value


def _optional_array(value: Any) -> Any:
    return None if value is None else as_array(value)


def parameters_of(cls: type) -> dict[str, ParameterInfo]:
    """Name to `ParameterInfo` of every parameter that a plant or effect class declares."""
    fields = cls.__dataclass_fields__.values()
    return {f.name: f.metadata["parameter"] for f in fields if "parameter" in f.metadata}
