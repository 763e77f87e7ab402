"""Libraries that only some formats need: imported on use, with one line where they are missing."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from jaxid.errors import InputError


def need(module: str, path: Path, what: str) -> Any:
    """Import a library of the extra `logs`.

    Args:
        module: Name of the module.
        path: The file that needs it, for messages.
        what: Name of the format.

    Raises:
        InputError: If it is not installed.
    """
    package = _PACKAGES.get(module.partition(".")[0], module.partition(".")[0])
    try:
        return importlib.import_module(module)
    except ImportError as error:
        hint = f"pip install {package}, or pip install 'jaxid[logs]' for all formats"
        raise InputError(f"{what} needs {package}", where=str(path), hint=hint) from error


# Names in the package index that differ from those of the modules.
_PACKAGES = {"nptdms": "npTDMS"}
