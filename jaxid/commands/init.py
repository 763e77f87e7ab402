"""The command `init`: from a raw log to a case that runs, with what was assumed and what only the user knows."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.case.case import Case, load_case
from jaxid.case.urdf import Urdf, read_urdf
from jaxid.errors import InputError
from jaxid.files import write_whole
from jaxid.first_case.balance import FreeSwing, RoughBalance, free_swing, rough_balance
from jaxid.first_case.columns import NO_TIME_RATE, Chosen, Column, choose, columns_of
from jaxid.first_case.draft import Section, case_text, rounded
from jaxid.first_case.units import Measures, measures_of
from jaxid.first_case.words import meaning_of
from jaxid.logs.in_memory import LogLike, arrays_of, as_log, units_of_table
from jaxid.logs.log import Log
from jaxid.logs.readers import read_table
from jaxid.logs.readers.contents import Contents, contents_of
from jaxid.logs.soundness import position_levels
from jaxid.logs.units import Frame, parse_unit
from jaxid.model.units import Units
from jaxid.numerics.filters import high_band_std
from jaxid.settings import LogTable

_GRAVITY = 9.81
# Mass times distance of a swing that nothing states [kg m].
_MOMENT = 0.1
# Smallest guesses over the size of the force: friction is positive.
_LEAST = 0.01
# Noise beyond that of the rounding, as a variance over it, from which it is stated.
_BEYOND_ROUNDING = 1.5


@dataclass(frozen=True, repr=False)
class FirstCase:
    """A case written from a raw log.

    Args:
        text: The case as TOML, with comments.
        folder: Folder that file names in it start from.
        source: The log.
        assumed: Everything that was assumed, a line each.
        questions: Everything that only the user knows, a line each.
    """

    text: str
    folder: Path
    source: str
    assumed: tuple[str, ...]
    questions: tuple[str, ...]

    @property
    def tables(self) -> dict[str, Any]:
        """Tables of the case, as `load_case` takes them."""
        return tomllib.loads(self.text)

    def case(self) -> Case:
        """Return the case, as `identify` and the other commands take it; a URDF counts from the current folder."""
        return load_case(self.tables)

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the case to a file.

        Raises:
            InputError: If the file exists and `overwrite` is not given, or it cannot be written.
        """
        path = check_target(Path(path), overwrite=overwrite)
        write_whole(path, self.text)
        return path

    def __str__(self) -> str:
        lines = [f"assumed: {line}" for line in self.assumed]
        return "\n".join([*lines, *(f"question: {line}" for line in self.questions)])

    def __repr__(self) -> str:
        return f"FirstCase of {self.source}: {len(self.assumed)} assumed, {len(self.questions)} question(s)"


def check_target(path: Path, *, overwrite: bool = False) -> Path:
    """Check that a case may be written to a file, before the work that makes it.

    Raises:
        InputError: If it exists and `overwrite` is false, is a folder, or its folder does not exist.
    """
    if path.is_dir():
        raise InputError("is a folder", where=str(path), hint="name a file: -o case.toml")
    if path.suffix.lower() != ".toml":
        raise InputError("a case is a .toml file", where=str(path), hint="end its name in .toml")
    if path.exists() and not overwrite:
        hint = "choose another -o, or overwrite with --force"
        raise InputError("exists already", where=str(path), hint=hint)
    if not path.parent.is_dir():
        raise InputError("has no such folder", where=str(path), hint="make the folder first")
    return path


