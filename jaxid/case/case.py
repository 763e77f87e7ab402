"""Cases: a machine with its known and unknown parameters, the columns of its logs, and settings."""

from __future__ import annotations

import contextlib
import difflib
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxid.case.contradictions import refuse_contradictions, refuse_without_loop
from jaxid.case.declared import EffectEntry, PlantEntry, own_effects
from jaxid.case.entries import check_kinds, read_effects, read_kind, read_plant, read_search
from jaxid.case.kinds import Kinds, NeedsClassesError, declared_kinds, loaded_kinds
from jaxid.case.log_entries import FitEntry, Validation, fits_of, log_of, validations_of
from jaxid.case.reference import read_signal, read_unknown_reference
from jaxid.case.sensors import read_inertial_sensors
from jaxid.case.tables import (
    TOP,
    ControllerTable,
    controller_keys,
    controller_table,
)
from jaxid.case.values import Value
from jaxid.errors import InputError, suggest
from jaxid.names import DISCOVER, HOLDS
from jaxid.schema import Counts, Spot, plain, read_settings, read_table
from jaxid.settings import (
    Actuator,
    Algebraic,
    DesignTable,
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
)

if TYPE_CHECKING:
    from jaxid.model.effect import Effect

# Name of a case that is a dict, in messages and results.
UNNAMED = "case"


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
        links = self.plant.cls.links(self.plant.joints) > 0

        def by_default(cls: type[Effect]) -> bool:
            return not (self.kinds or cls.on_request or (links and cls.in_links))

        registered = [cls for kind, cls in EFFECTS.items() if kind in asked or by_default(cls)]
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
        log=log_of(tables, root),
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
        fits=fits_of(tables, root),
        validations=validations_of(tables, root),
        candidates=candidates,
        kinds=searched,
        design=read(DesignTable, "design") if tables.get("design") else None,
        reference=read_signal("reference", {**tables, **at_guess}, drives, root),
        unknown_reference=unknown,
        input=read_signal("input", tables, drives, root),
        simulation=read(SimulationTable, "simulation"),
        study=read(StudyTable, "study"),
    )

    refuse_contradictions(case, tables, root)
    check_kinds(_others(case, kinds.effects), root)
    refuse_without_loop(case, root, kinds)
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
        beside = sorted(p.name for p in path.parent.glob("*.toml") if _has_plant(p))[:8]
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


def _has_plant(path: Path) -> bool:
    """Check that a TOML file may be a case: it has the table that every case has."""
    try:
        return "[plant" in path.read_text(encoding="utf-8", errors="ignore")
    except OSError:
        return False


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


def _controller(tables: Mapping[str, Any], root: Spot, kinds: Kinds) -> ControllerTable | None:
    if "controller" not in tables:
        return None
    table, spot = tables["controller"], root.under("[controller]")
    kind = read_kind(table, kinds.laws, spot)
    return controller_table(read_table(table, controller_keys(kind, kinds), spot))
