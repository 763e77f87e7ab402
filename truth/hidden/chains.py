"""Exact chains of masses that hide a known effect at a known mass or spring.

As in `truth.hidden.cases`, everything follows from the id of a case. Damping belongs to the plant, and an
added mass is the same as a mass: neither is hidden.
"""

import dataclasses
import functools
import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from truth.axis.machines import moves, multisine
from truth.axis.stepper import Loop, Sensor
from truth.chain import stepper as chain

NOISES = (0.3, 1.0, 3.0)
FIRST_SEED = {"calibrate": 3000, "test": 4001, "fresh": 5001, "last": 7001, "new": 9001, "latest": 10_001}
KINDS = (
    "coulomb_friction", "quadratic_drag", "constant_force", "stribeck_friction", "cogging",
    "quadratic_stiffness", "cubic_stiffness",
)  # fmt: skip
Values = dict[str, float]

# All chosen, for resonances from 3 to 10 Hz; each case draws its own around them.
MASS = (2.0, 1.4, 2.6)  # kg
DAMPING = 8.0  # N s/m
STIFFNESS = 1700.0  # N/m
LEVEL = 10.0  # N, of Coulomb friction
GAIN = (25.0, 20.0, 30.0)  # N/A
STROKE, SPEEDS, ACCELERATION, REST = 0.025, (0.04, 0.12, 0.2, 0.3, 0.4), 8.0, 0.05  # m, s
SINES, SINES_PEAK = (0.7, 1.9, 3.1, 5.3, 8.3), 0.002  # Hz, m
BANDWIDTH = {1000.0: 2.0 * math.pi * 18.0, 500.0: 2.0 * math.pi * 14.0}  # Hz -> rad/s
DURATION = 8.0  # s


@dataclasses.dataclass(frozen=True)
class ChainSetup:
    """A chain with its loops, sensor and experiment; attributes as in `truth.axis.machines.Setup`."""

    machine: chain.ChainMachine
    loops: Sequence[Loop]
    sensor: Sensor
    rate: float
    duration: float
    seed: int

    def run(self, **changes) -> dict[str, np.ndarray]:
        """Simulate; changes go to `simulate_chain` as they are."""
        options = {"rate": self.rate, "duration": self.duration, "seed": self.seed} | changes
        return chain.simulate_chain(self.machine, self.loops, self.sensor, **options)