def init(
    log: LogLike,
    *,
    urdf: str | Path | None = None,
    tip: str | None = None,
    mjcf: str | Path | None = None,
    folder: str | Path = ".",
) -> FirstCase:
    """Write a first case from a raw log: columns, units, sensors, and rough guesses of the unknowns.

    Args:
        log: The file, or a table in memory (DataFrame, Dataset, dict).
        urdf: File that describes the arm of the log; None: an axis.
        tip: Name of its last link; None: there is only one way to go.
        mjcf: MuJoCo model of the machine; not built yet.
        folder: Folder in which the case will stand, for the path of the URDF file in it.

    Raises:
        InputError: If no column is the position or velocity of a joint, there is no force, or nothing else
            from which one could be concluded.
    """
    if mjcf is not None:
        hint = "give --urdf FILE --tip LINK, or no model for the case of one axis"
        raise InputError("--mjcf is not built yet", where=str(mjcf), hint=hint)
    if tip is not None and urdf is None:
        raise InputError("--tip goes with --urdf", hint="add --urdf FILE, or leave --tip out")
    if isinstance(log, Log):
        hint = "give the file, or a table with the columns by name"
        raise InputError("a Log has its columns already", where=log.source, hint=hint)
    raw = _raw(log)
    chosen = choose(columns_of(raw.data, raw.units, raw.contents.time), raw.source)
    arm = None if urdf is None else read_urdf(urdf, tip)
    if arm is not None:
        chosen = _of_arm(chosen, arm, str(urdf), raw.source)
    elif len(chosen.joints) > 1:
        _need_forces(chosen, raw.source)
        chosen = _most_moved(chosen)
    measures = measures_of(chosen)
    drafted = _Drafting(log, raw, chosen, measures, Path(folder))
    if not chosen.force:
        sections = drafted.without_force()
    elif arm is not None:
        assert urdf is not None, "an arm is read from it"
        sections = drafted.arm(arm, Path(urdf), tip)
    else:
        sections = drafted.axis()
    return drafted.finished(sections)


@dataclass(frozen=True)
class _Raw:
    """All columns of a log as they are: the data by name, units, and the file's own list."""

    source: str
    contents: Contents
    data: dict[str, np.ndarray]
    units: Mapping[str, str]


def _raw(log: LogLike) -> _Raw:
    """Read all columns of numbers of a log."""
    if not isinstance(log, str | Path):
        source, arrays = arrays_of(log)
        data = {}
        for name, values in arrays.items():
            values = np.asarray(values)
            if values.dtype.kind == "M":
                values = (values - values[0]) / np.timedelta64(1, "s")
            if values.dtype.kind in "fiub" and values.ndim == 1:
                data[name] = values.astype(np.float64)[:, None]
        return _Raw(source, Contents(tuple(data)), data, units_of_table(log))
    path = Path(log)
    if not path.exists():
        beside = sorted(p.name for p in path.parent.glob("*" + path.suffix))
        hint = f"check the path; in that folder there is: {', '.join(beside[:8]) or 'none'}"
        raise InputError("no such file", where=str(path), hint=hint)
    contents = contents_of(path)
    names = list(dict.fromkeys([*([contents.time] if contents.time else []), *contents.names]))
    time = contents.time or next((n for n in names if meaning_of(n).quantity == "time"), None)
    settings = LogTable(
        time=time,
        sample_rate=None if time else NO_TIME_RATE,
        position=names[0] if names else "q",
        force=names[0] if names else "u",
        episode=0 if contents.episodes > 1 else None,
    )
    try:
        read = read_table(path, names, None, settings)
        columns, units = read.columns, dict(read.units)
    except InputError:
        # One column of text or of another length is no reason to refuse the others.
        columns, units = _one_by_one(path, names, contents, settings)
    data = {name: values for name, values in columns.items() if values.shape[1] == 1}
    rows = max((len(v) for v in data.values()), default=0)
    data = {name: values for name, values in data.items() if len(values) == rows > 1}
    return _Raw(str(path), contents, data, {**contents.units, **units})


