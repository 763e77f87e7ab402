"""The experiment that would tell two effects apart which a log cannot."""

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
from jaxid.numerics.precision import NoiseModel
from jaxid.sensors.encoder import Sensor
from jaxid.session import Session
from jaxid.simulation.force_balance import ForceData
from jaxid.simulation.loops import Drive, needed_substeps
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import TooStiffError, needed_steps

if TYPE_CHECKING:
    from jaxid.discovery.result import NamedEffect
    from jaxid.discovery.search import Search

# Ticks of the longest signal that is optimised: a longer log is met by a shorter experiment.
_LONGEST = 30_000
# Starts that are optimised, of those that look best, and evaluations for each.
_OPTIMISED = 3
_EVALUATIONS = 60
# Integration steps of all joints in all evaluations together, and fewest evaluations: what is stiff
# gets fewer.
_STEPS = 5_000_000
_FEWEST = 8
# Integration steps a tick that the smoothed sign may ask for in the design: where friction is large it
# is made rounder there. What is expected of an experiment comes from exact friction.
_SMOOTH = 4
# Order of the noise's model, as in the search.
_ORDER = 20
# Alternatives of one effect for which an experiment is sought: the next where one cannot be.
_RIVALS = 2
# Samples of past command that a loop keeps for a delay, as in a replay.
_DELAYS = 12
# A tour accelerates as hard as the log did at most; sines reach this factor of it.
_HARDER = 2.0


@dataclass(frozen=True)
class Proposal:
    """An experiment that would tell an effect from one that the log cannot tell it from.

    Args:
        named: The effect that was named, with its place.
        rival: The other.
        places: Where each acts: one of `PLACES`, and which, 1-based.
        signal: "reference" for a loop, "input" for open loop.
        time: Ticks [s].
        values: Reference or command at each, (ticks, m); None where no experiment was found.
        start: Position at the start, at rest, (n,).
        present: Evidence [nats] for the named effect over the other in the present log.
        expected: The same in the proposed experiment, or for the other where that is the true one:
            the smaller of the two, by playing it through.
        needed: Evidence that it takes for the other to be ruled out.
        limits: What the experiment had to keep to.
        peaks: How far the machine goes in it, whichever effect is the true one.
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
        """Whether the experiment is expected to rule the wrong effect out."""
        return self.values is not None and self.expected > self.needed

    @property
    def file(self) -> str:
        """Name of its CSV."""
        return f"separate_{_plain(self.named)}_from_{_plain(self.rival)}.csv"


def _plain(kind: str) -> str:
    """A kind as a part of a file name: a user's own may be a path."""
    return re.sub(r"\W+", "_", kind.rpartition(":")[2]).strip("_")


def proposals(
    session: Session, search: Search, effects: tuple[NamedEffect, ...], progress: Callable[[str], None]
) -> tuple[Proposal, ...]:
    """An experiment for every effect that has alternatives.

    The alternative nearest in evidence is the hardest to rule out; where nothing can, as between
    effects that are one by another name, the next is tried too.

    Args:
        session: Case and logs.
        search: The search, at its end.
        effects: What it added, in its order.
        progress: Called with a line at every stage.
    """
    out = []
    for found, own in zip(effects, search.added, strict=True):
        refitted = [s for s in found.alternatives if s.theta is not None]
        for rival in sorted(refitted, key=lambda s: -s.total)[:_RIVALS]:
            progress(f"an experiment to tell {own.label} from {rival.candidate.label}")
            try:
                out.append(propose(session, search, own, rival))
            except TooStiffError:  # there is nothing to play it through with
                continue
            if out[-1].separates:
                break
    return tuple(out)


