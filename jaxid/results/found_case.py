"""The case with the results of a fit or a search, as an object and as a file."""

from __future__ import annotations

import copy
import json
import math
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.case.case import Case, load_case
from jaxid.case.declared import EffectEntry
from jaxid.case.tables import UNKNOWN_OF_CONTROLLER, ControllerTable, at_start
from jaxid.case.values import Value
from jaxid.controllers import Controller
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.files import write_whole
from jaxid.model.effect import Effect
from jaxid.model.unknowns import CONTROLLER, REFERENCE, Free, several_places
from jaxid.names import TEN
from jaxid.plants.link_tree import LinkTree
from jaxid.settings import LogTable

if TYPE_CHECKING:
    from jaxid.results.result import FitResult

# Settings of [controller] that a fit may choose.
_CHOSEN = ("derivative", "period")
# Digits of a guess: far more than any log determines, and few enough to read.
_DIGITS = 9
# Keys whose text is a file name relative to the case, and texts that name a class in such a file.
_FILES = ("log", "file", "urdf", "mjcf")
_CLASS = re.compile(r"(.+\.py):\w+$")
# Key and entry of each parameter of a link in a table [[plant.links]].
_LINKS = {
    **{part: ("first_moment", k) for k, part in enumerate(TEN[1:4])},
    **{part: ("inertia", k) for k, part in enumerate(TEN[4:])},
}

Index = int | tuple[int, int] | None


@dataclass(frozen=True)
class Findings:
    """The changes of a case that follow from a result.

    Args:
        plant: New guesses of [plant.parameters] by name and entry.
        effects: New guesses of [[effects]] by number of the table, name, and place among its places.
        reference: New guesses of [reference] by key.
        controller: New guesses of [controller] by key and drive.
        added: Effects beside those of the case: the object, its place, and its values.
        stated: Values that effects beside those of the case have as keys of [controller], by key.
        chosen: Settings of [controller] that the fit chose because the case leaves them out, by key.
        hold: Course of the reference between two rows, if the fit chose one.
    """

    plant: dict[str, dict[Index, float]]
    effects: dict[int, dict[str, dict[int, float]]]
    reference: dict[str, float]
    controller: dict[str, dict[Index, float]]
    added: tuple[tuple[Effect, tuple[str, int] | None, dict[str, Value]], ...]
    stated: dict[str, Value | tuple[Value | float, ...]]
    chosen: dict[str, Any]
    hold: str | None


def found_case(result: FitResult) -> Case:
    """Return the case with estimates as guesses, and with the effects that a search added."""
    case, findings = result.session.declared, _findings(result)

    parameters = dict(case.plant.parameters)
    for name, guesses in findings.plant.items():
        for index, guess in guesses.items():
            parameters[name] = _with_guess(parameters[name], index, guess)

    effects = list(case.effects)
    for number, by_name in findings.effects.items():
        values = dict(effects[number].parameters)
        for name, guesses in by_name.items():
            for at, guess in guesses.items():
                values[name] = _with_guess(values[name], at, guess)
        effects[number] = replace(effects[number], parameters=values)
    for effect, _, values in findings.added:
        entry = EffectEntry(type(effect), {n: (v,) for n, v in values.items()}, (effect.port,))
        effects.append(entry)

    unknown = {n: _with_guess(v, None, findings.reference.get(n)) for n, v in case.unknown_reference.items()}
    reference = case.reference
    if reference is not None:
        reference = reference | {name: value.guess for name, value in unknown.items()}
    return replace(
        case,
        plant=replace(case.plant, parameters=parameters),
        effects=tuple(effects),
        reference=reference,
        unknown_reference=unknown,
        controller=_with_controller(case, findings),
        log=_log_with(case, findings),
    )


def _log_with(case: Case, findings: Findings) -> LogTable | None:
    """Return [log] with the course of the reference that the fit chose."""
    if case.log is None or findings.hold is None:
        return case.log
    return replace(case.log, reference_hold=findings.hold)


