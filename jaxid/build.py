"""A machine, built from its case."""

from __future__ import annotations

import math
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.case.case import Case, load_case
from jaxid.case.declared import EffectEntry
from jaxid.case.reference import info_of
from jaxid.case.tables import ON_LINE, at_start, unknown_info
from jaxid.case.values import Value
from jaxid.controllers import CONTROLLERS, Controller, check_drives
from jaxid.effects.friction import BackEmfDamping
from jaxid.errors import InputError
from jaxid.logs.drive import Drives, drives_of
from jaxid.machine import Machine
from jaxid.model.parameter import ParameterInfo, as_array, parameters_of
from jaxid.model.plant import Plant
from jaxid.model.smoothing import Smoothing
from jaxid.model.unknowns import CONTROLLER, REFERENCE, Free, Parameters, effect_name, label
from jaxid.names import AXES
from jaxid.numerics.kept import kept_jit
from jaxid.references import REFERENCES
from jaxid.references.unknown import UnknownReference
from jaxid.schema import stated
from jaxid.sensors.encoder import Sensor
from jaxid.sensors.inertial import Inertial, InertialSensors
from jaxid.settings import Recursive

# A period without bounds stays within this factor of its guess: a fit may run to a period far below the
# encoder's count, or to the harmonic of half the period.
_NEAR = 1.5
# Velocity [m/s or rad/s] above which a joint's row counts for an adaptive controller by default.
_GATE = 1e-2