def propose(session: Session, search: Search, own: cand.Candidate, rival: Score) -> Proposal:
    """The best experiment found that keeps within the limits, whether or not it suffices.

    Args:
        session: Case and logs.
        search: The search, with `own` among its effects.
        own: The effect that was named.
        rival: Another in its place, refitted.
    """
    pair = Pair.of(search, own, rival)
    log, data = session.fit.log, session.fit.data
    limits = Limits.of(session.case.limits, session.machine, log, data)
    present = compared(search.union, pair, search.samples, refit=False)
    rounded, bench = _bench(session, search, pair)
    stage = _stage(session, search, pair, bench)
    shapes, starts = _family(session, limits, bench)
    best, outcome, peaks = None, None, None
    for p in _optimised(starts, bench, ModelPair.of(rounded), shapes, limits):
        fitting = kept_within(limits, shapes, p, lambda signal: stage.peaks(pair, signal))
        if fitting is None:
            continue
        _, signal, reached = fitting
        now = min(stage.outcomes(search.union, pair, signal), key=lambda o: o.short)
        if outcome is None or now.short > outcome.short:
            best, outcome, peaks = signal, now, reached
    if outcome is None:
        outcome = Outcome(0.0, present.needed)
    tick = bench.drive.period
    ticks = len(shapes.basis)
    return Proposal(
        own.label,
        rival.candidate.label,
        tuple(pair.plant.place(p) for p in pair.ports),
        "input" if bench.controller is None else "reference",
        tick * np.arange(ticks),
        best,
        np.asarray(bench.start if best is None else bench.start_of(best[0])),
        present.nats,
        outcome.nats,
        outcome.needed,
        limits,
        peaks,
    )


def _bench(session: Session, search: Search, pair: Pair) -> tuple[Pair, Experiment]:
    """How an experiment runs in its design, and the rivals with a sign round enough for it."""
    machine, log, data = session.machine, session.fit.log, session.fit.data
    tick = machine.hold_period or log.period
    delayed = any(e.delays_command() for e in pair.plant.effects)
    hold = machine.hold if machine.controller is None else "zero_order"
    drive = Drive(
        jnp.asarray(machine.gain),
        tick,
        "linear" if hold == "band_limited" else hold,
        longest_delay=_DELAYS if delayed and machine.controller is not None else 0,
    )
    picks = np.linspace(0, log.samples - 1, 50).astype(int)
    q, u = jnp.asarray(log.position[picks]), jnp.asarray(log.force[picks] * machine.gain)
    asked = lambda of: max(needed_substeps(of.model(k), drive, q, jnp.zeros_like(q), u) for k in range(2))
    rounded = pair.rounder(max(1.0, asked(pair) / _SMOOTH))
    e, _ = cand.evaluate(search.union, search.samples, pair.thetas[0], ())
    noise = [NoiseModel.fit(x, c, _ORDER) for x, c in zip(e.T, search.samples.moving.T, strict=True)]
    whiten = np.zeros((len(noise), 1 + max(len(n.coefficients) for n in noise)))
    for row, n in zip(whiten, noise, strict=True):
        if n.innovation == 0.0:  # a joint that never moved in what the search looks at
            continue
        row[: 1 + len(n.coefficients)] = np.array([1.0, *-n.coefficients]) / n.innovation
    return rounded, Experiment(
        replace(drive, substeps=asked(rounded)),
        machine.controller,
        jnp.asarray(log.position[0]),
        tuple(int(i) for i in machine.plant.at_drives(np.arange(log.position.shape[1]))),
        max(1, round(log.period / tick)),
        log.period,
        ForceData.of(data),
        jnp.asarray(data.recipe.rest_velocity),
        jnp.asarray(whiten),
    )


