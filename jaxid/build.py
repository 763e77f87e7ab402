"""A machine, built from its case."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import Array
from jaxid.case.case import Case, load_case
from jaxid.case.declared import EffectEntry
from jaxid.case.reference import info_of
from jaxid.case.tables import ON_LINE
from jaxid.case.values import Value
from jaxid.controllers import CONTROLLERS, Controller, check_drives
from jaxid.errors import InputError
from jaxid.machine import Machine
from jaxid.model.parameter import ParameterInfo, as_array, parameters_of
from jaxid.model.plant import Plant
from jaxid.model.smoothing import Smoothing
from jaxid.model.unknowns import REFERENCE, Free, Parameters, effect_name, label
from jaxid.references import REFERENCES
from jaxid.references.unknown import UnknownReference
from jaxid.sensors.encoder import Sensor
from jaxid.sensors.inertial import Inertial, InertialSensors

# Velocity above which a joint's row counts for a law that identifies, where the case states none.
_GATE = 1e-2


def build_machine(case: Case, *, at_truth: bool = False, period: float | None = None) -> Machine:
    """Make a machine of a case.

    Args:
        case: The case.
        at_truth: Take the `true` values where there are any, in place of the guesses.
        period: Sampling time [s] of the log, which a controller without its own runs at; absent:
            what [log] or [simulation] give as sample_rate.

    Returns:
        The machine.

    Raises:
        InputError: If the controller's period is not to be found, or the case asks for what
            this version does not have.
    """
    if case.transmission is not None:
        hint = "leave it out, and state what the joints do and their drives"
        what = "transmission goes with a measured log that is checked, fitted or searched"
        raise InputError(what, where=f"{case.path}, [actuator]", hint=hint)
    plant, free = _plant(case, at_truth)
    unknown_reference, more = _course(case, at_truth, plant)
    gain = np.asarray(case.gain, dtype=np.float64) * np.asarray(plant.gearing)
    gain = np.broadcast_to(gain, (case.plant.drives,)).copy()
    controller = _controller(case, period, gain)
    sensor = _sensor(case, controller, plant)
    if controller is not None and "renewal" in controller.of_machine and sensor.inertial is not None:
        controller = replace(controller, renewal=sensor.inertial.hold)
    return Machine(
        plant=plant,
        parameters=Parameters((*free, *more)),
        gain=gain,
        units=case.plant.units,
        controller=controller,
        disturbance=(case.controller or {}).get("disturbance"),
        sensor=sensor,
        hold=case.log.get("hold", "zero_order"),
        unknown_reference=unknown_reference,
    )


def make_plant(case: Case | str | Path, *, at_truth: bool = False) -> Plant:
    """Build the plant of a case with its effects, and nothing that drives, closes or measures it.

    Args:
        case: The case, or its file.
        at_truth: Take the `true` values where there are any, in place of the guesses.

    Raises:
        InputError: If the case is unsound.
    """
    return _plant(case if isinstance(case, Case) else load_case(case), at_truth)[0]


def _sensor(case: Case, controller: Controller | None, plant: Plant) -> Sensor:
    """What measures; readings slower than the loop are held for some of its ticks."""
    given = {name: as_array(value) for name, value in case.sensor.items() if name != "rate"}
    given["inertial"] = _inertial(case, controller, plant) if case.inertial_sensors else None
    if "rate" not in case.sensor:
        return Sensor(**given)
    hold = _held(case.sensor["rate"], controller, f"{case.path}, [sensor]")
    # A difference over part of a hold is nothing, and then several times too much.
    for name in ("velocity_average", "reach"):
        ticks = getattr(controller, name, 0)
        if ticks % hold:
            raise InputError(
                f"{name} = {ticks} ticks, and readings are new every {hold}",
                where=f"{case.path}, [controller]",
                hint=f"take {name} = {hold}, or a multiple of it",
            )
    return Sensor(**given, hold=hold)


@eqx.filter_jit
def _told(sensors: InertialSensors, plant: Plant, q: Array, readings: Array, zero: Array) -> Array:
    return sensors.fused(plant, q, readings, zero, zero)[2]


def _held(rate: float, controller: Controller | None, where: str) -> int:
    """Ticks of the loop for which readings at this rate are held."""
    if controller is None:
        hint = "leave it out; sample_rate says how often a log without a loop is read"
        raise InputError("rate goes with a loop", where=where, hint=hint)
    hold = round(1 / (rate * controller.period))
    if hold < 1 or abs(hold * rate * controller.period - 1) > 1e-3:
        hint = f"take {1 / controller.period:g} Hz, the loop's, or a whole part of it"
        raise InputError(f"rate = {rate:g} Hz does not fit the loop", where=where, hint=hint)
    return hold


def _inertial(case: Case, controller: Controller | None, plant: Plant) -> InertialSensors:
    """Gyroscopes and accelerometers; together they must tell every joint, wherever the plant stands."""
    sensors, known, holds = [], [], []
    for k, stated in enumerate(case.inertial_sensors, start=1):
        own = {n: v for n, v in stated.items() if n not in ("rate", "calibrated", "link")}
        own["link"] = stated["link"] - 1
        nominal = {n: v for n, v in own.items() if n not in ("rotation", "scale", "bias")}
        sensors.append(Inertial(**own))
        known.append(Inertial(**(own if stated.get("calibrated", True) else nominal)))
        where = f"{case.path}, [[inertial_sensors]] {k}"
        holds.append(_held(stated["rate"], controller, where) if "rate" in stated else 1)
    out = InertialSensors(tuple(sensors), tuple(known), math.lcm(*holds))
    zero = np.zeros(plant.joints)
    rng = np.random.default_rng(0)
    try:
        positions = [plant.any_motion(rng)[0] for _ in range(3)]
    except InputError as error:
        raise InputError(f"{case.path}, [plant.parameters]: {error}") from error
    for q in positions:
        readings = out.read(plant, q, zero, zero)
        if not bool(_told(out, plant, q, readings, zero)):
            what = "the gyroscopes" if not out.accelerates else "gyroscopes and accelerometers"
            raise InputError(
                f"{what} do not tell the motion of every joint",
                where=f"{case.path}, [[inertial_sensors]]",
                hint="add one of each kind on the last link, or with more axes, and a range beyond gravity",
            )
    return out


def _plant(case: Case, at_truth: bool) -> tuple[Plant, list[Free]]:
    """The plant with its effects, and the unknowns."""
    plant, free = _bare_plant(case, at_truth)
    for entry in case.effects:
        for at in range(len(entry.ports)):
            plant, more = _with_effect(plant, entry, at, case, at_truth)
            free += more
    _check_weights(plant, case)
    return plant, free


def _check_weights(plant: Plant, case: Case) -> None:
    """A coefficient of friction needs a weight that it is of."""
    for effect in plant.effects:
        if getattr(effect, "friction_coefficient", None) is None:
            continue
        if not float(np.asarray(plant.port_normal(np.zeros(plant.joints)))[effect.port]) > 0:
            what = f"{label(plant, effect.kind, effect.port)} has a friction_coefficient where nothing weighs"
            hint = "let [plant] gravity be positive, or give the friction by its level"
            raise InputError(what, where=str(case.path), hint=hint)


def _bare_plant(case: Case, at_truth: bool) -> tuple[Plant, list[Free]]:
    """The plant without effects, and its own unknowns."""
    entry = case.plant
    known: dict[str, Any] = {"gravity": entry.gravity, "vertical": entry.vertical}
    sharpness = case.simulation.get("sharpness")
    known |= {"smoothing": None if sharpness is None else Smoothing(sharpness), "actuated": entry.actuated}
    options = {
        name: value
        for name, value in known.items()
        if value is not None and name in entry.cls.__dataclass_fields__
    }
    values: dict[str, Any] = {}
    for name, given in entry.parameters.items():
        listed = isinstance(given, tuple)
        values[name] = _starts(given, at_truth) if listed else given.start(at_truth)
    plant = entry.cls(**values, **options, **entry.options)
    free: list[Free] = []
    for name, info in parameters_of(entry.cls).items():
        given = entry.parameters.get(name)
        if isinstance(given, tuple):
            for k, v in enumerate(given):
                # Of one entry a joint it is the joint's motion, where these differ.
                motion = info.motion or (plant.motion(k) if info.more == 0 else None)
                row = [(k, v)] if isinstance(v, Value) else [((k, i), x) for i, x in enumerate(v)]
                for at, x in row:
                    number = k + 1 if isinstance(v, Value) else f"{k + 1}, {at[1] + 1}"
                    free += _free(x, f"{name}[{number}]", (name,), info, motion, case, at_truth, index=at)
        elif given is not None:
            free += _free(given, name, (name,), info, info.motion, case, at_truth)
    return plant, free


def _starts(given: tuple, at_truth: bool) -> list:
    """Values of a list, or of a list of lists."""
    return [v.start(at_truth) if isinstance(v, Value) else _starts(v, at_truth) for v in given]


def _with_effect(
    plant: Plant, entry: EffectEntry, at: int, case: Case, at_truth: bool
) -> tuple[Plant, list[Free]]:
    """The plant with an effect on one of its ports, and the effect's unknowns."""
    values = {name: of_ports[at] for name, of_ports in entry.parameters.items()}
    effect = entry.cls(port=entry.ports[at], **{name: v.start(at_truth) for name, v in values.items()})
    key = effect_name(plant, effect)
    free: list[Free] = []
    for name, info in parameters_of(entry.cls).items():
        if name in values:
            path = ("effects", len(plant.effects), name)
            motion = plant.motion(effect.port)
            free += _free(values[name], f"{key}.{name}", path, info, motion, case, at_truth)
    return plant.with_effect(effect), free


