"""Exact axes at three scales and several sampling rates, each with tours to fit and to validate on."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from truth.axis import machines
from truth.axis.machines import Setup
from truth.axis.stepper import Loop, Sensor


@dataclasses.dataclass(frozen=True)
class Scale:
    """A machine's size and what it does.

    Attributes:
        name: Of the preset in `truth.axis.machines`, which gives machine and sensor.
        motion: As the case file says it.
        waypoints: Of the tour [m].
        speeds: Of its moves [m/s].
        acceleration: Of its ramps [m/s^2].
        rest: After each move [s].
        sines: Lines of a multisine on top [Hz].
        sines_peak: Of that [m].
        durations: Of logs: the usual one, a short one, a long one [s].
        bandwidth: Rate [Hz] -> of the loop [rad/s], with a stable margin even under a drive's lag.
        loop: Gains for a bandwidth and a rate.
    """

    name: str
    motion: str
    waypoints: Sequence[float]
    speeds: Sequence[float]
    acceleration: float
    rest: float
    sines: Sequence[float]
    sines_peak: float
    durations: tuple[float, float, float]
    bandwidth: Mapping[float, float]
    loop: Callable[[float, float], Loop]

    @property
    def stroke(self) -> float:
        """Farthest waypoint from zero [m]."""
        return max(abs(w) for w in self.waypoints)

    @property
    def speed(self) -> float:
        """Speed of the fastest move [m/s]."""
        return max(self.speeds)

    def setup(
        self, seed: int, noise: float, duration: float, rate: float, *, validation: bool = False
    ) -> Setup:
        """Build machine, loop, sensor and tour.

        The tour to validate on is longer where the one to fit is shorter, by 10 to 40 %; every
        speed and the acceleration are drawn anew.
        """
        own = getattr(machines, self.name)(0, noise, 1.0)
        random = np.random.default_rng([seed, int(validation)])
        side = 1.0 if (seed + validation) % 2 else -1.0
        stroke = 1.0 + side * random.uniform(0.05, 0.2)
        speeds = np.array(self.speeds) * random.uniform(0.75, 1.25, len(self.speeds))
        acceleration = self.acceleration * random.uniform(0.8, 1.2)
        t = np.arange(round(duration * rate)) / rate
        waypoints = stroke * np.array(self.waypoints)
        reference = machines.moves(t, waypoints, speeds, acceleration, self.rest)
        if self.sines:
            phases = int(random.integers(2**31))
            reference += machines.multisine(t, self.sines, stroke * self.sines_peak, phases)
        loop = dataclasses.replace(self.loop(self.bandwidth[rate], rate), reference=reference)
        noise_seed = 2 * seed + validation
        return Setup(own.machine, loop, own.sensor, rate, duration, noise_seed)


def _emps_loop(bandwidth: float, rate: float) -> Loop:
    """Return the benchmark's cascade at its bandwidth of 120 rad/s, slowed by a factor."""
    slower = bandwidth / 120.0
    own = machines.EMPS_LOOP
    average = own.velocity_average if rate >= 1000.0 else 1
    return dataclasses.replace(own, kp=own.kp * slower, kv=own.kv * slower, velocity_average=average)


def _servo_loop(bandwidth: float, rate: float) -> Loop:
    """Return the preset's PID: kp = J w^2 / k, kd = 1.6 J w / k, the integral five times slower."""
    kp = 1e-4 * bandwidth**2 / 0.1
    return Loop(
        kind="pid", kp=kp, kd=1.6 * kp / bandwidth, ki=kp * bandwidth / 5.0,
        derivative_filter=0.5 / rate, anti_windup=True, limit=5.0,
    )  # fmt: skip


def _slide_loop(bandwidth: float, rate: float) -> Loop:
    """Return the preset's PD: kp = M w^2 / k, kd = 1.6 M w / k."""
    kp = 1000.0 * bandwidth**2 / 1000.0
    return Loop(kind="pd", kp=kp, kd=1.6 * kp / bandwidth, limit=10.0)


def _hz(**values: float) -> dict[float, float]:
    return {float(rate[1:]): 2.0 * math.pi * f for rate, f in values.items()}


SCALES = {
    "emps_like": Scale(
        "emps_like", "linear", machines.EMPS_WAYPOINTS, machines.EMPS_SPEEDS,
        machines.EMPS_ACCELERATION, 0.0, (), 0.0, (8.0, 4.0, 16.0),
        _hz(r1000=19.1, r500=15.0, r250=8.0, r200=7.0), _emps_loop,
    ),
    "servo": Scale(
        "servo", "rotary", (0.0, 1.0, 4.0, -2.0, 5.0, 4.5), (3.0, 8.0, 15.0, 30.0, 1.0, 20.0),
        400.0, 0.1, (0.7, 1.9, 3.1, 5.3, 8.3), 0.3, (3.0, 1.0, 6.0),
        _hz(r1000=20.0, r500=16.0, r250=9.0, r200=8.0), _servo_loop,
    ),
    "heavy_slide": Scale(
        "heavy_slide", "linear", (0.0, 0.03, 0.2, 0.6, 0.5, 0.7), (0.02, 0.1, 0.3, 0.05, 0.2, 0.3),
        1.0, 0.2, (0.3, 0.8, 1.7, 3.1), 0.01, (10.0, 2.0, 20.0),
        _hz(r1000=8.0, r500=8.0, r250=7.0, r200=6.0), _slide_loop,
    ),
}  # fmt: skip

# The servo through an encoder of 500 counts, sampled every 5 ms: quick moves, so that 100 samples
# hold several.
COARSE = dataclasses.replace(
    SCALES["servo"],
    waypoints=(0.0, 1.5, -1.0, 2.0),
    speeds=(15.0, 25.0, 20.0, 12.0),
    rest=0.0,
    sines=(2.3, 4.1),
    sines_peak=0.15,
    durations=(1.0, 0.5, 1.0),
    bandwidth=_hz(r200=6.0),
)
COARSE_RESOLUTION = 2.0 * math.pi / 500.0  # rad


def coarse_setup(seed: int, noise: float, duration: float, rate: float, *, validation: bool = False) -> Setup:
    """Build the servo with a coarse encoder, and three times the friction."""
    setup = COARSE.setup(seed, noise, duration, rate, validation=validation)
    sensor = Sensor(COARSE_RESOLUTION, 3e-6 * noise, 5e-3 * noise)
    effects = {
        kind: {name: 3.0 * value for name, value in values.items()}
        for kind, values in setup.machine.effects.items()
    }
    machine = dataclasses.replace(setup.machine, effects=effects)
    return dataclasses.replace(setup, machine=machine, sensor=sensor)
