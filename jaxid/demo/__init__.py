"""The demo: check, identify and discover on a log with an effect that the case does not declare.

The two logs were made by an exact set-valued friction stepper that shares no code with jaxid
(`truth/axis/demo_logs.py`), with an encoder's noise and rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from pathlib import Path

from jaxid.commands.check import check
from jaxid.commands.discover import discover
from jaxid.commands.identify import identify
from jaxid.files import check_folder, write_results

_FILES = ("case.toml", "log.csv", "validation.csv")


def run_demo(
    folder: Path, *, overwrite: bool = False, progress: Callable[[str], None] = lambda text: None
) -> tuple[str, bool]:
    """Run check, identify and discover in a folder.

    Args:
        folder: Folder for case, logs and results.
        overwrite: Whether to overwrite files that jaxid did not make.
        progress: Function called with a line of text at every stage.

    Returns:
        The text to print, and whether all fits converged.

    Raises:
        InputError: If the folder cannot be written to.
    """
    results = ("check.json", "result.json", "discovery.json", "report.html", "case_found.toml")
    check_folder(folder, [*_FILES, *results], overwrite=overwrite)
    source = resources.files("jaxid.demo")
    write_results(folder, {name: (source / name).read_bytes() for name in _FILES}, overwrite=overwrite)
    case, log = folder / "case.toml", folder / "log.csv"

    progress("checking the log")
    checked = check(case, log)
    checked.save(folder, overwrite=overwrite)
    identified = identify(case, log, progress=progress)
    identified.save(folder, overwrite=overwrite)
    discovered = discover(case, log, progress=progress)
    discovered.save(folder, overwrite=overwrite)

    shown = f"{folder}/case.toml {folder}/log.csv"
    text = "\n".join(
        [
            f"$ jaxid check {shown}",
            str(checked),
            "",
            f"$ jaxid identify {shown}",
            str(identified),
            "",
            f"$ jaxid discover {shown}",
            str(discovered),
            "",
            f"report: {folder / 'report.html'}",
        ]
    )
    return text, identified.converged and discovered.converged
