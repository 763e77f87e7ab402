"""Case files: what machine a log came from, what is known of it and what is not."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.case.declared import EffectEntry, PlantEntry
from jaxid.case.entries import check_kinds, read_effects, read_kind, read_plant, read_search
from jaxid.case.reference import read_signal, read_unknown_reference
from jaxid.case.schema import Key, Keys, Spot, read_table
from jaxid.case.sensors import read_inertial_sensors
from jaxid.case.tables import (
    ALGEBRAIC,
    IDENTIFICATION,
    OUTPUT_ERROR,
    STUDY,
    TOP,
    actuator_keys,
    controller_keys,
    design_keys,
    limits_keys,
    log_keys,
    preprocess_keys,
    recursive_keys,
    sensor_keys,
    simulation_keys,
    validation_keys,
)
from jaxid.case.values import Value
from jaxid.controllers import CONTROLLERS
from jaxid.effects import EFFECTS
from jaxid.errors import InputError, suggest
from jaxid.logs.log import LOG_KEYS
from jaxid.model.effect import Effect
from jaxid.model.parameter import parameters_of


@dataclass(frozen=True)
class Validation:
    """One of [[validation]].

    Args:
        name: What it is called in results.
        log: Its file; None: the log of the fit.
        columns: Its [log] table, complete: for `jaxid.logs.log.read_log`.
        disturbance: The controller's on this log: a square wave's keys, or a column's name.
    """

    name: str
    log: Path | None
    columns: dict[str, Any]
    disturbance: dict[str, float] | str | None = None


@dataclass(frozen=True)
class Case:
    """A case file, checked. Tables that it does not have are empty, or None.

    Args:
        path: The file.
        plant: What [plant] says.
        effects: What [[effects]] say, in the order of the drive.
        gain: Declared force per unit of the logged command: one, or one a drive.
        transmission: R, rows of numbers; joint = R^-1 motor.
        log: [log], as `jaxid.logs.log.read_log` takes it; empty where it is absent.
        preprocess: [preprocess], for `jaxid.logs.prepare.choose_recipe`.
        identification: [identification], for `jaxid.estimators`.
        algebraic: [algebraic], for the estimators of that name.
        output_error: [output_error], likewise.
        recursive: [recursive], likewise.
        controller: [controller].
        sensor: [sensor].
        inertial_sensors: [[inertial_sensors]], see `jaxid.case.sensors`.
        limits: [limits], for `jaxid.experiment_design.limits`.
        validations: What [[validation]] say.
        candidates: Effects that a search may name because [discover] asks: user's own, some of jaxid's.
        kinds: Of those that are registered, what it may name, from there; empty: all.
        design: [design], for `jaxid.experiment_design.along_reference`.
        reference: [reference], for `jaxid.references.make_reference`, at its guesses.
        unknown_reference: What of it is unknown.
        input: [input], likewise.
        simulation: [simulation].
        study: [study].
    """

    path: Path
    plant: PlantEntry
    effects: tuple[EffectEntry, ...] = ()
    gain: float | tuple[float, ...] = 1.0
    transmission: tuple[tuple[float, ...], ...] | None = None
    log: dict[str, Any] = field(default_factory=dict)
    preprocess: dict[str, Any] = field(default_factory=dict)
    identification: dict[str, Any] = field(default_factory=dict)
    algebraic: dict[str, Any] = field(default_factory=dict)
    output_error: dict[str, Any] = field(default_factory=dict)
    recursive: dict[str, Any] = field(default_factory=dict)
    controller: dict[str, Any] | None = None
    sensor: dict[str, Any] = field(default_factory=dict)
    inertial_sensors: tuple[dict[str, Any], ...] = ()
    limits: dict[str, Any] = field(default_factory=dict)
    validations: tuple[Validation, ...] = ()
    candidates: tuple[type[Effect], ...] = ()
    kinds: tuple[str, ...] = ()
    design: dict[str, Any] = field(default_factory=dict)
    reference: dict[str, Any] | None = None
    unknown_reference: dict[str, Value] = field(default_factory=dict)
    input: dict[str, Any] | None = None
    simulation: dict[str, Any] = field(default_factory=dict)
    study: dict[str, Any] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        """Where relative file names of the case start from."""
        return self.path.parent

    @property
    def true_reference(self) -> dict[str, Any] | None:
        """[reference] for a simulation: at true values where its unknowns have any."""
        if self.reference is None:
            return None
        return self.reference | {k: v.start(True) for k, v in self.unknown_reference.items()}

    @property
    def own_effects(self) -> tuple[type[Effect], ...]:
        """User's effects that the case knows: those it declares, and the candidates."""
        classes = (*(entry.cls for entry in self.effects), *self.candidates)
        return tuple(dict.fromkeys(c for c in classes if EFFECTS.get(c.kind) is not c))

    @property
    def searched(self) -> tuple[type[Effect], ...]:
        """Effects that `discover` may name."""
        asked = {*self.kinds, *(cls.kind for cls in self.candidates)}
        registered = [
            cls for kind, cls in EFFECTS.items() if kind in asked or not (self.kinds or cls.on_request)
        ]
        return (*registered, *self.own_effects)

    @property
    def load_column(self) -> bool:
        """Whether the log has the position of a load behind an elastic coupling."""
        named = self.log.get("position", ())
        whole = not isinstance(named, str) and len(named) == self.plant.joints
        return not self.log or whole or "load_position" in self.log

    @property
    def columns(self) -> dict[str, Any]:
        """The [log] table of a case that must have one.

        Raises:
            InputError: If it has none.
        """
        if not self.log:
            hint = "name the columns: time, position, force"
            raise InputError("the table [log] is missing", where=str(self.path), hint=hint)
        return self.log


