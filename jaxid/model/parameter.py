"""Physical parameters, as fields of plants and effects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp

SIGNS = ("free", "nonnegative", "positive")


@dataclass(frozen=True)
class ParameterInfo:
    """The declaration of a parameter, independent of any data.

    Args:
        dimension: Product of base quantities, such as "force*time/position"; see `jaxid.model.units`.
        sign: Constraint "free", "nonnegative" or "positive".
        doc: One line for the tables.
        optional: Whether it may be absent (None).
        more: For a list, the number of entries beyond one for each joint; None: no list.
        motion: "linear" or "rotary", in a machine that has both; None: as the case states.
        width: For a list of lists, the length of its entries; None: entries are numbers.
        known: Whether it must be a number: no log separates it from an effect in the drive.
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
    """Convert a number or list to a float64 array; return anything else unchanged."""
    # Anything that is neither number nor list passes, because JAX fills trees with internal markers.
    if isinstance(value, (int, float, list, tuple)) and not isinstance(value, bool):
        return jnp.asarray(value, dtype=jnp.float64)
    return value


def _optional_array(value: Any) -> Any:
    return None if value is None else as_array(value)


def parameters_of(cls: type) -> dict[str, ParameterInfo]:
    """Return the `ParameterInfo` of every parameter of a plant or effect class, by name."""
    fields = cls.__dataclass_fields__.values()
    return {f.name: f.metadata["parameter"] for f in fields if "parameter" in f.metadata}
