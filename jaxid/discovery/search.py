"""What is missing: score every candidate on held-out time, add the best, refit, repeat."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.choice import MODEST, TIE_NATS, few, margin, modest, simplest
from jaxid.discovery.noise import NUMERICS
from jaxid.discovery.screen import Score, Screen, guess_pair, screen_candidates
from jaxid.precision import NoiseModel
from jaxid.preprocess import Prepared

# An effect must close this part of what stands above the noise floor (in sum of squares, so half
# of it in RMS), whatever its evidence: on measured data everything helps a little. One that is
# there already goes where it closes less than a third of that.
_RELEVANT = 0.15
_SUPERFLUOUS = 0.05
# A residual whose RMS exceeds the noise floor by less than so many times its scatter is noise.
_SCATTER = 3.0
# ... and one that leaves less than this part of the noise's sum of squares explains noise.
_LEAST = 0.25
# The gain on the validation log must be at least this part of what the log itself promises.
_CONFIRMED = 0.1
# Two effects are added at once where they close this part of the gap and gain more than the best
# single one with any partner, by so many times what noise may, and by this part of what they gain.
# An effect that keeps less than this part of what its linear screen promised is left out there.
_CLEARLY = 3.0
_KEPT = 0.5
_MUCH = 0.33
_MOST_OF_IT = 0.5


@dataclass(frozen=True)
class Step:
    """One round of the search.

    Args:
        added: What it added; None for the baseline and for a drop.
        dropped: What it dropped.
        scores: Of all candidates, best first.
        threshold: Evidence that noise alone exceeds once in a thousand searches.
        theta: All unknowns of the union after the step.
        active: Indices of those that are fitted.
    """

    added: Score | None
    dropped: cand.Candidate | None
    scores: tuple[Score, ...]
    threshold: float
    theta: np.ndarray
    active: np.ndarray


@dataclass
class Search:
    """State of a search: the union, the logs, and what has been added so far.

    Args:
        union: Machine with all candidates.
        data: The log to fit, prepared.
        floor: RMS force that the sensors' noise alone leaves, by joint.
        colour: Of that noise, by joint.
        validation: Logs that must confirm each effect.
        progress: Called with a line at every stage.
        added: Effects added, in order.
    """

    union: cand.Union
    data: Prepared
    floor: np.ndarray
    colour: tuple[NoiseModel, ...] = ()
    validation: tuple[Prepared, ...] = ()
    progress: Callable[[str], None] = lambda text: None
    added: list[cand.Candidate] = field(default_factory=list)

    def __post_init__(self) -> None:
        machine = self.union.machine
        known = machine.sensor.force_noise
        noise = None if known is None else np.asarray(known) * machine.gain
        self.samples = cand.Samples(self.data, noise)
        self.validation_samples = [cand.Samples(d, noise) for d in self.validation]
        force = self.data.at_kept(self.data.force - np.mean(self.data.force, axis=0))
        rows = len(self.samples.moving) / len(force)
        self.numerics = rows * float(np.sum((NUMERICS * force) ** 2))
        self.theta = self.union.neutral
        self._many: dict[tuple[str, int], list[cand.Point]] = {}

    @property
    def active(self) -> np.ndarray:
        """Unknowns fitted now: the case's own and those of the effects added."""
        return self._active(self.added)

    def _active(self, effects: Sequence[cand.Candidate]) -> np.ndarray:
        return np.concatenate([self.union.base, *[c.index for c in effects]]).astype(int)

    def rest(self) -> list[cand.Candidate]:
        """Candidates not added yet."""
        return [c for c in self.union.candidates if all(c is not a for a in self.added)]

    def many(self, candidate: cand.Candidate) -> list[cand.Point]:
        """A candidate at its many starts, computed once."""
        key = (candidate.kind, candidate.port)
        if key not in self._many:
            self._many[key] = cand.many_points(self.union, candidate, self.samples)
        return self._many[key]

    def run(self, most: int) -> list[Step]:
        """Add effects until none is worth it; drop what becomes superfluous on the way."""
        self.progress("fitting the baseline")
        self.theta = self._fit(self.theta, self.active)
        steps = [Step(None, None, (), 0.0, self.theta, self.active)]
        tried: set[frozenset[int]] = {frozenset()}
        while True:
            best, scores, limit = self.best(ahead=len(self.added) + 2 <= most)
            if not best or len(self.added) >= most:
                steps.append(Step(None, None, scores, limit, self.theta, self.active))
                return steps
            for score in best:
                self.added = [*self.added, score.candidate]
                self.theta = score.theta
                steps.append(Step(score, None, scores, limit, self.theta, self.active))
            steps.extend(self._drop_superfluous(limit))
            now = frozenset(id(c) for c in self.added)
            if now in tried:  # added and dropped in turn
                return steps
            tried.add(now)

    def best(
        self, near: float = 0.0, own: cand.Candidate | None = None, *, ahead: bool = False
    ) -> tuple[tuple[Score, ...], tuple[Score, ...], float]:
        """Screen all candidates, refit the most promising, choose; and all scores.

        Args:
            ahead: Look at two effects together too, and choose both where one alone would mislead.
            near: Only those are refitted whose screened evidence reaches this part of the best's,
                or of `own`'s.
            own: The effect that is to be replaced.
        """
        if self._at_floor():
            return (), (), 0.0
        self.progress(f"screening {len(self.rest())} effects")
        screened = screen_candidates(self, ahead=ahead)
        # A linear screen may promise far more of an effect than a refit then finds.
        judged = [s for s in screened.scores if own is None or s.candidate is own]
        top = max((s.evidence for s in judged), default=0.0)
        least = max(0.5 * screened.threshold, near * top)
        promising = [s for s in screened.scores if s.evidence > least]
        refitted = []
        for score in few(promising):
            self.progress(f"refitting with {score.candidate.kind}")
            refitted.append(self._refit(score, screened))
        refitted.sort(key=lambda s: -s.total)
        rest = [s for s in screened.scores if all(s.candidate is not r.candidate for r in refitted)]
        good = [s for s in refitted if not s.reason and s.evidence > screened.threshold]
        one = modest(good)
        promised = {id(s.candidate): s.evidence for s in promising}
        broken = [s.candidate for s in refitted if s.evidence < _KEPT * promised[id(s.candidate)]]
        two = self._two(screened, one, broken) if ahead else ()
        return two or ((one,) if one else ()), (*refitted, *rest), screened.threshold

    def _two(
        self, screened: Screen, one: Score | None, broken: list[cand.Candidate]
    ) -> tuple[Score, ...]:
        """Two effects to add at once, where they explain far more than one with any partner."""
        c = one.candidate if one else None
        reached = screened.pairs.with_partner(c.kind, c.port) if c else screened.threshold
        e, jacobian = cand.evaluate(self.union, self.samples, self.theta)
        for *pair, gained in screened.pairs.best(broken):
            if gained < reached + max(_CLEARLY * screened.threshold, _MUCH * gained):
                return ()
            guess = guess_pair(pair, screened, jacobian[..., self.active], e, self)
            if guess is None:
                continue
            self.progress("refitting with " + " and ".join(p.candidate.kind for p in pair))
            first, second = (
                Score(p.candidate, p.start, g, 0.0) for p, g in zip(pair, guess, strict=True)
            )
            both = self._refit(second, screened, beside=first)
            old, new = (cand.evaluate(self.union, self.samples, t)[0] for t in (self.theta, both.theta))
            enough = self._closed(old, new) > _MOST_OF_IT and (one is None or both.total > one.total)
            if enough and not both.reason:
                one = replace(self._refit(first, screened), reason="")
                other = self._refit(second, screened)
                # The first is added alone; each counts by what is lost without it.
                return replace(_after(both, other), **_place(one)), _after(both, one)
        return ()

    def alternatives(self, steps: list[Step]) -> dict[int, tuple[Score, ...]]:
        """For each effect added, those that could stand in its place without loss.

        Each effect is taken out and all are scored against the rest. A stand-in that closes
        relevantly more of the gap without more parameters, or as much with fewer, takes its place.
        """
        found: dict[int, tuple[Score, ...]] = {}
        for k in range(len(self.added)):
            own = self.added[k]
            self.progress(f"looking for what could replace {own.kind}")
            kept, theta = list(self.added), self.theta
            self.added = [c for c in kept if c is not own]
            self.theta = self._fit(self._without(theta, own), self.active)
            _, scores, limit = self.best(MODEST, own)
            good = [s for s in scores if s.theta is not None and not s.reason and s.evidence > limit]
            self.added, self.theta = kept, theta
            mine = next((s for s in scores if s.candidate is own), None)
            if not good or mine is None:
                found[k] = ()
                continue
            best, ties = simplest(good)
            if best.candidate is not own and self._takes_over(best, mine, own):
                self.added = [best.candidate if c is own else c for c in kept]
                self.theta = self._fit(best.theta, self.active)
                steps.append(Step(best, own, scores, limit, self.theta, self.active))
            elif best.candidate is not own:
                ties = (best, *ties) if mine.total > best.total - margin(best) else ()
            found[k] = tuple(s for s in ties if s.candidate is not self.added[k])
        return found

    def _takes_over(self, best: Score, mine: Score, own: cand.Candidate) -> bool:
        """Whether a stand-in is as good with fewer parameters, or closes relevantly more.

        One with more parameters has had its chance beside what is there, in the rounds before.
        """
        more = len(best.candidate.index) - len(own.index)
        if more > 0 or mine.total > best.total - margin(best):
            return more < 0
        now, _ = cand.evaluate(self.union, self.samples, self.theta)
        then, _ = cand.evaluate(self.union, self.samples, best.theta)
        return self._closed(now, then) > _RELEVANT

    def _fit(self, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
        return cand.refine(self.union, self.samples, theta, active)[0]

    def _without(self, theta: np.ndarray, c: cand.Candidate) -> np.ndarray:
        theta = theta.copy()
        theta[c.index] = c.neutral
        return theta

    def _refit(self, score: Score, screened: Screen, beside: Score | None = None) -> Score:
        new = [s for s in (beside, score) if s is not None]
        active = self._active([*self.added, *[s.candidate for s in new]])
        fits = []
        for guesses in itertools.product(*[_starts(s) for s in new]):
            theta = self.theta.copy()
            for s, guess in zip(new, guesses, strict=True):
                theta[s.candidate.index] = guess
            fits.append(self._fit(theta, active))
        theta = min(fits, key=self._squares)
        e, jacobian = cand.evaluate(self.union, self.samples, theta)
        after = screened.held_out(e, jacobian[..., active])
        if any(not s.candidate.amplitude.any() for s in new):
            after = after / (1 - self._swallowed(self.samples, theta))
        gained = float(ev.log_evidence(screened.rows, screened.before, after)[0])
        validation, confirmed = self._validated(theta, new)
        index = np.concatenate([s.candidate.index for s in new])
        reason = self._objection(index, theta, e, validation, confirmed)
        return replace(score, evidence=gained, validation=validation, theta=theta, reason=reason)

    def _squares(self, theta: np.ndarray) -> float:
        e, _ = cand.evaluate(self.union, self.samples, theta)
        total = float(np.sum(np.where(self.samples.moving, e, 0.0) ** 2))
        return total if np.isfinite(total) else np.inf

    def _swallowed(self, samples: cand.Samples, theta: np.ndarray) -> float:
        """Part of the noise that a drive swallows and the present one does not, in whitened squares.

        Noise of the logged force is on the log only. A drive that filters the force filters it
        too, and would gain by that though it explains nothing.
        """
        if not samples.noisier:
            return 0.0
        whitener = ev.Whitener(self.colour, samples.moving)
        squares = []
        for at in (self.theta, theta):
            e, _ = cand.evaluate(self.union, samples, at)
            noisy, _ = cand.evaluate_on(self.union, samples.noisier, at)
            squares.append(float(np.mean(whitener((noisy - e)[..., None]) ** 2)))
        return min(squares[0] - squares[1], 0.9)

    def _validated(
        self, theta: np.ndarray, new: Sequence[Score]
    ) -> tuple[float | None, float | None]:
        """Gain on the validation logs, nothing refitted there.

        Returns:
            Gain in log-likelihood [nats] by effects, each log with its own colour of noise, and the
            part by which the sum of squared residuals falls, in the worst log.
        """
        if not self.validation:
            return None, None
        total, worst = 0.0, np.inf
        for samples in self.validation_samples:
            old, fresh = (
                np.where(samples.moving, cand.evaluate(self.union, samples, t)[0], 0.0)
                for t in (self.theta, theta)
            )
            whitener = ev.Whitener.of(fresh, samples.moving, self.colour)
            squares = [np.sum(whitener(e[..., None]) ** 2) for e in (old, fresh)]
            if any(not s.candidate.amplitude.any() for s in new):
                squares[1] /= 1 - self._swallowed(samples, theta)
            total += float(ev.log_evidence(int(whitener.rows.sum()), *squares))
            worst = min(worst, 1 - float(np.sum(fresh**2) / np.sum(old**2)))
        return total, worst

    def _objection(
        self, index: np.ndarray, theta: np.ndarray, e: np.ndarray, validation: float | None,
        confirmed: float | None,
    ) -> str:
        """Why what has these unknowns may not be named; empty where it may."""
        free = self.union.machine.parameters.free
        for i in index:
            if not np.isfinite(theta[i]):
                return "its fit diverged"
            if free[i].sign == "nonnegative" and theta[i] <= 0.0:
                return f"{free[i].name} would have to be negative"
            if np.isfinite(free[i].upper) and theta[i] >= (1 - 1e-3) * free[i].upper:
                return f"{free[i].name} runs to its limit, where it only imitates"
        if self._below_noise(e):
            return "it takes away what the sensors' noise alone must leave"
        old, _ = cand.evaluate(self.union, self.samples, self.theta)
        closed = self._closed(old, e)
        if closed < _RELEVANT:
            part = 50 * closed  # in RMS, where little is closed
            return f"it closes only {part:.1f} % of the gap" if part > 0.05 else "it closes none of the gap"
        if validation is not None and (validation < TIE_NATS or confirmed < _CONFIRMED * closed):
            return "it does not help on the validation log"
        return ""

    def _drop_superfluous(self, limit: float) -> list[Step]:
        """Drop effects whose loss costs less than noise, or less than is relevant."""
        steps = []
        for c in self.added[:-1]:
            without = [a for a in self.added if a is not c]
            theta = self._fit(self._without(self.theta, c), self._active(without))
            if not self._costs(theta, self._active(without), limit):
                self.added, self.theta = without, theta
                steps.append(Step(None, c, (), limit, theta, self.active))
        return steps

    def _costs(self, theta: np.ndarray, active: np.ndarray, limit: float) -> bool:
        """Whether a smaller model is worse by more than noise and by what is relevant."""
        e, jacobian = cand.evaluate(self.union, self.samples, self.theta)
        now = Screen.of(ev.Whitener.of(e, self.samples.moving, self.colour), e, jacobian[..., self.active])
        less, jacobian = cand.evaluate(self.union, self.samples, theta)
        after = now.held_out(less, jacobian[..., active])
        lost = float(ev.log_evidence(now.rows, after, now.before)[0])
        return lost > limit and self._closed(less, e) > _SUPERFLUOUS

    def _at_floor(self) -> bool:
        """Whether the residual is what the sensors' noise leaves, within the scatter of its RMS."""
        e, _ = cand.evaluate(self.union, self.samples, self.theta)
        for x, counts, floor in zip(e.T, self.samples.moving.T, self.floor, strict=True):
            scatter = np.sqrt(0.5 / max(self.data.recipe.independent * counts.sum(), 1))
            if np.sqrt(np.mean(x[counts] ** 2)) > floor * (1 + _SCATTER * scatter):
                return False
        return True

    def _below_noise(self, e: np.ndarray) -> bool:
        """Whether a residual is far less than the sensors' noise leaves: a model that follows noise."""
        counts = self.samples.moving
        squares = np.sum(np.where(counts, e, 0.0) ** 2)
        return bool(squares < _LEAST * np.sum(counts.sum(axis=0) * np.square(self.floor)))

    def above_numerics(self, e: np.ndarray) -> bool:
        """Whether a residual is more than filtering and integrating leave wrong."""
        counts = self.samples.moving
        floor = np.sum(counts.sum(axis=0) * np.square(self.floor))
        return bool(np.sum(e[counts] ** 2) - floor > self.numerics)

    def _closed(self, old: np.ndarray, new: np.ndarray) -> float:
        """Part by which the gap above the noise floor closes, in sum of squares."""
        counts = self.samples.moving
        floor = np.sum(counts.sum(axis=0) * np.square(self.floor))
        before, after = np.sum(old[counts] ** 2), np.sum(new[counts] ** 2)
        if before - after < self.numerics:
            return 0.0
        # The floor is itself an estimate, and a search always finds something to close: at least
        # half of the residual counts as gap.
        return float((before - after) / max(before - floor, 0.5 * before))


def _starts(score: Score) -> list[np.ndarray]:
    """Where a refit of a candidate starts: once or twice."""
    second = score.second
    if second is None or np.array_equal(second, score.guess):
        return [score.guess]
    return [score.guess, second]


def _after(both: Score, one: Score) -> Score:
    """What two effects gain over one of them."""
    validation = None if both.validation is None else both.validation - one.validation
    return replace(both, evidence=both.evidence - one.evidence, validation=validation)


def _place(score: Score) -> dict:
    """All of a score but what it gained."""
    names = ("candidate", "start", "guess", "second", "theta", "reason")
    return {n: getattr(score, n) for n in names}
