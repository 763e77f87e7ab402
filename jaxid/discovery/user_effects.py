"""Checks of user-defined effects before a search uses them.

A missing definition (values at which a search starts, values at which the effect does nothing) would
otherwise spoil the baseline silently, or fail in the middle of compiled code.
"""

from __future__ import annotations

import numpy as np

from jaxid.arrays import Array
from jaxid.case.user_faults import check_action, one_line
from jaxid.errors import InputError
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import Effect, Scales
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Parameters, free_effect
from jaxid.numerics.kept import kept_jit
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_residual, sharpened

# Number of kept samples on which an effect is checked.
_ROWS = 400
# Largest force of an effect at its neutral values, as a part of the log's force.
_NOTHING = 1e-3


def is_user_effect(cls: type[Effect]) -> bool:
    """Check that a class is not part of jaxid."""
    return not cls.__module__.startswith("jaxid.")


def check_user_effect(
    cls: type[Effect], machine: Machine, data: Prepared, scales: Scales, port: int = 0
) -> None:
    """Refuse an effect that a search could not handle.

    Args:
        cls: Class of the effect.
        machine: The baseline.
        data: The log to be searched.
        scales: Scales of the log at that port.
        port: Port at which the effect is tried.

    Raises:
        InputError: If it has no parameters, if `starts` or `neutral` do not give values of exactly its
            parameters, if it acts at its neutral values, or if its force is not finite there.
    """
    where = f"effect {cls.kind}"
    neutral, *starts = _built(cls, scales, port, where)

    pieces = data.parts(3 * _ROWS, 3)
    part, plant = ForceData.of(pieces[len(pieces) // 2]), sharpened(machine.plant, data)
    models = [_with_effect(plant, e, machine) for e in (neutral, starts[0])]
    evaluated = [force_and_columns(model, places, part, theta) for model, places, theta in models]
    for which, arrays in zip(("neutral", "starts"), evaluated, strict=True):
        if not all(np.all(np.isfinite(a)) for a in arrays):
            what = f"its force or a derivative of it is not finite at the values of {which}"
            hint = "change them, or correct act: a root or a power at zero has no derivative"
            raise InputError(what, where=where, hint=hint)

    added = np.asarray(evaluated[0][0] - _force(plant, part))
    share = float(np.sqrt(np.mean(np.square(added)))) / scales.force
    if share > _NOTHING:
        size = f"{100 * share:.2g} %" if share < 1 else "more than 100 %"
        what = f"changes the force by {size} of its RMS at its neutral values"
        hint = (
            "define neutral(cls, scales), values at which it does nothing; an effect that acts in the drive "
            "also sets adds_force = False"
        )
        raise InputError(what, where=where, hint=hint)


def _built(cls: type[Effect], scales: Scales, port: int, where: str) -> list[Effect]:
    """Build an effect at its neutral values and at each of its starts, or explain why that fails."""
    names = [n for n, i in parameters_of(cls).items() if not i.optional]
    if not parameters_of(cls):
        hint = "declare with parameter(...) the values that a search estimates"
        raise InputError("has no parameters", where=where, hint=hint)

    try:
        starts, neutral = cls.starts(scales), cls.neutral(scales)
        for lower, upper in cls.limits(scales).values():
            _ = float(lower), float(upper)
        effects = [cls(**values, port=port) for values in (neutral, *starts)]
    except Exception as error:
        what = f"cannot be built at its neutral values or its starts ({one_line(error)})"
        hint = f"let neutral(scales) and each of starts(scales) give a number for {', '.join(names)}"
        raise InputError(what, where=where, hint=hint) from error
    if not starts:
        raise InputError("starts(scales) is empty", where=where, hint="give at least one start")
    for effect in effects[:2]:
        check_action(effect, where)
    return effects


def _with_effect(plant: Plant, effect: Effect, machine: Machine) -> tuple[Plant, tuple, Array]:
    """Return a plant with one more effect, the places of its parameters, and their values."""
    plant, free = free_effect(plant, effect, machine.units)
    unknown = Parameters(tuple(free))
    return plant, unknown.places, unknown.guess


_force = kept_jit(force_residual)
