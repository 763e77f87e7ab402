"""Values of a robot's file that a log contradicts, as a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxid.case.case import Case
from jaxid.estimators.estimate import Estimate
from jaxid.model.unknowns import Free
from jaxid.results.report.numbers import plain, usual_unit, with_std
from jaxid.session import Session

# A value contradicts the file's if it is off by so many standard deviations, and by this part of the larger
# one: files are written with two or three digits.
_STDS, _PART = 3.0, 0.01
# Most values that are listed; further ones are counted.
_MOST = 8


def file_of(session: Session) -> str:
    """Return the name of the robot's file whose values are guesses of unknowns; empty if there is none."""
    plant = session.case.tables.get("plant", {})
    file = plant.get("mjcf") or plant.get("urdf")
    if not file or "force" in plant.get("units", {}):
        return ""  # a file is in kg and N m, and says nothing about values in A
    return Path(str(file)).name


def values_of_file(session: Session) -> dict[str, float]:
    """Return the values of a robot's file that are unknowns of a fit, by name of the unknown."""
    if not file_of(session):
        return {}
    return {f.name: f.guess for f in session.machine.parameters.free if _from_file(f, session.case)}


def contradicted_file(session: Session, estimate: Estimate) -> list[str]:
    """Return a sentence on the values of a robot's file that a fit contradicts.

    Only unknowns whose guesses are values of the file count, and of these the identifiable ones.

    Args:
        session: Case and logs; the unknowns of its machine have the guesses.
        estimate: Parameters and their precision.
    """
    of_file = values_of_file(session)
    std = estimate.std if estimate.std_misspecified is None else estimate.std_misspecified
    spread = np.fmax(estimate.std, std)

    compared, off = 0, []
    rows = zip(estimate.machine.parameters.free, estimate.theta, spread, estimate.identifiable, strict=True)
    for f, value, deviation, identifiable in rows:
        if f.name not in of_file or not identifiable:
            continue
        compared += 1
        guess = of_file[f.name]
        size = max(abs(guess), abs(value))
        if abs(value - guess) > max(_STDS * deviation, _PART * size):
            off.append((abs(value - guess) / size, _words(f, guess, float(value), float(deviation))))

    if not off:
        return []
    listed = [text for _, text in sorted(off, key=lambda entry: -entry[0])]
    more = f"; and {len(listed) - _MOST} more" if len(listed) > _MOST else ""
    head = f"{len(off)} of {compared} values are not those of {file_of(session)}"
    return [f"{head}: {'; '.join(listed[:_MOST])}{more}."]


def _from_file(f: Free, case: Case) -> bool:
    """Check that the guess of an unknown is the value of the file: not one of the case, and not assumed."""
    tables = case.tables
    if f.path[0] == "effects":
        kind, parameter = f.name.split(".")[0].split("[")[0], str(f.path[-1])
        return parameter != "delay" and kind not in {e.get("kind") for e in tables.get("effects", ())}
    if f.path[0] == "controller":
        return "controller" not in tables and "delay" not in f.name
    plant = tables["plant"]
    return str(f.path[0]) not in plant and str(f.path[0]) not in plant.get("parameters", {})


def _words(f: Free, guess: float, value: float, std: float) -> str:
    scale, unit = usual_unit(f.unit, value, std)
    found = " ± ".join(with_std(value / scale, std / scale))
    return f"{f.name} = {found} {unit}".rstrip() + f" ({plain(guess / scale)} in the file)"
