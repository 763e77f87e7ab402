"""The reference of the effects: formula, curve, parameters, and a table to paste into a case."""

from __future__ import annotations

from pathlib import Path

from docs.site.curves import draw
from docs.site.markdown import code, prose
from docs.site.plant_reference import documented, parameter_table
from jaxid.effects import EFFECTS
from jaxid.model.effect import Effect
from jaxid.results.effect_page import snippet
from jaxid.results.effect_words import words_of

_INTRODUCTION = """# Effects

This page is made from the classes of `jaxid.EFFECTS`; `jaxid effects KIND` prints the same in a terminal. q
is the position of the joint (or the elongation e of a spring), v its velocity, a its acceleration, u the
declared force. A positive force pushes towards positive q. [An effect of your own](../adding_an_effect.md) is
one class.

Curves are drawn by the classes themselves, at round values of their parameters."""


def page(folder: Path) -> str:
    """Return the page; the curves are written to the folder as files."""
    (folder / "curves").mkdir(exist_ok=True)
    parts = [_INTRODUCTION, _overview()]
    for kind in (kind for kinds in groups().values() for kind in kinds):
        cls = EFFECTS[kind]
        draw(kind, folder / "curves" / f"{kind}.svg")
        parts += [
            f"## `{kind}`",
            documented(cls),
            *_met(kind, cls),
            f"![Curve of {kind}](curves/{kind}.svg){{ .curve }}",
            parameter_table(cls),
            code(snippet(kind), "toml"),
            *_notes(cls),
        ]
    return "\n\n".join(parts) + "\n"


def groups() -> dict[str, list[str]]:
    """Return the kinds of all effects by the place where they act."""
    special = {
        "In the drive": [k for k, c in EFFECTS.items() if c.in_drive],
        "In a spring": [k for k, c in EFFECTS.items() if c.with_springs],
    }
    rest = [k for k in EFFECTS if not any(k in kinds for kinds in special.values())]
    return {"On a joint": rest} | special


def _overview() -> str:
    return "\n".join(
        f"- {head}: " + ", ".join(f"[`{k}`](#{k})" for k in kinds) for head, kinds in groups().items()
    )


def _met(kind: str, cls: type[Effect]) -> list[str]:
    words = words_of(kind, cls.__doc__ or "", in_drive=cls.in_drive, of_spring=cls.of_spring)
    return [f"Met in {prose(words.met)}."] if words.met else []


def _notes(cls: type[Effect]) -> list[str]:
    notes = []
    if cls.on_request:
        notes.append("`discover` tries it on request only: `candidates = [...]` in `[discover]`.")
    if cls.of_stages:
        notes.append("`discover` tries it on stages only.")
    if cls.of_rotary:
        notes.append("It acts on joints that turn.")
    if cls.in_drive:
        notes.append("It acts in the drive, in the order of the case.")
    return [" ".join(notes)] if notes else []
