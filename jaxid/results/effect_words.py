"""Effects in words: name, formula in the names of their parameters, and the machines in which each is met.

Each effect states them in its class. One without, such as one of the user's, is described by the first line
of its docstring. No JAX is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxid.case.kinds import known_kinds

# Parts of the drive chain on which an effect may act, in their order.
CONTROLLER, DRIVE, GEAR, LOAD = "controller", "drive", "gear", "load"


@dataclass(frozen=True)
class EffectWords:
    """An effect in words.

    Args:
        name: Name in a sentence.
        formula: Its force, or its change of the command, in the names of its parameters; q is the position,
            v the velocity, a the acceleration, u the force that the drive is asked for.
        met: Machines and conditions in which it is met.
        part: Part of the drive chain on which it acts.
    """

    name: str
    formula: str
    met: str
    part: str = LOAD


def words_of(kind: str, doc: str = "", *, in_drive: bool = False, of_spring: bool = False) -> EffectWords:
    """Return an effect in words.

    Args:
        kind: Kind of the effect.
        doc: Docstring of its class, whose first line describes an effect that has no entry.
        in_drive: Whether the effect changes the force of the drive.
        of_spring: Whether it is the law of a spring.
    """
    known = known_kinds().effects.get(kind)
    if known is not None and known.title:
        return EffectWords(known.title, known.formula, known.met, known.part or LOAD)
    first = doc.strip().splitlines()[0].rstrip(".") if doc.strip() else ""
    return EffectWords(kind.replace("_", " "), first, "", DRIVE if in_drive else GEAR if of_spring else LOAD)
