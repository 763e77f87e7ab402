"""Cases: a machine with its known and unknown parameters, the columns of its logs, and settings."""

from __future__ import annotations

import contextlib
import difflib
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxid.case.declared import EffectEntry, PlantEntry, own_effects
from jaxid.case.entries import check_kinds, read_effects, read_kind, read_plant, read_search
from jaxid.case.kinds import Kinds, NeedsClassesError, declared_kinds, loaded_kinds
from jaxid.case.reference import read_signal, read_unknown_reference
from jaxid.case.sensors import read_inertial_sensors
from jaxid.case.tables import (
    TOP,
    UNKNOWN_OF_CONTROLLER,
    ControllerTable,
    controller_keys,
    controller_table,
    fit_keys,
    validation_keys,
)
from jaxid.case.values import Value
from jaxid.errors import InputError, suggest
from jaxid.model.parameter import parameters_of
from jaxid.names import DISCOVER, HOLDS
from jaxid.schema import Counts, Spot, keys_of, plain, read_settings, read_table
from jaxid.settings import (
    Actuator,
    Algebraic,
    DesignTable,
    Disturbance,
    Identification,
    InertialSensor,
    LimitsTable,
    LogTable,
    OutputError,
    Preprocess,
    Recursive,
    SensorTable,
    SimulationTable,
    StudyTable,
    WithinPrior,
    log_table,
)

if TYPE_CHECKING:
    from jaxid.model.effect import Effect

# Name of a case that is a dict, in messages and results.
UNNAMED = "case"


@dataclass(frozen=True)
class Validation:
    """One of [[validation]].

    Args:
        name: Name in results.
        log: Its file; None: the fitted log.
        columns: Its [log] table, complete: for `jaxid.logs.log.read_log`.
        disturbance: The controller's on this log: a square wave, or the name of a column.
        known: Values of parameters that are known in this log, by their names in results.
    """

    name: str
    log: Path | None
    columns: LogTable
    disturbance: Disturbance | str | None = None
    known: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class FitEntry(Validation):
    """One of [[fit]]: a log that is fitted with the others.

    Its `log` is None if it takes the first log of the command.
    """


