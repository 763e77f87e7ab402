"""Tables of all plants and effects with their parameters and units; no JAX is needed for them."""

from __future__ import annotations

from collections.abc import Mapping

from jaxid.case.kinds import known_kinds
from jaxid.model.parameter import parameters_of
from jaxid.model.units import Units
from jaxid.results.aligned import aligned

# Signs of parameters as tables show them.
SIGNS = {"free": "any", "nonnegative": ">= 0", "positive": "> 0"}


def effects_table() -> str:
    """Return the table of all registered effects, with their parameters, signs and units."""
    return _table(known_kinds().effects, "effect")


def plants_table() -> str:
    """Return the table of all plants, with their parameters, signs and units."""
    return _table(known_kinds().plants, "plant")


def _table(registry: Mapping[str, type], noun: str) -> str:
    linear, rotary = Units("linear"), Units("rotary")
    rows = [[noun, "parameter", "sign", "linear", "rotary", "description"]]
    for kind, cls in registry.items():
        asked = ""
        if getattr(cls, "on_request", False):
            asked = " `discover` searches for it on request."
        elif getattr(cls, "in_links", False):
            asked = " At an arm `discover` searches for it on request."
        rows.append([kind, "", "", "", "", (cls.__doc__ or "").strip().splitlines()[0] + asked])
        for name, info in parameters_of(cls).items():
            shown = f"{name}?" if info.optional else name
            units = [either.label(info.dimension, info.motion) for either in (linear, rotary)]
            rows.append(["", shown, SIGNS[info.sign], *units, info.doc])
    note = "\n? : optional, such as a parameter that replaces another"
    return aligned(rows) + (note if any(r[1].endswith("?") for r in rows) else "")