def _one_by_one(
    path: Path, names: Sequence[str], contents: Contents, settings: LogTable
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read those columns that are numbers."""
    columns: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    first: InputError | None = None
    for name in names:
        wanted = [name] if not contents.time or name == contents.time else [contents.time, name]
        try:
            read = read_table(path, wanted, None, settings)
        except InputError as error:
            first = first or error
            continue
        columns |= read.columns
        units |= dict(read.units)
    if not columns and first is not None:
        raise first
    return columns, units


def _of_arm(chosen: Chosen, arm: Urdf, urdf: str, where: str) -> Chosen:
    """Return the columns of an arm's joints, in their order."""
    keys = [" ".join(meaning_of(name).joint) for name in arm.names]
    if all(keys) and len(set(keys)) == len(keys) and set(keys) <= set(chosen.joints):
        at = [chosen.joints.index(key) for key in keys]
        said = f"columns belong to the joints of {Path(urdf).name} by their names"
    elif len(chosen.joints) == len(arm.names):
        at = list(range(len(arm.names)))
        said = f"columns belong to the joints {', '.join(arm.names)} of {Path(urdf).name} in this order"
    else:
        listed = ", ".join(f"'{j}'" for j in chosen.joints)
        hint = "name the tip whose joints the log has by --tip, or rename the columns"
        raise InputError(
            f"columns of {listed}, and {Path(urdf).name} moves {', '.join(arm.names)}", where=where, hint=hint
        )

    def picked(columns: tuple[Column, ...]) -> tuple[Column, ...]:
        return tuple(columns[k] for k in at) if columns else ()

    return replace(
        chosen,
        position=picked(chosen.position),
        velocity=picked(chosen.velocity),
        force=picked(chosen.force),
        reference=picked(chosen.reference),
        joints=arm.names,
        said=(*chosen.said, said),
    )


def _need_forces(chosen: Chosen, where: str) -> None:
    """Refuse a log of several joints without a force."""
    if not chosen.force:
        raise InputError(_no_force(chosen), where=where, hint=_NO_FORCE_HINT)


_NO_FORCE_HINT = "log the torque or the current of the drives with its sign, and name it so"


def _no_force(chosen: Chosen) -> str:
    reasons = [line for line in chosen.said if line.startswith("'") and "passed over" in line]
    why = f" ({reasons[0]})" if reasons else ""
    what = f"no column is a force with a sign{why}"
    if chosen.reference:
        what += "; a fit of the servo's loop from reference and position alone is not built yet"
    return what


def _most_moved(chosen: Chosen) -> Chosen:
    """Return the columns of the joint with the longest way, with a question for a model of all."""
    columns = chosen.position or chosen.velocity
    ways = [float(np.abs(np.diff(c.values)).sum()) for c in columns]
    joint = int(np.argmax(ways))
    name = columns[joint].name
    said = f"the log has {len(columns)} joints: the case is of that of '{name}' alone, which moves most"
    question = "a model of all joints? jaxid init LOG --urdf FILE --tip LINK; alone, coupling counts as noise"
    one = chosen.only(joint)
    return replace(one, said=(*one.said, said), questions={**one.questions, "joints": question})


class _Drafting:
    """The sections of one case, as they are written."""

    def __init__(self, log: LogLike, raw: _Raw, chosen: Chosen, measures: Measures, folder: Path):
        self._log, self._raw, self._chosen, self._measures = log, raw, chosen, measures
        self._folder = folder
        self._joints = len(chosen.position or chosen.velocity)

    # what stands in the case

    def axis(self) -> list[Section]:
        """Return the case of one joint with its force."""
        chosen, measures = self._chosen, self._measures
        table = self._log_table()
        rotary = measures.motion == "rotary"
        log = self._read(table) if chosen.position else None
        if log is not None:
            rough = rough_balance(log.force[:, 0], log.position[:, 0], log.period, rotary=rotary)
        else:
            time, motion, force = self._by_hand()
            rough = rough_balance(
                force, motion, float(np.median(np.diff(time))), rotary=rotary, of_velocity=not chosen.position
            )
        rough, signs = _driven(rough)
        if signs:
            table.keys["sign"] = {"force": -1}
            table.assumed.append("the force as logged brakes the motion: its sign is turned")
            table.questions.append("is a positive force one that drives a positive velocity?")
        plant, effects = self._plant(rough), self._effects(rough)
        return [*plant, *effects, table, *self._sensor(log)]

    def arm(self, arm: Urdf, urdf: Path, tip: str | None) -> list[Section]:
        """Return the case of an arm from a URDF file."""
        measures = self._measures
        plant = Section("[plant]", {"kind": "serial_arm", "urdf": _relative(urdf, self._folder)})
        if tip is not None:
            plant.keys["tip"] = tip
        plant.keys["unknown"] = "base"
        plant.notes["unknown"] = (
            'sums of link parameters that torques show; "none": those of the file are right'
        )
        if measures.labels:
            plant.keys["units"] = measures.labels
            plant.questions.append(measures.questions["force"])
        plant.questions.append(
            "does gravity act along -z of the first link? Else gravity_vector = [x, y, z] in m/s^2"
        )
        table = self._log_table(arm.names)
        log = self._read(table)
        rough = []
        for k in range(self._joints):
            others = [log.position[:, j] for j in range(self._joints)]
            one = rough_balance(log.force[:, k], log.position[:, k], log.period, rotary=True, others=others)
            rough.append(one)
        frictions = [
            Section("[[effects]]", {"kind": kind, key: {"guess": [_positive(r, name) for r in rough]}})
            for kind, key, name in (
                ("viscous_friction", "coefficient", "viscous"),
                ("coulomb_friction", "level", "coulomb"),
            )
        ]
        return [plant, *frictions, table, *self._sensor(log)]

    def without_force(self) -> list[Section]:
        """Return the case of a free swing, whose weight is the only force."""
        chosen, measures = self._chosen, self._measures
        swing = None
        if self._joints == 1 and chosen.position and not chosen.reference and measures.motion == "rotary":
            time, position, _ = self._by_hand()
            swing = free_swing(position, float(np.median(np.diff(time))))
        if swing is None:
            raise InputError(_no_force(chosen), where=self._raw.source, hint=_NO_FORCE_HINT)
        return [*self._swing(swing), self._log_table()]

    def finished(self, sections: Sequence[Section]) -> FirstCase:
        """Return the case, after it was loaded once."""
        title = [
            f"Case of {Path(self._raw.source).name}, written by `jaxid init`.",
            "Lines that begin with `assumed` say what the log seemed to show, lines that begin with `question` "
            "what only you know. Neither stops a command.",
        ]
        text = case_text(title, sections)
        assumed = tuple(line for section in sections for line in section.assumed)
        questions = tuple(line for section in sections for line in section.questions)
        first = FirstCase(text, self._folder, self._raw.source, assumed, questions)
        tables = first.tables
        if "urdf" in tables["plant"]:
            tables["plant"]["urdf"] = str(self._folder / tables["plant"]["urdf"])
        try:
            load_case(tables)
        except InputError as error:
            if self._chosen.force and self._chosen.position:
                raise
            what = "no force" if not self._chosen.force else "no position"
            raise InputError(
                f"the log has {what}, which this version does not fit ({error})",
                where=self._raw.source,
                hint=_NO_FORCE_HINT if not self._chosen.force else "log the position as well",
            ) from error
        return first

    # the tables

    def _log_table(self, joints: Sequence[str] = ()) -> Section:
        """Return the table [log], with lines on columns and units."""
        chosen, measures = self._chosen, self._measures
        section = Section("[log]")
        steady = chosen.time is None and not chosen.position and bool(chosen.force)
        if steady:
            section.keys["kind"] = "steady"
            section.assumed.append(
                "a table of steady speeds against the force: it has no time and no position"
            )
        elif chosen.time is not None:
            section.keys["time"] = chosen.time.name
        else:
            section.keys["sample_rate"] = NO_TIME_RATE
        for quantity in ("position", "velocity", "force", "reference"):
            names = [c.name for c in getattr(chosen, quantity)]
            if quantity == "velocity" and chosen.position and not self._velocity_counts():
                continue
            if names and joints:
                section.keys[quantity] = dict(zip(joints, names, strict=True))
            elif names:
                section.keys[quantity] = names[0] if len(names) == 1 else names
        if measures.units:
            section.keys["units"] = {q: u for q, u in measures.units.items() if q in section.keys}
        if not section.keys.get("units", True):
            del section.keys["units"]
        if measures.unwrap:
            section.keys["unwrap"] = measures.unwrap
        if self._raw.contents.episodes > 1:
            section.keys["episode"] = 0
            section.questions.append(
                f"which of the {self._raw.contents.episodes} episodes? The first is taken"
            )
        lines = [line for line in chosen.said if not (steady and "no time" in line)]
        section.assumed += [*lines, *measures.said]
        asked = {**chosen.questions, **{q: t for q, t in measures.questions.items() if q not in ("force",)}}
        section.questions += [t for q, t in asked.items() if not (steady and q == "time")]
        if chosen.reference:
            section.offers.append(
                '[controller] with its law (docs/case_file.md, "Control laws") lets jaxid simulate the closed loop'
            )
        return section

    def _velocity_counts(self) -> bool:
        """Whether the logged velocity has a known unit."""
        return "position" not in self._measures.labels and not any(
            "passed over" in line and f"'{self._chosen.velocity[0].name}'" in line
            for line in self._measures.said
        )

    def _units(self) -> Units:
        labels = self._measures.labels
        return Units(self._measures.motion, labels.get("position"), labels.get("force"))

    def _plant(self, rough: RoughBalance) -> list[Section]:
        """Return [plant] of an axis, or of a pendulum if the log shows a weight that turns."""
        measures, units = self._measures, self._units()
        inertia = {"guess": rounded(rough.inertia)}
        if rough.weight is not None:
            x, y = (rounded(w / _GRAVITY, 3) for w in rough.weight)
            plant = _pendulum([{"guess": x}, {"guess": y}, 0.0], inertia, [_GRAVITY, 0.0, 0.0])
            plant[0].assumed.append(
                "a force as of a weight that turns with the joint: mass times distance of its centre is unknown"
            )
            self._label(plant[0])
            return plant
        plant = Section("[plant]", {"kind": "axis", "motion": measures.motion})
        self._label(plant)
        if rough.has_offset and measures.motion == "linear":
            plant.questions.append('is the axis vertical? Then orientation = "vertical"')
        values = Section("[plant.parameters]", {"inertia": inertia}, {"inertia": units.label("inertia")})
        values.assumed.append(
            f"guesses are those of a rough least-squares fit, which explains {100 * rough.explained:.0f} % of the force"
        )
        return [plant, values]

    def _label(self, plant: Section) -> None:
        """Add labels of quantities that are not mechanical, with the question that replaces them."""
        if self._measures.labels:
            plant.keys["units"] = self._measures.labels
            plant.notes["units"] = "labels of results; nothing is converted"
        if "force" in self._measures.questions:
            plant.questions.append(self._measures.questions["force"])

    def _effects(self, rough: RoughBalance) -> list[Section]:
        """Return friction, and what else the rough fit found."""
        units = self._units()

        def effect(kind: str, key: str, value: float, dimension: str) -> Section:
            return Section(
                "[[effects]]", {"kind": kind, key: {"guess": rounded(value)}}, {key: units.label(dimension)}
            )

        out = [
            effect("viscous_friction", "coefficient", _positive(rough, "viscous"), "force*time/position"),
            effect("coulomb_friction", "level", _positive(rough, "coulomb"), "force"),
        ]
        if rough.spring is not None:
            out.append(effect("linear_stiffness", "coefficient", rough.spring, "force/position"))
            out[-1].assumed.append("the force grows with the position, as of a spring")
        if rough.has_offset:
            out.append(effect("constant_force", "level", -rough.offset, "force"))
            out[-1].assumed.append("a large part of the force is constant: a weight, or an offset")
        return out

    def _swing(self, swing: FreeSwing) -> list[Section]:
        """Return a pendulum that swings freely: its weight is known, or every value has that factor."""
        weight = _MOMENT * _GRAVITY
        down = [rounded(_GRAVITY * np.cos(swing.rest), 6), rounded(_GRAVITY * np.sin(swing.rest), 6), 0.0]
        plant = _pendulum([_MOMENT, 0.0, 0.0], {"guess": rounded(swing.inertia * weight)}, down)
        plant[0].assumed.append("no force is logged, and the joint swings freely: its weight moves it")
        plant[0].assumed.append(f"it hangs at rest at {swing.rest:.4g} rad")
        plant[1].assumed.append(f"mass times distance of the centre is {_MOMENT:g} kg m")
        plant[1].questions.append(
            "how much is mass times distance of the centre [kg m]? All results grow with first_moment"
        )
        frictions = [
            Section("[[effects]]", {"kind": kind, key: {"guess": rounded(max(value, 1e-4) * weight)}})
            for kind, key, value in (
                ("viscous_friction", "coefficient", swing.viscous),
                ("coulomb_friction", "level", swing.coulomb),
            )
        ]
        return [*plant, *frictions]

    def _sensor(self, log: Log | None) -> list[Section]:
        """Return [sensor]: counts of the encoders, and the noise beyond them."""
        if log is None:
            return []
        section = Section("[sensor]")
        noise = np.atleast_1d(np.asarray(high_band_std(log.position)))
        counts = [self._count(column) for column in self._chosen.position]
        unit = self._units().label("position")
        if all(counts):
            beyond = [
                rounded(float(np.sqrt(max(s**2 - c**2 / 12, 0.0))))
                for s, c in zip(noise, counts, strict=True)
            ]
            noisy = any(s**2 > _BEYOND_ROUNDING * c**2 / 12 for s, c in zip(noise, counts, strict=True))
            section.keys["position_resolution"] = _one([rounded(c, 6) for c in counts])
            section.notes["position_resolution"] = f"{unit}, the step between the positions of the log"
            if noisy:
                section.keys["position_noise"] = _one(beyond)
                section.notes["position_noise"] = f"{unit}, beyond the rounding, from its highest frequencies"
        else:
            shown = ", ".join(f"{s:.2g}" for s in noise)
            section.offers.append(
                f"position_noise: every command estimates it from the log; here {shown} {unit}"
            )
        return [section] if section.keys else []

    def _count(self, column: Column) -> float:
        """Return the step between the positions of a column, in the unit of results; 0 if there is none."""
        step = position_levels(column.values)[1]
        unit = self._measures.units.get("position")
        found = None if unit is None else parse_unit(unit)
        return step * (1.0 if found is None else found.factor)

    # reading

    def _read(self, table: Section) -> Log:
        """Read the log as the case will."""
        columns = {
            key: list(value.values()) if isinstance(value, dict) and key != "units" else value
            for key, value in table.keys.items()
        }
        frame = Frame(
            motions=(self._measures.motion,) * self._joints,
            driven=tuple(range(self._joints)),
            labels=self._measures.labels,
        )
        log = as_log(self._log, columns, joints=self._joints, drives=self._joints, frame=frame)
        table.assumed += [str(a) for a in log.assumed if not a.setting.startswith("units.")]
        return log

    def _by_hand(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return time, position or velocity, and force (zero if there is none), at even steps in SI units."""
        chosen, measures = self._chosen, self._measures

        def scaled(column: Column, quantity: str) -> np.ndarray:
            unit = parse_unit(measures.units.get(quantity, ""))
            return column.values * (1.0 if unit is None else unit.factor)

        motion = scaled(
            (chosen.position or chosen.velocity)[0], "position" if chosen.position else "velocity"
        )
        force = scaled(chosen.force[0], "force") if chosen.force else np.zeros_like(motion)
        if chosen.time is None:
            return np.arange(motion.size) / NO_TIME_RATE, motion, force
        time = scaled(chosen.time, "time")
        even = np.linspace(time[0], time[-1], time.size)
        return even, np.interp(even, time, motion), np.interp(even, time, force)


def _driven(rough: RoughBalance) -> tuple[RoughBalance, bool]:
    """Return the balance with the force turned if it brakes as logged, and whether it was."""
    if not rough.braked:
        return _plausible(rough), False
    weight = None if rough.weight is None else (-rough.weight[0], -rough.weight[1])
    turned = replace(
        rough,
        inertia=-rough.inertia,
        viscous=-rough.viscous,
        coulomb=-rough.coulomb,
        offset=-rough.offset,
        weight=weight,
        spring=None if rough.spring is None else -rough.spring,
    )
    return _plausible(turned), True


def _plausible(rough: RoughBalance) -> RoughBalance:
    """Return the balance with an inertia above zero."""
    if rough.inertia > 0:
        return rough
    size = rough.force / rough.speed if rough.speed > 0 else 1.0
    return replace(rough, inertia=max(0.01 * size, 1e-9))


def _positive(rough: RoughBalance, name: str) -> float:
    """Return a friction of a rough balance, at least a small part of the force."""
    least = _LEAST * (rough.force or 1.0)
    if name == "viscous":
        least /= rough.speed or 1.0
    return rounded(max(getattr(rough, name), least))


def _pendulum(first_moment: list[Any], inertia: dict[str, float], gravity: list[float]) -> list[Section]:
    """Return the tables of one link that turns about a horizontal axis."""
    plant = Section("[plant]", {"kind": "serial_arm", "gravity_vector": gravity})
    plant.notes["gravity_vector"] = "in the plane of the swing"
    link = Section(
        "[[plant.links]]",
        {
            "joint": "revolute",
            "alpha_deg": 0.0,
            "a": 0.0,
            "mass": 0.0,
            "first_moment": first_moment,
            "inertia": [0.0, 0.0, 0.0, 0.0, 0.0, inertia],
        },
        {"first_moment": "mass times centre [kg m]", "inertia": "about the joint [kg m^2]"},
    )
    return [plant, link]


def _one(values: list[float]) -> Any:
    return values[0] if len(set(values)) == 1 else values


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