def _with_controller(case: Case, findings: Findings) -> ControllerTable | None:
    """Return [controller] with new guesses."""
    table = case.controller
    if table is None or not (findings.controller or findings.stated or findings.chosen):
        return table
    unknown = {**table.unknown, **findings.stated}
    for name, guesses in findings.controller.items():
        for index, guess in guesses.items():
            unknown[name] = _with_guess(unknown[name], index, guess)
    law = {**table.law, **{name: at_start(value) for name, value in unknown.items()}}
    own = {key: value for key, value in findings.chosen.items() if key == "period"}
    law |= {key: value for key, value in findings.chosen.items() if key not in own}
    return replace(table, law=law, unknown=unknown, **own)


def _findings(result: FitResult) -> Findings:
    """Sort the estimates of a result by the entries of its case."""
    case, machine = result.session.declared, result.estimate.machine
    # Number of the table and of the place, by number of the effect in the plant.
    places = [(k, at) for k, entry in enumerate(case.effects) for at in range(len(entry.ports))]
    plant: dict[str, dict[Index, float]] = {}
    effects: dict[int, dict[str, dict[int, float]]] = {}
    reference: dict[str, float] = {}
    controller: dict[str, dict[Index, float]] = {}
    added: dict[int, dict[str, Value]] = {}

    rows = zip(machine.parameters.free, result.estimate.theta, result.estimate.identifiable, strict=True)
    for f, estimate, identifiable in _by_place(rows):
        guess = _rounded(estimate)
        known = bool(identifiable) and math.isfinite(guess)
        match f.path:
            case ("effects", int(number), str(name)) if number >= len(places):
                # An effect that was added has no other value, however well this one is known.
                added.setdefault(number, {})[name] = Value(guess, free=True)
            case ("effects", int(number), str(name)) if known:
                table, at = places[number]
                effects.setdefault(table, {}).setdefault(name, {})[at] = guess
            case (first, str(name)) if first == REFERENCE and known:
                reference[name] = guess
            case (first, str(name)) if first == CONTROLLER and known:
                controller.setdefault(name, {})[f.index] = guess
            case (str(name),) if known:
                plant.setdefault(name, {})[f.index] = guess

    fields = {k: machine.plant.effects[k].controller_field for k in added}
    keys = {k: name for k, name in fields.items() if name in UNKNOWN_OF_CONTROLLER}
    return Findings(
        plant,
        effects,
        reference,
        controller,
        tuple(_added(machine.plant, k, values) for k, values in added.items() if k not in keys),
        _stated(machine.plant, len(machine.gain), {k: (name, added[k]) for k, name in keys.items()}),
        _chosen(result.session.machine.controller, machine.controller),
        _hold(case, machine.reference_hold, result.session.machine.reference_hold),
    )


def _hold(case: Case, fitted: str, declared: str) -> str | None:
    """Return the course of the reference that a fit chose; None if it chose none, or the case states one."""
    open_to_choice = case.log is not None and case.log.reference_hold is None
    return fitted if open_to_choice and fitted != declared else None


def _chosen(declared: Controller | None, fitted: Controller | None) -> dict[str, Any]:
    """Return the settings of a control law that a fit chose in place of those of its case, by key."""
    if declared is None or fitted is None:
        return {}
    pairs = {key: (getattr(declared, key, None), getattr(fitted, key, None)) for key in _CHOSEN}
    changed = {key: new for key, (old, new) in pairs.items() if new != old}
    return {key: _rounded(new) if isinstance(new, float) else new for key, new in changed.items()}


def _stated(
    plant: Any, drives: int, found: Mapping[int, tuple[str | None, dict[str, Value]]]
) -> dict[str, Value | tuple[Value | float, ...]]:
    """Return the keys of [controller] that state effects, by the numbers of these; other drives have zero."""
    out: dict[str, list[Value | float]] = {}
    for k, (name, values) in found.items():
        (value,) = values.values()
        drive = plant.drive_of(plant.effects[k].port, drives)
        out.setdefault(str(name), [0.0] * drives)[drive] = value
    return {name: values[0] if drives == 1 else tuple(values) for name, values in out.items()}  # pyright: ignore[reportReturnType]  # a Value


def _by_place(rows: Iterable[tuple[Free, float, bool]]) -> Iterator[tuple[Free, float, bool]]:
    """Yield unknowns with estimate and identifiability; one with a value in each log has their mean."""
    places: dict[Any, list[tuple[Free, float, bool]]] = {}
    for f, estimate, identifiable in rows:
        places.setdefault((f.path, f.index), []).append((f, estimate, identifiable))
    for of_logs in places.values():
        known = [row for row in of_logs if row[2]] or of_logs
        yield known[0][0], float(np.mean([row[1] for row in known])), known[0][2]


