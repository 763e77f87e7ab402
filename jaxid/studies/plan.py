"""What a study is to do: which estimators, noise, draws and starts, in which chunks."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.estimators import need_consistent
from jaxid.machine import Machine
from jaxid.names import DISCOVER, IN_LOOP
from jaxid.numerics.lanes import cores
from jaxid.scene import Scene
from jaxid.studies.levels import Level, levels_of

# Part of the memory that the chunks in work may take together.
_MEMORY = 0.25
# On a processor's cores: most runs in a chunk of long logs, of more the arrays no longer fit its cache; of
# short ones, that many samples in all, and most runs in a compiled call. Runs that want different things
# next then fill each other's gaps.
_LARGEST, _SAMPLES, _LANES = 8, 6400, 16
# Likewise on an accelerator; and memory of a device that does not state it [bytes].
_RUNS_OF_DEVICE = 4096
_UNSTATED = 2**32
# Of the arrays in a chunk; counted up where they change.
_LAYOUT = 2
# Deviations of a drawn delay that a simulation's memory of past commands allows for.
_FARTHEST = 5.0


@dataclass(frozen=True)
class Plan:
    """A study, ready to run.

    Args:
        case: The case.
        levels: Under what it runs.
        estimators: Names of methods, "discover", or "in_loop".
        draw: Relative spread of the true values: each is multiplied by exp(draw * N(0, 1)).
        start_spread: Likewise of the values that a fit starts from.
        runs: At each level.
        chunk: Runs that are simulated and solved together.
        seed: Of everything drawn.
    """

    case: Case
    levels: tuple[Level, ...]
    estimators: tuple[str, ...]
    draw: float
    start_spread: float
    runs: int
    chunk: int
    seed: int

    @classmethod
    def of(cls, case: Case, *, runs: int | None = None, seed: int = 0, workers: int | None = None) -> Plan:
        """The study of a case.

        Args:
            case: The case; its [study] may be left out.
            runs: In place of the case's.
            seed: Of everything drawn, from 0 to 2^31 - 1.
            workers: Chunks that are run at once; absent: one a core, or one on an accelerator.

        Raises:
            InputError: If the case cannot be simulated, nothing is unknown, a factor of the noise has
                nothing to act on, what the law found is asked of one that does not identify, or links must
                be what bodies can be and an estimator cannot keep to it.
        """
        setting, where = case.study, case.where
        if not 0 <= seed < 2**31:
            raise InputError(f"the seed is {seed}", hint="give one from 0 to 2147483647")
        draw = setting.draw
        model = _without(case, setting.hidden)
        levels = levels_of(case, model, float(np.exp(_FARTHEST * draw)))
        if not levels[0].machine.parameters.free:
            raise InputError(
                "nothing is unknown", where=where, hint="give at least one parameter as { guess = ... }"
            )
        estimators = setting.estimators
        for method in estimators:
            if method == IN_LOOP:
                _need_learner(case, levels[0].scene)
            elif method != DISCOVER:
                need_consistent(method, case)
        runs = int(setting.runs if runs is None else runs)
        if runs < 1:
            raise InputError(f"{runs} runs", where=where, hint="give one or more")
        chunk = _fitting(levels, runs, workers or at_once()) if setting.chunk is None else setting.chunk
        start_spread = setting.start_spread
        return cls(case, levels, estimators, draw, start_spread, runs, chunk, seed)

    @property
    def scene(self) -> Scene:
        """What is simulated, but for the settings."""
        return self.levels[0].scene

    @property
    def machine(self) -> Machine:
        """Of the model, but for the settings."""
        return self.levels[0].machine

    @property
    def fits(self) -> bool:
        """Whether anything is fitted to the logs."""
        return set(self.estimators) != {IN_LOOP}

    @property
    def settings(self) -> dict[str, list[float]]:
        """Values of each setting, in the order of the levels."""
        return {
            name: list(dict.fromkeys(level.setting[name] for level in self.levels))
            for name in self.levels[0].setting
        }

    @property
    def names(self) -> list[str]:
        """Of the parameters."""
        return self.machine.parameters.names

    @property
    def own(self) -> list[int]:
        """Where the model's parameters stand among those of what is simulated."""
        return [self.scene.machine.parameters.names.index(name) for name in self.names]

    @property
    def lanes(self) -> int:
        """Runs in a compiled call: all of a chunk on an accelerator."""
        return self.chunk if _accelerator() else min(self.chunk, _LANES)

    @functools.cached_property
    def chunks(self) -> list[tuple[int, range]]:
        """Level and runs of each chunk, in order."""
        starts = range(0, self.runs, self.chunk)
        return [
            (level, range(first, min(first + self.chunk, self.runs)))
            for level in range(len(self.levels)) for first in starts
        ]  # fmt: skip

    def drawn(self, run: int) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
        """True values of all that is simulated in a run, where its fit starts, and what draws its noise.

        They depend on the seed and the run's number alone: every level sees the same draws.
        """
        rng = np.random.default_rng([self.seed, run])
        truth = self.scene.machine.parameters.guess
        truth = truth * np.exp(self.draw * rng.standard_normal(len(truth)))
        # A fit must be able to reach it.
        truth = np.clip(truth, *self.scene.machine.parameters.bounds)
        start = rng.standard_normal(len(self.names))
        guess = self.machine.parameters.guess
        lower, upper = self.machine.parameters.bounds
        started = np.clip(guess * np.exp(self.start_spread * start), lower, upper)
        return truth, started, rng

    @property
    def manifest(self) -> dict:
        """What must be the same for chunks to belong together."""
        from importlib.metadata import version

        packages = ("jaxid", "jax", "jaxlib", "numpy", "scipy")
        return {
            "case": self.case.name,
            "fingerprint": fingerprint(self.case),
            "estimators": list(self.estimators),
            "hidden": list(self.case.study.hidden),
            **self.settings,
            "draw": self.draw,
            "start_spread": self.start_spread,
            "runs": self.runs,
            "chunk": self.chunk,
            "seed": self.seed,
            "parameters": self.names,
            "layout": _LAYOUT,
            "versions": {p: version(p) for p in packages},
        }


