"""The reference of the JSON Schemas: each file that `jaxid schema` prints, with its topmost keys."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
from pathlib import Path

from docs.site.markdown import prose, table
from jaxid import cli

_INTRODUCTION = """# Schemas

`jaxid schema FILE` prints the JSON Schema of a file, by which editors complete and programs check. This
page is made from these schemas."""


def schemas() -> dict[str, str]:
    """Return each schema of the command, as it prints it."""
    subparsers = next(a for a in cli.build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    names = next(a.choices for a in subparsers.choices["schema"]._actions if a.choices)
    out = {}
    for name in names:
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            cli.main(["schema", name])
        out[name] = printed.getvalue()
    return out


def page(folder: Path) -> str:
    """Return the page; the schemas are written to the folder as files."""
    parts = [_INTRODUCTION]
    for name, text in schemas().items():
        (folder / f"{name}.schema.json").write_text(text, "utf-8")
        schema = json.loads(text)
        rows = []
        for key, entry in schema.get("properties", {}).items():
            doc = entry.get("description") or entry.get("items", {}).get("description", "")
            rows.append([f"`{key}`", prose(doc), "yes" if key in schema.get("required", []) else ""])
        parts += [
            f"## `{name}`",
            prose(schema.get("description", "")),
            f"[{name}.schema.json]({name}.schema.json)",
            table(["key", "meaning", "required"], rows),
        ]
    return "\n\n".join(filter(None, parts)) + "\n"
