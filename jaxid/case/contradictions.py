"""Refusals of keys of a case that are sound by themselves and contradict each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jaxid.case.kinds import Kinds
from jaxid.case.tables import UNKNOWN_OF_CONTROLLER, controller_keys
from jaxid.model.parameter import parameters_of
from jaxid.schema import Spot

if TYPE_CHECKING:
    from jaxid.case.case import Case
    from jaxid.model.effect import Effect


def refuse_contradictions(case: Case, tables: Mapping[str, Any], root: Spot) -> None:
    """Refuse keys that say one thing twice, or that do not go together.

    Args:
        case: The case.
        tables: Its tables as they were given.
        root: Place of the case in messages.

    Raises:
        InputError: If keys contradict each other.
    """
    _check_transmission(case, root)
    _check_drive(case, tables, root)
    _check_labels(case, root)
    _check_preprocess(tables.get("preprocess", {}), root)
    _check_recursive(tables.get("recursive", {}), root)


def refuse_without_loop(case: Case, root: Spot, kinds: Kinds) -> None:
    """Refuse entries that only a loop could use, and effects on the command that the loop states too.

    Raises:
        InputError: If there is such an entry.
    """
    _check_loop(case, root)
    _check_command(case, root, kinds)


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