def load_case(path: str | Path) -> Case:
    """Read a case file; whatever it does not know is an error.

    Args:
        path: A TOML file.

    Returns:
        The case.

    Raises:
        InputError: If the file cannot be read, or holds an unknown, missing or impossible entry;
            the text names file, table, key and the hint.
    """
    path = Path(path)
    tables, file = _tables(path), str(path)
    plant = read_plant(tables["plant"], file)
    joints, drives = plant.joints, plant.drives

    def read(name: str, keys: Keys) -> dict[str, Any]:
        return read_table(tables.get(name, {}), keys, Spot(file, f"[{name}]"))

    followed, unknown = read_unknown_reference(tables, drives, file)
    actuator = _checked_transmission(
        read("actuator", actuator_keys(drives)), plant, file, "controller" in tables
    )
    search = read_search(tables.get("discover", {}), path)
    case = Case(
        path=path,
        plant=plant,
        effects=read_effects(tables.get("effects", []), plant, path),
        gain=actuator.get("gain", 1.0),
        transmission=actuator.get("transmission"),
        log=_log(tables, plant, file),
        preprocess=_checked_preprocess(read("preprocess", preprocess_keys(joints)), file),
        identification=read("identification", IDENTIFICATION),
        algebraic=read("algebraic", ALGEBRAIC),
        output_error=_checked_output_error(read("output_error", OUTPUT_ERROR), file),
        recursive=_apart(
            read("recursive", recursive_keys(joints)),
            "restart",
            ("start", "regularization"),
            Spot(file, "[recursive]"),
        ),
        controller=_controller(tables, drives, file),
        sensor=read("sensor", sensor_keys(joints, drives)),
        inertial_sensors=read_inertial_sensors(tables, plant.cls.links(joints), file),
        limits=read("limits", limits_keys(joints, drives)),
        validations=_validations(tables, plant, path),
        candidates=search.get("candidates", ()),
        kinds=search.get("kinds", ()),
        design=read("design", design_keys(joints)),
        reference=read_signal("reference", tables | followed, drives, file),
        unknown_reference=unknown,
        input=read_signal("input", tables, drives, file),
        simulation=read("simulation", simulation_keys(joints)),
        study=read("study", STUDY),
    )
    check_kinds(case.own_effects, file)
    _check_loop(case)
    return case