def _added(plant: Any, number: int, values: dict[str, Value]) -> tuple:
    effect = plant.effects[number]
    return effect, plant.place(effect.port) if several_places(plant) else None, values


def _rounded(value: float) -> float:
    return float(f"{float(value):.{_DIGITS}g}")


def _with_guess(value: Any, index: Index, guess: float | None) -> Any:
    """Return a value, or a list of them, with another guess, which stays within its bounds."""
    if guess is None:
        return value
    if index is None:
        return replace(value, guess=float(np.clip(guess, value.lower, value.upper)))
    first, rest = index if isinstance(index, tuple) else (index, None)
    return (*value[:first], _with_guess(value[first], rest, guess), *value[first + 1 :])


def case_text(result: FitResult, folder: Path) -> str:
    """Return the case with the results as TOML.

    The text of the case file is edited, so that comments and order stay. A case without a file, or whose
    file writes its effects as one list, is written anew.

    Args:
        result: The result.
        folder: Folder from which the file names are to hold.

    Raises:
        InputError: If the case has been changed in Python since its file was read.
    """
    # Imported here, because only the writing of a case needs it.
    import tomlkit

    case = result.session.declared
    findings = _findings(result)
    text = _text(case)
    tables = tomllib.loads(text)
    rename = _renamer(case.folder, folder)
    added = [rename(_table(effect, place, v, case, tables)) for effect, place, v in findings.added]
    added += _of_file(case, findings, len(tables.get("effects", [])))

    wanted = rename(copy.deepcopy(tables))
    _put_guesses(wanted, case, findings)
    wanted["effects"] = [*wanted.get("effects", []), *added]
    wanted = wanted if wanted["effects"] else {k: v for k, v in wanted.items() if k != "effects"}

    document = tomlkit.parse(text)
    _rename_in(document, rename)
    _put_guesses(document, case, findings)
    return edited_or_whole(_appended(tomlkit.dumps(document), added), wanted)


def edited_or_whole(edited: str, wanted: Mapping[str, Any]) -> str:
    """Return an edited text with its comments if it holds the wanted tables, else these without."""
    import tomlkit

    try:
        if tomllib.loads(edited) == wanted:
            return edited
    except tomllib.TOMLDecodeError:
        pass
    return tomlkit.dumps(wanted)


def text_of_case(case: Case, folder: Path) -> str:
    """Return a case as TOML as it was given, its file names from another folder.

    Raises:
        InputError: If the case has been changed in Python since its file was read.
    """
    import tomlkit

    document = tomlkit.parse(_text(case))
    _rename_in(document, _renamer(case.folder, folder))
    return tomlkit.dumps(document)


def save_found_case(result: FitResult, path: Path, *, overwrite: bool = False) -> Path:
    """Write the case with the results; see `FitResult.save_case`."""
    if path.is_dir() or not path.parent.is_dir():
        what = "is a folder" if path.is_dir() else "has no such folder"
        raise InputError(
            what, where=str(path), hint="name a file in a folder that exists, such as found.toml"
        )
    if path.exists() and not overwrite:
        raise InputError("exists already", where=str(path), hint="choose another name, or overwrite=True")
    write_whole(path, case_text(result, path.parent))
    return path


def changed_in_python(case: Case) -> bool:
    """Check that a case differs from the file, or the tables, from which it was read."""
    source = _source(case)
    return source is None or repr(load_case(source)) != repr(case)


def _source(case: Case) -> Any:
    """Return the file or the tables that a case was read from; None if there are none."""
    if case.path is None:
        return getattr(case, "tables", None)
    return case.path if case.path.is_file() else None


def _text(case: Case) -> str:
    """Return the TOML of a case as it was read."""
    import tomlkit

    if changed_in_python(case):
        raise InputError(
            "the case was changed in Python, and differs from its file",
            where=str(case.path),
            hint="use case(), or write the changes to the file first",
        )
    source = _source(case)
    return source.read_bytes().decode("utf-8-sig") if isinstance(source, Path) else tomlkit.dumps(source)


