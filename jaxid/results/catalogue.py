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
        first = (cls.__doc__ or "").strip().splitlines()[0]
        searched = _searched(cls) if noun == "effect" else ""
        rows.append([kind, "", "", "", "", f"{first} {searched}".strip()])
        for name, info in parameters_of(cls).items():
            shown = f"{name}?" if info.optional else name
            units = [either.label(info.dimension, info.motion) for either in (linear, rotary)]
            rows.append(["", shown, SIGNS[info.sign], *units, info.doc])
    note = "\n? : optional, such as a parameter that replaces another"
    return aligned(rows) + (note if any(r[1].endswith("?") for r in rows) else "")


def _searched(cls: type) -> str:
    """Return the sentence on when `discover` searches for an effect; empty if it always does."""
    with_force, without_force = not getattr(cls, "on_request", False), getattr(cls, "without_force", False)
    if with_force and getattr(cls, "break_away_level", None) is not None:
        return "Without a force `discover` does not search for it."
    if with_force and not without_force:
        return "Without a force `discover` searches for it on request."
    if with_force and getattr(cls, "adds_spring", False):
        return "At an arm without a force `discover` searches for it on request."
    if with_force and getattr(cls, "in_links", False):
        return "At an arm `discover` searches for it on request."
    if with_force:
        return ""
    if without_force:
        return "`discover` searches for it without a force; with one, on request."
    return "`discover` searches for it on request."