def _tables(path: Path) -> dict[str, Any]:
    """The tables of a TOML file, whose names and kinds (one, or many) are right."""
    file = str(path)
    tables = _toml(path)
    for name, value in tables.items():
        if name not in TOP:
            what = (
                f"unknown table [{name}]"
                if isinstance(value, dict | list)
                else (f"key '{name}' stands outside of any table")
            )
            raise Spot(file).fault(what, _top_mend(name, value))
        many = isinstance(value, list) and all(isinstance(v, dict) for v in value)
        if TOP[name] and not many:
            raise Spot(file).fault(f"[{name}] may recur", f"write [[{name}]], in double brackets")
        if not TOP[name] and not isinstance(value, dict):
            raise Spot(file).fault(f"'{name}' is not one table", f"write [{name}] once")
    if "plant" not in tables:
        raise Spot(file).fault("the table [plant] is missing", 'add [plant] with kind = "axis"')
    return tables


def _top_mend(name: str, value: Any) -> str:
    if difflib.get_close_matches(name, TOP, n=1):
        return suggest(name, TOP, limit=len(TOP))
    hint = suggest(name, TOP, limit=len(TOP))
    return hint if isinstance(value, dict | list) else f"move it below its [table]; {hint}"


def _toml(path: Path) -> dict[str, Any]:
    if not path.exists():
        beside = sorted(p.name for p in path.parent.glob("*.toml"))[:8]
        hint = f"check the path; case files in that folder: {', '.join(beside) or 'none'}"
        raise InputError("no such file", where=str(path), hint=hint)
    try:
        # Some editors put a byte-order mark first, which TOML does not know.
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", where=str(path), hint="save it as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        hint = "correct that line (text in quotes, numbers with a point, lists in [ ])"
        raise InputError(f"is not TOML: {error}", where=str(path), hint=hint) from error
    except OSError as error:
        what = f"cannot be read ({error.strerror})"
        raise InputError(what, where=str(path), hint="name a TOML file that may be read") from error


def _checked_transmission(
    actuator: dict[str, Any], plant: PlantEntry, file: str, looped: bool
) -> dict[str, Any]:
    rows, spot = actuator.get("transmission"), Spot(file, "[actuator]", "transmission")
    if rows is None:
        return actuator
    joints = plant.joints
    if joints == 1:
        hint = "leave it out; a ratio of gears goes into gain"
        raise spot.fault("is for plants with several joints", hint)
    if plant.drives < joints:
        hint = "leave it out, and take a log of the joints"
        raise spot.fault(f"is for plants with a drive for each joint, not {plant.drives} for {joints}", hint)
    if {len(rows), *map(len, rows)} != {joints} or np.linalg.matrix_rank(rows) < joints:
        hint = f"give {joints} rows of {joints} numbers, none a sum of others"
        raise spot.fault("is not an invertible square matrix", hint)
    if looped:
        hint = "leave [controller] out: what was logged is then identified without the loop"
        raise spot.fault("does not go with a loop, whose gains are at the motors", hint)
    gears = [n for n, i in parameters_of(plant.cls).items() if i.known and n in plant.parameters]
    if gears:
        hint = "keep transmission where the log is of the motors' angles, else the other"
        raise spot.fault(f"and {gears[0]} of [plant.parameters] are both given", hint)
    return actuator


def _checked_output_error(given: dict[str, Any], file: str) -> dict[str, Any]:
    """Refuse what only a fit within a prior does where there is none."""
    lost = [key for key in given if key not in ("on", "prior", "start", "solver", "minimiser")]
    if lost and "prior" not in given:
        hint = f"add prior, the relative standard deviation of the guesses, or leave {lost[0]} out"
        raise Spot(file, "[output_error]", lost[0]).fault("goes with prior only", hint)
    return given


def _checked_preprocess(stated: dict[str, Any], file: str) -> dict[str, Any]:
    """Keys of a low-pass and of a parabola do not stand together."""
    parabolic, spot = stated.get("derivatives") == "parabolic", Spot(file, "[preprocess]")
    if "reach" in stated and not parabolic:
        hint = 'add derivatives = "parabolic", or leave it out'
        raise spot.at("reach").fault("is that of a parabola", hint)
    for key in ("cutoff_hz", "order"):
        if key in stated and parabolic:
            what = 'is of a low-pass, which derivatives = "parabolic" does without'
            raise spot.at(key).fault(what, "leave out one of them")
    return stated


