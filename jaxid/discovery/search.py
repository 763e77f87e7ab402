"""The search for missing effects: score every candidate on held-out time, add the best, refit, repeat."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.acceptance import RELEVANT, Acceptance
from jaxid.discovery.domain import Domain
from jaxid.discovery.score import Score
from jaxid.discovery.screen import Screen, guess_pair, screen_candidates
from jaxid.discovery.selection import MODEST, margin, next_effect, shortlist, simplest_equivalent
from jaxid.logs.prepare import Prepared
from jaxid.numerics.coloured_noise import NoiseModel

# An unknown of the case counts as displaced if an effect leaves less than this part of its value.
_GONE = 1e-2
# An effect in the model is dropped if it closes less than this part of the gap: a third of the part that it
# must close to be named.
SUPERFLUOUS = 0.05
# Two effects are added at once if together they close `MOST_OF_IT` of the gap, and gain more than the best
# single effect with any partner, by `_CLEARLY` times the threshold of noise and by `_MUCH` of their gain. An
# effect whose refit keeps less than `_KEPT` of its linear evidence takes no part in pairs.
_CLEARLY = 3.0
_KEPT = 0.5
_MUCH = 0.33
MOST_OF_IT = 0.5
# An effect below the threshold is added if it closes more than this part of the gap, by this evidence [nats].
NEARLY_ALL, CERTAIN = 0.99, 100.0


@dataclass(frozen=True)
class Model:
    """A model in the superset: the effects that act, and the values of all unknowns.

    Args:
        added: Effects beside the baseline, in the order in which they were added.
        theta: All unknowns of the superset; those of other candidates are neutral.
    """

    added: tuple[cand.Candidate, ...]
    theta: np.ndarray


@dataclass(frozen=True)
class Step:
    """One step of the search.

    Args:
        added: Score of the added effect; None for the baseline and for a drop.
        dropped: The effect that was dropped or replaced.
        scores: Scores of all candidates, best first.
        threshold: Evidence that noise alone exceeds once in a thousand searches.
        theta: All unknowns of the superset after the step.
        active: Indices of the fitted unknowns.
        why: Reason for a drop, unless the effect became superfluous.
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
    """A search: the superset, the logs, and the current model.

    Args:
        superset: Machine with all candidates.
        data: The log to fit, prepared.
        floor: RMS force residual caused by the sensors' noise alone, by joint.
        colour: Model of that noise, by joint.
        validation: Logs that must confirm each effect, prepared.
        progress: Called with a line of text at every stage.
        barred: Effects that were taken out for good.
        view: View of the log on the superset; None: it is the only one that is fitted.
        more: Further logs to fit with their views.
        validation_views: Views of the validation logs; empty: they have none.
        guess: Values of the case's unknowns before any fit; empty: not known.
        sure: Part of the floor that is no upper bound; see `Acceptance`.
    """

    superset: cand.CandidateModel
    data: Prepared
    floor: np.ndarray
    colour: tuple[NoiseModel, ...]
    validation: tuple[Prepared, ...] = ()
    progress: Callable[[str], None] = lambda text: None
    barred: list[cand.Candidate] = field(default_factory=list)
    view: cand.View | None = None
    more: tuple[tuple[Prepared, cand.View], ...] = ()
    validation_views: tuple[cand.View, ...] = ()
    guess: tuple[float, ...] = ()
    sure: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.acceptance = self._acceptance()
        self.domain: Domain = self.acceptance.domain
        self.samples = self.acceptance.samples
        self.candidates = self.superset.candidates
        self.model = Model((), self.superset.neutral)
        # The largest threshold so far, by which effects are dropped later.
        self.limit = 0.0
        self.baseline = self.model.theta

    def _acceptance(self) -> Acceptance:
        """Return the tests of models against the logs, with the domain in which they are compared."""
        return Acceptance(
            self.superset,
            self.data,
            self.validation,
            self.floor,
            self.colour,
            self.view,
            self.more,
            self.validation_views,
            self.guess,
            self.sure,
        )

    @property
    def added(self) -> tuple[cand.Candidate, ...]:
        """Effects of the current model."""
        return self.model.added

    @property
    def theta(self) -> np.ndarray:
        """All unknowns of the current model."""
        return self.model.theta

    @property
    def active(self) -> np.ndarray:
        """Indices of the unknowns that the current model fits: those of the case and of the added effects."""
        return self.fitted_by(self.model.added)

    def fitted_by(self, effects: Sequence[cand.Candidate]) -> np.ndarray:
        """Return the indices of the unknowns that a model with some effects fits."""
        return np.concatenate([self.superset.base, *[c.index for c in effects]]).astype(int)

    def renewed(self, model: Model) -> Model:
        """Return a model whose noise was estimated anew; that of forces is known beforehand."""
        return model

    def drawn_noise(self, model: Model, runs: int) -> Float[np.ndarray, "runs kept n"] | None:
        """Draw residuals by simulated noise; None: surrogates have the residual with other signs."""
        return None

    def widened(self, model: Model, screened: Screen) -> Screen:
        """Return a screen with what candidates gain far from the model; here they stay near it."""
        return screened

    def ends_with(self, best: Sequence[Score]) -> bool:
        """Check whether the search ends once these effects are in the model, whatever else is missing."""
        return False

    def finer(self, model: Model) -> bool:
        """Give the candidates their finer starts, and return whether that may explain what a model leaves."""
        if self.acceptance.at_floor(model.theta):
            return False
        rest = self.rest(model)
        before = self.candidates
        self.candidates = tuple(c.finer() if any(c is r for r in rest) else c for c in before)
        return any(now is not c for now, c in zip(self.candidates, before, strict=True))

    def rest(self, model: Model | None = None) -> list[cand.Candidate]:
        """Return the candidates that a model, by default the current one, may still get."""
        gone = [*(self.model if model is None else model).added, *self.barred]
        return [c for c in self.candidates if all(c is not g for g in gone)]

    def run(
        self, most: int, at_once: Callable[[Search, list[Step]], list[Step]] = lambda search, steps: steps
    ) -> list[Step]:
        """Add effects until none is accepted, and drop those that become superfluous on the way.

        Args:
            most: Largest number of effects in the model.
            at_once: Function of the search and its first step that may add several effects before, and then
                continues the search; it returns all steps.
        """
        self.progress("fitting the baseline")
        self.model = self.renewed(Model((), self.fit(self.model.theta, self.active)))
        self.baseline = self.model.theta
        first = self.step(self.model)
        steps = at_once(self, [first])
        if len(steps) > 1:
            return steps
        self.model, steps = self.grow(self.model, most)
        return [first, *steps]

    def bar(self, c: cand.Candidate, why: str, most: int) -> list[Step]:
        """Take an effect out for good, and continue the search without it.

        Args:
            c: The effect, of the current model.
            why: Reason, as in results.
            most: Largest number of effects in the model.
        """
        model = self.without(self.model, c)
        self.barred = [*self.barred, c]
        first = self.step(model, dropped=c, why=why)
        # An effect that was needed beside the barred one may be superfluous without it.
        model, dropped = self.drop_superfluous(model, self.limit, model.added)
        self.model, steps = self.grow(model, most)
        return [first, *dropped, *steps]

    def without(self, model: Model, c: cand.Candidate) -> Model:
        """Return a model without one of its effects, the other unknowns fitted again."""
        added = tuple(a for a in model.added if a is not c)
        active = self.fitted_by(added)
        theta = model.theta.copy()
        theta[c.index] = c.neutral
        refitted = self.fit(theta, active)

        base = self.superset.base
        if np.all(np.abs(theta[base]) > _GONE * np.abs(self.baseline[base])):
            return Model(added, refitted)
        # The effect displaced an unknown of the case, for instance as a limit that all of the force exceeds.
        # A fit does not return from values near zero: try a start from the baseline too.
        theta[base] = self.baseline[base]
        return Model(added, min((refitted, self.fit(theta, active)), key=self.acceptance.squares))

    def grow(self, model: Model, most: int) -> tuple[Model, list[Step]]:
        """Add effects to a model until none is accepted, it has the most, or a set of effects recurs."""
        steps: list[Step] = []
        tried = {frozenset(id(c) for c in model.added)}
        while True:
            best, scores, limit = self.best(model, ahead=len(model.added) + 2 <= most)
            self.limit = max(self.limit, limit)
            if not best and len(model.added) < most and self.finer(model):
                continue
            if not best or len(model.added) >= most:
                steps.append(self.step(model, scores=scores, threshold=limit))
                return model, steps

            for score in best:
                model = Model((*model.added, score.candidate), score.refitted)
                steps.append(self.step(model, added=score, scores=scores, threshold=limit))
            if self.ends_with(best):
                return model, steps
            model = self.renewed(model)
            model, dropped = self.drop_superfluous(model, limit, model.added[:-1])
            steps.extend(dropped)

            now = frozenset(id(c) for c in model.added)
            if now in tried:  # effects are added and dropped in turn
                return model, steps
            tried.add(now)

    def best(
        self, model: Model, near: float = 0.0, replaced: cand.Candidate | None = None, *, ahead: bool = False
    ) -> tuple[tuple[Score, ...], tuple[Score, ...], float]:
        """Screen all candidates, refit the most promising, and choose.

        Args:
            model: The model to extend.
            near: Candidates are refitted only if their screened evidence reaches this part of the best one's,
                or of that of `replaced`.
            replaced: The effect that was taken out of the model, if a replacement is sought.
            ahead: True to examine pairs of effects too, and choose both if a single one would mislead.

        Returns:
            The chosen scores (none, one or two), all scores, and the threshold of noise.
        """
        if self.acceptance.at_floor(model.theta):
            return (), (), 0.0
        self.progress(f"screening {len(self.rest(model))} effects")
        screened = self.widened(model, screen_candidates(self, model, ahead=ahead))

        # A linear screen may promise far more than a refit then gains: the effect itself is the measure.
        compared = [s for s in screened.scores if replaced is None or s.candidate is replaced]
        top = max((s.evidence for s in compared), default=0.0)
        least = max(0.5 * screened.threshold, near * top)
        promising = [s for s in screened.scores if s.evidence > least]
        refitted = []
        for score in shortlist(promising):
            self.progress(f"refitting with {score.candidate.label}")
            refitted.append(self.refit(model, score, screened))
        refitted.sort(key=lambda s: -s.total)
        rest = [s for s in screened.scores if all(s.candidate is not r.candidate for r in refitted)]

        promised = {id(s.candidate): s.evidence for s in promising}

        # The surrogates of the threshold are not refitted. A candidate with few starts needs the refit; one
        # with a start everywhere must exceed the threshold as the surrogates do, without it.
        def passed(s: Score) -> float:
            return min(s.evidence, promised[id(s.candidate)] if s.candidate.has_grid else np.inf)

        def enough(s: Score) -> bool:
            return passed(s) > screened.threshold or self._leaves_noise(model, s, passed(s))

        good = [s for s in refitted if not s.reason and enough(s)]
        one = next_effect(good)
        broken = [s.candidate for s in refitted if s.evidence < _KEPT * promised[id(s.candidate)]]
        two = self._two(model, screened, one, broken) if ahead else ()
        return two or ((one,) if one else ()), (*refitted, *rest), screened.threshold

    def _leaves_noise(self, model: Model, score: Score, evidence: float) -> bool:
        """Check that a refitted effect leaves next to nothing above the noise, by an evidence without doubt.

        The surrogates of the threshold are what no candidate explains linearly. Of an effect that acts in few
        moments, as a limit does, much of that is the effect itself.
        """
        return evidence >= CERTAIN and self._closes_nearly_all(model, score)

    def _closes_nearly_all(self, model: Model, score: Score) -> bool:
        """Check that a refitted effect leaves next to nothing of a model's gap."""
        old, new = (self.acceptance.residual(t) for t in (model.theta, score.refitted))
        return self.acceptance.closed(old, new) > NEARLY_ALL

    def _two(
        self, model: Model, screened: Screen, one: Score | None, broken: list[cand.Candidate]
    ) -> tuple[Score, ...]:
        """Choose two effects to add at once, if they explain far more than one with any partner."""
        pairs = screened.pairs
        assert pairs is not None, "screened ahead"
        reached = screened.threshold
        if one is not None:
            reached = pairs.with_partner(one.candidate.kind, one.candidate.port)
        active = self.fitted_by(model.added)
        e, jacobian = self.domain.evaluate(self.samples, model.theta, active)

        for *points, gained in pairs.best(broken):
            if gained < reached + max(_CLEARLY * screened.threshold, _MUCH * gained):
                return ()
            guess = guess_pair(points, screened, jacobian[..., active], e, self)
            if guess is None:
                continue
            self.progress("refitting with " + " and ".join(p.candidate.label for p in points))
            first, second = (Score(p.candidate, p.start, g, 0.0) for p, g in zip(points, guess, strict=True))
            both = self.refit(model, second, screened, beside=first)
            old, new = (self.acceptance.residual(t) for t in (model.theta, both.refitted))
            enough = self.acceptance.closed(old, new) > MOST_OF_IT and (one is None or both.total > one.total)
            if enough and not both.reason:
                only_first = replace(self.refit(model, first, screened), reason="")
                only_second = self.refit(model, second, screened)
                # The first is added alone; the evidence of each is the loss without it.
                added = (
                    replace(
                        only_first,
                        evidence=both.evidence - only_second.evidence,
                        validation=_difference(both.validation, only_second.validation),
                    ),
                    replace(
                        both,
                        evidence=both.evidence - only_first.evidence,
                        validation=_difference(both.validation, only_first.validation),
                    ),
                )
                if min(s.evidence for s in added) > screened.threshold:
                    return added
        return ()

    def alternatives(self, steps: list[Step]) -> dict[int, tuple[Score, ...]]:
        """Find, for each added effect, those that could replace it without loss.

        Each effect is taken out, and all candidates are scored against the rest. A candidate takes its place
        if it closes relevantly more of the gap without more parameters, or as much with fewer.

        Args:
            steps: Steps of the search; each replacement is appended.

        Returns:
            Equivalent effects by index of the added effect.
        """
        out: dict[int, tuple[Score, ...]] = {}
        for k in range(len(self.model.added)):
            model, named = self.model, self.model.added[k]
            self.progress(f"searching for a replacement of {named.label}")
            without = self.without(model, named)
            _, scores, limit = self.best(without, MODEST, named)
            good = [s for s in scores if s.theta is not None and not s.reason and s.evidence > limit]
            current = screened = next((s for s in scores if s.candidate is named), None)
            if current is not None and current.evidence < limit:
                # So large an effect passes for coloured noise where it is missing. Rivals leave as little.
                good = [s for s in good if self._closes_nearly_all(without, s)]
                current = replace(current, evidence=self.loss(model, without)[0])
            if not good or current is None:
                out[k] = ()
                continue
            if current.theta is None:  # others promised more, and it was not refitted: keep its values
                current = replace(current, theta=model.theta)

            best, ties = simplest_equivalent(good, self._chance_difference)
            if best.candidate is not named and self._takes_over(model, best, current):
                added = tuple(best.candidate if c is named else c for c in model.added)
                self.model = Model(added, self.fit(best.refitted, self.fitted_by(added)))
                steps.append(self.step(self.model, added=best, dropped=named, scores=scores, threshold=limit))
            elif best.candidate is not named:
                # One that gains more with more parameters does not replace the effect, but is a rival of it.
                ties = tuple(s for s in good if self._equal(s, current))
            ties = tuple(s for s in ties if s.candidate is not self.model.added[k])
            if self.model.added[k] is named and screened is not None:
                # The effect was scored with another noise when it was added: what counts is the difference.
                found = (s.added for s in reversed(steps) if s.added and s.added.candidate is named)
                shift = next(found, screened).evidence - screened.evidence
                ties = tuple(replace(s, evidence=s.evidence + shift) for s in ties)
            out[k] = ties
        return out

    def _takes_over(self, model: Model, best: Score, current: Score) -> bool:
        """Check that a candidate is as good with fewer parameters, or closes relevantly more of the gap.

        One with more parameters could be added beside the current effect in the rounds before.
        """
        more = len(best.candidate.index) - len(current.candidate.index)
        if more > 0 or self._equal(current, best):
            return more < 0
        old, new = self.acceptance.residual(model.theta), self.acceptance.residual(best.refitted)
        return self.acceptance.closed_somewhere(old, new) > RELEVANT

    def _chance_difference(self, one: Score, two: Score) -> float:
        """Return the difference in evidence of two fits that chance may cause: two deviations [nats]."""
        # If one is true, its gain scatters about the expected gain with a variance of twice that gain.
        return 2 * np.sqrt(2 * self.acceptance.divergence(one.refitted, two.refitted))

    def _equal(self, current: Score, best: Score) -> bool:
        """Check that an effect explains the log as well as the best one."""
        return current.total > best.total - max(margin(best), self._chance_difference(best, current))

    def fit(self, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Fit the active unknowns to the log, from and beside the others."""
        return cand.refine(self.superset, self.samples, theta, active, self.domain.evaluate)[0]

    def fit_from(self, starts: Sequence[np.ndarray] | np.ndarray, active: np.ndarray) -> np.ndarray:
        """Fit the active unknowns from each of several starts, and return the best fit."""
        return min((self.fit(theta, active) for theta in starts), key=self.acceptance.squares)

    def step(
        self,
        model: Model,
        *,
        added: Score | None = None,
        dropped: cand.Candidate | None = None,
        scores: tuple[Score, ...] = (),
        threshold: float = 0.0,
        why: str = "",
    ) -> Step:
        """Record a step of the search that ends at a model."""
        return Step(
            added=added,
            dropped=dropped,
            scores=scores,
            threshold=threshold,
            theta=model.theta,
            active=self.fitted_by(model.added),
            why=why,
        )

    def refit(self, model: Model, score: Score, screened: Screen, beside: Score | None = None) -> Score:
        """Refit a model with one more effect, or with two, and score the gain.

        Args:
            model: The model to extend.
            score: The effect, with its starts.
            screened: The screen that scored it.
            beside: Another effect that is added too; None: there is none.
        """
        new = [s for s in (beside, score) if s is not None]
        active = self.fitted_by([*model.added, *[s.candidate for s in new]])
        starts = []
        for guesses in itertools.product(*[_starts(s) for s in new]):
            theta = model.theta.copy()
            for s, guess in zip(new, guesses, strict=True):
                theta[s.candidate.index] = guess
            starts.append(theta)
        returned = self._returned(starts[0])
        if returned is not None:
            starts.append(returned)
        theta = self.fit_from(starts, active)

        e, jacobian = self.domain.evaluate(self.samples, theta, active)
        after = screened.held_out(e, jacobian[..., active])
        drive = any(not s.candidate.amplitude.any() for s in new)
        if drive:
            after = after / (1 - self.acceptance.absorbed_noise(self.samples, model.theta, theta))
        gained = float(ev.log_evidence(screened.rows, screened.before, after)[0])

        validation, confirmed = self.acceptance.confirmed(model.theta, theta, drive=drive)
        index = np.concatenate([s.candidate.index for s in new])
        reason = self.acceptance.objection(index, model.theta, theta, validation, confirmed, len(active))
        return replace(score, evidence=gained, validation=validation, theta=theta, reason=reason)

    def _returned(self, theta: np.ndarray) -> np.ndarray | None:
        """Return unknowns of the case that a model without an effect drove to zero to their guesses.

        A missing spring makes the inertia vanish on a slow sine, and a fit does not return from zero.

        Returns:
            The unknowns; None if none has vanished.
        """
        base, guess = self.superset.base, self.superset.neutral[self.superset.base]
        gone = np.abs(theta[base]) < _GONE * np.abs(guess)
        if not gone.any():
            return None
        out = theta.copy()
        out[base] = np.where(gone, guess, theta[base])
        return out

    def drop_superfluous(
        self, model: Model, limit: float, effects: Sequence[cand.Candidate]
    ) -> tuple[Model, list[Step]]:
        """Drop those of some effects whose loss is below the noise, or below what is relevant.

        The least needed goes first. One that a few samples hold makes the others look superfluous: the model
        predicts a stretch badly without these samples, with the others or without them.
        """
        steps, left = [], list(effects)
        while left:
            smaller = [self.without(model, c) for c in left]
            losses = [self.loss(model, less) for less in smaller]
            # An effect stays where its loss is not a number.
            free = [
                k
                for k, (lost, part) in enumerate(losses)
                if not np.isnan(lost) and (lost <= limit or part <= SUPERFLUOUS)
            ]
            if not free:
                break
            least = min(free, key=lambda k: losses[k][0])
            model, c = smaller[least], left.pop(least)
            steps.append(self.step(model, dropped=c, threshold=limit))
        return model, steps

    def loss(self, model: Model, smaller: Model) -> tuple[float, float]:
        """Return what a smaller model loses: evidence [nats], and the part of a gap that the model closes."""
        active, remaining = self.fitted_by(model.added), self.fitted_by(smaller.added)
        e, jacobian = self.domain.evaluate(self.samples, model.theta, active)
        whitener = ev.Whitener.of(e, self.samples.moving, self.colour)
        now = Screen.of(whitener, e, jacobian[..., active])

        less, jacobian = self.domain.evaluate(self.samples, smaller.theta, remaining)
        after = now.held_out(less, jacobian[..., remaining])
        lost = float(ev.log_evidence(now.rows, after, now.before)[0])
        return lost, self.acceptance.closed_somewhere(less, e)


def _starts(score: Score) -> list[np.ndarray]:
    """Return the one or two starts of a candidate's refit."""
    second = score.second
    if second is None or np.array_equal(second, score.guess):
        return [score.guess]
    return [score.guess, second]


def _difference(both: float | None, one: float | None) -> float | None:
    """Return the gain of two effects over that of one of them; None without validation logs."""
    return None if both is None or one is None else both - one
