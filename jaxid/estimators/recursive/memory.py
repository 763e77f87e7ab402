"""Where a recursive estimate goes on from: the memory in an earlier run's result.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError


def read_memory(path: Path, names: list[str]) -> dict[str, Any]:
    """Read what an earlier run of the method `recursive` has remembered.

    JSON holds every bit of a float64, so that a run goes on as if it had never stopped.

    Args:
        path: result.json of that run.
        names: Of the unknowns, which must be the same.

    Returns:
        The `restart` object, lists as arrays: `start`, `information`, `summed`, `instrument`, `memory`.

    Raises:
        InputError: If the file is not there, is none of this method, or is about other unknowns.
    """
    hint = "name the result.json of a run of the method recursive"
    try:
        saved = json.loads(path.read_text(encoding="utf-8"))["recursive"]["restart"]
        memory = {k: np.asarray(v) for k, v in saved["memory"].items()}
        out = {**saved, "memory": memory, **{k: np.asarray(saved[k]) for k in ("start", "information")}}
    except OSError as error:
        raise InputError("no such file", where=f"restart = {path}", hint=hint) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("holds no memory of the method recursive", where=str(path), hint=hint) from error
    if saved["names"] != names:
        raise InputError(
            f"is about {', '.join(saved['names'])}; the case's unknowns are {', '.join(names)}",
            where=str(path),
            hint="let both be the same, in the same order",
        )
    values = (*memory.values(), out["start"], out["information"])
    if any(v.dtype == object or not np.all(np.isfinite(v)) for v in values):
        raise InputError("its memory is not finite", where=str(path), hint="begin anew, without restart")
    return out
