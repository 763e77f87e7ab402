"""Propose the experiment that distinguishes two effects which explain a log equally well."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.discovery import candidates as cand
from jaxid.discovery.score import Score
from jaxid.discovery.separating.playback import Outcome, Playback, compared, exact
from jaxid.discovery.separating.rivals import Experiment, ModelPair, Pair, loss
from jaxid.experiment_design.improve import improved
from jaxid.experiment_design.limits import LimitCost, Limits, Peaks, kept_within
from jaxid.experiment_design.shapes import Shapes, basis
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.sensors.encoder import Sensor
from jaxid.session import Session
from jaxid.simulation.force_balance import ForceData
from jaxid.simulation.loops import Drive, needed_substeps
from jaxid.simulation.replay import remembered_ticks
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import TooStiffError, needed_steps

if TYPE_CHECKING:
    from jaxid.discovery.result import NamedEffect
    from jaxid.discovery.search import Search

# Ticks of the longest signal that is optimised: for a longer log the experiment is shorter.
_LONGEST = 30_000
# Number of most promising starts that are optimised, and evaluations for each.
_OPTIMISED = 3
_EVALUATIONS = 60
# Integration steps of all joints in all evaluations together, and least number of evaluations: a stiff
# machine gets fewer.
_STEPS = 5_000_000
_FEWEST = 8
# Integration steps in a tick that the smoothed sign may require in the design: if friction is large, the sign
# is made smoother there. The expected evidence is computed with exact friction.
_SMOOTH = 4
# Order of the noise model, as in the search.
_ORDER = 20
# Number of alternatives of one effect for which an experiment is sought, until one suffices.
_RIVALS = 2
# A tour accelerates as the log did at most; sines reach this factor of it.
_HARDER = 2.0


@dataclass(frozen=True)
class Proposal:
    """An experiment that distinguishes an effect from one that explains the log equally well.

    Args:
        named: The effect that was named, with its place.
        rival: The alternative, with its place.
        places: Place of each effect: a word of `PLACES` and a number counted from 1.
        signal: "reference" for a loop, "input" for open loop.
        time: Ticks [s].
        values: Reference or command at each tick, (ticks, m); None if no experiment was found.
        start: Position at the start, at rest, (n,).
        present: Evidence for the named effect over the other in the present log [nats].
        expected: Evidence for the true effect over the other in the proposed experiment, by simulation: the
            smaller value of the two cases [nats].
        needed: Evidence that rules the other effect out [nats].
        limits: Limits within which the experiment keeps.
        peaks: Extremes of the motion, whichever effect is true; None if no experiment was found.
    """

    named: str
    rival: str
    places: tuple[tuple[str, int], tuple[str, int]]
    signal: str
    time: Float[np.ndarray, " ticks"]
    values: Float[np.ndarray, "ticks m"] | None
    start: Float[np.ndarray, " n"]
    present: float
    expected: float
    needed: float
    limits: Limits
    peaks: Peaks | None

    @property
    def separates(self) -> bool:
        """True if the experiment is expected to rule the wrong effect out."""
        return self.values is not None and self.expected > self.needed

    @property
    def file(self) -> str:
        """File name of its CSV."""
        return f"separate_{_file_part(self.named)}_from_{_file_part(self.rival)}.csv"


def _file_part(kind: str) -> str:
    """Turn a kind into a part of a file name; the kind of a user-defined effect may be a path."""
    return re.sub(r"\W+", "_", kind.rpartition(":")[2]).strip("_")


def proposals(
    session: Session, search: Search, effects: tuple[NamedEffect, ...], progress: Callable[[str], None]
) -> tuple[Proposal, ...]:
    """Propose an experiment for every effect that has alternatives.

    The alternative with the nearest evidence is the hardest to rule out. If no experiment does, as between
    effects that are equivalent, the next alternative is tried too.

    Args:
        session: Case and logs.
        search: The search at its end.
        effects: Effects that it added, in its order.
        progress: Called with a line of text at every stage.
    """
    out = []
    for effect, named in zip(effects, search.added, strict=True):
        refitted = [s for s in effect.alternatives if s.theta is not None]
        for rival in sorted(refitted, key=lambda s: -s.total)[:_RIVALS]:
            progress(f"designing an experiment to distinguish {named.label} from {rival.candidate.label}")
            try:
                out.append(propose(session, search, named, rival))
            except TooStiffError:  # it cannot be simulated with exact friction
                continue
            if out[-1].separates:
                break
    return tuple(out)


def propose(session: Session, search: Search, named: cand.Candidate, rival: Score) -> Proposal:
    """Find the best experiment within the limits, even if it does not suffice.

    Args:
        session: Case and logs.
        search: The search, with `named` among its effects.
        named: The effect that was named.
        rival: A refitted alternative to it.
    """
    pair = Pair.of(search, named, rival)
    log, data = session.fit.log, session.fit.data
    limits = Limits.of(session.case.limits, session.machine, log, data)
    present = compared(search.superset, pair, search.samples, refit=False)
    rounded, experiment = _experiment(session, search, pair)
    playback = _playback(session, search, pair, experiment)
    shapes, starts = _family(session, limits, experiment)

    # Signals are optimised with smooth friction, and judged by simulation with exact friction.
    best, outcome, peaks = None, None, None
    for p in _optimised(starts, experiment, ModelPair.of(rounded), shapes, limits):
        fitting = kept_within(limits, shapes, p, lambda signal: playback.peaks(pair, signal))
        if fitting is None:
            continue
        _, signal, reached = fitting
        now = min(playback.outcomes(search.superset, pair, signal), key=lambda o: o.short)
        if outcome is None or now.short > outcome.short:
            best, outcome, peaks = signal, now, reached
    if outcome is None:
        outcome = Outcome(0.0, present.needed)

    first, second = pair.ports
    return Proposal(
        named=named.label,
        rival=rival.candidate.label,
        places=(pair.plant.place(first), pair.plant.place(second)),
        signal="input" if experiment.controller is None else "reference",
        time=experiment.drive.period * np.arange(len(shapes.basis)),
        values=best,
        start=np.asarray(experiment.start if best is None else experiment.start_of(best[0])),
        present=present.nats,
        expected=outcome.nats,
        needed=outcome.needed,
        limits=limits,
        peaks=peaks,
    )


def _experiment(session: Session, search: Search, pair: Pair) -> tuple[Pair, Experiment]:
    """Return the rivals with a sign smooth enough for a design, and how the experiment runs in it."""
    machine, log, data = session.machine, session.fit.log, session.fit.data
    tick = machine.hold_period or log.period
    rivals = [machine.with_plant(pair.model(k), machine.parameters) for k in range(2)]
    hold = machine.hold if machine.controller is None else "zero_order"
    drive = Drive(
        jnp.asarray(machine.gain),
        tick,
        "linear" if hold == "band_limited" else hold,
        longest_delay=max(remembered_ticks(rival, log) for rival in rivals),
    )
    picks = np.linspace(0, log.samples - 1, 50).astype(int)
    q, u = jnp.asarray(log.position[picks]), jnp.asarray(log.force[picks] * machine.gain)

    def substeps(of: Pair) -> int:
        return max(needed_substeps(of.model(k), drive, q, jnp.zeros_like(q), u) for k in range(2))

    rounded = pair.smoother(max(1.0, substeps(pair) / _SMOOTH))
    e, _ = cand.evaluate(search.superset, search.samples, pair.thetas[0], ())
    noise = [NoiseModel.fit(x, c, _ORDER) for x, c in zip(e.T, search.samples.moving.T, strict=True)]
    whiten = np.zeros((len(noise), 1 + max(len(n.coefficients) for n in noise)))
    for row, n in zip(whiten, noise, strict=True):
        if n.innovation == 0.0:  # a joint that never moved in the samples of the search
            continue
        row[: 1 + len(n.coefficients)] = np.array([1.0, *-n.coefficients]) / n.innovation

    return rounded, Experiment(
        drive=replace(drive, substeps=substeps(rounded)),
        controller=machine.controller,
        start=jnp.asarray(log.position[0]),
        driven=tuple(int(i) for i in machine.plant.at_drives(np.arange(log.position.shape[1]))),
        every=max(1, round(log.period / tick)),
        period=log.period,
        data=ForceData.of(data),
        rest=jnp.asarray(data.recipe.rest_velocity),
        whiten=jnp.asarray(whiten),
    )


def _playback(session: Session, search: Search, pair: Pair, experiment: Experiment) -> Playback:
    """Set up the playback of an experiment, with the sensors' noise or as much more as the log shows."""
    machine, log, recipe = session.machine, session.fit.log, session.recipe
    sensor = machine.sensor
    if sensor.position_std is None:
        noise = jnp.asarray(position_noise(machine, log))
        sensor = Sensor(position_noise=noise, force_noise=sensor.force_noise)

    # The part of the residual above the noise floor counts as white noise on the command, inside the band.
    e, _ = cand.evaluate(search.superset, search.samples, search.theta, ())
    counts = search.samples.moving
    rms = np.sqrt(np.nanmean(np.where(counts, e, np.nan) ** 2, axis=0))
    more = machine.plant.at_drives(np.sqrt(np.maximum(rms**2 - search.floor**2, 0.0)))
    more = more / np.sqrt(2 * recipe.band_hz(log.rate_hz) * log.period) / np.abs(machine.gain)
    stated = 0.0 if sensor.force_noise is None else np.asarray(sensor.force_noise)
    rivals = [machine.with_plant(pair.model(k), machine.parameters) for k in range(2)]
    steps = max(experiment.drive.substeps, *(needed_steps(rival, log) for rival in rivals))
    return Playback(exact(experiment, steps), machine, recipe, sensor, np.hypot(more, stated))


