"""Pairs of exact machines that differ in one thing, or in nothing, and an oracle of what can be seen.

The two logs of a pair follow different tours, of the few of their scale; machines, changes and noise are
drawn. Everything follows from the id of a pair.
"""

import dataclasses
import functools
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from truth.axis.cases import recorded, write_case
from truth.axis.machines import Setup, moves
from truth.axis.stepper import Sensor
from truth.chain import flexible_axes, flexible_log
from truth.chain.stepper import ChainMachine, elongations
from truth.hidden import cases as hidden_cases
from truth.hidden.bench import text_of
from truth.hidden.cases import HiddenCase
from truth.hidden.chain_oracle import at_mass, fading, noise_density, of_spring
from truth.hidden.chains import ChainSetup
from truth.hidden.machines import SCALES
from truth.hidden.oracle import (
    VISIBLE_NATS,
    VISIBLE_SHARE,
    Whitener,
    baseline_columns,
    effect_force,
    evidence_beyond,
    explained_away,
    faded,
    moving,
)

FIRST_SEED = {"calibrate": 50_000, "test": 60_000, "fresh": 70_000}
ON_AXIS = ("friction", "torque_constant", "payload", "temperature")
ON_BELT = ("loose_belt", "backlash")
# What a comparison must name: the parameter, or the effect in one log.
NAMES: Mapping[str, tuple[str, ...]] = {
    "friction": ("coulomb_friction.level",),
    "torque_constant": ("actuator_gain",),
    "payload": ("inertia",),
    "temperature": ("coulomb_friction.level", "viscous_friction.coefficient"),
    "loose_belt": ("stiffness",),
    "backlash": ("backlash",),
    "nothing": (),
}
# Effects that the case may lack in both logs alike.
ALIKE = tuple(
    k for k in hidden_cases.KINDS
    if k not in ("viscous_friction", "coulomb_friction", "static_friction", "actuator_gain", "added_mass")
)  # fmt: skip
DURATION = 4.0  # s, of the logs of a belt
NOISES = hidden_cases.NOISES


