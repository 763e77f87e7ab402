"""Exact servo axis in a sampled loop whose drive may measure its velocity, logged more slowly than it ticks.

The command is held for a tick. Between two events (a tick, a stop) force, viscous and Coulomb friction have a
solution in closed form, so nothing is integrated in steps. No line is shared with the package.
"""

import dataclasses
import math

import numpy as np


@dataclasses.dataclass(frozen=True)
class Servo:
    """An axis with viscous and Coulomb friction, and its loop u = kp (r - q) - kd v.

    Attributes:
        inertia, viscous, coulomb: Of the axis [kg m^2, N m s/rad, N m].
        kp, kd: Gains of the loop [N m/rad, N m s/rad].
        period: Of the loop [s].
        own_velocity: Whether v is the true velocity; else the last two readings are differenced.
    """

    inertia: float
    viscous: float
    coulomb: float
    kp: float
    kd: float
    period: float
    own_velocity: bool = True

    def move(self, q: float, v: float, u: float, time: float) -> tuple[float, float]:
        """Return position and velocity after a time under a constant force."""
        while time > 0:
            if v == 0:
                if abs(u) <= self.coulomb:
                    return q, 0.0
                sign = math.copysign(1.0, u)
            else:
                sign = math.copysign(1.0, v)
            rate, final = self.viscous / self.inertia, (u - sign * self.coulomb) / self.viscous
            length, stops = time, False
            if v * final < 0:
                stop = math.log1p(-v / final) / rate
                length, stops = (stop, True) if stop <= time else (time, False)
            fade = -math.expm1(-rate * length)
            q += final * length + (v - final) * fade / rate
            v = 0.0 if stops else v + (final - v) * fade
            time -= length
        return q, v


def log_of(
    servo: Servo,
    reference: np.ndarray,
    every: int,
    *,
    noise: float = 0.0,
    resolution: float = 0.0,
    force_noise: float = 0.0,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Run a servo from rest and return one row in every few ticks.

    Args:
        servo: The machine with its loop.
        reference: Target at every tick [rad].
        every: Ticks for a row.
        noise, resolution: Of the encoder, which loop and log share [rad].
        force_noise: Of the logged command alone [N m].
        seed: Of the noise.

    Returns:
        t [s], q [rad], dq (the true velocity) [rad/s], u [N m] and ref [rad] of every row.
    """
    random = np.random.default_rng(seed)
    errors = noise * random.standard_normal(len(reference))
    rows = np.zeros((len(reference), 3))
    q = v = before = 0.0
    for k, target in enumerate(reference.tolist()):
        reading = q + float(errors[k])
        if resolution > 0:
            reading = round(reading / resolution) * resolution
        speed = v if servo.own_velocity else (reading - before) / servo.period if k else 0.0
        before = reading
        u = servo.kp * (target - reading) - servo.kd * speed
        rows[k] = reading, v, u
        q, v = servo.move(q, v, u, servo.period)
    rows[:, 2] += force_noise * random.standard_normal(len(rows))
    time = servo.period * np.arange(len(rows))
    names = zip(("q", "dq", "u"), rows.T, strict=True)
    columns = {"t": time, **dict(names), "ref": np.asarray(reference)}
    return {name: column[::every].copy() for name, column in columns.items()}


def drawn(seed: int, every: int, *, own_velocity: bool, rows: int = 400, held: bool = True) -> tuple:
    """Return a servo and its target, both drawn: a multisine, kept until the next row or smooth.

    Args:
        seed: Of servo and target.
        every: Ticks for a row of 20 ms.
        own_velocity: Of the loop.
        rows: Of the log.
        held: Whether the target is kept from row to row.
    """
    random = np.random.default_rng([36, seed])
    scale = random.uniform(0.6, 1.6, 5)
    inertia = 0.03 * scale[0]
    # 4 to 5 Hz of bandwidth, damped well.
    frequency = 2 * math.pi * 4.2 * random.uniform(0.85, 1.2)
    kp = inertia * frequency**2
    kd = 1.3 * inertia * frequency * random.uniform(0.8, 1.2)
    period = 0.02 / every
    servo = Servo(inertia, 0.1 * scale[1], 0.3 * scale[2], kp, kd, period, own_velocity)
    time = period * np.arange((rows - 1) * every + 1)
    wave = np.zeros_like(time)
    for line in random.uniform(0.3, 2.2, 4):
        wave += np.sin(2 * math.pi * line * time + random.uniform(0, 2 * math.pi))
    wave = 0.5 * (wave - wave[0])
    ticks = np.arange(len(time))
    return servo, wave[ticks // every * every] if held else wave