def build_machine(case: Case, *, at_truth: bool = False, period: float | None = None) -> Machine:
    """Build the machine of a case.

    Args:
        case: The case.
        at_truth: Whether to take the `true` values, if there are any, in place of the guesses.
        period: Sampling time [s] of the log, for a controller without a period; None: from the
            sample_rate of [log] or [simulation].

    Returns:
        The machine.

    Raises:
        InputError: If the controller's period is not known, or entries of the case contradict each other.
    """
    if case.actuator.transmission is not None:
        hint = "leave it out, and give positions and forces of the joints"
        what = "transmission goes with a measured log that is checked, fitted or searched"
        raise InputError(what, where=f"{case.where}, [actuator]", hint=hint)
    plant, free = _plant(case, at_truth)
    unknown_reference, more = _unknown_reference(case, at_truth, plant)
    more += _unknowns_of_controller(case, at_truth, plant)
    gain = drives_of_case(case, plant).gain * np.asarray(plant.gearing)
    controller = _controller(case, period, gain, at_truth)
    sensor = _sensor(case, controller, plant)
    if controller is not None and "renewal" in controller.of_machine and sensor.inertial is not None:
        controller = replace(controller, renewal=sensor.inertial.hold)
    return Machine(
        plant=plant,
        parameters=Parameters((*free, *more)),
        gain=gain,
        units=case.plant.units,
        controller=controller,
        disturbance=None if case.controller is None else case.controller.disturbance,
        sensor=sensor,
        hold=case.hold,
        reference_hold=case.reference_hold,
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
    """Return the sensors; readings slower than the loop are held for some of its ticks."""
    given = {name: as_array(value) for name, value in stated(case.sensor).items() if name != "rate"}
    given["inertial"] = _inertial(case, controller, plant) if case.inertial_sensors else None
    if case.sensor.rate is None:
        return Sensor(**given)
    hold = _ticks_held(case.sensor.rate, controller, f"{case.where}, [sensor]")

    # A difference over a part of a hold is zero, and then several times too large.
    for name in ("velocity_average", "reach"):
        ticks = getattr(controller, name, 0)
        if ticks % hold:
            raise InputError(
                f"{name} = {ticks} ticks, and readings are new every {hold}",
                where=f"{case.where}, [controller]",
                hint=f"take {name} = {hold}, or a multiple of it",
            )
    return Sensor(**given, hold=hold)


@kept_jit
def _identifiable(sensors: InertialSensors, plant: Plant, q: Array) -> Array:
    zero = jnp.zeros_like(q)
    return sensors.fused(plant, q, sensors.read(plant, q, zero, zero), zero, zero)[2]


def _ticks_held(rate: float, controller: Controller | None, where: str) -> int:
    """Return the ticks of the loop for which readings at a rate [Hz] are held."""
    if controller is None:
        hint = "leave it out; sample_rate says how often a log without a loop is read"
        raise InputError("rate goes with a loop", where=where, hint=hint)
    hold = round(1 / (rate * controller.period))
    if hold < 1 or abs(hold * rate * controller.period - 1) > 1e-3:
        hint = f"take {1 / controller.period:g} Hz, the loop's, or a whole part of it"
        raise InputError(f"rate = {rate:g} Hz does not fit the loop", where=where, hint=hint)
    return hold


def _inertial(case: Case, controller: Controller | None, plant: Plant) -> InertialSensors:
    """Return gyroscopes and accelerometers; together they must determine every joint in any position."""
    sensors, known, holds = [], [], []
    for k, entry in enumerate(case.inertial_sensors, start=1):
        exact = {n: v for n, v in stated(entry).items() if n not in ("rate", "calibrated")}
        exact |= {"link": entry.link - 1, "axes": tuple(AXES.index(axis) for axis in entry.axes)}
        nominal = {n: v for n, v in exact.items() if n not in ("rotation", "scale", "bias")}
        sensors.append(Inertial(**exact))
        known.append(Inertial(**(exact if entry.calibrated else nominal)))
        where = f"{case.where}, [[inertial_sensors]] {k}"
        holds.append(1 if entry.rate is None else _ticks_held(entry.rate, controller, where))
    out = InertialSensors(tuple(sensors), tuple(known), math.lcm(*holds))

    # Three random positions show whether the readings determine the motion.
    rng = np.random.default_rng(0)
    try:
        positions = [plant.any_motion(rng)[0] for _ in range(3)]
    except InputError as error:
        raise InputError(f"{case.where}, [plant.parameters]: {error}") from error
    for q in positions:
        if not bool(_identifiable(out, plant, q)):
            what = "the gyroscopes" if not out.accelerates else "gyroscopes and accelerometers"
            raise InputError(
                f"{what} do not determine the motion of every joint",
                where=f"{case.where}, [[inertial_sensors]]",
                hint="add one of each kind on the last link, or with more axes, and a range beyond gravity",
            )
    return out


def _plant(case: Case, at_truth: bool) -> tuple[Plant, list[Free]]:
    """Return the plant with its effects, and the unknowns."""
    plant, free = _bare_plant(case, at_truth)
    for entry in case.effects:
        for at in range(len(entry.ports)):
            plant, more = _with_effect(plant, entry, at, case, at_truth)
            free += more
    _check_weights(plant, case)
    return _with_back_emf(plant, case), free


def motions_of(case: Case, plant: Plant) -> tuple[str, ...]:
    """Return "linear" or "rotary" for each joint."""
    return tuple(plant.motion(j) or case.plant.units.motion for j in range(plant.joints))


def drives_of_case(case: Case, plant: Plant) -> Drives:
    """Return the drives of [actuator]."""
    motions = motions_of(case, plant)
    driven = tuple(motions[j] for j in plant.driven(plant.joints)[: case.plant.drives])
    return drives_of(case.actuator, case.log, driven, case.where)


def _with_back_emf(plant: Plant, case: Case) -> Plant:
    """Return the plant with the damping of drives whose voltage is the command."""
    damping = drives_of_case(case, plant).damping
    for joint, coefficient in zip(plant.driven(plant.joints), damping, strict=False):
        if coefficient:
            plant = plant.with_effect(BackEmfDamping(port=joint, coefficient=as_array(float(coefficient))))
    return plant


def _check_weights(plant: Plant, case: Case) -> None:
    """Refuse a coefficient of friction on a joint without weight."""
    for effect in plant.effects:
        if getattr(effect, "friction_coefficient", None) is None:
            continue
        if not float(np.asarray(plant.port_normal(np.zeros(plant.joints)))[effect.port]) > 0:
            name = label(plant, effect.kind, effect.port)
            what = f"{name} has a friction_coefficient, but its joint carries no weight"
            hint = "let [plant] gravity be positive, or give the friction by its level"
            raise InputError(what, where=case.where, hint=hint)


def _bare_plant(case: Case, at_truth: bool) -> tuple[Plant, list[Free]]:
    """Return the plant without effects, and its unknowns."""
    entry = case.plant
    known: dict[str, Any] = {"gravity": entry.gravity, "vertical": entry.vertical}
    sharpness = case.simulation.sharpness
    known |= {"smoothing": None if sharpness is None else Smoothing(sharpness), "actuated": entry.actuated}
    options = {
        name: value
        for name, value in known.items()
        if value is not None and name in entry.cls.__dataclass_fields__
    }

    values: dict[str, Any] = {}
    for name, given in entry.parameters.items():
        values[name] = _guesses(given, at_truth) if isinstance(given, tuple) else given.start(at_truth)
    plant = entry.cls(**values, **options, **entry.options)

    free: list[Free] = []
    for name, info in parameters_of(entry.cls).items():
        given = entry.parameters.get(name)
        if isinstance(given, tuple):
            for k, v in enumerate(given):
                # A list with one entry a joint has the motion of each joint.
                motion = info.motion or (plant.motion(k) if info.more == 0 else None)
                entries: list[tuple[str, int | tuple[int, int], Value]]
                if isinstance(v, Value):
                    entries = [(f"{k + 1}", k, v)]
                else:
                    entries = [(f"{k + 1}, {i + 1}", (k, i), x) for i, x in enumerate(v)]
                for number, at, x in entries:
                    free += _free(x, f"{name}[{number}]", (name,), info, motion, case, at_truth, index=at)
        elif given is not None:
            free += _free(given, name, (name,), info, info.motion, case, at_truth)
    return plant, free


def _guesses(given: tuple, at_truth: bool) -> list:
    """Return the guesses (or true values) of a list, or of a list of lists."""
    return [v.start(at_truth) if isinstance(v, Value) else _guesses(v, at_truth) for v in given]


def _with_effect(
    plant: Plant, entry: EffectEntry, at: int, case: Case, at_truth: bool
) -> tuple[Plant, list[Free]]:
    """Return the plant with an effect on one of its ports, and the unknowns of the effect."""
    values = {name: of_ports[at] for name, of_ports in entry.parameters.items()}
    port = entry.ports[at]
    if entry.cls.of_rotary and (plant.motion(port) or case.plant.units.motion) != "rotary":
        raise InputError(
            f"{entry.cls.kind} acts on a joint that turns, and this one moves along a line",
            where=f"{case.where}, [[effects]]",
            hint='say motion = "rotary" in [plant], or take another effect',
        )
    effect = entry.cls(port=port, **{name: v.start(at_truth) for name, v in values.items()})
    key = effect_name(plant, effect)
    free: list[Free] = []
    for name, info in parameters_of(entry.cls).items():
        if name in values:
            path = ("effects", len(plant.effects), name)
            motion = plant.motion(effect.port)
            if name == "period" and info.sign == "positive":
                values[name] = _near(values[name])
            free += _free(values[name], f"{key}.{name}", path, info, motion, case, at_truth)
    return plant.with_effect(effect), free


def _near(value: Value) -> Value:
    """Return an unknown without bounds with bounds about its guess."""
    if not value.free or np.isfinite(value.lower) or np.isfinite(value.upper):
        return value
    near = value.start(False), value.start(True)
    return replace(value, lower=min(near) / _NEAR, upper=max(near) * _NEAR)


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
    """Return a value as a list of one unknown; empty if it is known."""
    if not value.free:
        return []
    unit = case.plant.units.label(info.dimension, motion)
    guess, bounds = value.start(at_truth), (value.lower, value.upper)
    return [Free(name, path, unit, info.sign, guess, *bounds, index=index, true=value.true)]


def _unknown_reference(
    case: Case, at_truth: bool, plant: Plant
) -> tuple[UnknownReference | None, list[Free]]:
    """Return the reference and its unknowns; None and an empty list if all of it is known."""
    if not case.unknown_reference:
        return None, []
    values = {name: v.start(at_truth) for name, v in case.unknown_reference.items()}
    assert case.reference is not None, "unknowns of a reference are read from its table"
    unknown_reference = UnknownReference.of(case.reference, values)
    free: list[Free] = []
    motion, keys = plant.motion(plant.driven(plant.joints)[0]), REFERENCES[unknown_reference.kind].keys
    for name, value in case.unknown_reference.items():
        path, info = (REFERENCE, name), info_of(keys[name])
        free += _free(value, f"{REFERENCE}.{name}", path, info, motion, case, at_truth)
    return unknown_reference, free


def _unknowns_of_controller(case: Case, at_truth: bool, plant: Plant) -> list[Free]:
    """Return the unknowns of [controller]; gains in units of the command, where the drives have a gain."""
    if case.controller is None:
        return []
    units = case.plant.units
    if np.any(drives_of_case(case, plant).gain != 1.0):
        units = replace(units, force="command")
    driven = plant.driven(plant.joints)
    free: list[Free] = []
    for name, given in case.controller.unknown.items():
        info = unknown_info(case.controller.kind, name)
        several = isinstance(given, tuple)
        for k, value in enumerate(given if isinstance(given, tuple) else (given,)):
            if not isinstance(value, Value) or not value.free:
                continue
            free.append(
                Free(
                    name=f"{CONTROLLER}.{name}[{k + 1}]" if several else f"{CONTROLLER}.{name}",
                    path=(CONTROLLER, name),
                    unit=units.label(info.dimension, plant.motion(driven[k])),
                    sign=info.sign,
                    guess=value.start(at_truth),
                    lower=value.lower,
                    upper=value.upper,
                    index=k if several else None,
                    true=value.true,
                )
            )
    return free


def _controller(
    case: Case, period: float | None, gain: np.ndarray, at_truth: bool = False
) -> Controller | None:
    """Return the controller of a case; None if it has none."""
    if case.controller is None:
        return None
    cls = CONTROLLERS[case.controller.kind]
    # Defaults that are plain numbers are no array leaves: a case that states them would compile anew.
    values = {
        field.name: field.default
        for field in fields(cls)
        if field.default is not MISSING and isinstance(field.default, float)
    }
    values |= case.controller.law
    values |= {name: at_start(value, at_truth) for name, value in case.controller.unknown.items()}
    static = {field.name for field in fields(cls) if field.metadata.get("static")}
    arrays: dict[str, Any] = {k: v if k in static else as_array(v) for k, v in values.items()}

    period = _loop_period(case, period)
    plant, where = case.plant, f"{case.where}, [controller]"
    check_drives(case.controller.kind, plant.cls, plant.drives, plant.joints, where)
    if "model" in cls.of_machine:
        # The law knows the guesses of the case, not the true values.
        model, free = _plant(case, False)
        arrays |= {"model": model, "gain": as_array(gain.tolist())}
        if "estimator" in cls.of_machine:
            known = Machine(model, Parameters(tuple(free)), gain, plant.units)
            settings = Recursive(**{k: arrays.pop(k) for k in ON_LINE if k in arrays})
            arrays["estimator"] = _estimator(case, known, period, settings)

    # Servos of a robot's file have the velocity of their joints, as in its simulator.
    of_file = "controller" not in case.tables
    own = of_file or (case.log is not None and case.log.loop_velocity is not None)
    return cls(period=period, own_velocity=own, **arrays)


def _estimator(case: Case, machine: Machine, period: float, settings: Recursive) -> Any:
    """Build the on-line estimator of an adaptive controller; the law itself sets the weight of its start."""
    from jaxid.estimators.recursive.real_time import RealTime

    where, count = f"{case.where}, [controller]", len(machine.parameters.free)
    if not count:
        hint = "take kind = 'computed_torque', or give a guess in place of a value"
        what = "kind = 'adaptive' needs at least one unknown parameter"
        raise InputError(what, where=where, hint=hint)
    velocity, acceleration = settings.gate_velocity, settings.gate_acceleration
    try:
        return RealTime.of(
            machine,
            period,
            noise=1.0,
            spread=np.ones(count),
            gate_velocity=_GATE if velocity is None else np.asarray(velocity),
            gate_acceleration=np.inf if acceleration is None else np.asarray(acceleration),
            half_life=np.inf if settings.half_life is None else settings.half_life,
            summed=settings.rows == "summed",
            instrument=settings.instrument == "model",
            start=machine.parameters.guess if settings.start == "guess" else None,
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _loop_period(case: Case, period: float | None) -> float:
    """Return the period of the loop [s].

    That of servos in a robot's file is the time step of a simulator, and no clock that a log keeps to: the
    nearest whole part of the log's period is taken.
    """
    stated = case.controller.period if case.controller is not None else None
    if not stated:
        return _log_period(case, period)
    if period is None or "controller" in case.tables:
        return stated
    whole = period / max(round(period / stated), 1)
    return stated if abs(whole - stated) < 1e-9 * stated else whole


def _log_period(case: Case, period: float | None) -> float:
    """Return the sampling period [s] of the log, or of [log] or [simulation]."""
    if period is not None:
        return period
    logged = None if case.log is None else case.log.sample_rate
    rate = logged or case.simulation.sample_rate
    if rate is None:
        hint = "add period = <its sampling time in s>"
        where = f"{case.where}, [controller]"
        raise InputError("the controller's period is not known", where=where, hint=hint)
    return 1.0 / rate