@dataclass(frozen=True, kw_only=True)
class Case:
    """A checked case. Tables that it does not have are at their defaults, or None.

    Args:
        path: The case file; None for a case that was given as a dict.
        base: Folder from which relative file names start, if there is no file.
        tables: The tables as they were given, before they were checked.
        plant: Entry of [plant].
        effects: Entries of [[effects]], in the order of the drive.
        actuator: Table [actuator].
        log: Table [log], for `jaxid.logs.log.read_log`.
        preprocess: Table [preprocess], for `jaxid.logs.prepare.choose_recipe`.
        identification: Table [identification], for `jaxid.estimators`.
        algebraic: Table [algebraic], for the estimators of that name.
        output_error: Table [output_error], for the estimator of that name.
        within_prior: Table [within_prior], or the same by the older keys of [output_error].
        recursive: Table [recursive], for the estimator of that name.
        controller: Table [controller].
        sensor: Table [sensor].
        inertial_sensors: Entries of [[inertial_sensors]].
        limits: Table [limits], for `jaxid.experiment_design.limits`.
        fits: Entries of [[fit]].
        validations: Entries of [[validation]].
        candidates: Effects of [discover] that a search may name beside the registered ones.
        kinds: Kinds of [discover] that a search is limited to; empty: all.
        design: Table [design], for `jaxid.experiment_design.along_reference`.
        reference: Table [reference], for `jaxid.references.make_reference`, at its guesses.
        unknown_reference: Unknowns of [reference], by name.
        input: Table [input], for `jaxid.references.make_reference`.
        simulation: Table [simulation].
        study: Table [study].
    """

    path: Path | None
    plant: PlantEntry
    base: Path = field(default=Path(), repr=False)
    tables: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)
    effects: tuple[EffectEntry, ...] = ()
    actuator: Actuator = Actuator()
    log: LogTable | None = None
    preprocess: Preprocess = Preprocess()
    identification: Identification = Identification()
    algebraic: Algebraic = Algebraic()
    output_error: OutputError = OutputError()
    within_prior: WithinPrior | None = None
    recursive: Recursive = Recursive()
    controller: ControllerTable | None = None
    sensor: SensorTable = SensorTable()
    inertial_sensors: tuple[InertialSensor, ...] = ()
    limits: LimitsTable = LimitsTable()
    fits: tuple[FitEntry, ...] = ()
    validations: tuple[Validation, ...] = ()
    candidates: tuple[type[Effect], ...] = ()
    kinds: tuple[str, ...] = ()
    design: DesignTable | None = None
    reference: dict[str, Any] | None = None
    unknown_reference: dict[str, Value] = field(default_factory=dict)
    input: dict[str, Any] | None = None
    simulation: SimulationTable = SimulationTable()
    study: StudyTable = StudyTable()

    @property
    def where(self) -> str:
        """Name of the case in messages: its path, or "case"."""
        return UNNAMED if self.path is None else str(self.path)

    @property
    def name(self) -> str:
        """Name of the case in results: that of its file, or "case"."""
        return UNNAMED if self.path is None else self.path.name

    @property
    def title(self) -> str:
        """Title of the case in reports: its file's name without suffix, or "case"."""
        return UNNAMED if self.path is None else self.path.stem

    @property
    def folder(self) -> Path:
        """Folder from which relative file names of the case start."""
        return self.base if self.path is None else self.path.parent

    @property
    def without_force(self) -> bool:
        """True if the logs hold what a controller follows, and no force."""
        return self.controller is not None and self.log is not None and self.log.force is None

    @property
    def true_reference(self) -> dict[str, Any] | None:
        """[reference] for a simulation: with the true values of its unknowns, if it has any."""
        if self.reference is None:
            return None
        return self.reference | {k: v.start(True) for k, v in self.unknown_reference.items()}

    @property
    def own_effects(self) -> tuple[type[Effect], ...]:
        """User-defined effects that the case names: those that it declares, and the candidates."""
        from jaxid.effects import EFFECTS

        return _others(self, EFFECTS)

    @property
    def searched(self) -> tuple[type[Effect], ...]:
        """Effects that `discover` may name."""
        from jaxid.effects import EFFECTS

        asked = {*self.kinds, *(cls.kind for cls in self.candidates)}
        registered = [
            cls for kind, cls in EFFECTS.items() if kind in asked or not (self.kinds or cls.on_request)
        ]
        return (*registered, *self.own_effects)

    @property
    def load_column(self) -> bool:
        """True if the log has the position of a load behind an elastic coupling."""
        if self.log is None:
            return True
        named = self.log.position
        whole = named is not None and not isinstance(named, str) and len(named) == self.plant.joints
        return whole or self.log.load_position is not None

    @property
    def hold(self) -> str:
        """Course of the command between samples."""
        return HOLDS[0] if self.log is None or self.log.hold is None else self.log.hold

    @property
    def reference_hold(self) -> str:
        """Course of a logged reference between samples; a smooth curve where the case states none."""
        stated = None if self.log is None else self.log.reference_hold
        return HOLDS[2] if stated is None else stated

    @property
    def columns(self) -> LogTable:
        """The [log] table of a case that must have one.

        Raises:
            InputError: If it has none.
        """
        if self.log is None:
            hint = "name the columns: time, position, force"
            raise InputError("the table [log] is missing", where=self.where, hint=hint)
        return self.log

    def fits_within_prior(self, method: str | None) -> bool:
        """Check that a method takes the guesses as a prior.

        The method `within_prior` does; `discover` (or no method, None) does if the case has a prior;
        `output_error` does if the prior is among the keys of [output_error].
        """
        if method == "output_error":
            return self.output_error.prior is not None
        return method == "within_prior" or (method in (None, DISCOVER) and self.within_prior is not None)

    @property
    def prior_method(self) -> str:
        """Name of the method that fits within the prior: of output_error if the prior is one of its keys."""
        return "within_prior" if self.output_error.prior is None else "output_error"

    def need_prior(self) -> WithinPrior:
        """Return the settings of a fit within the prior.

        Raises:
            InputError: If the case has none.
        """
        if self.within_prior is None:
            hint = "add [within_prior] with prior, the relative standard deviation of the guesses"
            raise InputError("the table [within_prior] is missing", where=self.where, hint=hint)
        return self.within_prior


# A case, its file, or a dict with its tables.
CaseLike = Case | Mapping[str, Any] | str | Path


