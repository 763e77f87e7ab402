"""An experiment played through: the log it would give, and what a search would make of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.screen import Screen
from jaxid.discovery.selection import TIE_NATS, TIE_PART
from jaxid.discovery.separating.rivals import Experiment, Pair
from jaxid.experiment_design.limits import Peaks
from jaxid.logs.log import Log
from jaxid.logs.prepare import Recipe, prepare
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import Trajectory


@dataclass(frozen=True)
class Outcome:
    """What an experiment gives where one of two rivals is true.

    Args:
        nats: Held-out evidence for the true one over the other.
        needed: More than that, and the other is no longer listed as an alternative.
    """

    nats: float
    needed: float

    @property
    def short(self) -> float:
        """Evidence over what is needed."""
        return self.nats / self.needed


@dataclass(frozen=True)
class Playback:
    """What it takes to play an experiment through.

    Args:
        bench: How it runs; dry friction sticks exactly here.
        machine: Gain, controller and hold.
        recipe: How its log would be filtered.
        sensor: What reads it.
        floor: Standard deviation of white noise on the command, in its units.
    """

    bench: Experiment
    machine: Machine
    recipe: Recipe
    sensor: Sensor
    floor: Float[np.ndarray, " m"]

    def runs(self, pair: Pair, signal: np.ndarray, noise: np.ndarray | None = None) -> list[Trajectory]:
        """Motion under each rival; the controller sees the sensor's noise, the position is true."""
        n = self.bench.start.size
        noise = np.zeros((len(signal), n)) if noise is None else noise
        return [self._run(pair.model(k), signal, noise) for k in range(2)]

    def peaks(self, pair: Pair, signal: np.ndarray) -> Peaks:
        """How far the machine goes, whichever of the two it is."""
        runs = self.runs(pair, signal)
        parts = [np.concatenate([np.asarray(getattr(r, n)) for r in runs]) for n in _MOTION]
        return Peaks.of(*parts)

    def outcomes(self, union: cand.CandidateModel, pair: Pair, signal: np.ndarray) -> list[Outcome]:
        """What the search would find: first where the named effect is true, then the other."""
        rng = np.random.default_rng(20240501)
        noise = rng.standard_normal((len(signal), self.bench.start.size))
        runs = self.runs(pair, signal, noise)
        logs = [self._log(run, rng) for run in runs]
        pairs = (pair, pair.turned())
        return [self._outcome(union, p, log) for p, log in zip(pairs, logs, strict=True)]

    def _run(self, plant: Plant, signal: np.ndarray, noise: np.ndarray) -> Trajectory:
        run = _played(self.bench, plant, self.sensor, jnp.asarray(signal), jnp.asarray(noise))
        return run

    def _log(self, run: Trajectory, rng: np.random.Generator) -> Log:
        command = np.asarray(run.command)
        command = command + self.floor * rng.standard_normal(command.shape)
        times = self.bench.period * np.arange(len(command))
        log = Log(times, np.asarray(run.reading), command, hold=self.machine.hold, source="rehearsal")
        return self.recipe.cleaned(log)

    def _outcome(self, union: cand.CandidateModel, pair: Pair, log: Log) -> Outcome:
        if not np.all(np.isfinite(log.position)):
            return Outcome(0.0, TIE_NATS)
        data = prepare(log, self.machine.gain, self.recipe, self.machine.hold_period)
        return compared(union, pair, cand.CandidateSamples(data))


_MOTION = ("position", "velocity", "command")


@eqx.filter_jit
def _played(bench: Experiment, plant: Plant, sensor: Sensor, signal: Array, noise: Array) -> Trajectory:
    return bench.run(plant, signal, sensor, noise)


def compared(
    union: cand.CandidateModel, pair: Pair, samples: cand.CandidateSamples, *, refit: bool = True
) -> Outcome:
    """Evidence in a log for the first of a pair over the second.

    Args:
        union: Machine with all candidates.
        pair: The rivals.
        samples: The log.
        refit: Fit both to it; without, they stand as they are.
    """
    counts = samples.moving
    if counts.sum() < 5 * len(pair.active[0]):
        return Outcome(0.0, TIE_NATS)
    base = np.intersect1d(*pair.active)
    none = pair.thetas[0].copy()
    own = np.setdiff1d(pair.active[0], base)
    none[own] = union.neutral[own]
    found = []
    for theta, active in zip((*pair.thetas, none), (*pair.active, base), strict=True):
        at = cand.refine(union, samples, theta, active)[0] if refit else theta
        e, jacobian = cand.evaluate(union, samples, at, active)
        found.append((e, jacobian[..., active]))
    whitener = ev.Whitener.of(found[0][0], counts)
    screen = Screen.of(whitener, *found[0])
    _, other, without = (screen.held_out(*f) for f in found)
    nats, total = (float(ev.log_evidence(screen.rows, x, screen.before)[0]) for x in (other, without))
    return Outcome(nats, max(TIE_NATS, TIE_PART * abs(total)))


def exact(bench: Experiment, substeps: int) -> Experiment:
    """The same experiment with dry friction that sticks."""
    drive = replace(bench.drive, set_valued=True, substeps=substeps)
    return eqx.tree_at(lambda b: b.drive, bench, drive)