def _need_learner(case: Case, scene: Scene) -> None:
    """Refuse to ask a law what it found that does not identify, or that knows what is to be hidden."""
    law, where = scene.machine.controller, f"{case.where}, [study] estimators"
    if law is None or "estimator" not in law.of_machine:
        hint = 'take [controller] kind = "adaptive", or leave in_loop out'
        raise InputError("in_loop: no law identifies in this case", where=where, hint=hint)
    if case.study.hidden:
        what = "in_loop: the law has the whole case for its model, and nothing is hidden from it"
        raise InputError(what, where=where, hint="leave hidden out")


def _without(case: Case, hidden: tuple[str, ...]) -> Case:
    kinds = [e.cls.kind for e in case.effects]
    for kind in hidden:
        if kind not in kinds:
            raise InputError(
                f"{kind!r} is not among the effects of this case",
                where=f"{case.where}, [study] hidden",
                hint=f"name what is to be hidden from the model: {', '.join(kinds)}",
            )
    return replace(case, effects=tuple(e for e in case.effects if e.cls.kind not in hidden))


def _fitting(levels: tuple[Level, ...], runs: int, workers: int) -> int:
    """Runs that are solved together: as many as memory holds for all workers, not more than there are."""
    machine, joints = levels[0].machine, levels[0].model.plant.joints
    samples = max(len(level.scene.signal) for level in levels)
    refined = 8 if machine.controller is None and machine.hold == "band_limited" else 1
    # Residual, Jacobian and trajectory, kept twice over by the solver.
    each = 8 * samples * refined * joints * 2 * (len(machine.parameters.free) + 10)
    most = _RUNS_OF_DEVICE if _accelerator() else max(_LARGEST, _SAMPLES // samples)
    shared = -(-runs // workers)
    return int(np.clip(_MEMORY * _memory() / workers / each, 1, min(most, shared)))


def _accelerator() -> bool:
    """Whether there is one: it is filled."""
    return jax.local_devices()[0].platform != "cpu"


def _memory() -> float:
    """Bytes that arrays may take."""
    if _accelerator():
        return (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit", _UNSTATED)
    stated = hasattr(os, "sysconf")
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if stated else _UNSTATED


def at_once() -> int:
    """Chunks in work at once: one a core; on an accelerator one, which fills it."""
    return 1 if _accelerator() else cores()


def fingerprint(case: Case) -> str:
    """Of a case as it is in memory, and of every file that it names and that is there."""
    digest = hashlib.sha256(repr(replace(case, path=Path(case.name))).encode())
    for path in named_files(case):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def named_files(case: Case) -> list[Path]:
    """Files that a case names and that are there, in a fixed order."""
    found: set[Path] = set()

    def look(value: object) -> None:
        if isinstance(value, Mapping):
            for entry in value.values():
                look(entry)
        elif isinstance(value, (list, tuple)):
            for entry in value:
                look(entry)
        elif isinstance(value, str):
            path = case.folder / value.partition(":")[0]
            if value and path.is_file():
                found.add(path)

    look(case.tables)
    return sorted(found)


def digest_of(manifest: dict) -> str:
    """What every chunk of a study carries, so that no other's is taken for one of it."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def same(one: dict, other: dict) -> str:
    """What of two manifests differs, in words; empty where they belong together."""
    words = {"fingerprint": "the case or a file that it names"}
    keys = [k for k in one if json.dumps(one[k]) != json.dumps(other.get(k))]
    return ", ".join(words.get(k, k) for k in keys)
