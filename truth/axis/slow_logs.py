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


def visible(setup: Setup, run: dict[str, np.ndarray], kind: str) -> float:
    """Return what an oracle gains in log-likelihood by a hidden effect [nats].

    It knows the true motion, the effect's force and the noise of a row, which is what the loop makes of its
    encoder's noise. What inertia and declared frictions can take on of that force is taken off.

    Args:
        setup: The joint with the effect.
        run: Its log, with the truth behind it.
        kind: Kind of the effect.
    """
    q, v, a = run["true_position"], run["true_velocity"], run["true_acceleration"]
    p = HIDDEN[kind]
    force = {
        "stribeck_friction": lambda: p["level"] * np.exp(-((v / p["velocity"]) ** 2)) * np.sign(v),
        "unbalance": lambda: 9.81 * p["moment"] * np.cos(q + p["phase"]),
        "cogging": lambda: p["amplitude"] * np.cos(2 * np.pi * q / p["period"] + p["phase"]),
        "quadratic_drag": lambda: p["coefficient"] * v * np.abs(v),
        "linear_stiffness": lambda: p["coefficient"] * q,
    }[kind]()
    moves_now = np.abs(v) > 0.01
    columns = np.stack([a, v, np.sign(v)], axis=1)[moves_now]
    left = force[moves_now] - columns @ np.linalg.lstsq(columns, force[moves_now], rcond=None)[0]
    sensor = setup.sensor
    reading = np.hypot(sensor.position_noise, sensor.position_resolution / np.sqrt(12))
    slope = setup.loop.kv * setup.rate / 2
    noise = np.hypot(np.hypot(slope + setup.loop.kv * setup.loop.kp, slope) * reading, sensor.force_noise)
    return float(0.5 * np.sum((left / (setup.machine.actuator_gain * noise)) ** 2))
