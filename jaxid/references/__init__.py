"""References for a loop and inputs for open loop: one family a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.errors import InputError, suggest
from jaxid.references.bezier import BEZIER
from jaxid.references.csv import CSV
from jaxid.references.family import Family, Grid
from jaxid.references.fourier import FOURIER
from jaxid.references.moves import POINT_TO_POINT, TRAPEZOID
from jaxid.references.multisine import MULTISINE
from jaxid.references.quarter_sine import QUARTER_SINE
from jaxid.references.synchronized import SYNCHRONIZED

if TYPE_CHECKING:
    from jaxtyping import Float

    from jaxid.model.plant import Plant

__all__ = ["REFERENCES", "Family", "make_reference"]

REFERENCES: dict[str, Family] = {
    family.kind: family
    for family in (CSV, TRAPEZOID, BEZIER, QUARTER_SINE, FOURIER, MULTISINE, POINT_TO_POINT, SYNCHRONIZED)
}


def make_reference(
    table: Mapping[str, Any],
    rate_hz: float | int,
    duration: float | int,
    base_dir: str | Path = ".",
    *,
    where: str = "[reference]",
    plant: Plant | None = None,
) -> Float[np.ndarray, "samples joints"]:
    """Sample the reference that a table of a case describes.

    Args:
        table: `kind` and the family's keys; a list in place of a value goes by joint.
        rate_hz: Samples per second [Hz].
        duration: Length [s]; round(duration * rate_hz) samples, the first at time zero.
        base_dir: Folder from which relative file names start: that of the case.
        where: File and table, for messages.
        plant: Plant that follows; needed if the points are those of its tool.

    Returns:
        The position (or, for an input, the command) of each joint [unit of the axis].

    Raises:
        InputError: If the table cannot be met.
    """
    kind = table.get("kind")
    if kind not in REFERENCES:
        hint = suggest(str(kind), REFERENCES)
        what = "kind is missing" if kind is None else f"kind = {kind!r} is unknown"
        raise InputError(what, where=where, hint=hint)
    samples = _samples(rate_hz, duration)
    family = REFERENCES[kind]
    grids = lambda joint: Grid(rate_hz, samples, Path(base_dir), joint, where, plant)
    if family.together:
        return family.sample(family.read(table, where), grids(0))
    columns = [family.sample(values, grids(joint)) for joint, values in enumerate(family.read(table, where))]
    return np.stack(columns, axis=1)


def _samples(rate_hz: float | int, duration: float | int) -> int:
    for name, value, unit in (("sample_rate", rate_hz, "Hz"), ("duration", duration, "s")):
        if not 0 < value < math.inf:
            hint = f"give a positive number of {unit}"
            raise InputError(f"{name} = {value} {unit}", where="[simulation]", hint=hint)
    samples = round(duration * rate_hz)
    if samples < 2:
        hint = "raise duration or sample_rate"
        raise InputError(f"only {samples} sample(s)", where="[simulation]", hint=hint)
    return samples
