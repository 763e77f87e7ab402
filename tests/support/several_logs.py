"""Logs of one exact axis, which differ by noise, load or offset, and cases of it."""

import dataclasses
from pathlib import Path

import numpy as np

from jaxid import Log
from truth.axis.cases import case_text, recorded
from truth.axis.machines import EMPS_ACCELERATION, EMPS_LOOP, Setup, emps_like, moves
from truth.axis.stepper import Sensor

# Mass of the load [kg].
LOADED = 40.0


def axis_setup(
    seed: int, *, noise: float = 1.0, seconds: float = 3.0, added: float = 0.0, offset: float = 0.0
) -> Setup:
    """Build an EMPS axis on a short tour, drawn by a few percent; `added` is a load, `offset` a force."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(1000 * seconds)) / 1000.0
    speeds = np.array([0.05, 0.3, 0.13, 0.2]) * rng.uniform(0.95, 1.05, 4)
    reference = moves(t, [0.0, 0.02, 0.12, 0.05], speeds, 2 * EMPS_ACCELERATION, rest=0.02)
    machine = emps_like().machine
    machine = dataclasses.replace(machine, inertia=machine.inertia + added)
    machine = machine.with_effect("constant_force", level=offset) if offset else machine
    sensor = Sensor(position_resolution=1e-9, position_noise=1e-6 * noise, force_noise=0.1 * noise)
    loop = dataclasses.replace(EMPS_LOOP, reference=reference)
    return Setup(machine, loop, sensor, rate=1000.0, duration=seconds, seed=seed)


def axis_log(seed: int, **options: float) -> Log:
    """Return the log of such an axis, named by its seed."""
    return Log(**(recorded(axis_setup(seed, **options)) | {"source": f"{seed}.csv"}))


def write_log(path: Path, setup: Setup) -> Path:
    """Write the log of an axis as a user has it."""
    run = recorded(setup)
    columns = np.column_stack([run[name] for name in ("time", "position", "force", "reference")])
    np.savetxt(path, columns, delimiter=",", header="t,q,u,ref", comments="", fmt="%.12g")
    return path


def axis_case(*, closed: bool, sensor: bool = True, gain_unknown: bool = False, offset: bool = False) -> str:
    """Return the case of the axis without load and offset, its guesses off by a factor of 1.2."""
    setup = axis_setup(0)
    text = case_text(setup, list(setup.machine.effects.items()), off=1.2, closed=closed, sensor=sensor)
    more = '[[effects]]\nkind = "added_mass"\nmass = 0.0\n'
    more += '[[effects]]\nkind = "constant_force"\nlevel = { guess = 0.0 }\n' if offset else ""
    more += '[[effects]]\nkind = "actuator_gain"\ngain = { guess = 0.8 }\n' if gain_unknown else ""
    return text.replace("[actuator]", more + "[actuator]")