@dataclasses.dataclass(frozen=True)
class ChainCase:
    """A chain, what its case file declares, and what it does not.

    Attributes:
        what: The hidden kind, or "null".
        scale: chain3 (every mass is driven) or chain2 (one of two is).
        noise: Factor on the sensor's noise.
        seed: Of everything drawn, the place included.
        sensor: Whether the case states the sensor.
        validated: Whether a validation log is given.
        length: 0: there is one duration only.
    """

    what: str
    scale: str
    noise: float
    seed: int
    sensor: bool = True
    validated: bool = True
    length: int = 0

    @property
    def group(self) -> str:
        """`chains` or `chain_nulls`."""
        return "chains" if self.hidden else "chain_nulls"

    @property
    def id(self) -> str:
        """Unique name."""
        where = "" if self.place is None else f"/{self.sort}{self.place}"
        extra = "" if self.sensor else "/unstated"
        return f"{self.group}/{self.what}{where}/{self.scale}/n{self.noise:g}/s{self.seed}{extra}"

    @property
    def hidden(self) -> tuple[str, ...]:
        """Hidden kinds."""
        return () if self.what == "null" else (self.what,)

    @property
    def sort(self) -> str:
        """Element on which the hidden effect acts, by its key in the case file."""
        return "spring" if self.what in chain.SPRING_EFFECTS else "joint"

    @property
    def place(self) -> int | None:
        """The mass or spring of the hidden effect, from 1; None for a null."""
        if not self.hidden:
            return None
        # In turn rather than at random: seeds follow each other, and each place has its case.
        return 1 + self.seed % (self.count + (self.sort == "spring"))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the hidden effects in results."""
        return tuple(chain.name_of(kind, self.place) for kind in self.hidden)

    @property
    def truth(self) -> Values:
        """True parameters by the names of results."""
        lists = {n: getattr(self.machine, n) for n in ("mass", "damping", "stiffness")}
        own = {f"{n}[{i}]": float(x) for n, xs in lists.items() for i, x in enumerate(xs, start=1)}
        return own | {f"{kind}.{n}": x for kind, vs in self.values.items() for n, x in vs.items()}

    @property
    def declared(self) -> tuple[chain.Place, ...]:
        """Kind and mass of the declared effects: Coulomb friction at each mass that does not hide it."""
        kind = "coulomb_friction"
        hidden = self.place if self.what == kind else None
        return tuple((kind, i) for i in range(1, self.count + 1) if i != hidden)

    @property
    def count(self) -> int:
        """Number of masses."""
        return int(self.scale[-1])

    @property
    def rate(self) -> float:
        """Rate of loops and log [Hz]."""
        return float(self._random("rate").choice(list(BANDWIDTH)))

    @property
    def duration(self) -> float:
        """Duration of each log [s]."""
        return DURATION

    @functools.cached_property
    def effects(self) -> dict[chain.Place, Values]:
        """True parameters of the effects, declared and hidden, by kind and mass or spring."""
        friction = self._friction()
        out = {place: friction[place] for place in self.declared}
        return out | ({(self.what, self.place): self._drawn()} if self.hidden else {})

    @property
    def values(self) -> dict[str, Values]:
        """True parameters by the names of results: `cubic_stiffness[spring 2]`."""
        return {chain.name_of(*place): values for place, values in self.effects.items()}

    @functools.cached_property
    def machine(self) -> chain.ChainMachine:
        """The chain without its effects."""
        random, n = self._random("machine"), self.count
        mass = np.array(MASS[:n]) * random.uniform(0.8, 1.2, n)
        stiffness = STIFFNESS * random.uniform(0.75, 1.25, n + 1)
        damping = DAMPING * random.uniform(0.6, 1.4, n)
        # Of two, the first or the second is driven.
        driven = tuple(range(1, 4)) if n == 3 else (int(random.integers(1, 3)),)
        gains = [GAIN[i - 1] for i in driven]
        lists = (mass.tolist(), damping.tolist(), stiffness.tolist())
        return chain.ChainMachine(*lists, actuated=driven, actuator_gain=gains)

    def setup(self, *, validation: bool = False) -> ChainSetup:
        """Build the experiment with its hidden effects."""
        return self._setup(self.effects, validation)

    def run(self, *, validation: bool = False) -> dict[str, np.ndarray]:
        """Simulate; return the log and the truth behind it."""
        return self.setup(validation=validation).run()

    def _setup(self, effects: Mapping[chain.Place, Values], validation: bool) -> ChainSetup:
        machine = dataclasses.replace(self.machine, effects=effects)
        random = np.random.default_rng([self.seed, int(validation)])
        loops = [self._loop(i, random) for i in machine.actuated]
        sensor = Sensor(1e-7, 5e-8 * self.noise, 4e-3 * self.noise)
        return ChainSetup(machine, loops, sensor, self.rate, DURATION, 2 * self.seed + validation)

    def _loop(self, joint: int, random: np.random.Generator) -> Loop:
        """Return a PD loop with a tour for one mass: kp = m w^2 / g, kd = 1.6 m w / g."""
        t = np.arange(round(DURATION * self.rate)) / self.rate
        # Alone, a drive must also move the mass beside it, against that one's friction.
        stroke = STROKE * random.uniform(0.8, 1.2) * (1.5 if self.count == 2 else 1.0)
        stops = stroke * random.permutation([-1.0, -0.6, -0.2, 0.4, 1.0])
        speeds = random.permutation(SPEEDS) * random.uniform(0.8, 1.2, len(SPEEDS))
        wanted = moves(t, [0.0, *stops], [*speeds, 0.2], ACCELERATION, REST)
        wanted += multisine(t, SINES, SINES_PEAK * stroke / STROKE, int(random.integers(2**31)))
        w, mass, gain = BANDWIDTH[self.rate], MASS[joint - 1], GAIN[joint - 1]
        kp = mass * w**2 / gain
        return Loop(kind="pd", kp=kp, kd=1.6 * kp / w, limit=30.0, reference=wanted)

    def _random(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(purpose.encode())])

    def _friction(self) -> dict[chain.Place, Values]:
        random = self._random("coulomb_friction")
        levels = LEVEL * random.uniform(0.7, 1.3, self.count)
        return {("coulomb_friction", i): {"level": float(x)} for i, x in enumerate(levels, start=1)}

    def _drawn(self) -> Values:
        """Draw the hidden effect's parameters; forces at full motion scale with the Coulomb level."""
        if self.what == "coulomb_friction":
            return self._friction()[self.what, self.place]
        log, i = self._setup(self._friction(), False).run(), self.place - 1
        # The few samples beyond are what a resonance or a multisine adds to the tour.
        large = lambda values, part: float(np.quantile(np.abs(values[:, i]), part))
        speed = lambda: large(log["true_velocity"], 0.95)
        way = lambda: large(log["true_position"], 0.99)
        reach = lambda: large(chain.elongations(log["true_position"]), 0.99)
        # A spring that softens must not snap through, not even at 1.5 times the reach.
        bend = lambda part: min(LEVEL, part * self.machine.stiffness[i] * reach())
        random = self._random(self.what)
        near = lambda value: float(value * random.uniform(0.7, 1.3))
        sign = float(random.choice([-1.0, 1.0]))
        most = 0.1 if sign < 0.0 else 1.0
        table = {
            "quadratic_drag": lambda: {"coefficient": near(0.9 * LEVEL / speed() ** 2)},
            "constant_force": lambda: {"level": sign * near(0.3 * LEVEL)},
            "stribeck_friction": lambda: {
                "level": near(0.5 * LEVEL), "velocity": near(0.16 * speed()),
            },
            "cogging": lambda: {
                "amplitude": near(0.3 * LEVEL), "period": near(way() / 12.0),
                "phase": float(random.uniform(-math.pi, math.pi)),
            },
            "quadratic_stiffness": lambda: {"coefficient": sign * near(bend(0.2) / reach() ** 2)},
            "cubic_stiffness": lambda: {"coefficient": sign * near(bend(most) / reach() ** 3)},
        }  # fmt: skip
        return table[self.what]()


