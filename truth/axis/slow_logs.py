"""A robot's joint in a loop of 1 kHz whose log holds every second to tenth tick, by the exact stepper."""

from dataclasses import replace

import numpy as np

from truth.axis.machines import Setup, moves
from truth.axis.stepper import Loop, Machine, Sensor

RATE = 1000.0
# Rows a second of the logs, and bits of the encoders, in turn.
LOG_RATES = (100.0, 125.0, 200.0, 250.0, 500.0)
BITS = (18, 16, 14)
_SPEEDS = (0.03, 0.1, 0.4, 1.2)  # rad/s
_KP, _KV = 25.0, 3.0


def robot_joint(seed: int, duration: float = 20.0) -> tuple[Setup, float]:
    """Return a joint with a tour of its own for each seed, and the rate of its log [Hz].

    It has about 0.8 kg m^2 and 10 N m/A. The loop differentiates its encoder over two ticks, and answers to
    its noise. The current is logged with noise of 5 mA.
    """
    random = np.random.default_rng([7, seed])
    inertia, viscous, coulomb = random.uniform(0.8, 1.25, 3) * (0.8, 2.0, 3.0)
    points, speeds = [0.0], []
    for k in range(12):
        speeds.append(_SPEEDS[k % 4] * random.uniform(0.7, 1.4))
        points.append(points[-1] + (-1) ** k * speeds[-1] * random.uniform(0.5, 1.5))
    reference = moves(np.arange(round(RATE * duration)) / RATE, points, [*speeds, 0.8], 4.0, rest=0.1)
    effects = {
        "viscous_friction": {"coefficient": float(viscous)},
        "coulomb_friction": {"level": float(coulomb)},
    }
    count = 2 * np.pi / 2 ** BITS[seed // len(LOG_RATES) % len(BITS)]
    loop = Loop(kind="cascade_pd", kp=_KP, kv=_KV, velocity_average=2, limit=20.0, reference=reference)
    sensor = Sensor(position_resolution=count, position_noise=0.5 * count, force_noise=5e-3)
    machine = Machine(float(inertia), effects, actuator_gain=10.0)
    return Setup(machine, loop, sensor, RATE, duration, seed), LOG_RATES[seed % len(LOG_RATES)]


# What may be hidden, with its parameters: sizes in N m, for a joint whose dry friction is 3 N m.
HIDDEN = {
    "stribeck_friction": {"level": 2.0, "velocity": 0.06},
    "unbalance": {"moment": 0.2, "phase": 0.3},
    "cogging": {"amplitude": 0.4, "period": 2 * np.pi / 24, "phase": 0.3},
    "quadratic_drag": {"coefficient": 1.0},
    "linear_stiffness": {"coefficient": 1.0},
}


def with_hidden(setup: Setup, kind: str) -> Setup:
    """Return the joint with an effect that its case does not declare."""
    return replace(setup, machine=setup.machine.with_effect(kind, **HIDDEN[kind]))