def _family(session: Session, limits: Limits, experiment: Experiment) -> tuple[Shapes, list[np.ndarray]]:
    """Build the family of signals within the limits, and the starts of the optimisation."""
    log, data, tick = session.fit.log, session.fit.data, experiment.drive.period
    ticks = min((log.samples - 1) * experiment.every + 1, _LONGEST)
    moving = data.at_kept(data.qdd)[data.moving.any(axis=1)]
    hardest = _HARDER * float(np.abs(moving).max())
    speed = float(limits.speed.max())
    fastest = min(hardest / (2 * np.pi * speed), 0.5 * session.recipe.band_hz(log.rate_hz))

    if experiment.controller is None:
        low, high, step = -limits.force, limits.force, np.full(limits.force.shape, np.inf)
        log_signal = log.force[:, 0] - log.force[0, 0]
    else:
        ends = (limits.low, limits.high, limits.speed * tick)
        low, high, step = (np.asarray(session.machine.plant.at_drives(x)) for x in ends)
        log_signal = None if log.reference is None else log.reference[:, 0] - log.reference[0, 0]
    if log_signal is not None:
        log_signal = np.interp(tick * np.arange(ticks), log.time - log.time[0], log_signal)

    stroke = float((high - low).max())
    tour = (stroke, speed, hardest / _HARDER)
    if (
        experiment.controller is None
    ):  # a tour of forces: to and fro as slowly as the duration of the log allows
        pace = 20 * stroke / (ticks * tick)
        tour = (stroke, pace, pace**2 / stroke)
    functions, weights = basis(ticks, tick, fastest, tour, log_signal)
    shapes = Shapes.within(functions, low, high, step)
    return shapes, [shapes.numbers(w) for w in weights]


