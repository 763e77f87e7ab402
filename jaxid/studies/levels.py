"""Under what a study runs: sampling rate, resolution and noise of the sensors, each with each other."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import jax.numpy as jnp

from jaxid.errors import InputError
from jaxid.io.case import Case
from jaxid.machine import Machine, build_machine
from jaxid.studies.settings import SETTINGS
from jaxid.virtual import Scene


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
    noises = [float(x) for x in setting.get("noise", (1.0,))]
    if not {"position_noise", "force_noise"} & set(case.sensor) and set(noises) != {1.0}:
        raise InputError(
            "there is no noise to multiply", where=f"{case.path}, [study] noise",
            mend="give position_noise or force_noise in [sensor]",
        )
    others = [name for name in SETTINGS[:-1] if name in setting]
    levels = []
    for values in itertools.product(*[[float(x) for x in setting[name]] for name in others]):
        own = dict(zip(others, values, strict=True))
        scene = Scene.of(_under(case, own), longer_delays=longer_delays)
        of_model = _under(model, own)
        machine = build_machine(of_model, period=1 / float(of_model.simulation["sample_rate"]))
        for noise in noises:
            noisy = replace(scene, machine=_noisier(scene.machine, noise))
            levels.append(Level(own | {"noise": noise}, of_model, noisy, _noisier(machine, noise)))
    return tuple(levels)


def _under(case: Case, setting: dict[str, float]) -> Case:
    """A case with its sampling rate and resolution replaced."""
    simulation, sensor = dict(case.simulation), dict(case.sensor)
    if "sample_rate" in setting:
        simulation["sample_rate"] = setting["sample_rate"]
    if "position_resolution" in setting:
        sensor["position_resolution"] = setting["position_resolution"]
    return replace(case, simulation=simulation, sensor=sensor)


def _noisier(machine: Machine, factor: float) -> Machine:
    """A machine whose sensors have so many times the noise; their resolution stays."""
    sensor = machine.sensor
    scaled = {
        n: None if getattr(sensor, n) is None else factor * jnp.asarray(getattr(sensor, n))
        for n in ("position_noise", "force_noise")
    }
    return replace(machine, sensor=replace(sensor, **scaled))
