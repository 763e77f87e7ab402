"""The case that fits the log of a designed experiment together with the logs that there are."""

from __future__ import annotations

import copy
import itertools
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxid.effects.inertia import AddedMass
from jaxid.first_case.section import toml
from jaxid.results.found_case import case_text, edited_or_whole, text_of_case

if TYPE_CHECKING:
    from jaxid.experiment_design.unforced_design import UnforcedDesign

PRESENT, DESIGNED, SECOND = "present", "designed", "designed_second"


def next_case(design: UnforcedDesign, path: Path) -> str:
    """Return the case as TOML, with an entry of [[fit]] for each log.

    The logs of the experiment are yet to be recorded: beside the reference, under its name with _log. If
    nothing gives the scale, a second one has the payload that does.

    Args:
        design: The experiment.
        path: File of the reference.
    """
    folder = path.parent
    # A scale that is not known leaves the guesses, which a fit of the present logs has improved otherwise.
    text = text_of_case(design.case, folder) if design.result is None else case_text(design.result, folder)
    tables = tomllib.loads(text)
    added = _added(design, path, tables)

    wanted = copy.deepcopy(tables)
    for name, entries in added.items():
        wanted[name] = [*wanted.get(name, []), *entries]
    edited = text if text.endswith("\n") else f"{text}\n"
    for name, entries in added.items():
        for entry in entries:
            keys = "".join(f"{key} = {toml(value)}\n" for key, value in entry.items())
            edited += f"\n[[{name}]]\n{keys}"
    return edited_or_whole(edited, wanted)


def _added(design: UnforcedDesign, path: Path, tables: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return tables to add to a case, by their name: a payload of zero if it has none, and the logs."""
    fits: list[dict[str, Any]] = []
    taken = {entry.get("name") for entry in tables.get("fit", [])}

    def free(name: str) -> str:
        """Return the name of a new entry: in a second round the first one is taken."""
        others = (f"{name} {number}" for number in itertools.count(2))
        return next(one for one in itertools.chain([name], others) if one not in taken)

    if design.result is not None and not tables.get("fit"):
        runs = design.result.session.fits
        for k, run in enumerate(runs):
            name = PRESENT if len(runs) == 1 else f"{PRESENT} {k + 1}"
            source = Path(run.log.source)
            # A table in memory is the log that `identify` is given.
            file = {"log": Path(os.path.relpath(source, path.parent)).as_posix()} if source.is_file() else {}
            fits.append({"name": name, **file})
    fits.append({"name": free(DESIGNED), "log": f"{path.stem}_log.csv"})
    effects: list[dict[str, Any]] = []
    if design.base is not None and design.second:
        second = design.second[0]
        fits.append({"name": free(SECOND), "log": f"{path.stem}_second_log.csv", "set": dict(second.values)})
        loads = f"{AddedMass.kind}.mass" in second.values
        if loads and not any(e["kind"] == AddedMass.kind for e in tables.get("effects", [])):
            effects.append({"kind": AddedMass.kind, "mass": 0.0})
    return ({"effects": effects} if effects else {}) | {"fit": fits}
