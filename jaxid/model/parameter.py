"""Physical parameters, as fields of plants and effects."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from typing import Any

# Equinox and JAX are imported where a class or an array is made: cases are checked without them.
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
    import equinox as eqx

    info = ParameterInfo(
        dimension=dimension,
        sign=sign,
        doc=doc,
        optional=optional,
        more=more,
        motion=motion,
        width=width,
        known=known,
    )
    convert = _optional_array if optional else as_array
    if optional:
        return eqx.field(converter=convert, metadata={"parameter": info}, default=None)
    return eqx.field(converter=convert, metadata={"parameter": info})


def as_array(value: Any) -> Any:
    """Convert a number or list to a float64 array; return anything else unchanged."""
    # Anything that is neither number nor list passes, because JAX fills trees with internal markers.
    if isinstance(value, (int, float, list, tuple)) and not isinstance(value, bool):
        import jax.numpy as jnp
        import numpy as np

        # A number of numpy is copied; for one of Python JAX would compile a conversion.
        number = np.float64(value) if isinstance(value, (int, float)) else value
        return jnp.asarray(number, dtype=jnp.float64)
    return value


def _optional_array(value: Any) -> Any:
    return None if value is None else as_array(value)


def need_one(kind: str, alternatives: tuple[str, ...], given: Container[str]) -> None:
    """Refuse none, or several, of parameters that replace each other.

    Args:
        kind: Name of the effect.
        alternatives: Names of its parameters that replace each other; empty if there are none.
        given: Names of the parameters that have a value.

    Raises:
        ValueError: If it is not one.
    """
    if alternatives and sum(name in given for name in alternatives) != 1:
        raise ValueError(f"{kind} takes either {' or '.join(alternatives)}.")


def parameters_of(cls: type) -> dict[str, ParameterInfo]:
    """Return the `ParameterInfo` of every parameter of a plant or effect class, by name."""
    fields = cls.__dataclass_fields__.values()
    return {f.name: f.metadata["parameter"] for f in fields if "parameter" in f.metadata}