def _put_guesses(tables: Any, case: Case, findings: Findings) -> None:
    """Put new guesses into the tables of a case, plain ones or those of a document."""
    for name, guesses in findings.plant.items():
        _put_plant(tables["plant"], case, name, guesses)
    for number, by_name in findings.effects.items():
        # Effects of a robot's file stand in no table of the case.
        for name, guesses in by_name.items() if number < len(tables.get("effects", ())) else ():
            places = len(case.effects[number].ports)
            _put(tables["effects"][number], name, guesses, places, case.effects[number].parameters[name])
    for key, guess in findings.reference.items():
        tables["reference"][key]["guess"] = guess
    if (findings.controller or findings.stated) and "controller" not in tables:
        # The servos of a robot's file stand in no table of the case.
        tables["controller"] = copy.deepcopy(case.plant.defaults["controller"])
    for key, value in findings.stated.items():
        tables["controller"][key] = _inline(value)
    for key, value in findings.chosen.items():
        tables["controller"][key] = value
    if findings.hold is not None and "log" in tables:
        tables["log"]["reference_hold"] = findings.hold
    for key, guesses in findings.controller.items():
        assert case.controller is not None, "its unknowns are estimated"
        values = case.controller.unknown[key]
        several = isinstance(values, tuple)
        by_drive = {k if isinstance(k, int) else 0: guess for k, guess in guesses.items()}
        _put(
            tables["controller"],
            key,
            by_drive,
            len(values) if several else 1,
            values if several else (values,),
        )


def _inline(value: Value | tuple[Value | float, ...]) -> Any:
    """Return a value with a guess as TOML writes it within a line, or a list of them."""
    import tomlkit

    if isinstance(value, tuple):
        listed = tomlkit.array()
        listed.extend([v if isinstance(v, (int, float)) else _inline(v) for v in value])
        return listed
    table = tomlkit.inline_table()
    table.append("guess", value.guess)
    return table


def _of_file(case: Case, findings: Findings, declared: int) -> list[dict[str, Any]]:
    """Return tables [[effects]] that take the place of a robot file's effects, with new guesses."""
    out = []
    for number, by_name in findings.effects.items():
        if number < declared:
            continue
        entry = case.effects[number]
        for name, guesses in by_name.items():
            for at, guess in guesses.items():
                port = entry.ports[at]
                place = {"joint": case.plant.names[port]} if case.plant.joints > 1 else {}
                out.append({"kind": entry.cls.kind, **place, name: {"guess": guess}})
    return out


def _put_plant(table: Any, case: Case, name: str, guesses: Mapping[Index, float]) -> None:
    """Put new guesses of one parameter into [plant]; those of an arm's URDF file have no place there."""
    values: Any = case.plant.parameters[name]
    if table["kind"] == LinkTree.kind:
        _put_tree(table, case, name, guesses)
        return
    if "links" in table:
        for index, guess in guesses.items():
            key, entry = _LINKS.get(name, (name, None))
            # This is one entry of a link's list; the other entries are written under their names.
            link = table["links"][index]
            places = 1 if entry is None else len([part for part in _LINKS.values() if part[0] == key])
            _put(link, key, {entry or 0: guess}, places, (values[index],) * places)
    elif "parameters" in table:
        parameters = table["parameters"]
        if isinstance(values, Value):
            _put(parameters, name, {0: guesses[None]}, 1, (values,))
            return
        rows: dict[int, dict[int, float]] = {}
        for index, guess in guesses.items():
            if isinstance(index, tuple):
                rows.setdefault(index[0], {})[index[1]] = guess
        if rows:
            for row, of_row in rows.items():
                _put(parameters[name], row, of_row, len(values[row]), values[row])
        else:
            _put(
                parameters,
                name,
                {k: g for k, g in guesses.items() if isinstance(k, int)},
                len(values),
                values,
            )


def _put_tree(table: Any, case: Case, name: str, guesses: Mapping[Index, float]) -> None:
    """Put new guesses of links or rotors of a tree into [plant.parameters], by joint."""
    names = case.plant.links if name in TEN else case.plant.names
    parameters = table.setdefault("parameters", {})
    given: Any = parameters.setdefault(name, {})
    for index, guess in guesses.items():
        assert isinstance(index, int), "each has a value a link or joint"
        if not isinstance(given, list) and names[index] not in given:
            given[names[index]] = {"guess": guess}
            continue
        stated = given[index] if isinstance(given, list) else given[names[index]]
        if isinstance(stated, Mapping):
            stated["guess"] = guess  # pyright: ignore[reportIndexIssue]  # a dict


