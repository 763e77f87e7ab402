"""The drive chain of a machine in words, from controller to load, with the effects that act on each part."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxid.results.effect_words import CONTROLLER, DRIVE, GEAR, LOAD, words_of
from jaxid.results.report.data import ChainPart, Mark
from jaxid.results.report.numbers import plain

if TYPE_CHECKING:
    from jaxid.machine import Machine
    from jaxid.model.effect import Effect
    from jaxid.model.plant import Plant
    from jaxid.session import Session

# Numbers of places that are listed one by one.
_FEW = 2


def drive_chain(session: Session, machine: Machine) -> tuple[ChainPart, ...]:
    """Return the parts of the drive chain, with the effects of a machine at the parts on which they act.

    Args:
        session: Case and logs; an effect that its machine lacks counts as found.
        machine: The fitted machine.
    """
    declared = len(session.machine.plant.effects)
    marks = _marks(machine.plant, declared)
    parts = {
        CONTROLLER: ("controller", _controller_lines(session, machine)),
        DRIVE: ("drive", _drive_lines(session)),
        GEAR: ("gear or belt", _gear_lines(machine.plant)),
        LOAD: ("load", _load_lines(session)),
    }
    if session.fit.log.steady is not None or (session.fit.log.passive and machine.controller is None):
        del parts[CONTROLLER]
    if session.fit.log.passive and machine.controller is None:
        del parts[DRIVE]
    return tuple(
        ChainPart(name, tuple(lines), tuple(marks.get(part, ()))) for part, (name, lines) in parts.items()
    )


def _controller_lines(session: Session, machine: Machine) -> list[str]:
    controller = session.case.controller
    if controller is None or machine.controller is None:
        return ["not in the case"]
    # The fit may have chosen the period.
    return [controller.kind.replace("_", " "), f"{1 / machine.controller.period:.4g} Hz"]


def _drive_lines(session: Session) -> list[str]:
    machine = session.machine
    gain = np.unique(np.round(machine.gain, 12))
    many = machine.gain.size
    lines = [f"{many} drives"] if many > 1 else []
    if machine.unforced(session.fit.log):
        return lines or ["force not logged"]
    if np.all(gain == 1.0):
        return lines or ["force as logged"]
    unit = machine.unit("force", machine.plant.driven(machine.plant.joints)[0])
    shown = plain(float(gain[0]), 4) if gain.size == 1 else f"{plain(gain[0])} to {plain(gain[-1])}"
    return [*lines, f"{shown} {unit} per unit of the command"]


def _gear_lines(plant: Plant) -> list[str]:
    springs = sum(plant.place(k)[0] == "spring" for k in range(_ports(plant)))
    ratio = getattr(plant, "gear_ratio", None)
    lines = [] if ratio is None else [f"ratio {', '.join(plain(r) for r in np.ravel(np.asarray(ratio)))}"]
    lines += [f"{springs} spring{'s' if springs > 1 else ''}"] if springs else []
    return lines or ["rigid in this model"]


def _ports(plant: Plant) -> int:
    return int(np.size(np.asarray(plant.port_width(np.zeros(plant.joints)))))


def _load_lines(session: Session) -> list[str]:
    joints = session.machine.plant.joints
    kind = session.machine.plant.kind.replace("_", " ")
    lines = [kind if joints == 1 else f"{kind}, {joints} joints"]
    unseen = joints - int(np.sum(session.fit.log.measured))
    return lines + ([f"{unseen} of them without an encoder"] if unseen else [])


def _marks(plant: Plant, declared: int) -> dict[str, list[Mark]]:
    """Return the marks of each part: an effect of one kind at several places is one mark."""
    grouped: dict[tuple[str, str, str, bool], list[str]] = {}
    alone = _ports(plant) == 1
    for number, effect in enumerate(plant.effects):
        word, place = plant.place(effect.port)
        key = (_part(effect, word), effect.kind, word, number >= declared)
        grouped.setdefault(key, []).append("" if alone else f"{word} {place}")
    marks: dict[str, list[Mark]] = {}
    # Found effects come first.
    for (part, kind, _, found), places in sorted(grouped.items(), key=lambda item: not item[0][3]):
        marks.setdefault(part, []).append(Mark(_with_places(kind.replace("_", " "), places), found))
    return marks


def _part(effect: Effect, place: str) -> str:
    if place == "spring":
        return GEAR
    cls = type(effect)
    part = words_of(effect.kind, cls.__doc__ or "", in_drive=effect.in_drive, of_spring=effect.of_spring).part
    # Without springs in the model a stiffness acts on the load.
    return LOAD if part == GEAR and effect.of_spring and not effect.opens_spring else part


def _with_places(name: str, places: list[str]) -> str:
    """Add places to a name, such as "joints 1 to 4"."""
    known = [place for place in places if place]
    if not known:
        return name
    word, numbers = known[0].split()[0], sorted(int(place.split()[1]) for place in known)
    if len(numbers) == 1:
        return f"{name} ({word} {numbers[0]})"
    run = len(numbers) > _FEW and numbers[-1] - numbers[0] == len(numbers) - 1
    listed = f"{numbers[0]} to {numbers[-1]}" if run else ", ".join(map(str, numbers))
    return f"{name} ({word}s {listed})"
