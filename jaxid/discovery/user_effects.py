"""Effects that are not jaxid's own, looked over before a search trusts them.

What a user forgets (values from which to search, values at which nothing acts) would otherwise
spoil the baseline without a word, or fail in the middle of compiled code.
"""

from __future__ import annotations

import equinox as eqx
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
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_residual, sharpened

# So many kept samples tell whether an effect is sound.
_ROWS = 400
# Part of the log's force that an effect may add where it should do nothing.
_NOTHING = 1e-3


def is_user_effect(cls: type[Effect]) -> bool:
    """Whether a class is not part of jaxid."""
    return not cls.__module__.startswith("jaxid.")


def check_user_effect(
    cls: type[Effect], machine: Machine, data: Prepared, scales: Scales, port: int = 0
) -> None:
    """Refuse an effect that a search could not handle.

    Args:
        cls: The class.
        machine: The baseline.
        data: The log to be searched.
        scales: Of the log, at that port.
        port: Where it is tried.

    Raises:
        InputError: If it has no parameters, `starts` or `neutral` give something else than its
            parameters, it acts where it should do nothing, or it is not a finite number there.
    """
    where = f"effect {cls.kind}"
    names = [n for n, i in parameters_of(cls).items() if not i.optional]
    if not parameters_of(cls):
        hint = "declare with parameter(...) what a search is to find"
        raise InputError("has no parameters", where=where, hint=hint)
    try:
        starts, neutral = cls.starts(scales), cls.neutral(scales)
        for lower, upper in cls.limits(scales).values():
            float(lower), float(upper)
        effects = [cls(**values, port=port) for values in (neutral, *starts)]
    except Exception as error:
        what = f"cannot be started ({one_line(error)})"
        hint = f"let neutral(scales) and each of starts(scales) give a number for {', '.join(names)}"
        raise InputError(what, where=where, hint=hint) from error
    if not starts:
        raise InputError("starts(scales) is empty", where=where, hint="give at least one start")
    for effect in effects[:2]:
        check_action(effect, where)
    pieces = data.parts(3 * _ROWS, 3)
    part, plant = ForceData.of(pieces[len(pieces) // 2]), sharpened(machine.plant, data)
    models = [_with(plant, e, machine) for e in effects[:2]]
    found = [force_and_columns(model, places, part, theta) for model, places, theta in models]
    for which, arrays in zip(("neutral", "starts"), found, strict=True):
        if not all(np.all(np.isfinite(a)) for a in arrays):
            what = f"its force or a derivative of it is no number at the values of {which}"
            hint = "change them, or correct act: a root or a power at zero has no derivative"
            raise InputError(what, where=where, hint=hint)
    added = np.asarray(found[0][0] - _force(plant, part))
    share = float(np.sqrt(np.mean(np.square(added)))) / scales.force
    if share > _NOTHING:
        size = f"{100 * share:.2g} %" if share < 1 else "more than all"
        what = f"changes the force by {size} of its RMS at its neutral values"
        hint = (
            "define neutral(cls, scales), values at which it does nothing; what acts in the drive "
            "also sets adds_force = False"
        )
        raise InputError(what, where=where, hint=hint)


def _with(plant: Plant, effect: Effect, machine: Machine) -> tuple[Plant, tuple, Array]:
    """A plant with an effect more, where its parameters are, and their values."""
    plant, free = free_effect(plant, effect, machine.units)
    unknown = Parameters(tuple(free))
    return plant, unknown.places, unknown.guess


_force = eqx.filter_jit(force_residual)