def _put(table: Any, key: Any, guesses: Mapping[int, float], places: int, values: Sequence[Any]) -> None:
    """Put new guesses of a value that stands for several places.

    Args:
        table: Table or list in which the value stands.
        key: Its key or number there.
        guesses: New guess by place.
        places: Number of places.
        values: The case's values, one a place.
    """
    stated = table[key]
    clipped = {k: _with_guess(values[k], None, guess).guess for k, guess in guesses.items()}
    if isinstance(stated, list):
        for k, guess in clipped.items():
            if isinstance(stated[k], Mapping):
                stated[k]["guess"] = guess
    elif isinstance(stated, Mapping):
        before = stated["guess"]
        before = list(before) if isinstance(before, list) else [before] * places
        after = [float(clipped.get(k, before[k])) for k in range(places)]
        stated["guess"] = after[0] if places == 1 and not isinstance(stated["guess"], list) else after  # pyright: ignore[reportIndexIssue]  # a dict


def _table(
    effect: Effect, place: tuple[str, int] | None, values: Mapping[str, Value], case: Case, tables: Mapping
) -> dict[str, Any]:
    """Return the table [[effects]] of an effect that was added."""
    known: dict[str, Any] = {} if place is None else {place[0]: place[1]}
    if "joint" in known and case.plant.names:
        known["joint"] = case.plant.names[known["joint"] - 1]
    return {"kind": _kind(type(effect), case, tables), **known} | {
        name: {"guess": value.guess} for name, value in values.items()
    }


def _kind(cls: type[Effect], case: Case, tables: Mapping) -> str:
    """Return the text by which a case names an effect: a kind, or a class in a file."""
    if cls.case_kind is not None:
        return cls.case_kind
    if EFFECTS.get(cls.kind) is cls:
        return cls.kind
    named = zip(case.candidates, tables.get("discover", {}).get("candidates", ()), strict=True)
    declared = zip((e.cls for e in case.effects), (e["kind"] for e in tables.get("effects", ())), strict=True)
    return next(text for known, text in (*named, *declared) if known is cls)


def _appended(text: str, effects: Sequence[Mapping[str, Any]]) -> str:
    """Return a case's text with tables [[effects]] at its end, each key on a line."""
    out = text if not text or text.endswith("\n") else f"{text}\n"
    for k, effect in enumerate(effects):
        out += "\n# Found by jaxid discover\n" if k == 0 else "\n"
        out += "[[effects]]\n"
        for name, value in effect.items():
            shown = f"{{ guess = {value['guess']!r} }}" if isinstance(value, Mapping) else json.dumps(value)
            out += f"{name} = {shown}\n"
    return out


def _renamer(old: Path, new: Path) -> Any:
    """Return a function that rewrites the file names of tables to start from another folder."""
    same = old.resolve() == new.resolve()

    def moved(name: str) -> str:
        if same or PurePath(name).is_absolute():
            return name
        try:
            return Path(os.path.relpath((old / name).resolve(), new.resolve())).as_posix()
        except ValueError:
            return (old / name).resolve().as_posix()  # another drive

    def rename(value: Any, key: str = "") -> Any:
        if isinstance(value, Mapping):
            return {k: rename(v, k) for k, v in value.items()}
        if isinstance(value, list):
            return [rename(v, key) for v in value]
        if isinstance(value, str) and (of_class := _CLASS.match(value)):
            return moved(of_class[1]) + value[len(of_class[1]) :]
        return moved(value) if isinstance(value, str) and key in _FILES else value

    return rename


def _rename_in(tables: Any, rename: Any, key: str = "") -> None:
    """Rewrite the file names of a document in place, so that its layout stays."""
    named = isinstance(tables, Mapping)
    entries: list[tuple[Any, Any]] = list(tables.items() if named else enumerate(tables))
    for k, value in entries:
        name = k if named else key
        if isinstance(value, Mapping | list):
            _rename_in(value, rename, name)
        elif isinstance(value, str) and (new := rename(value, name)) != value:
            tables[k] = new
