"""Name to class of every effect."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from jaxid.model.effect import Effect

EFFECTS: dict[str, type[Effect]] = {}
# A decorated class keeps its type, so that its parameters are known.
EffectClass = TypeVar("EffectClass", bound=type[Effect])


def register(kind: str) -> Callable[[EffectClass], EffectClass]:
    """Register an effect under the name that case files and results use.

    Raises:
        ValueError: If another class already has the name.
    """

    def add(cls: EffectClass) -> EffectClass:
        known = EFFECTS.get(kind)
        if known is not None and known.__qualname__ != cls.__qualname__:
            raise ValueError(f"effect {kind!r} is already registered; choose another name.")
        cls.kind = kind
        EFFECTS[kind] = cls
        return cls

    return add
