"""Logs of a ball-screw axis that also moves slowly, with or without a Stribeck term, by the exact stepper."""

from dataclasses import replace

import numpy as np

from truth.axis.machines import Setup, moves
from truth.axis.stepper import Loop, Machine, Sensor

DECLARED = (("viscous_friction", {"coefficient": 400.0}), ("coulomb_friction", {"level": 60.0}))
STRIBECK = ("stribeck_friction", {"level": 35.0, "velocity": 0.012})
TRUTH = (180.0, 400.0, 60.0)
_SPEEDS = (0.006, 0.015, 0.05, 0.15)  # m/s


def slow_axis(seed: int, *, duration: float = 8.0, stribeck: float = 1.0, noise: float = 1.0) -> Setup:
    """Return the axis with a tour of its own for each seed.

    Args:
        seed: Seed of the tour and of the noise.
        duration: Length of the log [s].
        stribeck: Factor on the level of the Stribeck term.
        noise: Factor on the noise of encoder and force.
    """
    random = np.random.default_rng(seed)
    points, speeds = [0.0], []
    for k in range(9):
        speeds.append(_SPEEDS[k % 4] * random.uniform(0.7, 1.4))
        points.append(points[-1] + (-1) ** k * speeds[-1] * random.uniform(0.5, 1.5))
    reference = moves(np.arange(round(1000 * duration)) / 1000, points, [*speeds, 0.1], 0.8, rest=0.1)
    kind, values = STRIBECK
    effects = {**dict(DECLARED), kind: {**values, "level": stribeck * values["level"]}}
    machine = Machine(inertia=TRUTH[0], actuator_gain=226.19, effects=effects)
    loop = Loop(kind="cascade_pd", kp=40.0, kv=72.0, velocity_average=2, limit=20.0, reference=reference)
    sensor = Sensor(position_resolution=1e-6, position_noise=3e-7 * noise, force_noise=0.03 * noise)
    return Setup(machine, loop, sensor, rate=1000.0, duration=duration, seed=seed)


def drag_axis(seed: int, duration: float = 16.0) -> Setup:
    """Return the axis under quadratic drag in place of the Stribeck term, with moves of random speed."""
    random = np.random.default_rng(seed)
    points, speeds, end = [0.0], [], 0.0
    while end < duration:
        speed = min(random.lognormal(np.log(0.08), 0.6), 0.3)
        length = speed * random.uniform(0.6, 1.4)
        points.append(points[-1] + (-1) ** len(speeds) * length)
        speeds.append(speed)
        end += length / speed + speed / 0.8 + 0.05
    reference = moves(np.arange(round(1000 * duration)) / 1000, points, [*speeds, 0.1], 0.8, rest=0.05)
    setup = slow_axis(seed, duration=duration)
    effects = {**dict(DECLARED), "quadratic_drag": {"coefficient": 2000.0}}
    machine = Machine(inertia=TRUTH[0], actuator_gain=226.19, effects=effects)
    return replace(setup, machine=machine, loop=replace(setup.loop, reference=reference))
