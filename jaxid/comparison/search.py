"""The search for the fewest changes that make one model explain several logs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.comparison.model import Change, Model
from jaxid.comparison.rows import STRETCHES, ComparedLog, Whitened
from jaxid.comparison.screen import Scored, Screen, screen_changes
from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.acceptance import RELEVANT
from jaxid.discovery.bounded_fit import bounded_fit
from jaxid.discovery.selection import MODEST, TIE_NATS, TIE_PART

# Number of best changes that are refitted. Those below this part of the best one follow only if none of the
# others may be made.
_REFITTED, _NEAR = 6, 0.4
# A change of an incomplete model must close `RELEVANT` of the gap, of which at least half of the residual is
# a part. A change is dropped if it closes less than this part.
_SUPERFLUOUS = 0.05
# A residual counts as noise if its RMS exceeds that of the noise by less than this many deviations.
_SCATTER = 3.0
# Differences must close this part of the gap, unless noise alone is left: an incomplete model leaves more to
# chance than to any difference. So must sets of parameters for each log, none of which differs clearly alone.
_MOST_OF_IT = 0.5
# A log is disturbed if its residual exceeds the noise by this factor, while that of another is noise: an
# effect that both have alike would show in both.
_ABOVE_FLOOR = 2.0
# Two changes explain the logs equally well if their evidence differs by less. If one is true, its gain over
# the other scatters by the root of twice that gain: this is a gain of two such deviations.
_CHANCE = 8.0
# Largest number of evaluations of a fit.
_EVALUATIONS = 25


@dataclass(frozen=True)
class Refit:
    """A change after a refit of all unknowns.

    Args:
        change: The change.
        model: The model with it.
        evidence: Held-out gain in log-likelihood [nats].
        reason: Reason why it was rejected; empty if it was not.
    """

    change: Change
    model: Model
    evidence: float
    reason: str = ""

    @property
    def simplicity(self) -> tuple:
        """Key by which the simpler of two equal explanations comes first.

        A change of all logs alike is no difference; a parameter of the case comes before an effect, and the
        first log is the base.
        """
        c = self.change
        based = c.effect is not None and 0 in c.logs and not c.alike
        return (not c.alike, c.unknowns, c.effect is not None, based, -self.evidence)


@dataclass(frozen=True)
class Round:
    """All that is known about the changes of one model.

    Args:
        model: The model.
        screen: Its linear screen.
        refits: The changes that were refitted, best first.
    """

    model: Model
    screen: Screen
    refits: tuple[Refit, ...]

    @property
    def good(self) -> list[Refit]:
        """Changes that may be made, best first."""
        good = [r for r in self.refits if not r.reason and r.evidence > self.screen.threshold]
        return sorted(good, key=lambda r: -r.evidence)


@dataclass(frozen=True)
class Named:
    """A difference that the search ended with.

    Args:
        change: The difference.
        evidence: Held-out gain in log-likelihood by it, all else refitted [nats].
        threshold: Evidence that noise alone exceeds once in a thousand comparisons.
        false_alarm: Probability that noise alone reaches the evidence with any change.
        alternatives: Other changes that explain the logs equally well.
    """

    change: Change
    evidence: float
    threshold: float
    false_alarm: float
    alternatives: tuple[Refit, ...] = ()


@dataclass
class Search:
    """A search for what differs between logs.

    Args:
        superset: Machine with all candidates.
        logs: The logs, the base first.
        comparable: Indices of the parameters that may differ between logs.
        progress: Called with a line of text at every stage.
        held: Indices of unknowns that keep their value in the first log; see `Model`.
    """

    superset: cand.CandidateModel
    logs: tuple[ComparedLog, ...]
    comparable: tuple[int, ...]
    progress: Callable[[str], None] = lambda text: None
    held: tuple[int, ...] = ()
    _rounds: dict[frozenset, Round] = field(default_factory=dict)

    def start(self, theta: Float[np.ndarray, " p"]) -> Model:
        """Return the model with one set of values for all logs, fitted from some values."""
        by_log = [log.view.theta(theta) for log in self.logs]
        for values in by_log:
            for c in self.superset.candidates:
                values[c.index] = c.neutral
        base = tuple(int(i) for i in self.superset.base if i not in self.held)
        model = self.fit(Model(np.stack(by_log), base, held=self.held))
        renewed = tuple(log.renewed(model.theta[k]) for k, log in enumerate(self.logs))
        if all(new is old for new, old in zip(renewed, self.logs, strict=True)):
            return model
        self.logs = renewed
        return self.fit(model)

    def run(self, start: Model, most: int) -> tuple[Model, list[Named]]:
        """Make changes until none is accepted, drop what became superfluous, and find alternatives.

        Args:
            start: The model without any change.
            most: Largest number of changes.

        Returns:
            The model, and its differences.
        """
        model, tried = start, {frozenset()}
        while len(model.changes) < most:
            best = _next(self.round(model).good)
            if best is None:
                break
            model = self.without_superfluous(best.model, best.model.changes[:-1])
            key = _key(model)
            if key in tried:
                break
            tried.add(key)

        named: list[Named] = []
        for place in [c.place for c in model.differences]:
            change = next((c for c in model.differences if c.place == place), None)
            if change is None:
                continue
            model, found = self.explained(model, change)
            named += [found] if found is not None else []
        # A change of all logs alike may have stood in for a difference that was found later.
        model = self.without_superfluous(model, [c for c in model.changes if c.alike])
        if named and not self.at_floor(model):
            shared = model
            for change in model.differences:
                shared = shared.without(change)
            shared = self.fit(shared)
            if self.closed(shared, model) < _MOST_OF_IT:
                return shared, []
        return model, named

    def round(self, model: Model) -> Round:
        """Screen the changes of a model, and refit the most promising."""
        key = _key(model)
        if key in self._rounds:
            return self._rounds[key]
        screen = self._screen(model)
        promising = [s for s in screen.scores if s.evidence > 0.5 * screen.threshold]
        near = [s for s in promising if s.evidence > _NEAR * promising[0].evidence]
        out = Round(model, screen, self._refits(model, near, screen))
        if not out.good:
            far = promising[len(near) :]
            out = replace(out, refits=(*out.refits, *self._refits(model, far, screen)))
        self._rounds[key] = replace(out, refits=tuple(sorted(out.refits, key=lambda r: -r.evidence)))
        return self._rounds[key]

    def _refits(self, model: Model, scores: Sequence[Scored], screen: Screen) -> tuple[Refit, ...]:
        """Refit a model with each of the most promising changes."""
        refits = []
        for scored in _shortlist(scores):
            self.progress(f"refitting with {scored.change.label}")
            refits.append(self.refit(model, scored, screen))
        return tuple(refits)

    def explained(self, model: Model, change: Change) -> tuple[Model, Named | None]:
        """Return a model with the simplest explanation in place of a difference, and its alternatives.

        Args:
            model: The model.
            change: A difference of it.

        Returns:
            The model; and the difference, or None if a change of all logs alike explains them as well, or if
            it varies as much within the logs as between them.
        """
        self.progress(f"searching for alternatives to {change.label}")
        without = self.fit(model.without(change))
        found = self.round(without)
        screen = found.screen
        good = found.good
        if not any(_same(r.change, change) for r in found.refits):
            itself = self.refit(without, Scored(change, 0.0, _values_of(model, change)), screen)
            good += [itself] if not itself.reason and itself.evidence > screen.threshold else []
        if not good:
            return without, None
        first = max(good, key=lambda r: r.evidence)
        equal = [r for r in good if r is first or self._equal(r, first)]
        best = min(equal, key=lambda r: r.simplicity)
        if best.change.alike:
            return best.model, None
        if self._by_chance(best.model, best.change, screen):
            return without, None
        others = tuple(r for r in equal if r is not best and r.change.place != best.change.place)
        chance = screen.false_alarm(best.evidence)
        return best.model, Named(best.change, best.evidence, screen.threshold, chance, others)

    def _by_chance(self, model: Model, change: Change, screen: Screen) -> bool:
        """Check that a difference may come about by its variation within the logs.

        A change of all logs alike may make the estimates scatter far more than it explains. So the difference
        is also tested in the model without such changes; the probability counts for both tests.
        """
        found = [self.chance(model, change, screen.whitened) * screen.changes]
        alike = [c for c in model.changes if c.alike]
        if alike and found[0] > ev.FALSE_POSITIVE:
            for other in alike:
                model = model.without(other)
            model = self.fit(model)
            plain = self.round(self.fit(model.without(change))).screen
            found.append(self.chance(model, change, plain.whitened) * plain.changes)
        return len(found) * min(found) > ev.FALSE_POSITIVE

    def without_superfluous(self, model: Model, changes: Sequence[Change]) -> Model:
        """Drop those of some changes whose loss is below the noise, or closes next to nothing."""
        for change in changes:
            smaller = self.fit(model.without(change))
            screen = self.round(smaller).screen
            lost = screen.gained(self._after(model, screen.whitened))
            if lost < screen.threshold or self.closed(smaller, model) < _SUPERFLUOUS:
                model = smaller
        return model

    def refit(self, model: Model, scored: Scored, screen: Screen) -> Refit:
        """Refit a model with one more change, and score the gain."""
        change = scored.change
        starts: Sequence[np.ndarray | None] = scored.starts or (None,)
        fits = [self.fit(model.with_change(change, start)) for start in starts]
        new = min(fits, key=self.squares)
        after = self._after(new, screen.whitened)
        if change.effect is not None and not change.effect.amplitude.any():
            rows = [len(b) for b in screen.whitened.blocks]
            absorbed = [log.absorbed(model.theta[k], new.theta[k]) for k, log in enumerate(self.logs)]
            after /= 1 - float(np.average(absorbed, weights=rows))
        evidence = screen.gained(after)
        return Refit(change, new, evidence, self.objection(model, new, change))

    def objection(self, old: Model, new: Model, change: Change) -> str:
        """Explain why a change may not be made; empty if it may."""
        if change.effect is not None:
            free = self.superset.machine.parameters.free
            for i in change.effect.index:
                value, f = new.theta[change.logs[0], i], free[i]
                if not np.isfinite(value):
                    return "its fit diverged"
                if f.sign == "nonnegative" and value <= 0.0:
                    return f"{f.name} would have to be negative"
                if np.isfinite(f.upper) and value >= (1 - 1e-3) * f.upper:
                    return f"{f.name} runs to its limit, at which the effect only imitates another"
        if self.squares(old) - self.squares(new) < sum(log.numerics for log in self.logs):
            return "it is smaller than the errors of filtering"
        if self.at_floor(new):
            return ""
        # An incomplete model is left, which may imitate a change.
        closed = self.closed(old, new)
        if closed < RELEVANT:
            return f"it closes only {100 * max(closed, 0.0):.1f} % of the gap, in squares"
        return ""

    def chance(self, model: Model, change: Change, whitened: Whitened) -> float:
        """Return the probability that a difference comes about by its variation within the logs.

        The difference is compared with the scatter of estimates that leave out one stretch of time of a log
        each: an incomplete model gives other values in other stretches.

        Source:
            Tukey's jackknife, by stretches; Efron (1982), The Jackknife, the Bootstrap and Other Resampling
            Plans. Student's distribution for its statistic.
        """
        columns, e = self._white(model, whitened)
        _, apart, _ = whitened.left_out(columns, e)
        values = model.values()
        contrasts = []
        for weights, neutral in _contrasts(model, change):
            spread = apart @ weights
            count = len(spread)
            variance = (count - 1) / count * float(np.sum((spread - spread.mean()) ** 2))
            size = float(values @ weights) - neutral
            contrasts.append(abs(size) / np.sqrt(max(variance, 1e-300)))
        freedom = STRETCHES * len({0, *change.logs}) - len(model.unknowns)
        strongest = max(contrasts)
        return float(min(1.0, len(contrasts) * 2 * scipy.stats.t.sf(strongest, max(freedom, 3))))

    def fit(self, model: Model, whitened: Whitened | None = None) -> Model:
        """Fit all unknowns of a model.

        Args:
            model: The model, from whose values the fit starts.
            whitened: Map to rows of unit noise; None: residuals count by their size over the noise.
        """
        unknowns = model.unknowns
        if not unknowns:
            return model
        some = cand.free_of(self.superset, np.array([u.index for u in unknowns]))
        rows = lambda values: self._rows(model.at(values), whitened)
        return model.at(bounded_fit(some, model.values(), rows, most=_EVALUATIONS)[0])

    def residuals(self, model: Model) -> list[Float[np.ndarray, "kept n"]]:
        """Return the force residual of a model on each log."""
        return [log.evaluate(model.theta[k])[0] for k, log in enumerate(self.logs)]

    def squares(self, model: Model) -> float:
        """Return the sum of squares of all residuals, in units of the noise."""
        return sum(log.squares(e) for log, e in zip(self.logs, self.residuals(model), strict=True))

    def closed(self, old: Model, new: Model) -> float:
        """Return the part of the gap above the noise that a model closes, in sum of squares."""
        before, after = self.squares(old), self.squares(new)
        noise = float(sum(log.counts.sum() for log in self.logs))
        return (before - after) / max(before - noise, 0.5 * before)

    def at_floor(self, model: Model) -> bool:
        """Check that the residual of each log is noise, within the scatter of its RMS."""
        pairs = zip(self.logs, self.residuals(model), strict=True)
        return all(self._is_noise(log, e) for log, e in pairs)

    def differ_unexplained(self, model: Model) -> str:
        """Describe a difference between the logs that no change explains; empty if there is none."""
        if self.at_floor(model):
            return ""
        screen = self.round(model).screen
        apart = self.fit(replace(model, changes=(*model.changes, *self._all_apart(model))))
        closed = self.closed(model, apart)
        if screen.apart > screen.apart_threshold and closed > _MOST_OF_IT:
            return (
                f"parameters of their own for each log close {100 * closed:.0f} % of the gap, in squares, "
                "and no one of them does"
            )
        # The residual of a disturbed log spoils parameters that all logs share.
        return self._disturbed(apart)

    def estimate(
        self, model: Model, whitened: Whitened | None
    ) -> tuple[Model, Float[np.ndarray, " u"], Float[np.ndarray, " u"]]:
        """Return a model after a last fit, with the values of its unknowns and their standard deviations.

        A deviation is the larger of that of the residual's noise and that of estimates without one stretch
        of time, which an incomplete model makes larger.
        """
        if whitened is None:
            whitened = screen_changes(
                self.superset, self.logs, model, self.comparable, effects=False
            ).whitened
        model = self.fit(model, whitened)
        columns, e = self._white(model, whitened)
        _, apart, covariance = whitened.left_out(columns, e)
        freedom = max(whitened.rows - len(model.unknowns), 1)
        variance = sum(float(np.sum(x**2)) for x in e) / freedom
        by_noise = np.sqrt(np.maximum(np.diag(covariance), 0.0) * variance)
        count = len(apart)
        by_stretch = np.sqrt((count - 1) / count * np.sum((apart - apart.mean(axis=0)) ** 2, axis=0))
        return model, model.values(), np.maximum(by_noise, by_stretch)

    def _all_apart(self, model: Model) -> list[Change]:
        names, count = self.superset.machine.parameters.names, len(self.logs)
        others = tuple(range(1, count))
        return [
            Change(names[i], others, count, index=i)
            for i in self.comparable
            if len(model.partition(i)) < count
        ]

    def _disturbed(self, model: Model) -> str:
        """Describe a log whose residual is no noise, while that of another is, over the same motion."""
        residuals = self.residuals(model)
        quiet = [k for k, log in enumerate(self.logs) if self._is_noise(log, residuals[k])]
        loud = [k for k in range(len(self.logs)) if k not in quiet]
        for k, other in itertools.product(loud, quiet):
            log, calm = self.logs[k], self.logs[other]
            counts = log.counts & log.within(calm)
            total = float(np.sum(np.where(counts, residuals[k] / log.smallest, 0.0) ** 2))
            ratio = np.sqrt(total / max(counts.sum(), 1))
            if ratio > _ABOVE_FLOOR:
                return (
                    f"{log.name} leaves a residual of {ratio:.2g} times the noise within the motion of "
                    f"{calm.name}, which leaves noise"
                )
        return ""

    def _is_noise(self, log: ComparedLog, e: Float[np.ndarray, "kept n"]) -> bool:
        counts = log.counts.sum(axis=0)
        scatter = np.sqrt(0.5 / np.maximum(log.independent * counts, 1))
        return bool(np.all((log.rms(e) <= log.smallest * (1 + _SCATTER * scatter))[counts > 0]))

    def _screen(self, model: Model) -> Screen:
        """Score the changes of a model; if its residual is noise, effects only if a parameter differs."""
        self.progress("screening changes")
        if self.at_floor(model):
            screen = screen_changes(self.superset, self.logs, model, self.comparable, effects=False)
            if all(s.evidence < screen.threshold for s in screen.scores):
                return screen
        return screen_changes(self.superset, self.logs, model, self.comparable)

    @staticmethod
    def _equal(one: Refit, best: Refit) -> bool:
        """Check that a change explains the logs as well as the best one."""
        return one.evidence >= best.evidence - max(_CHANCE, TIE_PART * best.evidence)

    def _after(self, model: Model, whitened: Whitened) -> float:
        """Return the held-out sum of squares of a model, linearised at its values."""
        columns, e = self._white(model, whitened)
        return float(whitened.held_out(columns, e)[0])

    def _white(self, model: Model, whitened: Whitened) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return columns and residual of a model as rows of unit noise, by log."""
        both = [log.evaluate(model.theta[k], model.fitted_in(k)) for k, log in enumerate(self.logs)]
        return whitened.columns(model.unknowns, [j for _, j in both]), whitened.residual([e for e, _ in both])

    def _rows(self, model: Model, whitened: Whitened | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual that a fit minimises, and its columns, of all logs one behind the other."""
        if whitened is not None:
            columns, e = self._white(model, whitened)
            return np.concatenate(e)[:, 0], np.concatenate(columns)
        residuals, jacobians = [], []
        unknowns = model.unknowns
        for k, log in enumerate(self.logs):
            e, jacobian = log.evaluate(model.theta[k], model.fitted_in(k))
            shown = [j for j, u in enumerate(unknowns) if k in u.logs]
            columns = np.zeros((*e.shape, len(unknowns)))
            columns[..., shown] = jacobian[..., [unknowns[j].index for j in shown]]
            weight = log.samples.weight / log.smallest
            with np.errstate(over="ignore", invalid="ignore"):  # a loop that diverged: the step is refused
                residuals.append((e * weight).ravel())
                jacobians.append((columns * weight[..., None]).reshape(-1, len(unknowns)))
        return np.concatenate(residuals), np.concatenate(jacobians)


def _next(good: Sequence[Refit]) -> Refit | None:
    """Return the change to make next: the simplest of those whose gain is close to the best."""
    if not good:
        return None
    top = good[0].evidence
    enough = [r for r in good if r.evidence > min(MODEST * top, top - TIE_NATS)]
    fewest = min(r.change.unknowns for r in enough)
    return max((r for r in enough if r.change.unknowns == fewest), key=lambda r: r.evidence)


def _shortlist(promising: Sequence[Scored]) -> list[Scored]:
    """Return the best changes, and the best of the others that add one unknown."""
    best = list(promising[:_REFITTED])
    single = [s for s in promising[_REFITTED:] if s.change.unknowns == 1]
    return [*best, *single[:2]]


def _key(model: Model) -> frozenset:
    """Return what makes two models the same: their changes."""
    return frozenset((c.place, c.logs) for c in model.changes)


def _same(one: Change, two: Change) -> bool:
    return one.place == two.place and one.logs == two.logs


def _values_of(model: Model, change: Change) -> tuple[np.ndarray, ...]:
    """Return the values of an effect of a model, as a start of its refit."""
    if change.effect is None:
        return ()
    return (model.theta[change.logs[0], change.effect.index],)


def _contrasts(model: Model, change: Change) -> list[tuple[np.ndarray, float]]:
    """Return the combinations of fitted numbers that are zero without a difference, each with its offset."""
    unknowns = model.unknowns
    out = []
    if change.effect is not None:
        c = change.effect
        drive = not c.amplitude.any()
        for i, neutral, amplitude in zip(c.index, c.neutral, c.amplitude, strict=True):
            if drive or amplitude:
                weights = np.array([float(u.index == i and u.logs == change.logs) for u in unknowns])
                out.append((weights, float(neutral)))
        return out
    sets = model.partition(int(change.index or 0))
    inside = [s for s in sets if set(s) <= set(change.logs)]
    rest = [s for s in sets if s not in inside] or inside[:1]
    # A value that is held is no fitted number.
    held = change.index in model.held and 0 in rest[0]
    constant = float(model.theta[0, int(change.index or 0)]) if held else 0.0
    for logs in inside:
        if logs in rest:
            continue
        mine = np.array([float(u.index == change.index and u.logs == logs) for u in unknowns])
        base = np.array([float(u.index == change.index and u.logs == rest[0]) for u in unknowns])
        out.append((mine - base, constant))
    return out