def _free(
    value: Value,
    name: str,
    path: tuple[str | int, ...],
    info: ParameterInfo,
    motion: str | None,
    case: Case,
    at_truth: bool,
    *,
    index: int | tuple[int, int] | None = None,
) -> list[Free]:
    """The unknown that a value is; empty where it is known."""
    if not value.free:
        return []
    unit = case.plant.units.label(info.dimension, motion)
    guess, bounds = value.start(at_truth), (value.lower, value.upper)
    return [Free(name, path, unit, info.sign, guess, *bounds, index=index, true=value.true)]


def _course(case: Case, at_truth: bool, plant: Plant) -> tuple[UnknownReference | None, list[Free]]:
    """The reference that has unknowns, and these."""
    if not case.unknown_reference:
        return None, []
    values = {name: v.start(at_truth) for name, v in case.unknown_reference.items()}
    unknown_reference, free = UnknownReference.of(case.reference, values), []
    motion, keys = plant.motion(plant.driven(plant.joints)[0]), REFERENCES[unknown_reference.kind].keys
    for name, value in case.unknown_reference.items():
        path, info = (REFERENCE, name), info_of(keys[name])
        free += _free(value, f"{REFERENCE}.{name}", path, info, motion, case, at_truth)
    return unknown_reference, free


def _controller(case: Case, period: float | None, gain: np.ndarray) -> Controller | None:
    if case.controller is None:
        return None
    cls = CONTROLLERS[case.controller["kind"]]
    # Defaults that are plain numbers would be no array leaves, and compile anew where given.
    values = {
        field.name: field.default
        for field in fields(cls)
        if field.default is not MISSING and isinstance(field.default, float)
    }
    given = {k: v for k, v in case.controller.items() if k not in ("kind", "disturbance", "period")}
    values |= given
    static = {field.name for field in fields(cls) if field.metadata.get("static")}
    arrays = {k: v if k in static else as_array(v) for k, v in values.items()}
    period = case.controller.get("period") or _log_period(case, period)
    plant, where = case.plant, f"{case.path}, [controller]"
    check_drives(case.controller["kind"], plant.cls, plant.drives, plant.joints, where)
    if "model" in cls.of_machine:
        # The law knows what the case guesses, whatever the machine truly is.
        model, free = _plant(case, False)
        arrays |= {"model": model, "gain": as_array(gain.tolist())}
        if "estimator" in cls.of_machine:
            known = Machine(model, Parameters(tuple(free)), gain, plant.units)
            stated = {k: arrays.pop(k) for k in ON_LINE if k in arrays}
            arrays["estimator"] = _estimator(case, known, period, stated)
    return cls(period=period, **arrays)


