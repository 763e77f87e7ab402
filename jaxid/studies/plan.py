"""The plan of a study: its estimators, noise levels, draws and starts, in chunks."""

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
from jaxid.estimators.needs import need_consistent, need_likelihood
from jaxid.machine import Machine
from jaxid.names import DISCOVER, IN_LOOP, SEVERAL_LOGS, USER_METHODS
from jaxid.numerics.lanes import accelerator, cores
from jaxid.scene import Scene
from jaxid.studies.levels import Level, levels_of

# Fraction of the memory that the chunks in work may take together, and of an accelerator's.
_MEMORY, _MEMORY_OF_DEVICE = 0.25, 0.5
# On a processor: largest number of runs in a chunk of long logs, beyond which the arrays exceed its cache;
# number of samples in a chunk of short logs; and largest number of runs in a compiled call. Runs that need
# different solves next then fill each other's gaps.
_LARGEST, _SAMPLES, _LANES = 8, 6400, 16
# Largest number of runs in a chunk on an accelerator, and memory of a device that does not state it [bytes].
_RUNS_OF_DEVICE = 4096
_UNSTATED = 2**32
# Version of the arrays in a chunk, counted up if they change.
_LAYOUT = 3
# Deviations of a drawn delay that a simulation's memory of past commands allows for.
_FARTHEST = 5.0

# True values of a run, the start of its fit, and the generator of its noise.
Draw = tuple[np.ndarray, np.ndarray, np.random.Generator]

# Value, lower and upper bound of each parameter.
_Centre = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Plan:
    """A study, ready to run.

    Args:
        case: The case.
        levels: Combinations of settings under which it runs.
        estimators: Names of methods, "discover", or "in_loop".
        draw: Relative spread of the true values, each of which is multiplied by exp(draw * N(0, 1)).
        start_spread: Relative spread of the values at which a fit starts, drawn in the same way.
        runs: Number of runs at each level.
        chunk: Number of runs that are simulated and solved together.
        seed: Seed of everything that is drawn.
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
        """Make the plan of a case's study.

        Args:
            case: The case; its [study] may be left out.
            runs: Number of runs at each level; None: that of the case.
            seed: Seed of everything that is drawn, from 0 to 2^31 - 1.
            workers: Number of chunks that run at once; None: see `at_once`.

        Raises:
            InputError: If the case cannot be simulated, no parameter is unknown, the case states no noise
                that a factor could multiply, `in_loop` is asked of a law that does not identify, links must
                be physically consistent and an estimator cannot ensure it, or an estimator needs a force and
                [log] names none.
        """
        setting, where = case.study, case.where
        if not 0 <= seed < 2**31:
            raise InputError(f"the seed is {seed}", hint="give one from 0 to 2147483647")
        draw = setting.draw
        model = _without(case, setting.hidden)
        levels = levels_of(case, model, float(np.exp(_FARTHEST * draw)))
        if not levels[0].machine.parameters.free:
            raise InputError(
                "no parameter is unknown", where=where, hint="give at least one parameter as { guess = ... }"
            )
        estimators = setting.estimators
        several = len(case.fits) > 1
        for method in estimators:
            if several and method != DISCOVER and method not in (*SEVERAL_LOGS, *USER_METHODS):
                what, hint = f"{method} fits one log", f"take one of {', '.join(SEVERAL_LOGS)}"
                raise InputError(what, where=f"{where}, [study] estimators", hint=hint)
            if method == IN_LOOP:
                _need_learner(case, levels[0].scene)
            elif method != DISCOVER:
                need_consistent(method, case)
                need_likelihood(method, case)
            _need_force(method, case)
        runs = int(setting.runs if runs is None else runs)
        if runs < 1:
            raise InputError(f"{runs} runs", where=where, hint="give one or more")
        chunk = _fitting(levels, runs, workers or at_once()) if setting.chunk is None else setting.chunk
        start_spread = setting.start_spread
        return cls(case, levels, estimators, draw, start_spread, runs, chunk, seed)

    @property
    def scene(self) -> Scene:
        """The simulated scene of the first level."""
        return self.levels[0].scene

    @property
    def machine(self) -> Machine:
        """The machine of the model at the first level."""
        return self.levels[0].machine

    @property
    def fits(self) -> bool:
        """The flag of a study that fits anything to the logs."""
        return set(self.estimators) != {IN_LOOP}

    @property
    def without_force(self) -> bool:
        """The flag of a study of logs that hold no force, as the case says."""
        return logs_no_force(self.case)

    @property
    def settings(self) -> dict[str, list[float]]:
        """Values of each setting, in the order of the levels."""
        return {
            name: list(dict.fromkeys(level.setting[name] for level in self.levels))
            for name in self.levels[0].setting
        }

    @property
    def names(self) -> list[str]:
        """Names of the parameters."""
        return self.machine.parameters.names

    @property
    def own(self) -> list[int]:
        """Positions of the model's parameters among those of the simulated machine."""
        return [self.scene.machine.parameters.names.index(name) for name in self.names]

    @property
    def lanes(self) -> int:
        """Number of runs in a compiled call; on an accelerator all of a chunk."""
        return self.chunk if accelerator() else min(self.chunk, _LANES)

    @functools.cached_property
    def chunks(self) -> list[tuple[int, range]]:
        """Level and runs of each chunk, in order."""
        starts = range(0, self.runs, self.chunk)
        return [
            (level, range(first, min(first + self.chunk, self.runs)))
            for level in range(len(self.levels)) for first in starts
        ]  # fmt: skip

    def drawn(self, run: int) -> Draw:
        """Draw the true values of a run, the start of its fit, and the generator of its noise.

        They depend on the seed and the run's number alone, so that every level has the same draws.
        """
        rng = np.random.default_rng([self.seed, run])
        true, guess = self._centres
        # A fit must be able to reach the true values.
        truth = _about(*true, self.draw * rng.standard_normal(len(true[0])))
        started = _about(*guess, self.start_spread * rng.standard_normal(len(self.names)))
        return truth, started, rng

    @functools.cached_property
    def _centres(self) -> tuple[_Centre, _Centre]:
        """Value, lower and upper bound of each parameter of the simulated machine, and of the model."""
        true, guess = self.scene.machine.parameters, self.machine.parameters
        return (true.guess, *true.bounds), (guess.guess, *guess.bounds)

    @property
    def manifest(self) -> dict:
        """All that must be equal for chunks to belong to one study."""
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