def _apart(stated: dict[str, Any], key: str, others: tuple[str, ...], spot: Spot) -> dict[str, Any]:
    """A table in which one key stands without some others: what they say, it says otherwise."""
    for other in others:
        if key in stated and other in stated:
            raise spot.at(other).fault(f"does not go with {key}", "leave out one of them")
    return stated


def _log(tables: Mapping[str, Any], plant: PlantEntry, file: str) -> dict[str, Any]:
    if "log" not in tables:
        return {}
    spot = Spot(file, "[log]")
    keys = log_keys(plant.joints, plant.drives, plant.names)
    keys |= {name: Key(keys[name].read, keys[name].doc, True) for name in ("position", "force")}
    return _check_time(read_table(tables["log"], keys, spot), spot)


def _check_time(table: dict[str, Any], spot: Spot) -> dict[str, Any]:
    if ("time" in table) == ("sample_rate" in table):
        if "time" in table:
            raise spot.fault("both time and sample_rate are given", "keep one of them")
        hint = 'add time = "<name of the column>", or sample_rate = <Hz>'
        raise spot.fault("neither time nor sample_rate is given", hint)
    return table


def _controller(tables: Mapping[str, Any], drives: int, file: str) -> dict[str, Any] | None:
    if "controller" not in tables:
        return None
    table, spot = tables["controller"], Spot(file, "[controller]")
    kind = read_kind(table, CONTROLLERS, spot)
    keys = {"kind": Key(lambda value, spot: value), **controller_keys(kind, drives)}
    return read_table(table, keys, spot)


def _validations(tables: Mapping[str, Any], plant: PlantEntry, path: Path) -> tuple[Validation, ...]:
    base = tables.get("log", {})
    own = (tables.get("controller") or {}).get("disturbance")
    found: list[Validation] = []
    for k, table in enumerate(tables.get("validation", []), start=1):
        spot = Spot(str(path), f"[[validation]] {k}")
        given = read_table(table, validation_keys(plant.joints, plant.drives, plant.names), spot)
        if given["name"] in [v.name for v in found]:
            raise spot.at("name").refuse(given["name"], "is taken", "give each its own name")
        columns = {key: value for key, value in given.items() if key in LOG_KEYS}
        if "log" not in given and "rows" not in columns:
            hint = "add log = <its file>, or rows that the fit does not use"
            raise spot.fault("it would be the log of the fit itself", hint)
        log = path.parent / given["log"] if "log" in given else None
        merged = _merged(base, columns, same_file=log is None)
        _check_time(merged, spot)
        disturbance = given.get("disturbance", own)
        found.append(Validation(given["name"], log, merged, disturbance))
    return tuple(found)


def _merged(base: dict[str, Any], columns: dict[str, Any], *, same_file: bool) -> dict[str, Any]:
    """[log] with what differs; rows of one file say nothing about another."""
    dropped = set() if same_file else {"rows"}
    # One time base takes the place of the other.
    dropped |= {"time"} if "sample_rate" in columns else set()
    dropped |= {"sample_rate"} if "time" in columns else set()
    return {**{key: value for key, value in base.items() if key not in dropped}, **columns}


def _check_loop(case: Case) -> None:
    """Refuse entries that only a loop could use, where there is none."""
    file = str(case.path)
    if case.controller is None:
        if case.reference is not None:
            hint = "add [controller], or call it [input] for open loop"
            raise Spot(file, "[reference]").fault("there is no loop to follow it", hint)
        for k, validation in enumerate(case.validations, start=1):
            if validation.disturbance is not None:
                spot = Spot(file, f"[[validation]] {k}", "disturbance")
                raise spot.fault("belongs to a controller", "add [controller], or leave it out")
    if case.reference is not None and case.input is not None:
        hint = "keep [reference] for closed loop, or [input] for open loop"
        raise Spot(file).fault("both [reference] and [input] are given", hint)
