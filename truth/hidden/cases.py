"""Exact axes that hide known physics, under several levels of noise.

Everything about a case follows from its id.
"""

import dataclasses
import functools
import math
import zlib
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from truth.axis.machines import Setup
from truth.hidden.machines import COARSE, SCALES, Scale, coarse_setup

NOISES = (0.3, 1.0, 3.0)
# Splits but "calibrate", "new" and "latest" were test splits once; faults that they showed were repaired.
FIRST_SEED = {
    "calibrate": 1000,
    "seen": 2000,
    "seen_too": 6000,
    "test": 8000,
    "fresh": 12_000,
    "last": 14_000,
    "new": 16_000,
    "latest": 18_000,
}
Values = dict[str, float]


@dataclasses.dataclass(frozen=True)
class HiddenCase:
    """A machine, what its case file declares, and what it does not.

    Attributes:
        group: effects, pairs, nulls, outside or short.
        what: The hidden kinds joined by " + ", or the variant of a null.
        scale: A key of `SCALES`, or "coarse".
        noise: Factor on the sensor's noise.
        seed: Of everything drawn.
        hidden: Kinds not declared; their parameters are drawn.
        declared: Kinds that the case has.
        sensor: Whether the case states the sensor.
        validated: Whether a validation log is given.
        length: Index into the scale's durations.
    """

    group: str
    what: str
    scale: str
    noise: float
    seed: int
    hidden: tuple[str, ...] = ()
    declared: tuple[str, ...] = ("viscous_friction", "coulomb_friction")
    sensor: bool = True
    validated: bool = True
    length: int = 0

    @property
    def id(self) -> str:
        """Unique name."""
        extra = ("" if self.sensor else "/unstated") + (f"/l{self.length}" if self.length else "")
        return f"{self.group}/{self.what}/{self.scale}/n{self.noise:g}/s{self.seed}{extra}"

    @property
    def inertia_known(self) -> bool:
        """Check that the case gives the inertia; a gain and a mass are identifiable only then."""
        return bool({"actuator_gain", "added_mass"} & set(self.hidden))

    @property
    def size(self) -> Scale:
        """Scale to which drawn parameters are relative."""
        return COARSE if self.scale == "coarse" else SCALES[self.scale]

    @property
    def rate(self) -> float:
        """Rate of loop and log [Hz]; varies by seed."""
        return float(self._random("rate").choice(list(self.size.bandwidth)))

    @property
    def duration(self) -> float:
        """Duration of each log [s]."""
        return self.size.durations[self.length]

    @property
    def off(self) -> float:
        """Factor between guesses and truth: 20 to 60 % either way."""
        random = self._random("off")
        return float(random.uniform(1.2, 1.6) ** random.choice([-1.0, 1.0]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the hidden effects in results."""
        return self.hidden

    @property
    def truth(self) -> Values:
        """True parameters by the names of results."""
        own = {f"{kind}.{n}": x for kind, values in self.values.items() for n, x in values.items()}
        return {"inertia": self._bare().machine.inertia} | own

    @functools.cached_property
    def values(self) -> dict[str, Values]:
        """True parameters of the effects, declared and hidden."""
        out = {kind: self._drawn(kind) for kind in self.declared}
        return out | {kind: self._drawn(kind) for kind in self.hidden}

    def setup(self, *, validation: bool = False) -> Setup:
        """Build the experiment with its hidden effects."""
        base = self._bare(validation)
        machine = dataclasses.replace(base.machine, effects=self.values)
        if self.group == "outside":
            machine = dataclasses.replace(machine, **self._outside(base, validation))
        return dataclasses.replace(base, machine=machine)

    def _bare(self, validation: bool = False) -> Setup:
        make = coarse_setup if self.scale == "coarse" else self.size.setup
        return make(self.seed, self.noise, self.duration, self.rate, validation=validation)

    def _random(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(purpose.encode())])

    def _drawn(self, kind: str) -> Values:
        bare = self._bare()
        own = bare.machine.effects
        size = self.size
        level = own["coulomb_friction"]["level"]
        random = self._random(kind)
        near = lambda value: float(value * random.uniform(0.7, 1.3))
        sign = float(random.choice([-1.0, 1.0]))
        big = 2.0 if self.scale == "coarse" else 1.0
        if kind == "saturation":
            return {"limit": float(random.uniform(0.75, 0.95) * self._peak())}
        if kind in own:
            ((name, value),) = own[kind].items()
            return {name: near(value)}
        if kind in _FORCES:
            amount, power, variable = _FORCES[kind]
            signed = 1.0 if kind in _DISSIPATING else sign
            reach = {"v": size.speed, "q": size.stroke}[variable] ** power
            return {_NAMES.get(kind, "coefficient"): signed * near(big * amount * level / reach)}
        table: dict[str, Callable[[], Values]] = {
            "stribeck_friction": lambda: {
                "level": near(0.5 * big * level), "velocity": near(0.16 * size.speed),
            },
            "cogging": lambda: {
                "amplitude": near(0.3 * big * level), "period": near(size.stroke / 12.0),
                "phase": float(random.uniform(-math.pi, math.pi)),
            },
            # It slips after a sixtieth of the stroke.
            "hysteresis": lambda: {
                "stiffness": near(60.0 * level / size.stroke), "level": near(level),
            },
            "actuator_gain": lambda: {"gain": 1.0 + sign * near(0.15 * big)},
            # Relative to the loop, which must stay stable.
            "actuator_lag": lambda: {"time_constant": near(0.2 * big / self._bandwidth)},
            "input_delay": lambda: {"delay": near(0.15 * big / self._bandwidth)},
            "added_mass": lambda: {"mass": near(0.16 * big * bare.machine.inertia)},
            # The levels change by this part over the log.
            "friction_drift": lambda: {"rate": sign * near(0.4 / self.duration)},
        }  # fmt: skip
        return table[kind]()

    @property
    def _bandwidth(self) -> float:
        return self.size.bandwidth[self.rate]

    def _peak(self) -> float:
        """Return the largest force of the same run without clipping, except the rarest samples [N]."""
        bare = self._bare()
        values = {k: self._drawn(k) for k in (*self.declared, *self.hidden) if k != "saturation"}
        machine = dataclasses.replace(bare.machine, effects=values)
        force = dataclasses.replace(bare, machine=machine).run()["true_force"]
        return float(np.quantile(np.abs(force), 0.995))

    def _outside(self, base: Setup, validation: bool) -> dict:
        """Add bursts while the axis moves, or a force that is a sine in time."""
        level = base.machine.effects["coulomb_friction"]["level"]
        random = self._random(f"outside {validation}")
        if self.what == "clock":
            frequency = self._random("clock").uniform(5.0, 12.0)
            return {"clock_force": (0.3 * level, float(frequency))}
        length = 0.006 * self.duration
        speed = np.abs(np.gradient(base.loop.reference)) * self.rate
        window = round(length * self.rate)
        slow = np.convolve(speed < 0.15 * speed.max(), np.ones(window + 1), "full")[window:] > 0
        edge = int(0.05 * len(speed))  # filters leave out the ends
        starts = []
        for i in random.permutation(np.arange(edge, len(speed) - edge - window)):
            if not slow[i] and all(abs(i - s) > 4 * window for s in starts):
                starts.append(int(i))
            if len(starts) == 6:
                break
        signs = random.choice([-1.0, 1.0], len(starts))
        return {
            "bursts": [
                (s / self.rate, length, 1.5 * level * float(x))
                for s, x in zip(sorted(starts), signs, strict=True)
            ]
        }


# Kind -> force at full speed or stroke over the Coulomb level, power, and of what.
_FORCES: Mapping[str, tuple[float, int, str]] = {
    "static_friction": (0.5, 0, "v"),
    "asymmetric_viscous": (0.35, 1, "v"),
    "quadratic_drag": (0.6, 2, "v"),
    "cubic_friction": (0.6, 3, "v"),
    "quartic_friction": (0.6, 4, "v"),
    "constant_force": (0.3, 0, "q"),
    "linear_stiffness": (1.0, 1, "q"),
    "quadratic_stiffness": (1.0, 2, "q"),
    "cubic_stiffness": (1.0, 3, "q"),
}
_NAMES = {"static_friction": "level", "constant_force": "level"}
_DISSIPATING = ("static_friction", "quadratic_drag", "cubic_friction", "quartic_friction")
BASE = ("viscous_friction", "coulomb_friction")
KINDS = (
    "viscous_friction", "coulomb_friction", "static_friction", "stribeck_friction",
    "asymmetric_viscous", "quadratic_drag", "cubic_friction", "quartic_friction",
    "constant_force", "linear_stiffness", "quadratic_stiffness", "cubic_stiffness", "cogging",
    "hysteresis", "actuator_gain", "actuator_lag", "input_delay", "saturation", "added_mass",
    "friction_drift",
)  # fmt: skip
PAIRS = (
    ("coulomb_friction", "cogging"),
    ("input_delay", "asymmetric_viscous"),
    ("constant_force", "cubic_stiffness"),
    ("stribeck_friction", "linear_stiffness"),
    ("viscous_friction", "constant_force"),
    ("cogging", "friction_drift"),
    ("actuator_lag", "quadratic_drag"),
    ("hysteresis", "constant_force"),
)
NULLS: Mapping[str, tuple[str, ...]] = {
    "viscous": ("viscous_friction",),
    "viscous and coulomb": BASE,
    "stribeck too": (*BASE, "stribeck_friction"),
}
SHORT = (
    "coulomb_friction", "viscous_friction", "constant_force", "linear_stiffness", "cogging",
    "input_delay", "added_mass", "actuator_gain",
)  # fmt: skip


def declared_beside(hidden: tuple[str, ...]) -> tuple[str, ...]:
    """Return the effects that a case declares beside hidden ones: viscous and Coulomb friction.

    Presliding takes the place of Coulomb friction, as in the machine.
    """
    without = {*hidden, *(["coulomb_friction"] if "hysteresis" in hidden else [])}
    return tuple(kind for kind in BASE if kind not in without)


def _hiding(group: str, hidden: tuple[str, ...], scale: str, noise: float, seed: int, **more):
    what = " + ".join(hidden)
    declared = declared_beside(hidden)
    return HiddenCase(group, what, scale, noise, seed, hidden, declared, **more)


def cases(split: str, seeds: int = 1) -> Iterator[HiddenCase]:
    """Return all cases of a split, `seeds` of each kind.

    Every case has a seed of its own, so that nothing that is drawn repeats.
    """
    seed = FIRST_SEED[split]
    for build in (_effects, _pairs, _nulls, _outside, _short, _coarse_nulls):
        for _ in range(seeds):
            for case in build():
                yield dataclasses.replace(case, seed=seed)
                seed += 1
    if seed > FIRST_SEED[split] + 1000:
        raise ValueError("the seeds of the splits overlap; ask for fewer.")


def _effects() -> Iterator[HiddenCase]:
    for kind in KINDS:
        for scale in SCALES:
            for noise in NOISES:
                yield _hiding("effects", (kind,), scale, noise, 0)


def _pairs() -> Iterator[HiddenCase]:
    for pair in PAIRS:
        for scale in SCALES:
            for noise in NOISES:
                yield _hiding("pairs", pair, scale, noise, 0)


def _nulls() -> Iterator[HiddenCase]:
    for what, declared in NULLS.items():
        for scale in SCALES:
            for noise in NOISES:
                for sensor in (True, False):
                    for length in (1, 2):
                        yield HiddenCase(
                            "nulls", what, scale, noise, 0, (), declared, sensor, not sensor, length
                        )


def _outside() -> Iterator[HiddenCase]:
    for what in ("bursts", "clock"):
        for scale in SCALES:
            for noise in NOISES:
                yield HiddenCase("outside", what, scale, noise, 0)


def _short() -> Iterator[HiddenCase]:
    for i, kind in enumerate(SHORT):
        for k, noise in enumerate(NOISES):
            yield _hiding("short", (kind,), "coarse", noise, 0, length=(i + k) % 2)


def _coarse_nulls() -> Iterator[HiddenCase]:
    for what, declared in NULLS.items():
        for k, noise in enumerate(NOISES):
            for sensor in (True, False):
                length = (k + sensor) % 2
                yield HiddenCase("nulls", what, "coarse", noise, 0, (), declared, sensor, not sensor, length)