def load_case(source: CaseLike) -> Case:
    """Load a case from a file or a dict; unknown keys are errors.

    Args:
        source: A TOML file; or a dict with the same tables and keys, in which relative file names start from
            the current folder. A case is returned as it is.

    Returns:
        The case.

    Raises:
        InputError: If the file cannot be read, or a table or key is unknown, missing or impossible; the text
            names file (or "case"), table, key and the fix.
    """
    if isinstance(source, Case):
        return source
    if isinstance(source, Mapping):
        return read_case(plain(source), None, Path())
    path = Path(source)
    return read_case(_toml(path), path, path.parent)


def refuse_unsound(path: Path) -> None:
    """Refuse a case before JAX is imported, as far as that needs no classes of plants and effects.

    Args:
        path: A TOML file.

    Raises:
        InputError: If the file cannot be read, or a table or key is unknown, missing or impossible.
    """
    if "jax" not in sys.modules:
        with contextlib.suppress(NeedsClassesError):
            read_case(_toml(path), path, path.parent, declared_kinds())


def read_case(tables: Mapping[str, Any], path: Path | None, folder: Path, kinds: Kinds | None = None) -> Case:
    """Check the tables of a case.

    Args:
        tables: Tables as TOML gives them.
        path: File that they came from; None: no file.
        folder: Folder from which relative file names start.
        kinds: Plants, effects and control laws that it may name; None: all that are registered.

    Returns:
        The case; with stand-ins in place of classes, if the kinds are such.

    Raises:
        InputError: If a table or key is unknown, missing or impossible.
        NeedsClassesError: If the kinds are stand-ins, and only a class can check the case further.
    """
    kinds = loaded_kinds() if kinds is None else kinds
    top = Spot(UNNAMED if path is None else str(path), folder=folder)
    _check_top(tables, top)
    plant, given = read_plant(tables["plant"], top, kinds), tables
    tables = _with_defaults(tables, plant)
    drives = plant.drives
    root = replace(top, counts=Counts(plant.joints, drives, plant.names))

    def read(cls: type, name: str) -> Any:
        return read_settings(cls, tables.get(name, {}), root.under(f"[{name}]"))

    at_guess, unknown = read_unknown_reference(tables, drives, root)
    candidates, searched = read_search(tables.get("discover", {}), root, kinds)
    output_error = read(OutputError, "output_error")
    case = Case(
        path=path,
        base=folder,
        tables=given,
        plant=plant,
        effects=_all_effects(tables, plant, root, kinds),
        actuator=read(Actuator, "actuator"),
        log=_log(tables, root),
        preprocess=read(Preprocess, "preprocess"),
        identification=read(Identification, "identification"),
        algebraic=read(Algebraic, "algebraic"),
        output_error=output_error,
        within_prior=_within_prior(tables, output_error, root),
        recursive=read(Recursive, "recursive"),
        controller=_controller(tables, root, kinds),
        sensor=read(SensorTable, "sensor"),
        inertial_sensors=read_inertial_sensors(tables, plant.cls.links(plant.joints), root),
        limits=read(LimitsTable, "limits"),
        fits=_fits(tables, root),
        validations=_validations(tables, root),
        candidates=candidates,
        kinds=searched,
        design=read(DesignTable, "design") if tables.get("design") else None,
        reference=read_signal("reference", {**tables, **at_guess}, drives, root),
        unknown_reference=unknown,
        input=read_signal("input", tables, drives, root),
        simulation=read(SimulationTable, "simulation"),
        study=read(StudyTable, "study"),
    )

    # Keys that are sound by themselves may contradict each other.
    _check_transmission(case, root)
    _check_drive(case, tables, root)
    _check_labels(case, root)
    _check_preprocess(tables.get("preprocess", {}), root)
    _check_recursive(tables.get("recursive", {}), root)
    check_kinds(_others(case, kinds.effects), root)
    _check_loop(case, root)
    _check_command(case, root, kinds)
    return case


def _with_defaults(tables: Mapping[str, Any], plant: PlantEntry) -> Mapping[str, Any]:
    """Return the tables with those that the plant's file states, such as its servos, if the case has none."""
    log = tables.get("log", {})
    followed = "reference" in tables or (isinstance(log, dict) and "reference" in log)
    defaults = {k: v for k, v in plant.defaults.items() if k != "controller" or followed}
    return {**defaults, **tables}