def cases(split: str, seeds: int = 1) -> Iterator[ChainCase]:
    """Return all cases of a split, `seeds` of each kind, each case with a separate seed."""
    seed = FIRST_SEED[split]
    for _ in range(seeds):
        for case in (*_hiding(), *_nulls()):
            yield dataclasses.replace(case, seed=seed)
            seed += 1
    if seed > FIRST_SEED[split] + 1000:
        raise ValueError("the seeds of the splits overlap; ask for fewer.")


def _hiding() -> Iterator[ChainCase]:
    for k, kind in enumerate(KINDS):
        for noise in NOISES:
            yield ChainCase(kind, "chain3", noise, 0)
        yield ChainCase(kind, "chain2", NOISES[k % 3], 0)


def _nulls() -> Iterator[ChainCase]:
    for scale in ("chain3", "chain2"):
        for noise in NOISES:
            yield ChainCase("null", scale, noise, 0)
        yield ChainCase("null", scale, 1.0, 0, sensor=False)


def text_of_chain(case: ChainCase, *, known: bool = False) -> str:
    """Return the case file that does not declare what is hidden, its guesses 20 to 60 % off.

    Args:
        case: The case.
        known: Write the truth instead, what is hidden included, with nothing left to identify.
    """
    random = case._random("off")

    def one(value: float) -> str:
        guess = float(value * random.uniform(1.2, 1.6) ** random.choice([-1.0, 1.0]))
        return repr(float(value)) if known else f"{{ guess = {guess!r} }}"

    row = lambda values: f"[{', '.join(one(v) for v in values)}]"
    machine, setup = case.machine, case.setup()
    lines = ["[plant]", 'kind = "chain"']
    lines += [f"actuated = {list(machine.actuated)}"] if len(machine.actuated) < case.count else []
    lines += ["[plant.parameters]"]
    lines += [f"{name} = {row(getattr(machine, name))}" for name in ("mass", "damping", "stiffness")]
    joints = [place for _, place in case.declared]
    levels = [case.effects[place]["level"] for place in case.declared]
    lines += ["[[effects]]", 'kind = "coulomb_friction"', f"joint = {joints}", f"level = {row(levels)}"]
    if known and case.hidden:
        lines += ["[[effects]]", f'kind = "{case.what}"', f"{case.sort} = {case.place}"]
        lines += [f"{n} = {one(v)}" for n, v in case.effects[case.what, case.place].items()]
    lines += _drive_lines(setup)
    if case.sensor:
        lines += ["[sensor]", *[f"{k} = {v!r}" for k, v in dataclasses.asdict(setup.sensor).items()]]
    return "\n".join(lines) + "\n"


def _drive_lines(setup: ChainSetup) -> list[str]:
    """Return actuator, log and controller: a force, a reference and gains for each drive."""
    machine, text = setup.machine, lambda names: "[" + ", ".join(f'"{n}"' for n in names) + "]"
    return [
        "[actuator]", f"gain = {machine.gains.tolist()}",
        "[log]", 'time = "t"', f"position = {text(f'position{i + 1}' for i in range(machine.count))}",
        f"force = {text(f'force{d + 1}' for d in range(len(machine.driven)))}",
        f"reference = {text(f'reference{i}' for i in machine.actuated)}",
        "[controller]", 'kind = "pd"',
        *[f"{n} = {[getattr(loop, n) for loop in setup.loops]}" for n in ("kp", "kd", "limit")],
    ]  # fmt: skip


def write_files(case: ChainCase, folder: Path) -> list[Path]:
    """Write case, log and, if there is one, validation to files."""
    names = ["case.toml", "log.csv", "validation.csv"][: 2 + case.validated]
    paths = [Path(folder) / name for name in names]
    paths[0].write_text(text_of_chain(case))
    for k, path in enumerate(paths[1:]):
        chain.write_csv(case.run(validation=bool(k)), path)
    return paths
