"""Units and zero of a position that is not that of its reference: in front of a gear, or in counts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from jaxid.first_case.columns import Chosen
from jaxid.first_case.section import near_whole, rounded
from jaxid.first_case.units import SI, Measures
from jaxid.logs.rough_inertia import Strokes, correlation, ratio_of_strokes
from jaxid.logs.units import fits, parse_unit, size_of

# Correlation from which a position follows its reference, and the part of its variance that may be left.
_ALIKE, _FOLLOWED = 0.9, 0.05
# Ratio of two strokes that counts as one: a loop with a weight or low gains does not reach its reference.
_SAME = 1.5
# Part of the stroke of a reference from which its distance from the position counts as one of two zeros.
_APART = 0.05
# Within so much of a whole number a ratio is that. Dry friction moves a ratio by some 1 %: so near to a power
# of two are the counts of a turn, and twice that near to the ratio of two units are these.
_WHOLE, _POWER, _NEAR = 5e-4, 0.01, 0.02
# Units of position and reference that the ratio of their strokes shows, where no column states one.
_PAIRS = {
    "rotary": (
        ("deg", "rad"),
        ("rad", "deg"),
        ("rad", "rev"),
        ("rev", "rad"),
        ("deg", "rev"),
        ("rev", "deg"),
    ),
    "linear": (("mm", "m"), ("m", "mm"), ("um", "m"), ("m", "um")),
}


@dataclass
class _Changes:
    """Changes of the units of a log, with the lines that say them.

    Attributes:
        motion: "linear" or "rotary".
        units: New units, by quantity.
        said, questions: New lines, see `Measures`.
        settled: Beginnings of older lines, and quantities of older questions, that no longer hold.
        counts: Counts of a turn; None: positions are not brought from counts to an angle.
        sign: Signs that are turned, by quantity.
    """

    motion: str
    units: dict[str, str] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    questions: dict[str, str] = field(default_factory=dict)
    settled: list[str] = field(default_factory=list)
    counts: int | None = None
    sign: dict[str, int] = field(default_factory=dict)

    def on(self, measures: Measures) -> Measures:
        """Return measures with these changes."""
        old = tuple(self.settled)
        said = [line for line in measures.said if not old or not line.startswith(old)]
        questions = {q: text for q, text in measures.questions.items() if q not in self.settled}
        return replace(
            measures,
            motion=self.motion,
            units={**measures.units, **self.units},
            labels={q: label for q, label in measures.labels.items() if q not in self.units},
            said=(*said, *self.said),
            questions={**questions, **self.questions},
            counts=self.counts,
            sign=self.sign,
        )


def beside_reference(chosen: Chosen, measures: Measures) -> Measures:
    """Return the units of a joint, changed where its position moves otherwise than its reference.

    Without a force the position is brought to the joint, where the reference is. Beside a force the reference
    is brought to the position.

    Args:
        chosen: The columns.
        measures: Their units, as names and values show.
    """
    counted = "position" in measures.labels
    if len(chosen.position) != 1 or len(chosen.reference) != 1 or (counted and chosen.force):
        return measures
    if measures.counts is not None or measures.unwrap or _of_other_kinds(measures):
        return measures
    position, reference = chosen.position[0].values, chosen.reference[0].values
    alike, strokes = correlation(position, reference), ratio_of_strokes(position, reference)
    if abs(alike) < _ALIKE or strokes.left > _FOLLOWED or strokes.ratio * alike <= 0:
        return measures

    changes = _Changes(measures.motion)
    ratio = strokes.ratio * measures.size("position") / size_of(_unit_of_reference(chosen, measures))
    if ratio < 0:
        _turned(chosen, changes)
    if not 1 / _SAME < abs(ratio) < _SAME:
        if counted:
            _of_counts(chosen, measures, abs(ratio), changes)
        elif not _of_two_units(chosen, measures, abs(ratio), changes):
            _of_gear(chosen, measures, abs(ratio), changes)
    changed = changes.on(measures)
    if chosen.force or "position" in changed.labels:
        return changed
    return _with_zero(chosen, changed, strokes)


def _of_other_kinds(measures: Measures) -> bool:
    """Check whether one of position and reference is an angle and the other one a length."""
    units = [parse_unit(measures.units.get(quantity, "")) for quantity in ("position", "reference")]
    return {"angle", "length"} == {unit.kind for unit in units if unit is not None}


def _unit_of_reference(chosen: Chosen, measures: Measures) -> str:
    """Return the unit of the reference; that in SI units if nothing states it."""
    own = chosen.reference[0].unit
    stated = own if fits(parse_unit(own), "position") else ""
    return measures.units.get("reference", "") or stated or SI[measures.motion]


def _turned(chosen: Chosen, changes: _Changes) -> None:
    """Turn the sign of a reference against which the position moves."""
    position, reference = chosen.position[0].name, chosen.reference[0].name
    changes.sign["reference"] = -1
    changes.said.append(f"'{position}' moves against '{reference}': the sign of the reference is turned")
    changes.questions["sign"] = f"do '{position}' and '{reference}' count in opposite directions?"


def _of_counts(chosen: Chosen, measures: Measures, ratio: float, changes: _Changes) -> None:
    """Bring counts of an encoder to the unit of the reference."""
    reference, wanted = chosen.reference[0].name, _unit_of_reference(chosen, measures)
    unit = parse_unit(wanted)
    changes.motion = "linear" if unit is not None and unit.kind == "length" else "rotary"
    si = SI[changes.motion]
    changes.settled.append("positions are whole numbers")
    changes.said.append(f"positions are encoder counts, {ratio:.5g} for one {si} of '{reference}'")
    if changes.motion == "linear":
        changes.units["position"] = f"{rounded(1 / ratio, 5):g} m"
        changes.questions["position"] = "is this the size of a count?"
    else:
        turn = 2 * np.pi * ratio
        power = 2.0 ** round(np.log2(turn))
        changes.counts = round(power if abs(turn / power - 1) < _POWER else turn)
        changes.units["position"] = "count"
        changes.questions["position"] = (
            f"is a turn of the joint {changes.counts} counts? Else counts_per_revolution"
        )
    if chosen.velocity:
        changes.said.append(f"'{chosen.velocity[0].name}' is passed over: nothing states its unit")
    # Without a unit it would have that of the position.
    changes.units["reference"] = wanted


def _of_two_units(chosen: Chosen, measures: Measures, ratio: float, changes: _Changes) -> bool:
    """State two units of which the ratio is that of the strokes; return whether there are two.

    No column may state a unit. Where the motion was guessed by its size, the units decide it.
    """
    if chosen.position[0].unit or chosen.reference[0].unit or "position" in measures.units:
        return False
    guessed = "motion" in measures.questions
    motions = ("rotary", "linear") if guessed else (measures.motion,)
    found = [
        (motion, of, to)
        for motion in motions
        for of, to in _PAIRS[motion]
        if abs(ratio * size_of(of) / size_of(to) - 1) < _NEAR
    ]
    if not found:
        return False
    changes.motion, *units = found[0]
    changes.units |= dict(zip(("position", "reference"), units, strict=True))
    if chosen.velocity:
        changes.units["velocity"] = measures.units.get("velocity", f"{units[0]}/s")
    changes.settled += ["the position is taken to be", "the motion is", "motion"]
    changes.said.append(
        f"'{chosen.position[0].name}' is in {units[0]} and '{chosen.reference[0].name}' in {units[1]}, "
        f"by the ratio of their strokes, {ratio:.4g}"
    )
    changes.questions["position"] = f"is the position in {units[0]}, and the reference in {units[1]}?"
    return True


def _of_gear(chosen: Chosen, measures: Measures, ratio: float, changes: _Changes) -> None:
    """Bring position and reference to one place where a gear is between them."""
    position, reference = chosen.position[0].name, chosen.reference[0].name
    si, ratio = SI[measures.motion], near_whole(ratio, _WHOLE)
    at_motor = position if ratio > 1 else reference
    changes.said.append(
        f"'{position}' moves about {ratio:.4g} times as far as '{reference}': a gear is taken to be between "
        f"them, with '{at_motor}' on the side of the motor"
    )
    changes.questions["position"] = (
        f"is {ratio:g} the ratio of the gear between '{position}' and '{reference}'? Or are their units not "
        "those in [log]?"
    )
    if chosen.force:
        changes.units["reference"] = f"{ratio:g} {_unit_of_reference(chosen, measures)}"
        return
    size = rounded(1 / ratio, 6)
    changes.units["position"] = f"{size:g} {measures.units.get('position', si)}"
    if chosen.velocity:
        changes.units["velocity"] = f"{size:g} {measures.units.get('velocity', f'{si}/s')}"
    # Without a unit it would have that of the position.
    changes.units["reference"] = _unit_of_reference(chosen, measures)


def _with_zero(chosen: Chosen, measures: Measures, strokes: Strokes) -> Measures:
    """Return measures with the zero of a reference moved, if its position follows it at a distance."""
    position, reference = chosen.position[0], chosen.reference[0]
    size = size_of(_unit_of_reference(chosen, measures)) * measures.sign.get("reference", 1)
    wanted = reference.values * size
    # The fit at the mean of the reference, where an error of the ratio does not count.
    mean = strokes.ratio * float(reference.values.mean()) + strokes.offset
    offset = mean * measures.size("position") - float(wanted.mean())
    if abs(offset) < _APART * float(np.ptp(wanted)):
        return measures
    distance = f"{offset:.4g} {SI[measures.motion]}"
    said = f"'{position.name}' lies {distance} from '{reference.name}', whose zero is moved"
    question = (
        f"do '{position.name}' and '{reference.name}' count from different zeros? Else a constant load holds "
        "the joint away, and offset is to be left out"
    )
    return replace(
        measures,
        offset={"reference": rounded(offset, 6)},
        said=(*measures.said, said),
        questions={**measures.questions, "offset": question},
    )