def _all_effects(
    tables: Mapping[str, Any], plant: PlantEntry, root: Spot, kinds: Kinds
) -> tuple[EffectEntry, ...]:
    """Return the effects of the case, and behind them those of the plant's file that it does not replace."""
    declared = read_effects(tables.get("effects", []), plant, root, kinds)
    return (*declared, *own_effects(declared, plant.effects))


def _others(case: Case, registered: Mapping[str, type[Effect]]) -> tuple[type[Effect], ...]:
    """Return the effects that a case declares or searches for, and that are not registered."""
    classes = (*(entry.cls for entry in case.effects), *case.candidates)
    return tuple(dict.fromkeys(c for c in classes if registered.get(c.kind) is not c))


def _check_top(tables: Mapping[str, Any], top: Spot) -> None:
    """Refuse tables with unknown names or of the wrong kind (one, or many)."""
    for name, value in tables.items():
        if name not in TOP:
            what = (
                f"unknown table [{name}]"
                if isinstance(value, dict | list)
                else f"key '{name}' stands outside of any table"
            )
            raise top.fault(what, _hint_at_top(name, value))
        many = isinstance(value, list) and all(isinstance(v, dict) for v in value)
        if TOP[name] and not many:
            raise top.fault(f"[{name}] may recur", f"write [[{name}]], in double brackets")
        if not TOP[name] and not isinstance(value, dict):
            raise top.fault(f"'{name}' is not one table", f"write [{name}] once")
    if "plant" not in tables:
        raise top.fault("the table [plant] is missing", 'add [plant] with kind = "axis"')


def _hint_at_top(name: str, value: Any) -> str:
    hint = suggest(name, TOP, limit=len(TOP))
    near = difflib.get_close_matches(name, TOP, n=1)
    return hint if near or isinstance(value, dict | list) else f"move it below its [table]; {hint}"


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


# Only a transmission needs numpy, and only stated units their reader: neither should delay other refusals.
def _check_transmission(case: Case, root: Spot) -> None:
    rows, spot = case.actuator.transmission, root.under("[actuator]").at("transmission")
    if rows is None:
        return
    plant, joints = case.plant, case.plant.joints
    if joints == 1:
        hint = "leave it out; a ratio of gears goes into gain"
        raise spot.fault("is for plants with several joints", hint)
    if plant.drives < joints:
        hint = "leave it out, and take a log of the joints"
        raise spot.fault(f"is for plants with a drive for each joint, not {plant.drives} for {joints}", hint)
    import numpy as np

    if {len(rows), *map(len, rows)} != {joints} or np.linalg.matrix_rank(rows) < joints:
        hint = f"give {joints} rows of {joints} numbers, none a sum of others"
        raise spot.fault("is not an invertible square matrix", hint)
    if case.controller is not None:
        hint = "leave [controller] out: the log is then identified without the loop"
        raise spot.fault("does not go with a loop, whose gains are at the motors", hint)
    gears = [n for n, i in parameters_of(plant.cls).items() if i.known and n in plant.parameters]
    if gears:
        hint = "keep transmission if the log is of the motors' angles, else the other"
        raise spot.fault(f"and {gears[0]} of [plant.parameters] are both given", hint)


def _check_drive(case: Case, tables: Mapping[str, Any], root: Spot) -> None:
    """Refuse a drive that is described twice, and words on it that convert nothing."""
    given, spot = tables.get("actuator", {}), root.under("[actuator]")
    if case.actuator.torque_constant is not None:
        for key in ("gain", "transmission"):
            if key in given:
                hint = "keep gain, the force for the logged command, or torque_constant"
                raise spot.at(key).fault("does not go with torque_constant", hint)
    else:
        for key in ("gear_ratio", "lead"):
            if key in given and "gain" not in given:
                hint = "state gain (ratio times efficiency for a logged motor torque) or torque_constant"
                raise spot.at(key).fault("leaves open what the logged command is", hint)
    if case.log is not None and case.log.counts_per_revolution is not None and case.log.units is not None:
        from jaxid.logs.units import parse_unit

        given = case.log.units.values()
        texts = [text for unit in given for text in ((unit,) if isinstance(unit, str) else unit)]
        if "count" not in {unit.kind for unit in map(parse_unit, texts) if unit is not None}:
            hint = 'add units = { position = "count" }, or leave it out'
            raise root.under("[log]").at("counts_per_revolution").fault("converts nothing", hint)


