"""The reference of the Python interface: signature and docstring of each public name."""

from __future__ import annotations

import dataclasses
import inspect
import re
from pathlib import Path
from typing import Any

import jaxid
from docs.site.markdown import code, paragraphs, prose

_INTRODUCTION = """# Python interface: every name

This page is made from the docstrings. [The Python interface](../api.md) shows the names in use."""
# Sections of a docstring, by the heads of Google's style.
_HEADS = ("Args", "Returns", "Raises", "Source", "Yields", "Note")


def page(folder: Path) -> str:
    """Return the page."""
    parts = [_INTRODUCTION]
    for name in jaxid._HOMES:
        parts += [f"## `jaxid.{name}`", *described(name, getattr(jaxid, name))]
    return "\n\n".join(parts) + "\n"


def described(name: str, value: Any) -> list[str]:
    """Return signature, docstring and public members of one name, each a block of Markdown."""
    if not callable(value):
        listed = ", ".join(f"`{key}`" for key in value)
        return [f"A dictionary with the keys {listed}."]
    parts = [code(_signature(name, value), "python"), *docstring(value)]
    if inspect.isclass(value):
        for member, entry in vars(value).items():
            parts += _member(value, member, entry)
    return parts


def _member(owner: type, name: str, entry: Any) -> list[str]:
    """Return the blocks of a method or a property that is public and has a docstring."""
    function = entry.fget if isinstance(entry, property) else getattr(owner, name, None)
    kind = isinstance(entry, property | classmethod | staticmethod) or inspect.isfunction(function)
    if name.startswith("_") or not kind or not getattr(function, "__doc__", None):
        return []
    is_property = isinstance(entry, property)
    shown = f"**`.{name}`**" if is_property else f"**`.{_signature(name, function)}`**"
    first, *rest = docstring(function)
    return [f"{shown}: {first}", *rest]


def _signature(name: str, value: Any) -> str:
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return name
    taken = [p for p in signature.parameters.values() if p.name != "self"]
    shown = []
    for p in taken:
        star = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "")
        if p.kind is p.KEYWORD_ONLY and "*" not in shown and not any(s.startswith("*") for s in shown):
            shown.append("*")
        shown.append(f"{star}{p.name}" + ("" if p.default is p.empty else f"={_default(p.default)}"))
    one = f"{name}({', '.join(shown)})"
    return one if len(one) <= 100 else f"{name}(\n    " + ",\n    ".join(shown) + ",\n)"


def _default(value: Any) -> str:
    if isinstance(value, type) or (inspect.isfunction(value) and value.__name__ != "<lambda>"):
        return value.__name__
    text = repr(value)
    return "..." if len(text) > 40 or "<" in text or dataclasses.is_dataclass(value) else text


def docstring(value: Any) -> list[str]:
    """Return a docstring in Google's style as blocks of Markdown."""
    text = inspect.getdoc(value) or ""
    blocks = []
    for part in re.split(r"\n\s*\n", text):
        lines = part.splitlines()
        while lines:
            head = lines[0].rstrip(":")
            if lines[0].endswith(":") and head in _HEADS:
                # A section may follow another without a blank line.
                end = next((k for k, s in enumerate(lines[1:], 1) if not s.startswith(" ")), len(lines))
                blocks += [f"*{'Arguments' if head == 'Args' else head}*", *_entries(lines[1:end])]
                lines = lines[end:]
            else:
                blocks += paragraphs("\n".join(lines))
                lines = []
    return blocks or [""]


def _entries(lines: list[str]) -> list[str]:
    """Return the entries of a section as a list; deeper lines belong to the entry above."""
    entries: list[str] = []
    for line in inspect.cleandoc("\n".join(lines)).splitlines():
        if line.startswith(" ") and entries:
            entries[-1] += " " + line.strip()
        else:
            entries.append(line.strip())
    named = [re.match(r"([\w, *]+): (.*)$", e) for e in entries]
    if not any(named):
        return [prose(" ".join(entries))]
    return [
        "\n".join(
            f"- `{m[1]}`: {prose(m[2])}" if m else f"- {prose(e)}"
            for m, e in zip(named, entries, strict=True)
        )
    ]
