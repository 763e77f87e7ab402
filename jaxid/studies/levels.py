"""The levels of a study: all combinations of sampling rate, resolution and noise of the sensors."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import jax.numpy as jnp

from jaxid.build import build_machine
from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.machine import Machine
from jaxid.scene import Scene, sampling_of
from jaxid.studies.logs import with_logs
from jaxid.studies.settings import SETTINGS


@dataclass(frozen=True)
class Level:
    """One combination of settings.

    Args:
        setting: The factor `noise`, and the other settings that [study] lists, by name.
        model: The case under these settings, without the effects that are hidden from the estimators.
        scene: The machine and its input, ready to be simulated.
        machine: The machine of the model at the start of the fits, before the starts are spread.
    """

    setting: dict[str, float]
    model: Case
    scene: Scene
    machine: Machine


def levels_of(case: Case, model: Case, longer_delays: float) -> tuple[Level, ...]:
    """Return all combinations of the settings that [study] lists.

    Args:
        case: The case.
        model: The case without the hidden effects.
        longer_delays: Factor on the delays that the simulation allows for, see `Scene.of`.

    Raises:
        InputError: If the case cannot be simulated so, or states no noise that a factor could multiply.
    """
    setting = case.study
    noises = [float(x) for x in setting.noise]
    noisy = case.sensor.position_noise is not None or case.sensor.force_noise is not None
    if not noisy and set(noises) != {1.0}:
        raise InputError(
            "there is no noise to multiply",
            where=f"{case.where}, [study] noise",
            hint="give position_noise or force_noise in [sensor]",
        )
    others = [name for name in SETTINGS[:-1] if getattr(setting, name) is not None]
    for name in (*others, "noise"):
        values = [float(x) for x in getattr(setting, name)]
        twice = next((x for x in values if values.count(x) > 1), None)
        if twice is not None:
            raise InputError(
                f"{twice:g} is given twice", where=f"{case.where}, [study] {name}", hint="give it once"
            )
    if "sample_rate" in others and _follows_rate(case):
        raise InputError(
            "the samples of the file have no time, and would be played faster or slower",
            where=f"{case.where}, [study] sample_rate",
            hint="add time or sample_rate beside kind",
        )
    levels = []
    for values in itertools.product(*[[float(x) for x in getattr(setting, name)] for name in others]):
        chosen = dict(zip(others, values, strict=True))
        scene = Scene.of(_under(case, chosen), longer_delays=longer_delays)
        of_model = _under(model, chosen)
        scene = replace(scene, machine=with_logs(scene.case, scene.machine))
        machine = with_logs(of_model, build_machine(of_model, period=1 / sampling_of(of_model)[0]))
        for noise in noises:
            noisy = replace(scene, machine=_noisier(scene.machine, noise))
            levels.append(Level(chosen | {"noise": noise}, of_model, noisy, _noisier(machine, noise)))
    return tuple(levels)


def _under(case: Case, setting: dict[str, float]) -> Case:
    """Return a case with another sampling rate and resolution of its log, and the same loop."""
    simulation, sensor, controller = case.simulation, case.sensor, case.controller
    if "sample_rate" in setting:
        if controller is not None and simulation.sample_rate is not None:
            logged = None if case.log is None else case.log.sample_rate
            rate = logged or simulation.sample_rate
            controller = replace(controller, period=controller.period or 1.0 / rate)
        simulation = replace(simulation, sample_rate=setting["sample_rate"])
    if "position_resolution" in setting:
        sensor = replace(sensor, position_resolution=setting["position_resolution"])
    return replace(case, simulation=simulation, sensor=sensor, controller=controller)


def _follows_rate(case: Case) -> bool:
    """Return whether a file without a time column drives the case."""
    tables = [t for t in (case.input, case.reference) if t and t.get("kind") == "csv"]
    return any("time" not in t and "sample_rate" not in t for t in tables)


def _noisier(machine: Machine, factor: float) -> Machine:
    """Return a machine with the noise of its sensors multiplied by a factor, at the same resolution."""
    sensor = machine.sensor
    scaled = {
        n: None if getattr(sensor, n) is None else factor * jnp.asarray(getattr(sensor, n))
        for n in ("position_noise", "force_noise")
    }
    return replace(machine, sensor=replace(sensor, **scaled))