def _optimised(
    starts: list[np.ndarray], experiment: Experiment, models: ModelPair, shapes: Shapes, limits: Limits
) -> list[np.ndarray]:
    """Improve the most promising starts, and return them best first."""
    bounds = LimitCost.of(limits)

    def both(p: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = loss(jnp.asarray(p), experiment, models, shapes, bounds)
        # A loop that diverged gets the worst value, and no direction.
        good = np.isfinite(value) & np.all(np.isfinite(slope))
        return (float(value), np.asarray(slope)) if good else (1e6, np.zeros_like(p))

    steps = len(shapes.basis) * experiment.drive.substeps * experiment.start.size
    affordable = max(_STEPS // steps, _FEWEST)

    # The last start is the log's signal, if it has one: it keeps to its limits most reliably.
    evaluated = [starts[-1], *starts[:-1]][: affordable // 2]
    values = {p.tobytes(): both(p) for p in evaluated}
    ranked = sorted(evaluated, key=lambda p: values[p.tobytes()][0])[:_OPTIMISED]
    evaluations = min((affordable - len(evaluated)) // len(ranked), _EVALUATIONS)
    optima = [improved(both, p, values[p.tobytes()], evaluations) for p in ranked]
    return [p for _, p in sorted(optima, key=lambda f: f[0])]
