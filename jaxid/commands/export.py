"""The command `export`: a result as a file of another program."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxid.errors import InputError, suggest
from jaxid.export.exported import ExportedFile
from jaxid.logs.in_memory import LogLike
from jaxid.names import TARGETS

if TYPE_CHECKING:
    from jaxid.export.replayed import Replayed
    from jaxid.export.samples import Drawn

# Targets that change the text of the robot's file, with the key of the case that names it.
_OWN_FILES = {"mjcf": "mjcf", "urdf": "urdf"}


def export(
    result: Mapping[str, Any] | str | Path, to: str, model: str | Path | None = None, *, name: str = "robot"
) -> ExportedFile:
    """Put the values of a result into the user's model, or into a file of another program.

    Args:
        result: result.json or discovery.json, or its content.
        to: One of `jaxid.names.TARGETS`.
        model: For "mjcf" and "urdf" the file that the case names: its text is kept, and single values are
            changed. None: the path that the case states; a file of its own if the case names none, as that
            of an arm by Denavit-Hartenberg parameters. The other targets need none.
        name: Name of the machine in files that have one: the stem of the file that is written.

    Raises:
        InputError: If the result is of no arm or tree of links, or the model is not that of its case.
    """
    if to not in TARGETS:
        hint = suggest(to, TARGETS) if isinstance(to, str) else f"choose one of {', '.join(TARGETS)}"
        raise InputError(f"target {to!r} is not known", hint=hint)
    machine, where = machine_of(result)
    if to in _OWN_FILES:
        path = Path(model) if model is not None else _named_file(machine, to, where)
        if path is None:
            if to == "urdf":
                from jaxid.export.new_urdf import new_urdf as new
            else:
                from jaxid.export.new_mjcf import new_mjcf as new
            return new(machine, name, version("jaxid"), where)
        if to == "urdf":
            from jaxid.export.urdf import export_urdf

            return export_urdf(machine, path)
        from jaxid.export.mjcf import export_mjcf

        return export_mjcf(machine, path)
    if model is not None:
        hint = "leave it out: a result holds all that this target needs"
        raise InputError(f"--model goes with {' and '.join(_OWN_FILES)}", hint=hint)
    if to == "c":
        from jaxid.export.c_header import export_c as written
    elif to == "python":
        from jaxid.export.python_module import export_python as written
    else:
        from jaxid.export.isaaclab import export_isaaclab as written
    return written(machine, name, version("jaxid"), where)


def check_export(
    result: Mapping[str, Any] | str | Path,
    to: str,
    exported: ExportedFile,
    log: LogLike,
    model: str | Path | None = None,
) -> Replayed:
    """Replay a log by an exported file in MuJoCo, and say how far that is from jaxid's simulation.

    Args:
        result: result.json or discovery.json, or its content.
        to: Target of the file: "mjcf" or "urdf".
        exported: The file, as `export` returns it.
        log: The log, with the columns of the case.
        model: The user's file; None: the path that the case states.

    Raises:
        InputError: If MuJoCo does not read this target or is not installed, or the log or the result is
            unsound.
    """
    _need_own_file("--check", to)
    from jaxid.export.replayed import replay_export

    machine, where = machine_of(result)
    path = Path(model) if model is not None else _named_file(machine, to, where)
    return replay_export(machine, exported, path, log, where, to)


def draw_exports(
    result: Mapping[str, Any] | str | Path,
    to: str,
    count: int,
    model: str | Path | None = None,
    *,
    seed: int = 0,
) -> Drawn:
    """Draw models from the posterior of a result, each in the robot's file.

    Args:
        result: result.json or discovery.json, or its content.
        to: "mjcf" or "urdf".
        count: Number of models.
        model: The user's file; None: the path that the case states.
        seed: Seed of the draws.

    Raises:
        InputError: If the target is another one, or the result has no covariance.
    """
    _need_own_file("--samples", to)
    if count < 1:
        raise InputError(f"--samples is {count}", hint="give one or more")
    from jaxid.export.samples import draw

    _, where = machine_of(result)
    content = content_of(result)
    return draw(content, count, seed, lambda one: export({"model": one}, to, model), where)


def _need_own_file(option: str, to: str) -> None:
    if to not in _OWN_FILES:
        hint = f"leave it out, or export to {' or '.join(_OWN_FILES)} too"
        raise InputError(f"{option} goes with {' and '.join(_OWN_FILES)}", hint=hint)


def machine_of(result: Mapping[str, Any] | str | Path) -> tuple[Mapping[str, Any], str]:
    """Return `model` of a result, and the result's name for messages.

    Raises:
        InputError: If it cannot be read, or is of no arm or tree of links.
    """
    where = "result" if isinstance(result, Mapping) else str(result)
    machine = content_of(result).get("model")
    if not isinstance(machine, Mapping):
        hint = 'give a result.json or discovery.json of a case with kind = "tree" or "serial_arm"'
        raise InputError("has no robot to export", where=where, hint=hint)
    return machine, where


def content_of(result: Mapping[str, Any] | str | Path) -> Mapping[str, Any]:
    """Return the content of a result.

    Raises:
        InputError: If it cannot be read.
    """
    if isinstance(result, Mapping):
        return result
    path = Path(result)
    try:
        content = json.loads(path.read_text("utf-8"))
    except OSError as error:
        hint = "name the result.json that identify wrote"
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), hint=hint) from error
    except ValueError as error:
        raise InputError("is no JSON", where=str(path), hint="name a result.json") from error
    return content if isinstance(content, Mapping) else {}


def _named_file(machine: Mapping[str, Any], to: str, where: str) -> Path | None:
    """Return the robot's file as the case of a result names it; None if there is none to name.

    Raises:
        InputError: If the result does not say, or the file is not there.
    """
    case = machine.get("case")
    given = (case or {}).get("tables", {}).get("plant", {}).get(_OWN_FILES[to])
    if given is None:
        if case is not None or not machine.get("of_file", True):
            return None
        what = f"does not say which {to.upper()} it belongs to"
        raise InputError(what, where=where, hint="name the file of the case by --model")
    path = Path((case or {})["folder"]) / given
    if not path.is_file():
        hint = "run it in the folder in which identify ran, or name the file by --model"
        raise InputError(f"its case names {path}, which is not here", where=where, hint=hint)
    return path
