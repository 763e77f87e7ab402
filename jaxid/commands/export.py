"""The command `export`: a result as a file of another program."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxid.errors import InputError
from jaxid.export.mjcf import ExportedFile, export_mjcf
from jaxid.names import TARGETS


def export(result: Mapping[str, Any] | str | Path, to: str, model: str | Path) -> ExportedFile:
    """Put the values of a result into the user's own model.

    Args:
        result: result.json or discovery.json, or its content.
        to: One of `jaxid.names.TARGETS`.
        model: The file that the case names: its text is kept, and single values are changed.

    Raises:
        InputError: If the result is of no robot from a file, or the model is not that of its case.
    """
    if to not in TARGETS:
        raise InputError(f"target {to!r} is not known", hint=f"choose one of {', '.join(TARGETS)}")
    where = "result" if isinstance(result, Mapping) else str(result)
    content = result if isinstance(result, Mapping) else _read(Path(result))
    machine = content.get("model")
    if not isinstance(machine, Mapping):
        hint = 'give a result.json or discovery.json of a case with kind = "tree"'
        raise InputError("has no robot to export", where=where, hint=hint)
    return export_mjcf(machine, Path(model))


def _read(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text("utf-8"))
    except OSError as error:
        hint = "name the result.json that identify wrote"
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), hint=hint) from error
    except ValueError as error:
        raise InputError("is no JSON", where=str(path), hint="name a result.json") from error
    return content if isinstance(content, Mapping) else {}