def _stage(session: Session, search: Search, pair: Pair, bench: Experiment) -> Playback:
    """Play an experiment through with the sensors' noise, or as much more as the log shows."""
    machine, log, recipe = session.machine, session.fit.log, session.recipe
    sensor = machine.sensor
    if sensor.position_std is None:
        noise = jnp.asarray(position_noise(machine, log))
        sensor = Sensor(position_noise=noise, force_noise=sensor.force_noise)
    e, _ = cand.evaluate(search.union, search.samples, search.theta, ())
    counts = search.samples.moving
    rms = np.sqrt(np.nanmean(np.where(counts, e, np.nan) ** 2, axis=0))
    more = machine.plant.at_drives(np.sqrt(np.maximum(rms**2 - search.floor**2, 0.0)))
    # White noise of which the band holds that much.
    more = more / np.sqrt(2 * recipe.band_hz(log.rate_hz) * log.period) / np.abs(machine.gain)
    stated = 0.0 if sensor.force_noise is None else np.asarray(sensor.force_noise)
    rivals = [machine.with_plant(pair.model(k), machine.parameters) for k in range(2)]
    steps = max(bench.drive.substeps, *(needed_steps(rival, log) for rival in rivals))
    return Playback(exact(bench, steps), machine, recipe, sensor, np.hypot(more, stated))


def _family(session: Session, limits: Limits, bench: Experiment) -> tuple[Shapes, list[np.ndarray]]:
    """Signals within the limits, and where to start."""
    log, data, tick = session.fit.log, session.fit.data, bench.drive.period
    ticks = min((log.samples - 1) * bench.every + 1, _LONGEST)
    moving = data.at_kept(data.qdd)[data.moving.any(axis=1)]
    hardest = _HARDER * float(np.abs(moving).max())
    speed = float(limits.speed.max())
    fastest = min(hardest / (2 * np.pi * speed), 0.5 * session.recipe.band_hz(log.rate_hz))
    if bench.controller is None:
        low, high, step = -limits.force, limits.force, np.full(limits.force.shape, np.inf)
        own = log.force[:, 0] - log.force[0, 0]
    else:
        low, high, step = (
            session.machine.plant.at_drives(x) for x in (limits.low, limits.high, limits.speed * tick)
        )
        own = None if log.reference is None else log.reference[:, 0] - log.reference[0, 0]
    if own is not None:
        own = np.interp(tick * np.arange(ticks), log.time - log.time[0], own)
    stroke = float((high - low).max())
    ways = (stroke, speed, hardest / _HARDER)
    if bench.controller is None:  # a tour of forces: to and fro as slowly as the log lasts
        pace = 20 * stroke / (ticks * tick)
        ways = (stroke, pace, pace**2 / stroke)
    functions, weights = basis(ticks, tick, fastest, ways, own)
    shapes = Shapes.within(functions, low, high, step)
    return shapes, [shapes.numbers(w) for w in weights]


def _optimised(
    starts: list[np.ndarray], bench: Experiment, duel: ModelPair, shapes: Shapes, limits: Limits
) -> list[np.ndarray]:
    """The most promising starts, each improved, best first."""
    bounds = LimitCost.of(limits)

    def both(p: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = loss(jnp.asarray(p), bench, duel, shapes, bounds)
        # A loop that diverged is as bad as it gets, and tells no direction.
        good = np.isfinite(value) & np.all(np.isfinite(slope))
        return (float(value), np.asarray(slope)) if good else (1e6, np.zeros_like(p))

    # See `loss`: of several joints it goes forwards.
    slower = 4 if bench.start.size > 1 else 1
    steps = slower * len(shapes.basis) * bench.drive.substeps * bench.start.size
    affordable = max(_STEPS // steps, _FEWEST)
    # The last start is the log's own signal where it has one: the surest to keep to its limits.
    looked_at = [starts[-1], *starts[:-1]][: affordable // 2]
    known = {p.tobytes(): both(p) for p in looked_at}
    ranked = sorted(looked_at, key=lambda p: known[p.tobytes()][0])[:_OPTIMISED]
    each = min((affordable - len(looked_at)) // len(ranked), _EVALUATIONS)
    found = [improved(both, p, known[p.tobytes()], each) for p in ranked]
    return [p for _, p in sorted(found, key=lambda f: f[0])]