@dataclasses.dataclass(frozen=True)
class Toured(HiddenCase):
    """A hidden case whose tours, noise level and rate are those of one of three experiments.

    Machines and noise are drawn for each seed. Few tours let compiled code serve many pairs.
    """

    @property
    def experiment(self) -> int:
        """Number of the experiment."""
        return NOISES.index(self.noise)

    @property
    def rate(self) -> float:
        """Rate of loop and log [Hz]."""
        return list(self.size.bandwidth)[self.experiment]

    def _bare(self, validation: bool = False) -> Setup:
        tour = self.size.setup(
            1 + self.experiment, self.noise, self.duration, self.rate, validation=validation
        )
        return dataclasses.replace(tour, seed=2 * self.seed + validation)


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two logs of one case file.

    Attributes:
        what: What differs, a key of `NAMES`.
        scale: A key of `truth.hidden.machines.SCALES`, or "belt".
        noise: Factor on the sensor's noise.
        seed: Of everything drawn.
        alike: Effect that both machines have and the case lacks; empty for none.
        sensor: Whether the case states the sensor.
    """

    what: str
    scale: str
    noise: float
    seed: int
    alike: str = ""
    sensor: bool = True

    @property
    def id(self) -> str:
        """Unique name."""
        extra = (f"/both with {self.alike}" if self.alike else "") + ("" if self.sensor else "/unstated")
        return f"{self.what}/{self.scale}/n{self.noise:g}/s{self.seed}{extra}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the differences in results."""
        return NAMES[self.what]

    @functools.cached_property
    def change(self) -> dict[str, float]:
        """Factors, or the clearance [m], by which the second machine differs from the first."""
        random = np.random.default_rng([self.seed, zlib.crc32(b"change")])
        side = float(random.choice([-1.0, 1.0]))
        draw = lambda low, high: float(random.uniform(low, high))
        return {
            "friction": lambda: {"coulomb": 1.0 + side * draw(0.1, 0.4)},
            "torque_constant": lambda: {"gain": 1.0 + side * draw(0.04, 0.12)},
            "payload": lambda: {"inertia": 1.0 + draw(0.05, 0.3)},
            "temperature": lambda: {"viscous": draw(0.5, 0.8), "coulomb": draw(0.7, 0.9)},
            "loose_belt": lambda: {"stiffness": draw(0.6, 0.9)},
            "backlash": lambda: {"gap": draw(1e-5, 6e-5)},
            "nothing": lambda: {},
        }[self.what]()  # fmt: skip

    @functools.cached_property
    def hidden(self) -> HiddenCase:
        """The case of the first machine on an axis."""
        kinds = (self.alike,) if self.alike else ()
        declared = hidden_cases.declared_beside(kinds)
        what = self.alike or "viscous and coulomb"
        group = "effects" if kinds else "nulls"
        return Toured(group, what, self.scale, self.noise, self.seed, kinds, declared, self.sensor)

    def setup(self, second: bool) -> Setup:
        """Build the experiment of the first or the second machine on an axis."""
        base = self.hidden.setup(validation=second)
        if not second:
            return base
        return dataclasses.replace(base, machine=self._changed(base.machine))

    def _changed(self, machine):
        change = self.change
        effects = {kind: dict(values) for kind, values in machine.effects.items()}
        for kind, name, key in (
            ("coulomb_friction", "level", "coulomb"),
            ("viscous_friction", "coefficient", "viscous"),
        ):
            if key in change:
                effects[kind][name] *= change[key]
        return dataclasses.replace(
            machine,
            effects=effects,
            actuator_gain=machine.actuator_gain * change.get("gain", 1.0),
            inertia=machine.inertia * change.get("inertia", 1.0),
        )

    def belt(self, second: bool) -> ChainSetup:
        """Build the experiment of the first or the second machine with a belt."""
        random = np.random.default_rng(int(second))
        own = np.random.default_rng([self.seed, zlib.crc32(b"belt")])
        values = {name: value * own.uniform(0.8, 1.2) for name, value in flexible_axes.TRUTH.items()}
        if second and "stiffness" in self.change:
            values["stiffness"] *= self.change["stiffness"]
        machine = flexible_axes.machine(**values)
        if second and "gap" in self.change:
            machine = machine.with_effect("backlash", 2, gap=self.change["gap"])
        t = np.arange(round(DURATION * flexible_axes.RATE)) / flexible_axes.RATE
        stops = np.array((0.0, 0.22, 0.05, 0.18)) * random.uniform(0.8, 1.2)
        speeds = np.array((0.08, 0.2, 0.13, 0.25)) * random.uniform(0.75, 1.25, 4)
        reference = moves(t, stops, speeds, 1.5 * random.uniform(0.8, 1.2), 0.15)
        sensor = Sensor(position_resolution=flexible_axes.COUNT, force_noise=0.02 * self.noise)
        loop = flexible_axes.Loop(
            "cascade_pd", reference=reference, disturbance=flexible_log.PULSES, limit=10.0, **flexible_log.LAW
        )
        seed = 2 * self.seed + second
        return ChainSetup(machine, [loop], sensor, flexible_axes.RATE, DURATION, seed)

    def logs(self) -> list[dict]:
        """Return what a user would have of both machines, by the names of columns or of a log's fields."""
        if self.scale == "belt":
            return [flexible_axes.columns(self.belt(second).run(), noise=0.0) for second in (False, True)]
        return [recorded(self.setup(second)) for second in (False, True)]

    def write_case(self, folder: Path) -> Path:
        """Write the case file, which states nothing of what differs; return its path."""
        if self.scale == "belt":
            text = flexible_log.case("positions")
            stated = f"[sensor]\nposition_resolution = {flexible_axes.COUNT!r}\n"
            stated += f"force_noise = {0.02 * self.noise!r}\n"
            return write_case(folder, text + (stated if self.sensor else ""))
        return write_case(folder, text_of(self.hidden))

    def sights(self) -> dict[str, tuple[float, float]]:
        """Return evidence [nats] and share of the force of each difference, beside the others."""
        rows, force, share = (self._belt_rows if self.scale == "belt" else self._axis_rows)()
        out = {}
        for name in self.names:
            others = [rows[1][other] for other in self.names if other != name]
            columns = np.column_stack([rows[0], *others])
            plain = np.column_stack([share[0], *[share[1][other] for other in self.names if other != name]])
            left = explained_away(plain, share[2])
            part = float(np.linalg.norm(left) / np.linalg.norm(share[2]))
            out[name] = (evidence_beyond(columns, force), part)
        return out

    @property
    def visible(self) -> bool:
        """Check that an oracle sees every difference."""
        return all(e >= VISIBLE_NATS and part >= VISIBLE_SHARE for e, part in self.sights().values())

    def _axis_rows(self):
        """Return whitened and plain columns of one machine, those of the differences, and the force."""
        white, own, force, plain, plain_own, total = [], [], [], [], [], []
        for second in (False, True):
            setup = self.setup(second)
            log = setup.run()
            declared = self.setup(False).machine.actuator_gain
            fade = faded(moving(log["true_velocity"]))
            alike = [effect_force(kind, setup, log) for kind in self.hidden.hidden]
            columns = np.column_stack([*baseline_columns(self.hidden, setup, log), *alike])
            v, u = log["true_velocity"], declared * log["true_command"]
            shapes = {
                "coulomb_friction.level": np.sign(v), "viscous_friction.coefficient": v,
                "inertia": log["true_acceleration"], "actuator_gain": u,
            }  # fmt: skip
            changes = {name: shapes[name] * float(second) for name in self.names}
            whiten = Whitener(setup, fade)
            white.append(whiten(columns))
            force.append(whiten(u))
            own.append({name: whiten(x) for name, x in changes.items()})
            plain.append(fade[:, None] * columns)
            plain_own.append({name: fade * x for name, x in changes.items()})
            total.append(fade * u)
        return _stacked(white, own, force, plain, plain_own, total)

    def _belt_rows(self):
        white, own, force, plain, plain_own, total = [], [], [], [], [], []
        for second in (False, True):
            setup = self.belt(second)
            log = setup.run()
            machine: ChainMachine = setup.machine
            fades, n = fading(log), 2
            q, v, a = log["true_position"], log["true_velocity"], log["true_acceleration"]
            e, rate = elongations(q)[:, 1], elongations(v)[:, 1]
            columns = [at_mass(i, x[:, i], n) for x in (a, v, np.sign(v)) for i in range(n)]
            columns += [of_spring(1, e, n), of_spring(1, rate, n)]
            gap = self.change.get("gap", 0.0)
            inside = np.clip(e, -0.5 * gap, 0.5 * gap)
            within = np.where(np.abs(e) < 0.5 * gap, rate, 0.0)
            lost = machine.stiffness[1] * inside + (machine.coupling or (0.0, 0.0))[1] * within
            shapes = {"stiffness": of_spring(1, e, n), "backlash": of_spring(1, lost, n)}
            changes = {name: shapes[name] * float(second) for name in self.names}
            declared = at_mass(0, flexible_axes.GAIN * log["true_command"][:, 0], n)
            whiten = [Whitener(setup, fades[:, i], functools.partial(noise_density, i)) for i in range(n)]
            rows = lambda x, whiten=whiten: np.concatenate([w(x[:, i]) for i, w in enumerate(whiten)])
            white.append(np.column_stack([rows(c) for c in columns]))
            force.append(rows(declared))
            own.append({name: rows(x) for name, x in changes.items()})
            plain.append(np.column_stack([(fades * c).ravel() for c in columns]))
            plain_own.append({name: (fades * x).ravel() for name, x in changes.items()})
            total.append((fades * declared).ravel())
        return _stacked(white, own, force, plain, plain_own, total)


