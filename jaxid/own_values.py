"""Values that differ between logs that are fitted together: known in one, or unknown with one in each."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxid.case.case import Case
from jaxid.case.kinds import loaded_kinds
from jaxid.case.tables import controller_keys
from jaxid.controllers import Controller
from jaxid.errors import suggest
from jaxid.machine import Machine
from jaxid.model.by_name import Place, parameters_by_name
from jaxid.model.parameter import as_array
from jaxid.model.plant import Plant
from jaxid.model.unknowns import CONTROLLER, Free, Parameters, of_log, scatter, scatter_controller
from jaxid.schema import Spot, number

# Prefix of the values of [controller] among those that a log sets.
_CONTROLLER = "controller."
# Relative difference of two sampling periods beyond which a controller without a period has another one.
_SAME_PERIOD = 1e-6

Stated = Mapping[str, float | tuple[float, ...]]


@dataclass(frozen=True)
class OwnValues:
    """The values that hold in one log.

    Args:
        log: Name of the log; pieces of one log share it.
        plant: Known values by their places in the plant.
        controller: Known values by the fields of the controller.
        period: Sampling time of the controller in this log [s]; None: that of the machine.
        declared: Sampling time of the machine's controller for which `period` holds [s]. A fit may choose
            another one, which is then that of all logs.
    """

    log: str
    plant: Mapping[Place, float] = field(default_factory=dict)
    controller: Mapping[str, Any] = field(default_factory=dict)
    period: float | None = None
    declared: float | None = None

    def machine(self, machine: Machine) -> Machine:
        """Return the machine of this log: with its values, and with the unknowns that it shows.

        An unknown with a value in each log has that of this log; if it is none of them, their mean.
        """
        values, others = dict(self.plant), {}
        kept: list[int] = []
        for k, f in enumerate(machine.parameters.free):
            place = (f.path, f.index)
            if place in self.plant or (f.path[0] == CONTROLLER and f.path[1] in self.controller):
                continue
            if f.log is None:
                kept.append(k)
            elif f.log == self.log:
                values[place] = f.guess
                kept.append(k)
            else:
                others.setdefault(place, []).append(f.guess)
        values = {place: float(np.mean(many)) for place, many in others.items()} | values
        controller = self._controller(machine.controller)
        if not values and controller is machine.controller and len(kept) == len(machine.parameters.free):
            return machine
        places, numbers = tuple(values), np.array(list(values.values()))
        plant = scatter(places, machine.plant, numbers)
        controller = scatter_controller(places, controller, numbers)
        return replace(
            machine,
            plant=plant,
            parameters=machine.parameters.chosen(kept),
            controller=controller,
        )

    def _controller(self, controller: Controller | None) -> Controller | None:
        if controller is None or not (self.controller or self.period):
            return controller
        chosen = self.declared is not None and controller.period != self.declared
        period = {} if self.period is None or chosen else {"period": self.period}
        return replace(
            controller, **{name: as_array(value) for name, value in self.controller.items()}, **period
        )


def own_values(
    case: Case, machine: Machine, name: str, stated: Stated, period: float, where: str
) -> OwnValues:
    """Return the values of one log.

    Args:
        case: The case.
        machine: Its machine.
        name: Name of the log.
        stated: Values that are known in the log, by the names of parameters in results.
        period: Sampling period of the log [s].
        where: Entry of the case, for messages.

    Raises:
        InputError: If a name is unknown, or a value impossible.
    """
    plant, controller = {}, {}
    for given, value in stated.items():
        if given.startswith(_CONTROLLER):
            key = given.removeprefix(_CONTROLLER)
            controller[key] = _of_controller(case, key, value, where)
        else:
            plant |= _of_plant(machine.plant, given, value, where)
    own = declared = None
    if machine.controller is not None and case.controller is not None and case.controller.period is None:
        declared = float(machine.controller.period)
        own = period if abs(period / declared - 1) > _SAME_PERIOD else None
    return OwnValues(name, plant, controller, own, declared)


def _of_controller(case: Case, key: str, value: Any, where: str) -> Any:
    """Return a checked value of the controller."""
    spot = Spot(where, key=f"set {_CONTROLLER}{key}")
    if case.controller is None:
        raise spot.fault("belongs to a controller", "add [controller], or leave it out")
    keys = controller_keys(case.controller.kind, loaded_kinds())
    known = [name for name in case.controller.law if name in keys]
    if key not in known:
        raise spot.fault("is not stated in [controller]", suggest(key, known))
    before, after = case.controller.law[key], keys[key].read(value, spot)
    if isinstance(before, bool | str) or isinstance(after, bool | str):
        raise spot.refuse(value, "is no number", f"state {key} in [controller] for all logs")
    return after


def _of_plant(plant: Plant, name: str, value: Any, where: str) -> dict[Place, float]:
    """Return checked values of a parameter of the plant or an effect, by their places."""
    known = parameters_by_name(plant)
    spot = Spot(where, key=f"set {name}")
    names = [name] if name in known else [n for n in known if n.startswith(f"{name}[")]
    if not names or (name not in known and "." in name):
        hint = f"declare it in the case, known or not; {suggest(name, known)}"
        raise spot.fault("is no declared parameter", hint)
    values = value if isinstance(value, tuple) else (value,) * len(names)
    if len(values) != len(names):
        raise spot.refuse(value, f"has {len(values)} values", f"give one, or {len(names)} in a list")
    return {known[n][0]: number(known[n][1].sign)(x, spot) for n, x in zip(names, values, strict=True)}


def expanded(
    case: Case, machine: Machine, per_log: Sequence[str], logs: Mapping[str, Collection[Place]]
) -> Machine:
    """Return the machine with one unknown for each log in place of each of some unknowns.

    An unknown whose value is known in every log is none.

    Args:
        case: The case, for messages.
        machine: Its machine.
        per_log: Names of the unknowns that have a value of their own in each log.
        logs: Places whose value is known in a log, by its name.

    Raises:
        InputError: If a name is unknown, or the parameter is known.
    """
    own = {name for given in per_log for name in _named(case, machine, given)}
    free: list[Free] = []
    for f in machine.parameters.free:
        unknown_in = [log for log, known in logs.items() if (f.path, f.index) not in known]
        if f.name in own:
            free += [replace(f, name=of_log(f.name, log), log=log) for log in unknown_in]
        elif unknown_in:
            free.append(f)
    return machine.with_plant(machine.plant, Parameters(tuple(free), machine.parameters.bodies))


def _named(case: Case, machine: Machine, given: str) -> list[str]:
    """Return the unknowns that a name of `per_log` means: one, or those of a list of the plant."""
    unknown = machine.parameters.names
    names = [n for n in unknown if n == given] or [n for n in unknown if n.startswith(f"{given}[")]
    if names and ("." not in given or given in names):
        return names
    spot = Spot(case.where, "[identification]", "per_log")
    known = parameters_by_name(machine.plant)
    if given in known:
        hint = "give it as { guess = ... }, or state what is known to differ by set in [[fit]]"
        raise spot.fault(f"names {given}, which is known", hint)
    raise spot.fault(f"names {given}, which is no unknown of the case", suggest(given, unknown))