def _about(value: np.ndarray, lower: np.ndarray, upper: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return values changed by factors exp(change), within bounds."""
    return np.minimum(np.maximum(value * np.exp(change), lower), upper)


def logs_no_force(case: Case) -> bool:
    """Check that a case names the columns of a log of a loop, and that no force is among them."""
    return case.controller is not None and case.log is not None and case.log.force is None


def _need_force(method: str, case: Case) -> None:
    """Refuse a method of jaxid that needs a force in a study of logs without one."""
    if logs_no_force(case) and method not in ("output_error", DISCOVER, IN_LOOP, *USER_METHODS):
        raise InputError(
            f"{method} needs a force, and [log] names none",
            where=f"{case.where}, [study] estimators",
            hint="take output_error, or name a column of the force in [log]",
        )


def _need_learner(case: Case, scene: Scene) -> None:
    """Refuse `in_loop` for a law that does not identify, or that knows the hidden effects."""
    law, where = scene.machine.controller, f"{case.where}, [study] estimators"
    if law is None or "estimator" not in law.of_machine:
        hint = 'take [controller] kind = "adaptive", or leave in_loop out'
        raise InputError("in_loop: no law identifies in this case", where=where, hint=hint)
    if case.study.hidden:
        what = "in_loop: the law uses the whole case as its model, so that no effect is hidden from it"
        raise InputError(what, where=where, hint="leave hidden out")


def _without(case: Case, hidden: tuple[str, ...]) -> Case:
    kinds = [e.cls.kind for e in case.effects]
    for kind in hidden:
        if kind not in kinds:
            raise InputError(
                f"{kind!r} is not among the effects of this case",
                where=f"{case.where}, [study] hidden",
                hint=f"name effects of the case: {', '.join(kinds)}",
            )
    return replace(case, effects=tuple(e for e in case.effects if e.cls.kind not in hidden))


def _fitting(levels: tuple[Level, ...], runs: int, workers: int) -> int:
    """Return the number of runs that are solved together: as many as the memory holds."""
    machine, joints = levels[0].machine, levels[0].model.plant.joints
    samples = max(len(level.scene.signal) for level in levels)
    refined = 8 if machine.controller is None and machine.hold == "band_limited" else 1
    # Residual, Jacobian and trajectory, kept twice over by the solver.
    each = 8 * samples * refined * joints * 2 * (len(machine.parameters.free) + 10)
    if accelerator():
        # Chunks of one size, since a smaller one takes as long.
        chunks = np.ceil(runs / np.clip(_MEMORY_OF_DEVICE * _memory() / each, 1, _RUNS_OF_DEVICE))
        return int(np.ceil(runs / chunks))
    most, shared = max(_LARGEST, _SAMPLES // samples), -(-runs // workers)
    return int(np.clip(_MEMORY * _memory() / workers / each, 1, min(most, shared)))


def _memory() -> float:
    """Return the memory of the device [bytes]."""
    if accelerator():
        return (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit", _UNSTATED)
    stated = hasattr(os, "sysconf")
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if stated else _UNSTATED


def at_once() -> int:
    """Return the number of chunks in work at once: one a core, or one computed and one drawn."""
    return 2 if accelerator() else cores()


def fingerprint(case: Case) -> str:
    """Return the digest of a case as it is in memory, and of every existing file that it names."""
    digest = hashlib.sha256(repr(replace(case, path=Path(case.name))).encode())
    for path in named_files(case):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def named_files(case: Case) -> list[Path]:
    """Return the existing files that a case names, in a fixed order."""
    files: set[Path] = set()

    def visit(value: object) -> None:
        if isinstance(value, Mapping):
            for entry in value.values():
                visit(entry)
        elif isinstance(value, (list, tuple)):
            for entry in value:
                visit(entry)
        elif isinstance(value, str):
            path = case.folder / value.partition(":")[0]
            if value and path.is_file():
                files.add(path)

    visit(case.tables)
    return sorted(files)


def digest_of(manifest: dict) -> str:
    """Return the digest by which a chunk is known to belong to a study."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def same(one: dict, other: dict) -> str:
    """Return the differences of two manifests in words; empty if the studies are the same."""
    words = {"fingerprint": "the case or a file that it names"}
    keys = [k for k in one if json.dumps(one[k]) != json.dumps(other.get(k))]
    return ", ".join(words[k] if k in words else str(k) for k in keys)