def _estimator(case: Case, machine: Machine, period: float, stated: Mapping[str, Any]) -> Any:
    """Of a law that identifies: what finds the unknowns; how certain its start is, the law says."""
    from jaxid.estimators.recursive.real_time import RealTime

    where, count = f"{case.path}, [controller]", len(machine.parameters.free)
    if not count:
        hint = "take kind = 'computed_torque', or give a guess in place of a value"
        raise InputError("kind = 'adaptive' has nothing to find: all is known", where=where, hint=hint)
    velocity = stated.get("gate_velocity", _GATE)
    at_guess = stated.get("start") == "guess"
    try:
        return RealTime.of(
            machine,
            period,
            noise=1.0,
            spread=np.ones(count),
            gate_velocity=velocity,
            gate_acceleration=stated.get("gate_acceleration", np.inf),
            half_life=stated.get("half_life", np.inf),
            summed=stated.get("rows") == "summed",
            instrument=stated.get("instrument") == "model",
            start=machine.parameters.guess if at_guess else None,
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _log_period(case: Case, period: float | None) -> float:
    rate = case.log.get("sample_rate") or case.simulation.get("sample_rate")
    if period is None and rate is None:
        hint = "add period = <its sampling time in s>"
        where = f"{case.path}, [controller]"
        raise InputError("the controller's period is not known", where=where, hint=hint)
    return period if period is not None else 1.0 / rate
