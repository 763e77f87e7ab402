"""What there is: plants and effects with their parameters and units, read off the registries."""

from __future__ import annotations

from jaxid.effects import EFFECTS
from jaxid.model.parameter import parameters_of
from jaxid.model.units import Units
from jaxid.plants import PLANTS
from jaxid.results.as_text import aligned

_SIGNS = {"free": "any", "nonnegative": ">= 0", "positive": "> 0"}


def effects_table() -> str:
    """Every registered effect: what it does, its parameters, their signs and units."""
    return _table(EFFECTS, "effect")


def plants_table() -> str:
    """Every plant: what it is, its parameters, their signs and units."""
    return _table(PLANTS, "plant")


def _table(registry: dict[str, type], what: str) -> str:
    linear, rotary = Units("linear"), Units("rotary")
    rows = [[what, "parameter", "sign", "linear", "rotary", "what it is"]]
    for kind, cls in registry.items():
        asked = " `discover` looks for it on request." if getattr(cls, "on_request", False) else ""
        rows.append([kind, "", "", "", "", (cls.__doc__ or "").strip().splitlines()[0] + asked])
        for name, info in parameters_of(cls).items():
            shown = f"{name}?" if info.optional else name
            units = [either.label(info.dimension, info.motion) for either in (linear, rotary)]
            rows.append(["", shown, _SIGNS[info.sign], *units, info.doc])
    note = "\n? : may be left out; what stands in place of another, where that is given"
    return aligned(rows) + (note if any(r[1].endswith("?") for r in rows) else "")
