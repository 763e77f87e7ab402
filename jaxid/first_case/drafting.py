"""The tables of a first case, from the columns of its log and a rough fit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.case.robot import Robot
from jaxid.errors import InputError
from jaxid.first_case.balance import FreeSwing, RoughBalance, free_swing, rough_balance
from jaxid.first_case.columns import NO_TIME_RATE, Chosen, Column
from jaxid.first_case.joints import lacking_force
from jaxid.first_case.raw import RawLog
from jaxid.first_case.section import Section, rounded
from jaxid.first_case.servo import BANDWIDTH, loop_of_servos, servos_of
from jaxid.first_case.units import Measures
from jaxid.logs.in_memory import LogLike, as_log
from jaxid.logs.log import Log
from jaxid.logs.soundness import position_levels
from jaxid.logs.units import Frame
from jaxid.model.units import Units
from jaxid.numerics.filters import high_band_std
from jaxid.settings import Actuator

_GRAVITY = 9.81
# Mass times distance of a swing that nothing states [kg m].
_MOMENT = 0.1
# Smallest guesses over the size of the force: friction is positive.
_LEAST = 0.01
# Keys of [log] that are tables by quantity, and not by joint.
_BY_QUANTITY = ("units", "sign", "offset")
# Noise beyond that of the rounding, as a variance over it, from which it is stated.
_BEYOND_ROUNDING = 1.5


class Draft:
    """The sections of one case, as they are written."""

    def __init__(self, log: LogLike, raw: RawLog, chosen: Chosen, measures: Measures, folder: Path):
        self._log, self._raw, self._chosen, self._measures = log, raw, chosen, measures
        self._folder = folder
        self._joints = len(chosen.position or chosen.velocity)
        self._motions = (measures.motion,) * self._joints

    @property
    def unit_of_force(self) -> str:
        """Unit of the forces where they are currents, or per cent of the drives' rating; otherwise empty."""
        unit = self._measures.labels.get("force", "") if self._chosen.force else ""
        return unit if unit in ("A", "%") else ""

    @property
    def driven(self) -> tuple[int, ...]:
        """Joints with a drive, 0-based, in the order of the forces."""
        return tuple(range(self._joints)) if self._chosen.driven is None else self._chosen.driven

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
        rough = driven_balance(rough, table)
        plant, effects = self._plant(rough), self._effects(rough)
        return [*plant, *effects, table, *self._sensor(log)]

    def tree(
        self, robot: Robot, path: Path, key: str, names: Sequence[str], unknown: Sequence[str]
    ) -> list[Section]:
        """Return the case of a robot's file: its joints that the log has, their friction and its servos.

        Args:
            robot: The robot.
            path: Its file.
            key: "mjcf" or "urdf".
            names: Names of the joints that the log has.
            unknown: Words for the values that are unknown.

        Raises:
            InputError: If the log has neither the forces nor the commands of all joints, or no forces where
                some joints of the file have position servos and others none; or its positions are counts.
        """
        measures, chosen = self._measures, self._chosen
        plant = Section("[plant]", {"kind": "tree", key: _relative(path, self._folder)})
        if len(names) < len(robot.free):
            plant.keys["joints"] = list(names)
        self._need_angles(robot)
        served = servos_of(robot, names)
        if not chosen.force:
            self._need_commands(robot, names, served)
        followed = not chosen.force and bool(served)
        if chosen.driven is not None and not robot.drives:
            plant.keys["actuated"] = [names[k] for k in chosen.driven]
        plant.keys["unknown"] = [*unknown]
        plant.notes["unknown"] = "the values of the file that are unknown, from the file's on"
        if measures.labels:
            plant.keys["units"] = measures.labels
            plant.questions += [measures.questions[q] for q in ("force",) if q in measures.questions]
        plant.questions.append(
            'which values of the file are right? Take them out of unknown; "none": all are'
        )

        if followed:
            plant.assumed.append("no force is logged: the file's position servos follow the reference")
        elif not chosen.force:
            plant.assumed.append("no force is logged: a position loop is taken to move each joint")
            if robot.drives:
                plant.keys["actuators"] = False
                plant.assumed.append("the file's actuators are left out, with their limits")
        elif robot.drives and chosen.force[0].meaning.quantity in ("torque", "force", "current"):
            if any(drive.gain != 1.0 or drive.drag or drive.limit for drive in robot.drives):
                plant.keys["actuators"] = False
                plant.assumed.append("the forces are those of the joints, behind the file's actuators")
        if key == "urdf":
            plant.questions.append(
                "does gravity act along -z of the first link? Else gravity_vector = [x, y, z] in m/s^2"
            )

        table = self._log_table(names)
        if followed:
            # Between two rows of a log a servo keeps the command that it was sent last.
            table.keys["reference_hold"] = "zero_order"
            table.assumed.append("each command holds until the next one")
        motions = {joint.name: "rotary" if joint.motion == "revolute" else "linear" for joint in robot.joints}
        self._motions = tuple(motions[name] for name in names)
        log = self._read(table)
        return [plant, table, *(self._sensor_of_servos(log) if followed else self._sensor(log))]

    def _need_angles(self, robot: Robot) -> None:
        """Refuse positions in a unit of which nothing says the size: the links of a file need angles."""
        unit = self._measures.labels.get("position")
        if unit is not None:
            name = (self._chosen.position or self._chosen.velocity)[0].name
            raise InputError(
                f"'{name}' is in {unit}, and the links of {robot.file} need rad or m",
                where=self._raw.source,
                hint="convert the column to deg, and name it so, as q1_deg; or write the case by hand with "
                "counts_per_revolution in [log]",
            )

    def _need_commands(self, robot: Robot, names: Sequence[str], served: Sequence[str]) -> None:
        """Refuse a log without forces that has no command for each joint, or servos in the file for some."""
        chosen, where = self._chosen, self._raw.source
        if not chosen.position:
            what = "the log has neither forces nor positions"
            raise InputError(what, where=where, hint="log the position of each joint")
        if not chosen.reference or (chosen.loose_forces and not served):
            raise lacking_force(chosen, where, of_robot=True)
        if served and len(served) < len(names):
            without = ", ".join(f"'{name}'" for name in names if name not in served)
            raise InputError(
                f"the log has no force, and {robot.file} has no position servo at {without}",
                where=where,
                hint="log the forces, or take the position servos out of the file: each loop is then unknown",
            )

    def without_force(self) -> list[Section]:
        """Return the case of a servo that follows its reference, or of a free swing under its weight."""
        chosen, measures = self._chosen, self._measures
        if self._joints == 1 and chosen.position and chosen.reference:
            return self._servo()
        swing = None
        if self._joints == 1 and chosen.position and not chosen.reference and measures.motion == "rotary":
            time, position, _ = self._by_hand()
            swing = free_swing(position, float(np.median(np.diff(time))))
        if swing is None:
            raise lacking_force(chosen, self._raw.source)
        return [*self._swing(swing), self._log_table()]

    def _servo(self) -> list[Section]:
        """Return the case of a joint under a position loop, of which only command and position are logged.

        The guesses are those of a loop of 5 Hz about an inertia that is known, because nothing else in such a
        log has an absolute scale.
        """
        units, rotary = self._units(), self._measures.motion == "rotary"
        inertia, rate = (0.01 if rotary else 1.0), 2 * np.pi * BANDWIDTH
        stroke = float(np.ptp(self._by_hand()[1]))
        table = self._log_table()
        log = self._read(table)
        plant = Section("[plant]", {"kind": "axis", "motion": self._measures.motion})
        plant.assumed.append("no force is logged: a position loop is taken to follow the reference")
        self._label(plant)
        values = Section("[plant.parameters]", {"inertia": inertia}, {"inertia": units.label("inertia")})
        values.questions.append(
            "how large is the inertia that the joint moves? All forces and gains are in proportion to it"
        )

        def effect(kind: str, key: str, value: float, dimension: str) -> Section:
            keys = {"kind": kind, key: {"guess": rounded(value)}}
            return Section("[[effects]]", keys, {key: units.label(dimension)})

        # The distance from the reference is known to some per cent of the stroke.
        constant = []
        if self._measures.offset:
            constant = [effect("constant_force", "level", 0.01 * inertia * rate**2 * stroke, "force")]
        return [
            plant,
            values,
            effect("viscous_friction", "coefficient", 0.3 * inertia * rate, "force*time/position"),
            effect("coulomb_friction", "level", 0.01 * inertia * rate**2 * stroke, "force"),
            *constant,
            loop_of_servos([inertia], log.period),
            table,
            *self._sensor(log),
        ]

    # the tables

    def _log_table(self, joints: Sequence[str] = ()) -> Section:
        """Return the table [log], with lines on columns and units."""
        chosen, measures = self._chosen, self._measures
        section = Section("[log]")
        steady = chosen.time is None and not chosen.position and bool(chosen.force)
        if steady:
            section.keys["kind"] = "steady"
            section.assumed.append("a table of steady speeds and forces: it has no time and no position")
        elif chosen.time is not None:
            section.keys["time"] = chosen.time.name
        else:
            section.keys["sample_rate"] = NO_TIME_RATE

        for quantity in ("position", "velocity", "force", "reference"):
            names = [c.name for c in getattr(chosen, quantity)]
            if quantity == "velocity" and chosen.position and not self._velocity_counts():
                continue
            if names and len(names) == len(joints):
                section.keys[quantity] = dict(zip(joints, names, strict=True))
            elif names:
                section.keys[quantity] = names[0] if len(names) == 1 else names

        if measures.units:
            section.keys["units"] = {q: u for q, u in measures.units.items() if q in section.keys}
        if not section.keys.get("units", True):
            del section.keys["units"]
        if measures.sign:
            section.keys["sign"] = dict(measures.sign)
        if measures.offset:
            section.keys["offset"] = dict(measures.offset)
        if measures.unwrap:
            section.keys["unwrap"] = measures.unwrap
        if measures.counts is not None:
            section.keys["counts_per_revolution"] = measures.counts
        if self._raw.contents.episodes > 1:
            section.keys["episode"] = 0
            section.questions.append(
                f"which of the {self._raw.contents.episodes} episodes? The first is taken"
            )

        lines = [line for line in chosen.said if not (steady and "no time" in line)]
        section.assumed += [*lines, *measures.said]
        asked = {**chosen.questions, **{q: t for q, t in measures.questions.items() if q not in ("force",)}}
        section.questions += [t for q, t in asked.items() if not (steady and q == "time")]
        if chosen.reference and chosen.force:
            section.offers.append(
                "[controller] with the law of the loop (docs/case_file.md) makes simulations closed-loop"
            )
        return section

    def _velocity_counts(self) -> bool:
        """Check whether the logged velocity has a known unit."""
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
            plant = _pendulum([{"guess": x}, {"guess": y}, 0.0], inertia, [_GRAVITY, 0.0, 0.0], units)
            plant[0].assumed.append(
                "the force has a part as of a weight that turns with the joint: first_moment"
            )
            self._label(plant[0])
            return plant
        plant = Section("[plant]", {"kind": "axis", "motion": measures.motion})
        self._label(plant)
        if rough.has_offset and measures.motion == "linear":
            plant.questions.append('is the axis vertical? Then orientation = "vertical"')
        values = Section("[plant.parameters]", {"inertia": inertia}, {"inertia": units.label("inertia")})
        # Rounded down: 100 % would say that nothing is missing.
        percent = np.floor(1000 * rough.explained) / 10
        values.assumed.append(
            f"guesses are those of a rough fit: it explains {percent:g} % of the variance of the force"
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

        viscous, coulomb = (positive_friction(rough, name) for name in ("viscous", "coulomb"))
        out = [
            effect("viscous_friction", "coefficient", viscous, "force*time/position"),
            effect("coulomb_friction", "level", coulomb, "force"),
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
        inertia = {"guess": rounded(swing.inertia * weight)}
        plant = _pendulum([_MOMENT, 0.0, 0.0], inertia, down, self._units())
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
        if log is None or log.resampled or not self._chosen.position:
            # Resampled positions lie on no steps, and their noise is another one.
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
        return [section] if section.keys else []

    def _sensor_of_servos(self, log: Log) -> list[Section]:
        """Return [sensor] for servos of a robot's file, which read their joints exactly, as in MuJoCo."""
        if log.resampled or not self._chosen.position:
            return []
        counts = np.array([self._count(column) for column in self._chosen.position])
        noise = np.maximum(np.atleast_1d(high_band_std(log.position)), counts / np.sqrt(12))
        if not np.all(noise > 0):
            return []
        unit = self._units().label("position")
        said = f"{unit}, counts included: the servos of the file read their joints exactly"
        values = _one([rounded(float(x)) for x in noise])
        return [Section("[sensor]", {"position_noise": values}, {"position_noise": said})]

    def _count(self, column: Column) -> float:
        """Return the step between the positions of a column, in the unit of results; 0 if there is none."""
        step = position_levels(column.values)[1]
        return step * self._factor("position")

    def _factor(self, quantity: str) -> float:
        """Return the size of one unit of a column, in the unit of results."""
        return self._measures.size(quantity)

    # reading

    def _read(self, table: Section, drive: Section | None = None) -> Log:
        """Read the log as the case will, with the ratio of a gear if there is one."""
        columns = {
            key: list(value.values()) if isinstance(value, dict) and key not in _BY_QUANTITY else value
            for key, value in table.keys.items()
        }
        driven = self.driven
        frame = Frame(
            motions=self._motions,
            driven=driven,
            labels=self._measures.labels,
            actuator=Actuator() if drive is None else Actuator(**drive.keys),
        )
        if self._empty():
            # A text table has such readings by itself; in other formats the case must say so.
            columns["resample"] = table.keys["resample"] = rounded(self._rate(), 6)
            table.assumed.append("values that are NaN are no readings: resampled at the rate of the log")
        log = as_log(self._log, columns, joints=self._joints, drives=len(driven), frame=frame)
        table.assumed += [str(a) for a in log.assumed if not a.setting.startswith("units.")]
        return log

    def _empty(self) -> bool:
        """Check for values that are NaN in a log whose format has no empty cells."""
        chosen = self._chosen
        load = [] if chosen.load is None else [chosen.load]
        used = [*chosen.position, *load, *chosen.velocity, *chosen.force, *chosen.reference]
        nan = any(np.isnan(self._raw.data[c.name]).any() for c in used)
        return nan and not self._raw.sparse and chosen.time is not None

    def _rate(self) -> float:
        """Return the usual rate of the log [Hz]."""
        assert self._chosen.time is not None, "the caller has seen it"
        steps = np.diff(self._chosen.time.values)
        return 1.0 / (float(np.median(steps[steps > 0])) * self._factor("time"))

    def _by_hand(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return time, position or velocity, and force (zero if there is none), at even steps in SI units."""
        chosen = self._chosen

        def scaled(column: Column, quantity: str) -> np.ndarray:
            return column.values * self._factor(quantity)

        motion = scaled(
            (chosen.position or chosen.velocity)[0], "position" if chosen.position else "velocity"
        )
        force = scaled(chosen.force[0], "force") if chosen.force else np.zeros_like(motion)
        if chosen.time is None:
            return np.arange(motion.size) / NO_TIME_RATE, motion, force
        time = scaled(chosen.time, "time")
        even = np.linspace(time[0], time[-1], time.size)
        return even, np.interp(even, time, motion), np.interp(even, time, force)


def driven_balance(rough: RoughBalance, table: Section) -> RoughBalance:
    """Return the balance with the force turned if it brakes as logged, and say so in the table of the log."""
    if not rough.braked:
        return _plausible(rough)
    table.keys["sign"] = {**table.keys.get("sign", {}), "force": -1}
    table.assumed.append("the force as logged brakes the motion: its sign is turned")
    table.questions.append("is a positive force one that drives a positive velocity?")
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
    return _plausible(turned)


def _plausible(rough: RoughBalance) -> RoughBalance:
    """Return the balance with an inertia above zero."""
    if rough.inertia > 0:
        return rough
    size = rough.force / rough.speed if rough.speed > 0 else 1.0
    return replace(rough, inertia=max(0.01 * size, 1e-9))


def positive_friction(rough: RoughBalance, name: str) -> float:
    """Return a friction of a rough balance, at least a small part of the force."""
    least = _LEAST * (rough.force or 1.0)
    if name == "viscous":
        least /= rough.speed or 1.0
    return rounded(max(getattr(rough, name), least))


def _pendulum(
    first_moment: list[Any], inertia: dict[str, float], gravity: list[float], units: Units
) -> list[Section]:
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
        {
            "first_moment": f"mass times centre [{units.label('moment')}]",
            "inertia": f"about the joint [{units.label('inertia', 'rotary')}]",
        },
    )
    return [plant, link]


def _one(values: list[float]) -> Any:
    return values[0] if len(set(values)) == 1 else values


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