def _check_labels(case: Case, root: Spot) -> None:
    """Refuse labels of [plant] units that look as if they converted: mm, deg, kN."""
    for quantity in ("position", "force"):
        label = getattr(case.plant.units, quantity)
        if label is None:
            continue
        from jaxid.logs.units import parse_unit

        unit = parse_unit(label)
        mechanical = (
            unit is not None and unit.kind in ("length", "angle", "force", "torque") and unit.factor != 1.0
        )
        if mechanical and unit is not None and unit.per == 0:
            hint = f'state [log] units = {{ {quantity} = "{label}" }}, which converts; results are in SI'
            raise (
                root.under("[plant]")
                .at(f"units.{quantity}")
                .refuse(label, "is a label, and converts nothing", hint)
            )


def _within_prior(tables: Mapping[str, Any], settings: OutputError, root: Spot) -> WithinPrior | None:
    """Return [within_prior]; or the same by the older keys of [output_error]."""
    given, spot = tables.get("output_error", {}), root.under("[output_error]")
    if "within_prior" in tables:
        if settings.prior is not None:
            raise spot.at("prior").fault("is given beside [within_prior]", "keep [within_prior] alone")
        stated = read_settings(WithinPrior, tables["within_prior"], root.under("[within_prior]"))
    else:
        stated = None
    if settings.prior is None:
        lost = [key for key in given if key not in ("on", "start", "solver", "minimiser")]
        if lost:
            hint = f"add prior, the relative standard deviation of the guesses, or leave {lost[0]} out"
            raise spot.at(lost[0]).fault("goes with prior only", hint)
        return stated
    return WithinPrior(**{key: getattr(settings, key) for key in given})


def _check_preprocess(given: Mapping[str, Any], root: Spot) -> None:
    """Refuse keys of a low-pass beside those of a parabola."""
    parabolic, spot = given.get("derivatives") == "parabolic", root.under("[preprocess]")
    if "reach" in given and not parabolic:
        hint = 'add derivatives = "parabolic", or leave it out'
        raise spot.at("reach").fault("is that of a parabola", hint)
    for key in ("cutoff_hz", "order"):
        if key in given and parabolic:
            what = 'is of a low-pass, which derivatives = "parabolic" does without'
            raise spot.at(key).fault(what, "leave out one of them")


def _check_recursive(given: Mapping[str, Any], root: Spot) -> None:
    """Refuse a start beside a run to go on from."""
    for key in ("start", "regularization"):
        if "restart" in given and key in given:
            spot = root.under("[recursive]").at(key)
            raise spot.fault("does not go with restart", "leave out one of them")


def _log(tables: Mapping[str, Any], root: Spot) -> LogTable | None:
    if "log" not in tables:
        return None
    return _time_base(log_table(tables["log"], root.under("[log]")), root.under("[log]"))


def _time_base(table: LogTable, spot: Spot) -> LogTable:
    """Return the table of a log; refuse two time bases."""
    if table.time is not None and table.sample_rate is not None:
        raise spot.fault("both time and sample_rate are given", "keep one of them")
    return table


def _controller(tables: Mapping[str, Any], root: Spot, kinds: Kinds) -> ControllerTable | None:
    if "controller" not in tables:
        return None
    table, spot = tables["controller"], root.under("[controller]")
    kind = read_kind(table, kinds.laws, spot)
    return controller_table(read_table(table, controller_keys(kind, kinds), spot))


def _validations(tables: Mapping[str, Any], root: Spot) -> tuple[Validation, ...]:
    out: list[Validation] = []
    for k, table in enumerate(tables.get("validation", []), start=1):
        spot = root.under(f"[[validation]] {k}")
        given = read_table(table, validation_keys(), spot)
        _check_name(given["name"], out, spot)
        if "log" not in given and "rows" not in table:
            hint = "add log = <its file>, or rows that the fit does not use"
            raise spot.fault("this validation log is identical to the fitted log", hint)
        log = root.folder / given["log"] if "log" in given else None
        out.append(
            Validation(given["name"], log, *_of_log(tables, table, given, spot, same_file=log is None))
        )
    return tuple(out)


