"""Under what a study runs: sampling rate, resolution and noise of the sensors, each with each other."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import jax.numpy as jnp

from jaxid.build import build_machine
from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.machine import Machine
from jaxid.scene import Scene, sampling_of
from jaxid.studies.settings import SETTINGS


@dataclass(frozen=True)
class Level:
    """One combination of settings.

    Args:
        setting: `noise`, a factor, and of the other settings those that [study] lists.
        model: The case as it is under them, without the effects that are hidden from the estimators.
        scene: What is simulated.
        machine: Of the model, where fits start, before the starts are spread.
    """

    setting: dict[str, float]
    model: Case
    scene: Scene
    machine: Machine


def levels_of(case: Case, model: Case, longer_delays: float) -> tuple[Level, ...]:
    """All combinations of what [study] lists.

    Args:
        case: The case.
        model: The same without what is hidden.
        longer_delays: See `Scene.of`.

    Raises:
        InputError: If the case cannot be simulated so, or a factor of the noise has nothing to act on.
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
                f"{twice:g} stands there twice", where=f"{case.where}, [study] {name}", hint="once is enough"
            )
    if "sample_rate" in others and _follows_rate(case):
        raise InputError(
            "the file's samples have no time of their own, and would be played faster or slower",
            where=f"{case.where}, [study] sample_rate",
            hint="give its time or sample_rate beside its kind",
        )
    levels = []
    for values in itertools.product(*[[float(x) for x in getattr(setting, name)] for name in others]):
        own = dict(zip(others, values, strict=True))
        scene = Scene.of(_under(case, own), longer_delays=longer_delays)
        of_model = _under(model, own)
        machine = build_machine(of_model, period=1 / sampling_of(of_model)[0])
        for noise in noises:
            louder = replace(scene, machine=_noisier(scene.machine, noise))
            levels.append(Level(own | {"noise": noise}, of_model, louder, _noisier(machine, noise)))
    return tuple(levels)


def _under(case: Case, setting: dict[str, float]) -> Case:
    """A case whose log is sampled and resolved otherwise; its loop stays."""
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
    """Whether what drives the case is a file without a time of its own."""
    tables = [t for t in (case.input, case.reference) if t and t.get("kind") == "csv"]
    return any("time" not in t and "sample_rate" not in t for t in tables)


def _noisier(machine: Machine, factor: float) -> Machine:
    """A machine whose sensors have so many times the noise; their resolution stays."""
    sensor = machine.sensor
    scaled = {
        n: None if getattr(sensor, n) is None else factor * jnp.asarray(getattr(sensor, n))
        for n in ("position_noise", "force_noise")
    }
    return replace(machine, sensor=replace(sensor, **scaled))
