"""Parts of generated pages: tables, and values and types as Markdown."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# Signs of numbers by the keywords of a JSON Schema.
_BOUNDS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
# A list of more names than this is cut in a cell.
_MOST_NAMES = 12


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; bars in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def code(text: str, language: str = "") -> str:
    """Return a fenced block."""
    return f"```{language}\n{text.rstrip()}\n```"


def prose(text: str) -> str:
    """Return a docstring's text such that Markdown shows every sign of it."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(p if p.startswith("`") else re.sub(r"([*_<\[\]|])", r"\\\1", p) for p in parts)


def paragraphs(text: str) -> list[str]:
    """Return the paragraphs of a docstring as Markdown; indented ones are equations and stay."""
    out = []
    for part in re.split(r"\n\s*\n", text.strip("\n")):
        lines = part.splitlines()
        if lines and all(line.startswith("    ") for line in lines):
            out.append(code(textwrap.dedent(part)))
        elif lines:
            out.append(prose(" ".join(line.strip() for line in lines)))
    return out


def shown(value: Any) -> str:
    """Return a default as TOML writes it."""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, float):
        return f"`{value:g}`"
    return f"`{value}`"


def spelled(schema: Mapping[str, Any]) -> str:
    """Return the type of a value in words, from its JSON Schema."""
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(spelled(s) for s in schema["anyOf"]))
    if "const" in schema:
        return shown(schema["const"])
    if "enum" in schema:
        return _names(schema["enum"])
    kind = schema.get("type")
    if kind in ("number", "integer"):
        word = "number" if kind == "number" else "whole number"
        if schema.get("not", {}).get("const") == 0:
            return f"{word}, not 0"
        if schema.get("not", {}).get("multipleOf") == 2:
            word = f"odd {word}"
        bounds = [f"{sign} {schema[name]:g}" for name, sign in _BOUNDS.items() if name in schema]
        return " ".join([word, *bounds])
    if kind == "array":
        return _listed(schema)
    if kind == "object":
        return _inline(schema)
    return {"string": "text", "boolean": "true or false"}.get(kind or "", "any")


def _names(names: Sequence[Any]) -> str:
    words = [f"`{n}`" if isinstance(n, str) else f"`{n}`" for n in names]
    rest = len(words) - _MOST_NAMES
    return ", ".join(words[:_MOST_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def _listed(schema: Mapping[str, Any]) -> str:
    fewest, most = schema.get("minItems", 0), schema.get("maxItems")
    count = f"{most} " if fewest == most and most is not None else ""
    inside = spelled(schema.get("items", {}))
    return f"list of {count}({inside})" if " or " in inside or ", " in inside else f"list of {count}{inside}"


def _inline(schema: Mapping[str, Any]) -> str:
    properties = schema.get("properties", {})
    if set(properties) == {"guess", "min", "max", "true"}:
        return "`{ guess = … }`"
    if properties:
        return f"table of {_names(list(properties))}"
    extra = schema.get("additionalProperties")
    return f"table by name of {spelled(extra)}" if isinstance(extra, Mapping) else "table"
