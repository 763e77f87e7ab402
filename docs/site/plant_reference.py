"""The reference of the plants: equation, parameters with units, and the doc of each class."""

from __future__ import annotations

import inspect
from pathlib import Path

from docs.site.markdown import paragraphs, prose, table
from jaxid.model.parameter import parameters_of
from jaxid.model.units import Units
from jaxid.plants import PLANTS

SIGNS = {"free": "any", "nonnegative": "≥ 0", "positive": "> 0"}
_INTRODUCTION = """# Plants

This page is made from the classes of `jaxid.PLANTS`; `jaxid plants` prints the same in a terminal. A plant is
what moves, without friction, drive and sensors. [A plant of your own](../adding_a_plant.md) is one class."""
# Pages that explain a plant.
_GUIDES = {
    "chain": "case_file.md#several-joints-a-chain-of-masses",
    "flexible_axis": "case_file.md#a-load-behind-a-coupling",
    "micropositioning_stage": "case_file.md#a-stage-a-table-behind-a-screw",
    "serial_arm": "case_file.md#an-arm",
    "tree": "case_file.md#a-robot-from-its-urdf-or-mjcf-file",
    "five_bar": "case_file.md#a-five-bar-robot",
}


def page(folder: Path) -> str:
    """Return the page."""
    parts = [_INTRODUCTION]
    for kind, cls in PLANTS.items():
        parts += [f"## `{kind}`", documented(cls), parameter_table(cls)]
        if kind in _GUIDES:
            parts.append(f"[Case with this plant](../{_GUIDES[kind]})")
    return "\n\n".join(parts) + "\n"


def documented(cls: type) -> str:
    """Return a class's docstring as Markdown: the first line, and the paragraphs below it."""
    head, _, rest = inspect.cleandoc(cls.__doc__ or "").partition("\n")
    rest = rest.replace("Source:\n    ", "Source: ").strip("\n")
    return "\n\n".join([f"**{prose(head)}**", *paragraphs(rest)])


def parameter_table(cls: type) -> str:
    """Return the table of a class's parameters, with sign and units."""
    linear, rotary, rows = Units("linear"), Units("rotary"), []
    for name, info in parameters_of(cls).items():
        units = [either.label(info.dimension, info.motion) for either in (linear, rotary)]
        shown = f"`{name}`" + (" (optional)" if info.optional else "")
        rows.append([shown, SIGNS[info.sign], *units, prose(info.doc)])
    if not rows:
        return "It has no parameters of its own."
    return table(["parameter", "sign", "linear", "rotary", "meaning"], rows)
