"""The commands `report` and `plot`: a result that was written before, as a page or as one picture."""

from __future__ import annotations

import json
from pathlib import Path

from jaxid.errors import InputError
from jaxid.results.report.data import ReportData
from jaxid.results.report.kept import CONTENT
from jaxid.results.report.store import unpacked

# Files that a result may be named by, with the file that holds its curves.
_NAMES = {"result.json": CONTENT["identify"], "discovery.json": CONTENT["discover"]}
_STUDY = ("study.nc", "summary.json")


def report(result: str | Path) -> str:
    """Return the report of a result that was written before, as one page of HTML.

    Args:
        result: result.json or discovery.json, summary.json of a study, or the folder that holds one; of a
            folder with several, the discovery.

    Raises:
        InputError: If there is none, or the file with its curves is missing.
    """
    path = Path(result)
    study = _study_in(path)
    if study is not None:
        return study
    from jaxid.results.report.page import render

    return render(read_content(path))


def read_content(result: str | Path) -> ReportData:
    """Read the content of the report of an identification or a discovery.

    Args:
        result: result.json or discovery.json, or the folder that holds one.

    Raises:
        InputError: If there is none, or the file with its curves is missing.
    """
    path = Path(result)
    if path.is_dir():
        there = [name for name in ("discovery.json", "result.json") if (path / name).exists()]
        if not there:
            hint = "name a folder that identify or discover wrote with -o"
            raise InputError("holds no result", where=str(path), hint=hint)
        path = path / there[0]
    if path.suffix == ".npz":
        return unpacked(path)
    if path.name not in _NAMES:
        raise InputError("is no result", where=str(path), hint=f"name {' or '.join(_NAMES)}, or their folder")
    return unpacked(path.with_name(_NAMES[path.name]))


def _study_in(path: Path) -> str | None:
    """Return the report of a study; None if the path is not that of one."""
    folder = path if path.is_dir() else path.parent
    named = path.name in _STUDY or (path.is_dir() and not any((path / name).exists() for name in _NAMES))
    if not named or not all((folder / name).is_file() for name in _STUDY):
        return None
    import xarray as xr

    from jaxid.results.report.study import study_report
    from jaxid.studies.result import Study

    try:
        summary = json.loads((folder / "summary.json").read_text("utf-8"))
        table = xr.load_dataset(folder / "study.nc", engine="scipy")
        return study_report(Study(table, float(summary["seconds"]), str(summary["case"])))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"cannot be read: {error}", where=str(folder), hint="run the study again") from error