def _stacked(white, own, force, plain, plain_own, total):
    both = lambda parts: {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    return (
        (np.concatenate(white), both(own)),
        np.concatenate(force),
        (np.concatenate(plain), both(plain_own), np.concatenate(total)),
    )


def pairs(split: str, count: int = 100) -> Iterator[Pair]:
    """Return so many pairs that differ, and as many that do not, in turn."""
    seed = FIRST_SEED[split]
    kinds = (*ON_AXIS, "loose_belt", *ON_AXIS, "backlash")
    for k in range(count):
        what = kinds[k % len(kinds)]
        random = np.random.default_rng(seed + 2 * k)
        scale = "belt" if what in ON_BELT else str(random.choice(list(SCALES)))
        noise = float(random.choice(NOISES))
        yield Pair(what, scale, noise, seed + 2 * k, sensor=bool(random.random() < 0.75))
        # Of the others every tenth is a belt, and every second of the rest is of an incomplete model.
        belt = k % 10 == 4
        alike = ALIKE[(k // 2) % len(ALIKE)] if k % 2 and not belt else ""
        scale = "belt" if belt else str(random.choice(list(SCALES)))
        sensor = bool(random.random() < 0.75)
        yield Pair("nothing", scale, float(random.choice(NOISES)), seed + 2 * k + 1, alike, sensor)
