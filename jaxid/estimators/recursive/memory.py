"""The memory of an earlier recursive run, read from its result.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError


def read_memory(path: Path, names: list[str]) -> dict[str, Any]:
    """Read the memory of an earlier run of the method `recursive`.

    JSON keeps every bit of a float64: a run continues as if it had not stopped.

    Args:
        path: The result.json of that run.
        names: Names of the unknowns, which must be the same.

    Returns:
        The `restart` object, lists as arrays: `start`, `information`, `summed`, `instrument`, `memory`.

    Raises:
        InputError: If there is no such file, or it is the result of another method or of other unknowns.
    """
    hint = "name the result.json of a run of the method recursive"
    try:
        saved = json.loads(path.read_text(encoding="utf-8"))["recursive"]["restart"]
        memory = {k: np.asarray(v) for k, v in saved["memory"].items()}
        out = {**saved, "memory": memory, **{k: np.asarray(saved[k]) for k in ("start", "information")}}
    except OSError as error:
        raise InputError("no such file", where=f"restart = {path}", hint=hint) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("has no memory of the method recursive", where=str(path), hint=hint) from error
    if saved["names"] != names:
        raise InputError(
            f"has the unknowns {', '.join(saved['names'])}; those of the case are {', '.join(names)}",
            where=str(path),
            hint="make both the same, in the same order",
        )
    values = (*memory.values(), out["start"], out["information"])
    if any(v.dtype == object or not np.all(np.isfinite(v)) for v in values):
        raise InputError("its memory is not finite", where=str(path), hint="start again without restart")
    return out
