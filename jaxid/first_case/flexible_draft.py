"""The first case of a motor and a load behind a coupling, of which each has its encoder."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxid.first_case.balance import rough_balance
from jaxid.first_case.columns import Column
from jaxid.first_case.drafting import Draft, driven_balance, positive_friction
from jaxid.first_case.section import Section, near_whole, rounded
from jaxid.first_case.two_encoders import by_screw
from jaxid.first_case.units import kind_of_force
from jaxid.logs.rough_inertia import ratio_of_strokes

# Resonance of a coupling [Hz] and its damping ratio that nothing states.
_RESONANCE, _DAMPED = 20.0, 0.05
# Ratio of the strokes of motor and load from which there is a gear; within so much of a whole one it is that.
_GEARED, _WHOLE = 1.1, 2e-3
# Ratios of two units of one quantity, which a ratio of strokes within so much of them may be.
_UNITS = {
    180.0 / np.pi: "deg beside rad",
    1e3: "mm beside m",
    2 * np.pi: "rad beside turns",
    360.0: "deg beside turns",
}
_NEAR = 5e-3


class FlexibleDraft(Draft):
    """The sections of the case of a joint whose load has an encoder too."""

    @property
    def _load(self) -> Column:
        load = self._chosen.load
        assert load is not None, "the caller has seen it"
        return load

    def axis(self) -> list[Section]:
        """Return the case of motor and load; of the motor alone if the units of the two do not compare.

        The guesses are those of a rigid joint, half of it on each side, with a resonance that is usual.
        """
        if len(self._chosen.position) != 1 or "position" in self._measures.labels or self._measures.unwrap:
            return self._motor_alone()
        chosen, units = self._chosen, self._units()
        table = self._log_table()
        table.keys["load_position"] = self._load.name
        if (unit := self._measures.units.get("load_position")) is not None:
            table.keys["units"] = {**table.keys.get("units", {}), "load_position": unit}
        drive = self._gear(table)
        gain = 1.0 if drive is None else drive.keys["gain"]
        log = self._read(table, drive)
        rotary = self._measures.motion == "rotary"
        rough = rough_balance(gain * log.force[:, 0], log.position[:, 0], log.period, rotary=rotary)
        rough = driven_balance(rough, table)

        half, omega = 0.5 * rough.inertia, 2 * np.pi * _RESONANCE
        stiffness = omega**2 * 0.5 * half
        plant = Section("[plant]", {"kind": "flexible_axis", "motion": self._measures.motion})
        screw = by_screw(chosen.position[0], self._load)
        why = "is a length beside an angle" if screw else "names the load"
        plant.assumed.append(
            f"'{self._load.name}' has the course of '{chosen.position[0].name}' and {why}: it is "
            "the load's encoder, behind a coupling that gives"
        )
        self._label(plant)
        guesses = {
            "motor_inertia": half,
            "load_inertia": half,
            "stiffness": stiffness,
            "damping": 2 * _DAMPED * stiffness / omega,
        }
        keys: dict[str, Any] = {name: {"guess": rounded(value)} for name, value in guesses.items()}
        assert log.load_position is not None, "the table names its column"
        offset = float(np.median(log.load_position[:, 0] - log.position[:, 0]))
        keys["zero_offset"] = {"guess": rounded(offset)}
        labels = {name: units.label("inertia") for name in ("motor_inertia", "load_inertia")}
        labels |= {"stiffness": units.label("force/position"), "damping": units.label("force*time/position")}
        values = Section("[plant.parameters]", keys, labels)
        values.assumed.append(
            f"guesses are those of a rigid joint, halved, and a resonance of {_RESONANCE:g} Hz"
        )

        def both(kind: str, key: str, value: float, dimension: str) -> Section:
            guess = {"guess": rounded(0.5 * value)}
            return Section("[[effects]]", {"kind": kind, key: [guess, guess]}, {key: units.label(dimension)})

        viscous, coulomb = (positive_friction(rough, name) for name in ("viscous", "coulomb"))
        return [
            plant,
            values,
            both("viscous_friction", "coefficient", viscous, "force*time/position"),
            both("coulomb_friction", "level", coulomb, "force"),
            *([drive] if drive is not None else []),
            table,
        ]

    def _gear(self, table: Section) -> Section | None:
        """Return the table of a gear or a screw between two encoders; None if there is none."""
        [motor], load = self._chosen.position, self._load
        slope = ratio_of_strokes(motor.values, load.values).ratio
        slope *= self._factor("position") / self._factor("load_position")
        if slope < 0:
            table.keys["sign"] = {**table.keys.get("sign", {}), "load_position": -1}
            table.assumed.append(f"'{load.name}' moves against '{motor.name}': its sign is turned")
            table.questions.append(f"do '{load.name}' and '{motor.name}' count in opposite directions?")
        slope = abs(slope)
        if by_screw(motor, load):
            return self._screw(slope, table)
        if 1 / _GEARED < slope < _GEARED:
            return None
        ratio = near_whole(slope, _WHOLE)
        drive = Section("[actuator]", {"gear_ratio": ratio})
        drive.assumed.append(f"the motor turns {slope:.6g} times as far as the load")
        drive.questions.append("is this the ratio of the gear?")
        self._of_motor(drive, ratio, table)
        near = next((name for unit, name in _UNITS.items() if abs(slope / unit - 1) < _NEAR), "")
        if near:
            drive.questions.append(f"or are the units of the two positions not the same ({near})?")
        return drive

    def _screw(self, slope: float, table: Section) -> Section:
        """Return the table of a screw, rack or belt that turns an angle into a travel.

        Args:
            slope: Angle of the motor for the travel of the load [rad/m].
            table: The table of the log.
        """
        travel = 1e3 * 2 * np.pi / slope
        lead = rounded(1e-3 * near_whole(travel, _WHOLE), 6)
        drive = Section("[actuator]", {"gear_ratio": 1.0, "lead": lead}, {"lead": "m/rev"})
        drive.assumed.append(f"the load moves {travel:.6g} mm in a turn of the motor")
        drive.questions.append("is this the lead of the screw, or the travel of rack or belt in a turn?")
        drive.questions.append("are the two positions those of one drive, and not of two joints?")
        self._of_motor(drive, 2 * np.pi / lead, table)
        return drive

    def _of_motor(self, drive: Section, ratio: float, table: Section) -> None:
        """State that position and force are the motor's, in front of a gear of a ratio."""
        [motor], reference = self._chosen.position, self._chosen.reference
        table.keys["position_at"] = "motor"
        labelled = "force" in self._measures.labels
        at_load = by_screw(motor, self._load) and kind_of_force(self._chosen.force[0]) == "force"
        drive.keys["gain"] = 1.0 if labelled or at_load else rounded(ratio, 6)
        if not labelled and not at_load:
            drive.questions.append(
                "is the force that of the motor? If it is that behind the gear, gain = 1.0"
            )
        if reference and not by_screw(motor, reference[0]) and self._of_load_side(reference[0], motor, ratio):
            del table.keys["reference"]
            for key in ("units", "sign"):
                stated = table.keys.get(key, {})
                stated.pop("reference", None)
                if not stated:
                    table.keys.pop(key, None)
            table.offers.clear()
            table.assumed.append(f"'{reference[0].name}' is not used: it moves as far as the load")

    def _of_load_side(self, reference: Column, motor: Column, ratio: float) -> bool:
        """Check that a reference moves as far as the load, and not as its motor."""
        stroke = float(np.ptp(reference.values)) * self._factor("reference")
        return stroke < float(np.ptp(motor.values)) * self._factor("position") / np.sqrt(ratio)

    def without_force(self) -> list[Section]:
        """Return the case of a log without a force, which leaves the load's encoder out."""
        sections = super().without_force()
        sections[-1].assumed.append(
            f"'{self._load.name}' is not used: a log without a force has one position for a joint"
        )
        return sections

    def _motor_alone(self) -> list[Section]:
        """Return the case of the motor alone, with what to state for one of both."""
        sections = super().axis()
        table = next(section for section in sections if section.head == "[log]")
        table.questions.append(
            f"'{self._load.name}' seems to be the encoder of a load behind the motor, which this case leaves "
            'out: how large is one count of each? With units = { position = "0.044 deg", load_position = '
            '"0.018 deg" } the case can be one of kind = "flexible_axis" (docs/case_file.md)'
        )
        return sections