def _fits(tables: Mapping[str, Any], root: Spot) -> tuple[FitEntry, ...]:
    out: list[FitEntry] = []
    for k, table in enumerate(tables.get("fit", []), start=1):
        spot = root.under(f"[[fit]] {k}")
        given = read_table(table, fit_keys(), spot)
        if "name" not in given and "log" not in given:
            raise spot.fault("has neither name nor log", "add log = <its file>, or name for the first LOG")
        log = root.folder / given["log"] if "log" in given else None
        name = given["name"] if log is None else given.get("name", log.stem)
        if log is not None and "name" not in given and name in [entry.name for entry in out]:
            name = f"{log.parent.name}/{name}"
        _check_name(name, out, spot)
        out.append(FitEntry(name, log, *_of_log(tables, table, given, spot, same_file=log is None)))
    return tuple(out)


def _check_name(name: str, others: Sequence[Validation], spot: Spot) -> None:
    """Refuse the name of another entry."""
    if name in [entry.name for entry in others]:
        raise spot.at("name").refuse(name, "is taken", "give each a different name")


def _of_log(
    tables: Mapping[str, Any],
    table: Mapping[str, Any],
    given: Mapping[str, Any],
    spot: Spot,
    *,
    same_file: bool,
) -> tuple[LogTable, Disturbance | str | None, Mapping[str, float | tuple[float, ...]]]:
    """Return columns, disturbance and known values of an entry that names a log."""
    columns = {name: table[name] for name in keys_of(LogTable) if name in table}
    merged = log_table(_merged(tables.get("log", {}), columns, same_file=same_file), spot)
    of_fit = (tables.get("controller") or {}).get("disturbance")
    disturbance = given["disturbance"] if "disturbance" in given else _disturbance(of_fit)
    return _time_base(merged, spot), disturbance, given.get("set", {})


def _disturbance(given: Any) -> Disturbance | str | None:
    """Return the disturbance of [controller], which was checked there."""
    return Disturbance(**{k: float(v) for k, v in given.items()}) if isinstance(given, dict) else given


def _merged(base: Mapping[str, Any], columns: Mapping[str, Any], *, same_file: bool) -> dict[str, Any]:
    """Return [log] with the keys that differ; rows of one file mean nothing in another."""
    dropped = set() if same_file else {"rows"}
    # One time base takes the place of the other.
    dropped |= {"time"} if "sample_rate" in columns else set()
    dropped |= {"sample_rate"} if "time" in columns else set()
    return {**{key: value for key, value in base.items() if key not in dropped}, **columns}


def _check_command(case: Case, root: Spot, kinds: Kinds) -> None:
    """Refuse effects on the command without a controller, or beside the same key of [controller]."""
    for entry in case.effects:
        kind, name, spot = entry.cls.kind, entry.cls.controller_field, root.under("[[effects]]")
        if name is None:
            continue
        if case.controller is None:
            hint = "add [controller], or leave the effect out"
            raise spot.fault(f"{kind} acts on the command of a controller, and there is none", hint)
        if name in case.controller.law:
            hint = "state it in one of the two places"
            raise spot.fault(f"{kind} and [controller] {name} are both given, and are the same", hint)
        if sum(other.cls is entry.cls for other in case.effects) > 1 and not _apart(case, entry.cls):
            raise spot.fault(f"{kind} is given twice for one joint", "state it once")
        if name not in controller_keys(case.controller.kind, kinds) and name in UNKNOWN_OF_CONTROLLER:
            hint = "take another law, or leave the effect out"
            what = f"{kind} does not go with [controller] kind = '{case.controller.kind}', which has no error"
            raise spot.fault(what, hint)


def _apart(case: Case, cls: type[Effect]) -> bool:
    """Check that the entries of an effect are on different joints."""
    ports = [port for entry in case.effects if entry.cls is cls for port in entry.ports]
    return len(set(ports)) == len(ports)


def _check_loop(case: Case, root: Spot) -> None:
    """Refuse entries that only a loop could use, if there is none."""
    if case.controller is None:
        if case.reference is not None:
            hint = "add [controller], or call it [input] for open loop"
            raise root.under("[reference]").fault("there is no loop to follow it", hint)
        for table, entries in (("fit", case.fits), ("validation", case.validations)):
            for k, entry in enumerate(entries, start=1):
                if entry.disturbance is not None:
                    spot = root.under(f"[[{table}]] {k}").at("disturbance")
                    raise spot.fault("belongs to a controller", "add [controller], or leave it out")
    if case.reference is not None and case.input is not None:
        hint = "keep [reference] for closed loop, or [input] for open loop"
        raise root.fault("both [reference] and [input] are given", hint)
