"""Three machines on the exact axis, and references that excite them: the EMPS slide, a servo, a heavy slide.

Friction, limits, encoder and sampling are those of `truth.axis.stepper`; each machine gives its values.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from truth.axis.stepper import Loop, Machine, Sensor, simulate


def single_move(t: np.ndarray, distance: float, speed: float, acceleration: float) -> np.ndarray:
    """Return a trapezoid in velocity from 0 to `distance`, at rest before t = 0 and after its end.

    Args:
        t: Time since the start [s].
        distance: Signed stroke [m].
        speed: Plateau [m/s]; a short stroke does not reach it.
        acceleration: Of both ramps [m/s^2].
    """
    length = abs(distance)
    peak = min(speed, math.sqrt(length * acceleration))
    end = move_time(distance, speed, acceleration)
    t = np.clip(t, 0.0, end)
    left = end - t
    rising, falling = 0.5 * acceleration * t**2, length - 0.5 * acceleration * left**2
    cruise = peak * (t - 0.5 * peak / acceleration)
    ramp = peak / acceleration
    return math.copysign(1.0, distance) * np.where(t < ramp, rising, np.where(left < ramp, falling, cruise))


def move_time(distance: float, speed: float, acceleration: float) -> float:
    """Return the duration of a trapezoid move [s]."""
    length = abs(distance)
    peak = min(speed, math.sqrt(length * acceleration))
    return length / peak + peak / acceleration if length > 0.0 else 0.0


def moves(
    t: np.ndarray,
    waypoints: Sequence[float] | np.ndarray,
    speeds: Sequence[float] | np.ndarray,
    acceleration: float,
    rest: float = 0.0,
) -> np.ndarray:
    """Tour the waypoints and return to the first, repeatedly, with a rest after each move.

    Args:
        t: Time [s], from 0 on.
        waypoints: Positions in turn [m]; the tour starts at the first.
        speeds: Plateau of each move [m/s], as many as waypoints: the last leads home.
        acceleration: Of all ramps [m/s^2].
        rest: Pause after each move [s].
    """
    position, begin, i = np.full_like(t, waypoints[0]), 0.0, 0
    while begin <= t[-1]:
        here, there = waypoints[i % len(waypoints)], waypoints[(i + 1) % len(waypoints)]
        speed = speeds[i % len(speeds)]
        position += single_move(t - begin, there - here, speed, acceleration)
        begin += move_time(there - here, speed, acceleration) + rest
        i += 1
    return position


def multisine(t: np.ndarray, frequencies: Sequence[float], peak: float, seed: int = 0) -> np.ndarray:
    """Return the sum of equal sines of random phase, scaled to `peak` and shifted to start at zero.

    Args:
        t: Time [s].
        frequencies: Lines [Hz].
        peak: Largest magnitude before the shift [m, or the input's unit].
        seed: Of the phases.
    """
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, len(frequencies))
    wave = sum(np.sin(2.0 * math.pi * f * t + phase) for f, phase in zip(frequencies, phases, strict=True))
    wave = wave * (peak / np.abs(wave).max())
    return wave - wave[0]


def random_bursts(duration: float, count: int, length: float, amplitude: float, seed: int = 0) -> list:
    """Return force pulses of either sign at random times, for `Machine.bursts`.

    Args:
        duration: Span in which they start [s].
        count: How many.
        length: Of each [s].
        amplitude: Magnitude of each [N].
        seed: Of times and signs.
    """
    random = np.random.default_rng(seed)
    starts, signs = np.sort(random.uniform(0.0, duration, count)), random.choice([-1.0, 1.0], count)
    return [
        (float(start), length, float(sign) * amplitude) for start, sign in zip(starts, signs, strict=True)
    ]


@dataclasses.dataclass(frozen=True)
class Setup:
    """A machine with its loop, sensor and experiment.

    Attributes:
        machine: What moves.
        loop: What gives the command.
        sensor: What is read.
        rate: Ticks of the loop [Hz].
        duration: Length of the log [s].
        seed: Of the noise.
    """

    machine: Machine
    loop: Loop
    sensor: Sensor
    rate: float
    duration: float
    seed: int

    def with_effect(self, kind: str, **parameters: float) -> "Setup":
        """Return this experiment on a machine with one effect added or replaced."""
        return dataclasses.replace(self, machine=self.machine.with_effect(kind, **parameters))

    def run(self, **changes: Any) -> dict[str, np.ndarray]:
        """Simulate; changes go to `stepper.simulate` as they are."""
        options: dict[str, Any] = {
            "rate": self.rate,
            "duration": self.duration,
            "seed": self.seed,
        } | changes
        return simulate(self.machine, self.loop, self.sensor, **options)


def varied(seed: int, values: Sequence[float], spread: float) -> np.ndarray:
    """Return the values unchanged for seed 0, else each scaled at random by 1 +/- spread."""
    if seed == 0:
        return np.array(values, dtype=float)
    return np.array(values) * np.random.default_rng(seed).uniform(1.0 - spread, 1.0 + spread, len(values))


EMPS_WAYPOINTS = (0.0, 0.01693, 0.08182, 0.22942, 0.24635, 0.22942, 0.16454, 0.01693)  # m
EMPS_SPEEDS = (0.04212, 0.08255, 0.12467, 0.04212, 0.04212, 0.08255, 0.12467, 0.04212)  # m/s
EMPS_ACCELERATION = 0.8424  # m/s^2
EMPS_LOOP = Loop(kind="cascade_pd", kp=160.18, kv=243.45, velocity_average=2, limit=10.0)


def emps_like(seed: int = 0, noise: float = 1.0, duration: float = 25.0) -> Setup:
    """Build a ball-screw axis with the size, loop, tour and encoder of the EMPS benchmark.

    Seed 0 runs the benchmark's own tour, read off its reference; other seeds vary
    stroke and speeds by up to 20 %, so that two seeds make a log and a validation.
    The encoder: steps of 50 nm, and white noise of 12 nm below the step, with which
    the command is as rough as the logged one (fourth differences: 3.0 mV, there 3.2 mV).
    """
    t = np.arange(round(duration * 1000.0)) / 1000.0
    stroke = varied(seed, [1.0], 0.2)[0]
    reference = moves(t, stroke * np.array(EMPS_WAYPOINTS), varied(seed, EMPS_SPEEDS, 0.2), EMPS_ACCELERATION)
    machine = Machine(
        inertia=95.1,
        actuator_gain=35.15065,
        effects={"viscous_friction": {"coefficient": 203.5}, "coulomb_friction": {"level": 20.39}},
    )
    sensor = Sensor(position_resolution=5e-8, position_noise=1.2e-8 * noise, force_noise=2e-3 * noise)
    loop = dataclasses.replace(EMPS_LOOP, reference=reference)
    return Setup(machine, loop, sensor, rate=1000.0, duration=duration, seed=seed)


def servo(seed: int = 0, noise: float = 1.0, duration: float = 10.0) -> Setup:
    """Build a rotary servo under a PID: 1e-4 kg m^2, 0.1 N m/A, 20-bit encoder; all values chosen.

    Moves between rests cover dry friction and rest, a multisine on top covers inertia.
    """
    t = np.arange(round(duration * 1000.0)) / 1000.0
    speeds = varied(seed, [3.0, 8.0, 15.0, 30.0, 1.0, 20.0], 0.2)
    reference = moves(t, [0.0, 1.0, 4.0, -2.0, 5.0, 4.5], speeds, 400.0, rest=0.1)
    reference += multisine(t, [0.7, 1.9, 3.1, 5.3, 8.3], 0.3, seed)
    machine = Machine(
        inertia=1e-4,
        actuator_gain=0.1,
        effects={"viscous_friction": {"coefficient": 2e-4}, "coulomb_friction": {"level": 0.01}},
    )
    # 20 Hz of bandwidth: kp = J w^2 / k, kd = 1.6 J w / k, the integral five times slower
    loop = Loop(
        kind="pid", kp=15.8, kd=0.2, ki=400.0, derivative_filter=5e-4, anti_windup=True, limit=5.0,
        reference=reference,
    )  # fmt: skip
    resolution = 2.0 * math.pi / 2**20
    sensor = Sensor(position_resolution=resolution, position_noise=3e-6 * noise, force_noise=5e-3 * noise)
    return Setup(machine, loop, sensor, rate=1000.0, duration=duration, seed=seed)


def heavy_slide(seed: int = 0, noise: float = 1.0, duration: float = 25.0) -> Setup:
    """Build a slide of 1000 kg under a PD, 1000 N/V, scale of 0.1 um; all values chosen.

    8 Hz of bandwidth: kp = M w^2 / k, kd = 1.6 M w / k.
    """
    t = np.arange(round(duration * 1000.0)) / 1000.0
    speeds = varied(seed, [0.02, 0.1, 0.3, 0.05, 0.2, 0.3], 0.2)
    reference = moves(t, [0.0, 0.03, 0.2, 0.6, 0.5, 0.7], speeds, 1.0, rest=0.2)
    reference += multisine(t, [0.3, 0.8, 1.7, 3.1], 0.01, seed)
    machine = Machine(
        inertia=1000.0,
        actuator_gain=1000.0,
        effects={"viscous_friction": {"coefficient": 2000.0}, "coulomb_friction": {"level": 300.0}},
    )
    loop = Loop(kind="pd", kp=2500.0, kd=80.0, limit=10.0, reference=reference)
    sensor = Sensor(position_resolution=1e-7, position_noise=1e-7 * noise, force_noise=5e-3 * noise)
    return Setup(machine, loop, sensor, rate=1000.0, duration=duration, seed=seed)
