"""What is missing: score every candidate on held-out time, add the best, refit, repeat."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.acceptance import RELEVANT, Acceptance
from jaxid.discovery.score import Score
from jaxid.discovery.screen import Screen, guess_pair, screen_candidates
from jaxid.discovery.selection import MODEST, margin, next_effect, shortlist, simplest_equivalent
from jaxid.logs.prepare import Prepared
from jaxid.numerics.precision import NoiseModel

# What the case has is gone where less than this part of it is left beside an effect.
_GONE = 1e-2
# An effect that is there already goes where it closes less than this part of the gap: a third of
# what it must close to be named.
_SUPERFLUOUS = 0.05
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
        why: Reason for what was dropped, where it is not that it became superfluous.
    """

    added: Score | None
    dropped: cand.Candidate | None
    scores: tuple[Score, ...]
    threshold: float
    theta: np.ndarray
    active: np.ndarray
    why: str = ""


@dataclass
class Search:
    """State of a search: the union, the logs, and what has been added so far.

    Args:
        superset: Machine with all candidates.
        data: The log to fit, prepared.
        floor: RMS force that the sensors' noise alone leaves, by joint.
        colour: Of that noise, by joint.
        validation: Logs that must confirm each effect.
        progress: Called with a line at every stage.
        added: Effects added, in order.
        barred: Effects taken out for good.
    """

    superset: cand.CandidateModel
    data: Prepared
    floor: np.ndarray
    colour: tuple[NoiseModel, ...]
    validation: tuple[Prepared, ...] = ()
    progress: Callable[[str], None] = lambda text: None
    added: list[cand.Candidate] = field(default_factory=list)
    barred: list[cand.Candidate] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.acceptance = Acceptance(self.superset, self.data, self.validation, self.floor, self.colour)
        self.samples = self.acceptance.samples
        self.theta = self.superset.neutral
        self._grid_points: dict[tuple[str, int], list[cand.Point]] = {}
        self._limit = 0.0
        # All unknowns where nothing is added.
        self._alone = self.theta

    @property
    def active(self) -> np.ndarray:
        """Unknowns fitted now: the case's own and those of the effects added."""
        return self._active(self.added)

    def _active(self, effects: Sequence[cand.Candidate]) -> np.ndarray:
        return np.concatenate([self.superset.base, *[c.index for c in effects]]).astype(int)

    def rest(self) -> list[cand.Candidate]:
        """Candidates not added yet."""
        gone = [*self.added, *self.barred]
        return [c for c in self.superset.candidates if all(c is not g for g in gone)]

    def grid_points(self, candidate: cand.Candidate) -> list[cand.Point]:
        """A candidate at its many starts, computed once."""
        key = (candidate.kind, candidate.port)
        if key not in self._grid_points:
            self._grid_points[key] = cand.grid_points(self.superset, candidate, self.samples)
        return self._grid_points[key]

    def run(self, most: int) -> list[Step]:
        """Add effects until none is worth it; drop what becomes superfluous on the way."""
        self.progress("fitting the baseline")
        self.theta = self._alone = self._fit(self.theta, self.active)
        return [Step(None, None, (), 0.0, self.theta, self.active), *self._grow(most)]

    def bar(self, c: cand.Candidate, why: str, most: int) -> list[Step]:
        """Take an effect out for good, and go on without it."""
        theta = self.without(c)
        self.barred, self.added = [*self.barred, c], [a for a in self.added if a is not c]
        self.theta = theta
        steps = [Step(None, c, (), 0.0, theta, self.active, why)]
        # What was worth its place beside it need not be so alone.
        steps += self._drop_superfluous(self._limit, self.added)
        return [*steps, *self._grow(most)]

    def without(self, c: cand.Candidate) -> np.ndarray:
        """All unknowns, those of one effect neutral and the others fitted again."""
        active = self._active([a for a in self.added if a is not c])
        theta = self._neutral(self.theta, c)
        found = self._fit(theta, active)
        now, alone = np.abs(theta[self.superset.base]), np.abs(self._alone[self.superset.base])
        if np.all(now > _GONE * alone):
            return found
        # An effect that took over from what the case has, as a limit that all of the force exceeds: from
        # next to nothing that does not come back.
        theta[self.superset.base] = self._alone[self.superset.base]
        return min((found, self._fit(theta, active)), key=self.acceptance.squares)

    def _grow(self, most: int) -> list[Step]:
        steps: list[Step] = []
        tried = {frozenset(id(c) for c in self.added)}
        while True:
            best, scores, limit = self.best(ahead=len(self.added) + 2 <= most)
            self._limit = max(self._limit, limit)
            if not best or len(self.added) >= most:
                steps.append(Step(None, None, scores, limit, self.theta, self.active))
                return steps
            for score in best:
                self.added = [*self.added, score.candidate]
                self.theta = score.theta
                steps.append(Step(score, None, scores, limit, self.theta, self.active))
            steps.extend(self._drop_superfluous(limit, self.added[:-1]))
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
        if self.acceptance.at_floor(self.theta):
            return (), (), 0.0
        self.progress(f"screening {len(self.rest())} effects")
        screened = screen_candidates(self, ahead=ahead)
        # A linear screen may promise far more of an effect than a refit then finds.
        judged = [s for s in screened.scores if own is None or s.candidate is own]
        top = max((s.evidence for s in judged), default=0.0)
        least = max(0.5 * screened.threshold, near * top)
        promising = [s for s in screened.scores if s.evidence > least]
        refitted = []
        for score in shortlist(promising):
            self.progress(f"refitting with {score.candidate.label}")
            refitted.append(self._refit(score, screened))
        refitted.sort(key=lambda s: -s.total)
        rest = [s for s in screened.scores if all(s.candidate is not r.candidate for r in refitted)]
        promised = {id(s.candidate): s.evidence for s in promising}
        # The threshold's surrogates are not refitted. Few starts need the refit; what has a start
        # everywhere must pass as they do.
        passed = lambda s: min(s.evidence, promised[id(s.candidate)] if s.candidate.has_grid else np.inf)
        good = [s for s in refitted if not s.reason and passed(s) > screened.threshold]
        one = next_effect(good)
        broken = [s.candidate for s in refitted if s.evidence < _KEPT * promised[id(s.candidate)]]
        two = self._two(screened, one, broken) if ahead else ()
        return two or ((one,) if one else ()), (*refitted, *rest), screened.threshold

    def _two(self, screened: Screen, one: Score | None, broken: list[cand.Candidate]) -> tuple[Score, ...]:
        """Two effects to add at once, where they explain far more than one with any partner."""
        c = one.candidate if one else None
        reached = screened.pairs.with_partner(c.kind, c.port) if c else screened.threshold
        e, jacobian = cand.evaluate(self.superset, self.samples, self.theta, self.active)
        for *pair, gained in screened.pairs.best(broken):
            if gained < reached + max(_CLEARLY * screened.threshold, _MUCH * gained):
                return ()
            guess = guess_pair(pair, screened, jacobian[..., self.active], e, self)
            if guess is None:
                continue
            self.progress("refitting with " + " and ".join(p.candidate.label for p in pair))
            first, second = (Score(p.candidate, p.start, g, 0.0) for p, g in zip(pair, guess, strict=True))
            both = self._refit(second, screened, beside=first)
            old, new = (self.acceptance.residual(t) for t in (self.theta, both.theta))
            enough = self.acceptance.closed(old, new) > _MOST_OF_IT and (
                one is None or both.total > one.total
            )
            if enough and not both.reason:
                left = replace(self._refit(first, screened), reason="")
                right = self._refit(second, screened)
                # The first is added alone; each counts by what is lost without it.
                added = replace(_after(both, right), **_place(left)), _after(both, left)
                if min(s.evidence for s in added) > screened.threshold:
                    return added
        return ()

    def alternatives(self, steps: list[Step]) -> dict[int, tuple[Score, ...]]:
        """For each effect added, those that could stand in its place without loss.

        Each effect is taken out and all are scored against the rest. A stand-in that closes
        relevantly more of the gap without more parameters, or as much with fewer, takes its place.
        """
        found: dict[int, tuple[Score, ...]] = {}
        for k in range(len(self.added)):
            own = self.added[k]
            self.progress(f"looking for what could replace {own.label}")
            kept, theta = list(self.added), self.theta
            self.theta = self.without(own)
            self.added = [c for c in kept if c is not own]
            _, scores, limit = self.best(MODEST, own)
            good = [s for s in scores if s.theta is not None and not s.reason and s.evidence > limit]
            self.added, self.theta = kept, theta
            mine = next((s for s in scores if s.candidate is own), None)
            if not good or mine is None:
                found[k] = ()
                continue
            if mine.theta is None:  # others promised more, and it was not refitted: it stands where it stood
                mine = replace(mine, theta=theta)
            best, ties = simplest_equivalent(good, self._undecided)
            if best.candidate is not own and self._takes_over(best, mine, own):
                self.added = [best.candidate if c is own else c for c in kept]
                self.theta = self._fit(best.theta, self.active)
                steps.append(Step(best, own, scores, limit, self.theta, self.active))
            elif best.candidate is not own:
                ties = (best, *ties) if self._equal(mine, best) else ()
            found[k] = tuple(s for s in ties if s.candidate is not self.added[k])
        return found

    def _takes_over(self, best: Score, mine: Score, own: cand.Candidate) -> bool:
        """Whether a stand-in is as good with fewer parameters, or closes relevantly more.

        One with more parameters has had its chance beside what is there, in the rounds before.
        """
        more = len(best.candidate.index) - len(own.index)
        if more > 0 or self._equal(mine, best):
            return more < 0
        now, then = self.acceptance.residual(self.theta), self.acceptance.residual(best.theta)
        return self.acceptance.closed(now, then) > RELEVANT

    def _undecided(self, one: Score, two: Score) -> float:
        """Difference in evidence of two fits that chance may make [nats]: two deviations of it."""
        # Where one is true, its gain scatters about what is expected with twice that as variance.
        return 2 * np.sqrt(2 * self.acceptance.divergence(one.theta, two.theta))

    def _equal(self, mine: Score, best: Score) -> bool:
        return mine.total > best.total - max(margin(best), self._undecided(best, mine))

    def _fit(self, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
        return cand.refine(self.superset, self.samples, theta, active)[0]

    def _neutral(self, theta: np.ndarray, c: cand.Candidate) -> np.ndarray:
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
        theta = min(fits, key=self.acceptance.squares)
        e, jacobian = cand.evaluate(self.superset, self.samples, theta, active)
        after = screened.held_out(e, jacobian[..., active])
        drive = any(not s.candidate.amplitude.any() for s in new)
        if drive:
            after = after / (1 - self.acceptance.absorbed_noise(self.samples, self.theta, theta))
        gained = float(ev.log_evidence(screened.rows, screened.before, after)[0])
        validation, confirmed = self.acceptance.confirmed(self.theta, theta, drive=drive)
        index = np.concatenate([s.candidate.index for s in new])
        reason = self.acceptance.objection(index, self.theta, theta, validation, confirmed, len(active))
        return replace(score, evidence=gained, validation=validation, theta=theta, reason=reason)

    def _drop_superfluous(self, limit: float, of: Sequence[cand.Candidate]) -> list[Step]:
        """Drop effects whose loss costs less than noise, or less than is relevant."""
        steps = []
        for c in of:
            left = [a for a in self.added if a is not c]
            theta = self.without(c)
            if not self._costs(theta, self._active(left), limit):
                self.added, self.theta = left, theta
                steps.append(Step(None, c, (), limit, theta, self.active))
        return steps

    def _costs(self, theta: np.ndarray, active: np.ndarray, limit: float) -> bool:
        """Whether a smaller model is worse by more than noise and by what is relevant."""
        e, jacobian = cand.evaluate(self.superset, self.samples, self.theta, self.active)
        now = Screen.of(ev.Whitener.of(e, self.samples.moving, self.colour), e, jacobian[..., self.active])
        less, jacobian = cand.evaluate(self.superset, self.samples, theta, active)
        after = now.held_out(less, jacobian[..., active])
        lost = float(ev.log_evidence(now.rows, after, now.before)[0])
        return lost > limit and self.acceptance.closed(less, e) > _SUPERFLUOUS


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
