"""Facts of a run for its report: machine, date, command, method, settings, and the log."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.case.case import UNNAMED
from jaxid.results.report.numbers import short

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification
    from jaxid.discovery.result import Discovery
    from jaxid.session import OpenedLog, Session


def run_facts(result: Identification | Discovery, command: str) -> tuple[tuple[str, str], ...]:
    """Return pairs of a name and a text.

    Args:
        result: The result.
        command: Name of the command, for a run from Python.
    """
    session, estimate = result.session, result.estimate
    known = [
        ("machine", _machine(session)),
        ("joints", _joints(session)),
        ("case", "" if session.case.path is None else session.case.path.name),
        *[("log" if k == 0 else "", _log(run)) for k, run in enumerate(session.fits)],
        *[("validated on", _log(run)) for run in session.validations],
        ("method", estimate.method.replace("_", " ") + _reason(result.settings)),
        ("settings", _settings(result.settings)),
        ("filter", _filter(session)),
        ("command", _command_line(command)),
        ("date", datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z").strip()),
    ]
    return tuple((name, text) for name, text in known if text)


def _machine(session: Session) -> str:
    plant = session.machine.plant
    joints = "" if plant.joints == 1 else f", {plant.joints} joints"
    kind = f"{plant.kind.replace('_', ' ')}{joints}"
    # A file that is called case.toml does not name its machine.
    return kind if session.case.title.startswith(UNNAMED) else f"{session.case.title} ({kind})"


def _joints(session: Session) -> str:
    """Return numbers and names of the joints, if a file names them."""
    return ", ".join(f"{k} {name}" for k, name in enumerate(session.case.plant.names, start=1))


def _log(run: OpenedLog) -> str:
    """Return file, length and rate of a log."""
    log = run.log
    name = Path(log.source).name
    shown = name if run.name in (name, Path(name).stem, "fit") else f"{run.name} ({name})"
    if log.steady is not None:
        return f"{shown}: {log.samples} steady speeds"
    length = float(log.time[-1] - log.time[0])
    return f"{shown}: {short(length, 3)} s at {short(log.rate_hz, 4)} Hz, {log.samples} samples"


def _reason(settings: Mapping[str, Any]) -> str:
    chosen = settings.get("method")
    return f", because {chosen['reason']}" if isinstance(chosen, Mapping) and chosen.get("reason") else ""


def _settings(settings: Mapping[str, Any]) -> str:
    """Return the choices that were made from case and log, the method aside."""
    chosen = {k: v["value"] for k, v in settings.items() if isinstance(v, Mapping) and "value" in v}
    return ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in chosen.items() if k != "method")


def _filter(session: Session) -> str:
    log = session.fit.log
    if log.steady is not None or not np.any(log.force):
        return ""
    recipe = session.recipe
    return (
        f"low-pass of {short(recipe.band_hz(log.rate_hz), 3)} Hz, one sample in {recipe.decimation} kept, "
        "samples at rest left out"
    )


def _command_line(command: str) -> str:
    """Return the command as it was typed; for a run from Python the name of its function."""
    program = Path(sys.argv[0]).name if sys.argv else ""
    if program in ("jaxid", "jaxid.exe") or sys.argv[0].endswith("jaxid/cli.py"):
        return shlex.join(["jaxid", *sys.argv[1:]])
    return f"jaxid.{command}(...) from Python"
