"""Play an experiment through in simulation: the log that it would give, and the evidence in that log."""

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
from jaxid.numerics.kept import kept_jit
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import Trajectory


@dataclass(frozen=True)
class Outcome:
    """Result of an experiment if one of two rivals is true.

    Args:
        nats: Held-out evidence for the true one over the other [nats].
        needed: Evidence above which the other is no longer listed as an alternative [nats].
    """

    nats: float
    needed: float

    @property
    def short(self) -> float:
        """Ratio of the evidence to the needed evidence."""
        return self.nats / self.needed


@dataclass(frozen=True)
class Playback:
    """Machine, sensors and filter with which an experiment is played through.

    Args:
        experiment: How the experiment runs; dry friction sticks exactly here.
        machine: Gain, controller and hold.
        recipe: Filter of the log.
        sensor: Sensor of the position.
        floor: Standard deviation of white noise on the command, in units of the command, (m,).
    """

    experiment: Experiment
    machine: Machine
    recipe: Recipe
    sensor: Sensor
    floor: Float[np.ndarray, " m"]

    def runs(self, pair: Pair, signal: np.ndarray, noise: np.ndarray | None = None) -> list[Trajectory]:
        """Simulate the motion under each rival; noise enters the controller's readings only."""
        n = self.experiment.start.size
        noise = np.zeros((len(signal), n)) if noise is None else noise
        return [self._run(pair.model(k), signal, noise) for k in range(2)]

    def peaks(self, pair: Pair, signal: np.ndarray) -> Peaks:
        """Return the extremes of the motion over both rivals."""
        runs = self.runs(pair, signal)
        parts = [np.concatenate([np.asarray(getattr(r, n)) for r in runs]) for n in _MOTION]
        return Peaks.of(*parts)

    def outcomes(self, superset: cand.CandidateModel, pair: Pair, signal: np.ndarray) -> list[Outcome]:
        """Compute the outcome of the search if the named effect is true, and if the other is."""
        rng = np.random.default_rng(20240501)
        noise = rng.standard_normal((len(signal), self.experiment.start.size))
        runs = self.runs(pair, signal, noise)
        logs = [self._log(run, rng) for run in runs]
        pairs = (pair, pair.swapped())
        return [self._outcome(superset, p, log) for p, log in zip(pairs, logs, strict=True)]

    def _run(self, plant: Plant, signal: np.ndarray, noise: np.ndarray) -> Trajectory:
        """Simulate one plant."""
        return _simulated(self.experiment, plant, self.sensor, jnp.asarray(signal), jnp.asarray(noise))

    def _log(self, run: Trajectory, rng: np.random.Generator) -> Log:
        """Build the log of a simulated run, with noise on the command."""
        command = np.asarray(run.command)
        command = command + self.floor * rng.standard_normal(command.shape)
        times = self.experiment.period * np.arange(len(command))
        log = Log(times, np.asarray(run.reading), command, hold=self.machine.hold, source="playback")
        return self.recipe.cleaned(log)

    def _outcome(self, superset: cand.CandidateModel, pair: Pair, log: Log) -> Outcome:
        """Compare the rivals on a log; a run that diverged gives no evidence."""
        if not np.all(np.isfinite(log.position)):
            return Outcome(0.0, TIE_NATS)
        data = prepare(log, self.machine.gain, self.recipe, self.machine.hold_period)
        return compared(superset, pair, cand.CandidateSamples(data))


_MOTION = ("position", "velocity", "command")


@kept_jit
def _simulated(
    experiment: Experiment, plant: Plant, sensor: Sensor, signal: Array, noise: Array
) -> Trajectory:
    return experiment.run(plant, signal, sensor, noise)


def compared(
    superset: cand.CandidateModel, pair: Pair, samples: cand.CandidateSamples, *, refit: bool = True
) -> Outcome:
    """Compute the evidence in a log for the first of a pair over the second, none if a model diverges.

    Args:
        superset: Machine with all candidates.
        pair: The rivals.
        samples: Samples of the log.
        refit: True to fit both models to the log; else they keep their values.
    """
    counts = samples.moving
    if counts.sum() < 5 * len(pair.active[0]):
        return Outcome(0.0, TIE_NATS)

    # The third model has neither effect: its loss is the scale on which a difference matters.
    base = np.intersect1d(*pair.active)
    without_either = pair.thetas[0].copy()
    named = np.setdiff1d(pair.active[0], base)
    without_either[named] = superset.neutral[named]

    models = []
    for theta, active in zip((*pair.thetas, without_either), (*pair.active, base), strict=True):
        at = cand.refine(superset, samples, theta, active)[0] if refit else theta
        e, jacobian = cand.evaluate(superset, samples, at, active)
        if not (np.all(np.isfinite(e[counts])) and np.all(np.isfinite(jacobian[counts]))):
            return Outcome(0.0, TIE_NATS)
        models.append((e, jacobian[..., active]))
    whitener = ev.Whitener.of(models[0][0], counts)
    screen = Screen.of(whitener, *models[0])
    _, other, without = (screen.held_out(*m) for m in models)
    nats, total = (float(ev.log_evidence(screen.rows, x, screen.before)[0]) for x in (other, without))
    return Outcome(nats, max(TIE_NATS, TIE_PART * abs(total)))


def exact(experiment: Experiment, substeps: int) -> Experiment:
    """Return an experiment with exact dry friction, which sticks."""
    drive = replace(experiment.drive, set_valued=True, substeps=substeps)
    return eqx.tree_at(lambda b: b.drive, experiment, drive)
