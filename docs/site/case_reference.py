"""The reference of the case file: every table and key, from the JSON Schema that also reads a case."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from docs.site.markdown import prose, shown, spelled, table
from jaxid.case.json_schema import case_schema
from jaxid.case.tables import TOP

_INTRODUCTION = """# Every key of the case file

This page is made from the code that reads a case. [The case file](../case_file.md) explains the keys with
examples. `jaxid schema case` prints the same as a [JSON Schema](schemas.md), by which editors
complete and check.

A value is a number (known) or `{ guess = …, min = …, max = …, true = … }` (unknown). All numbers are in SI
units."""
# Tables whose kinds have pages of their own.
_ELSEWHERE = {
    "effects": "Its `kind` is one of [the effects](effects.md), whose parameters are keys too. "
    "`joint`, `spring`, `shaft`, `passive` or `tool` state where it acts, counted from 1; absent: "
    "every joint.",
}


def page(folder: Path) -> str:
    """Return the page."""
    schema = case_schema()
    parts = [_INTRODUCTION]
    for name, several in TOP.items():
        parts.append(f"## `{'[[' if several else '['}{name}{']]' if several else ']'}` {{ #{name} }}")
        parts.append(_ELSEWHERE.get(name) or _section(schema["properties"][name]))
    return "\n\n".join(parts) + "\n"


def _section(schema: Mapping[str, Any]) -> str:
    if schema.get("type") == "array":
        schema = schema["items"]
    doc = schema.get("description", "")
    heading = [prose(doc[0].upper() + doc[1:] + ".")] if doc else []
    if "properties" in schema:
        return "\n\n".join([*heading, keys_table(schema)])
    variants = [v for v in schema.get("oneOf", []) if "properties" in v]
    for variant in variants:
        parts = [f"### `kind = {_kind(variant)}`"]
        if variant.get("description"):
            parts.append(prose(variant["description"].rstrip(".")) + ".")
        heading += [*parts, keys_table(variant, leave=("kind",))]
    return "\n\n".join(heading)


def _kind(variant: Mapping[str, Any]) -> str:
    properties = variant["properties"]
    kind = f'"{properties["kind"]["const"]}"'
    coupling = properties.get("coupling", {}).get("const")
    return f'{kind}, coupling = "{coupling}"' if coupling else kind


def keys_table(schema: Mapping[str, Any], leave: tuple[str, ...] = ()) -> str:
    """Return the table of the keys of one table of a case.

    Args:
        schema: JSON Schema of the table.
        leave: Keys that are left out.
    """
    required = schema.get("required", [])
    rows = []
    for name, entry in schema["properties"].items():
        if name in leave:
            continue
        rows.append(_row(name, entry, name in required))
        inner = _inner(entry)
        for key, value in inner.get("properties", {}).items():
            rows.append(_row(f"{name}.{key}", value, key in inner.get("required", [])))
    return table(["key", "meaning", "value"], rows) if rows else "No keys beside `kind`."


def _row(name: str, entry: Mapping[str, Any], required: bool) -> list[str]:
    value = spelled(entry)
    if required:
        value += "; **required**"
    elif "default" in entry:
        value += f"; default {shown(entry['default'])}"
    return [f"`{name}`", prose(entry.get("description", "")), value]


def _inner(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the schema of the tables that a key holds, if they have documented keys."""
    if entry.get("type") == "array":
        entry = entry["items"]
    properties = entry.get("properties", {})
    documented = any("description" in value for value in properties.values())
    return entry if documented and "guess" not in properties else {}
