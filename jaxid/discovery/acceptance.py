"""Acceptance tests of a model change: gain above the noise, confirmation by other logs, and objections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.domain import Domain, ForceDomain, Samples
from jaxid.discovery.noise import NUMERICS
from jaxid.discovery.selection import TIE_NATS
from jaxid.logs.prepare import Prepared
from jaxid.model.plant import inertia_behind
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.simulation.sensor_noise import force_noise

# An effect must close this part of the gap above the noise floor (in sum of squares, so about half of this
# part in RMS), whatever its evidence: on measured data every effect helps a little.
RELEVANT = 0.15
# A residual counts as noise if its RMS exceeds the noise floor by less than this many standard deviations.
_SCATTER = 3.0
# A fit that leaves less than this part of the noise's sum of squares explains noise. With few independent
# samples the limit is lower: a true model falls below it only once in a thousand logs.
_LEAST = 0.25
_RARELY = 1e-3
# The part by which the squared residual falls on a validation log must be at least this fraction of the part
# by which the gap closes on the fitted log.
_CONFIRMED = 0.1

# Standard deviation of a force's drawn noise over that of the force, at least: so little meets no limit.
_DRAWN = 1e-3

# A mass of the machine, or another positive parameter of its plant, is next to nothing below this part of its
# value without an effect.
_NOTHING = 0.1

# A ripple of which the filter passes less than this part of the power, at the speeds that count, is an
# extrapolation from a few samples near reversals, where friction that is no step leaves its error too.
_IN_BAND = 0.03
_ENDLESS = 1e12

# A load behind a spring is a part of the joint's inertia; one that is so many times as large is none.
_HEAVIER = 1.25


@dataclass
class Acceptance:
    """Acceptance tests of models against logs and their noise.

    Args:
        superset: Machine with all candidates; a model is a vector of its unknowns.
        data: The log to fit, prepared.
        validation: Logs that must confirm an effect, prepared.
        floor: RMS force residual caused by the sensors' noise alone, by joint.
        colour: Model of that noise, by joint.
        view: View of the log on the superset; None: it is the only one that is fitted.
        more: Further logs to fit with their views.
        validation_views: Views of the validation logs; empty: they have none.
        guess: Values of the case's unknowns before any fit; empty: not known.
        sure: RMS force residual that the noise causes at least, by joint; None: the floor. A noise of the
            force that is estimated from the log is an upper bound, and counts as none here.
    """

    superset: cand.CandidateModel
    data: Prepared
    validation: tuple[Prepared, ...]
    floor: np.ndarray
    colour: tuple[NoiseModel, ...]
    view: cand.View | None = None
    more: tuple[tuple[Prepared, cand.View], ...] = ()
    validation_views: tuple[cand.View, ...] = ()
    guess: tuple[float, ...] = ()
    sure: np.ndarray | None = None

    # Least part of a residual that counts as gap.
    least_gap: ClassVar[float] = 0.5

    def __post_init__(self) -> None:
        self.domain: Domain = ForceDomain(self.superset)
        machine = self.superset.machine
        # Any size does if none is stated; see `absorbed_noise`.
        least = _DRAWN * np.std(self.data.force, axis=0)
        std = force_noise(machine, self.data) * machine.gain
        noise = std if self._states_noise else np.maximum(np.abs(std), least)
        self.samples: Any = cand.CandidateSamples(self.data, noise, self.view, self.more)
        views = self.validation_views or (None,) * len(self.validation)
        self.others: list[Any] = [
            cand.CandidateSamples(d, noise, view) for d, view in zip(self.validation, views, strict=True)
        ]
        force = self.data.at_kept(self.data.force - np.mean(self.data.force, axis=0))
        rows = len(self.samples.moving) / len(force)
        self._numerics = rows * np.sum((NUMERICS * force) ** 2, axis=0)
        # What acts on a joint without a drive comes from the driven ones.
        self._numerics_of_joints = np.full(self.samples.moving.shape[1], np.max(self._numerics))
        self._numerics_of_joints[list(machine.plant.driven(machine.plant.joints))] = self._numerics
        self._noise = self.samples.moving.sum(axis=0) * np.square(self.floor)

    @property
    def _states_noise(self) -> bool:
        """True if the case states the noise of the force."""
        return self.superset.machine.sensor.force_noise is not None

    @property
    def _independent(self) -> float:
        """Part of the samples that a filter leaves independent of each other."""
        return self.data.recipe.independent

    @property
    def _sure_noise(self) -> Float[np.ndarray, " n"]:
        """Sum of squares of the noise that a model must leave, by joint."""
        return self.samples.moving.sum(axis=0) * np.square(self.floor if self.sure is None else self.sure)

    @property
    def noise(self) -> float:
        """Sum of squares of the noise."""
        return float(self._noise.sum())

    def residual(self, theta: np.ndarray) -> Float[np.ndarray, "kept n"]:
        """Return the force residual of a model on the fitted log."""
        return self.domain.evaluate(self.samples, theta, ())[0]

    def squares(self, theta: np.ndarray) -> float:
        """Return the sum of squares of the residual; infinite if it diverged."""
        total = self._sum(self.residual(theta))
        return total if np.isfinite(total) else np.inf

    def at_floor(self, theta: np.ndarray) -> bool:
        """Check that all residuals are at the noise floor, within the scatter of their RMS.

        The validation logs are included: an effect that a fit absorbs on the fitted log may show on another.
        """
        part = self._independent
        for samples in (self.samples, *self.others):
            e, moving = self.domain.evaluate(samples, theta, ())[0], samples.moving
            for x, counts, floor in zip(e.T, moving.T, self.floor, strict=True):
                scatter = np.sqrt(0.5 / max(part * counts.sum(), 1))
                if np.sqrt(np.mean(x[counts] ** 2)) > floor * (1 + _SCATTER * scatter):
                    return False
        return True

    def above_numerics(self, theta: np.ndarray) -> bool:
        """Check that a residual exceeds the errors of filtering and integration."""
        return self._sum(self.residual(theta)) - self.noise > self._numerics.sum()

    def closed(self, old: Float[np.ndarray, "kept n"], new: Float[np.ndarray, "kept n"]) -> float:
        """Return the part of the gap above the noise floor that closes, in sum of squares over all joints."""
        sums = (self._sums(old), self._sums(new), self._noise, self._numerics)
        return self._part(*(float(x.sum()) for x in sums))

    def closed_somewhere(self, old: Float[np.ndarray, "kept n"], new: Float[np.ndarray, "kept n"]) -> float:
        """Return the largest part of the gap that closes, of all joints together or of a single one.

        The friction of a wrist is little beside what the model still lacks at the shoulder.
        """
        sums = (self._sums(old), self._sums(new), self._noise, self._numerics_of_joints)
        by_joint = (self._part(*map(float, joint)) for joint in zip(*sums, strict=True))
        return max(self.closed(old, new), *by_joint)

    def _part(self, before: float, after: float, noise: float, numerics: float) -> float:
        """Return the part of the gap that closes between two sums of squares."""
        if before - after < numerics:
            return 0.0
        # The floor is itself an estimate, and a search always finds something to close: at least a part of
        # the residual counts as gap.
        return (before - after) / max(before - noise, self.least_gap * before, 1e-300)

    def absorbed_noise(self, samples: Samples, old: np.ndarray, new: np.ndarray) -> float:
        """Return the part of the noise that a new model's drive filters out; see `absorbed_noise`."""
        return absorbed_noise(self.domain, samples, self.colour, old, new, stated=self._states_noise)

    def confirmed(
        self, old: np.ndarray, new: np.ndarray, *, drive: bool
    ) -> tuple[float | None, float | None]:
        """Return the gain on the validation logs, without a refit there.

        Args:
            old, new: Unknowns of the two models.
            drive: Whether they differ in the drive, which filters noise.

        Returns:
            Gain in log-likelihood [nats], each log with its own colour of noise; and the part by which the
            sum of squared residuals falls on the worst log. None for both without validation logs.
        """
        if not self.others:
            return None, None
        total, worst = 0.0, np.inf
        for samples in self.others:
            before, after = (
                np.where(samples.moving, self.domain.evaluate(samples, theta, ())[0], 0.0)
                for theta in (old, new)
            )
            whitener = ev.Whitener.of(after, samples.moving, self.colour)
            squares = [np.sum(whitener(e[..., None]) ** 2) for e in (before, after)]
            if drive:
                squares[1] /= 1 - self.absorbed_noise(samples, old, new)
            total += float(ev.log_evidence(int(whitener.rows.sum()), *squares))
            worst = min(worst, 1 - float(np.sum(after**2) / np.sum(before**2)))
        return total, worst

    def divergence(self, one: np.ndarray, two: np.ndarray) -> float:
        """Return the expected gain in log-likelihood of the true one of two models over the other [nats].

        The noise is what the worse one leaves: evidence is gained over a model that leaves more still.
        """
        totals = np.zeros(2)
        for samples in (self.samples, *self.others):
            residuals = [self.domain.evaluate(samples, theta, ())[0] for theta in (one, two)]
            apart = (residuals[0] - residuals[1])[..., None]
            whiteners = [ev.Whitener.of(e, samples.moving, self.colour) for e in residuals]
            totals += [0.5 * float(np.sum(whitener(apart) ** 2)) for whitener in whiteners]
        return float(totals.min())

    def objection(
        self,
        index: np.ndarray,
        old: np.ndarray,
        new: np.ndarray,
        validation: float | None,
        confirmed: float | None,
        fitted: int,
    ) -> str:
        """Explain why the effects added to a model may not be named; empty if they may.

        Args:
            index: Indices of the added unknowns.
            old, new: All unknowns, without and with the added effects.
            validation, confirmed: Both results of `confirmed`.
            fitted: Number of fitted unknowns.
        """
        free = self.superset.machine.parameters.free
        for i in index:
            if not np.isfinite(new[i]):
                return "its fit diverged"
            if free[i].sign == "nonnegative" and new[i] <= 0.0:
                return f"{free[i].name} would have to be negative"
            if np.isfinite(free[i].upper) and new[i] >= (1 - 1e-3) * free[i].upper:
                return f"{free[i].name} runs to its limit, at which the effect only imitates another"

        lost = self._lost_mass(old, new)
        if lost:
            return f"{lost} would be next to nothing beside it, as if only signs of the force had to agree"

        heavier = self._heavier_load(index, new)
        if heavier:
            return f"{heavier} would be more than the inertia of the joint, of which it is a part"

        if self._within_a_row(index, new):
            return "by so little of a row a held force and one on lines between the rows differ"

        if self._beyond_band(index, new):
            return "its ripple is beyond the band of the filter at nearly all speeds of the log"

        e = self.residual(new)
        if self._sum(e) < self._least(fitted) * self._sure_noise.sum():
            return "it removes more than the sensors' noise allows"

        closed = self.closed_somewhere(self.residual(old), e)
        if closed < RELEVANT:
            part = 50 * closed  # in RMS: half of the part in squares, if that is small
            return f"it closes only {part:.1f} % of the gap" if part > 0.05 else "it closes none of the gap"
        if validation is not None and confirmed is not None:  # both or neither
            if validation < TIE_NATS or confirmed < _CONFIRMED * closed:
                return "it does not help on the validation log"
        return ""

    def _lost_mass(self, old: np.ndarray, new: np.ndarray) -> str:
        """Return the name of a parameter of the plant, positive by physics, that an effect takes away.

        Along motions at even speeds a limit of the drive that equals dry friction leaves sign(u) against
        sign(v), which agree, and no inertia. A fit without a limit that most of the log is at makes the
        inertia too large: one near its guess is not lost.

        Args:
            old, new: All unknowns, without and with the added effects.
        """
        usual = old.copy()
        usual[: len(self.guess)] = np.minimum(usual[: len(self.guess)], self.guess)
        for f, least, after in zip(self.superset.machine.parameters.free, usual, new, strict=True):
            if f.effect is None and f.sign == "positive" and after < _NOTHING * least:
                return f.name
        return ""

    def _heavier_load(self, index: np.ndarray, new: np.ndarray) -> str:
        """Return the name of an added load behind a spring that exceeds the inertia of its joint."""
        machine = self.superset.machine
        plant = machine.with_estimate(new).plant
        for i in index:
            f = machine.parameters.free[i]
            if f.effect is None or f.path[-1] != "load_inertia" or not plant.effects[f.effect].adds_spring:
                continue
            if new[i] > _HEAVIER * inertia_behind(plant, int(plant.effects[f.effect].port)):
                return f.name
        return ""

    def _within_a_row(self, index: np.ndarray, new: np.ndarray) -> bool:
        """Check for an added delay by which two courses of the force between its rows differ.

        A held force and one on lines between the rows are half a row apart.
        """
        if not isinstance(self.domain, ForceDomain):
            return False
        machine = self.superset.machine
        effects = machine.with_estimate(new).plant.effects
        added = {f.effect for f in (machine.parameters.free[i] for i in index) if f.effect is not None}
        delays = [float(effects[k].command_delay()) for k in added]
        return any(0.0 < delay < 0.5 * self.data.period for delay in delays)

    def _beyond_band(self, index: np.ndarray, new: np.ndarray) -> bool:
        """Check for an added ripple over the position that the filter removes nearly everywhere."""
        free = self.superset.machine.parameters.free
        added = {free[i].path[-1]: i for i in index if free[i].effect is not None}
        if not {"amplitude", "period", "phase"} <= {*added}:
            return False
        # A period of no end makes a constant force of the ripple, which passes the filter.
        without, constant = new.copy(), new.copy()
        without[added["amplitude"]] = 0.0
        constant[added["period"]], constant[added["phase"]] = _ENDLESS, 0.0
        nothing = self.residual(without)
        passed, whole = (self._sum(nothing - self.residual(x)) for x in (new, constant))
        return bool(2 * passed < _IN_BAND * whole)

    def _least(self, fitted: int) -> float:
        """Return the part of the noise's sum of squares that a fit of so many unknowns must leave.

        Source:
            Satterthwaite (1946) for sums of squares with unequal weights, here by joint.
        """
        count = self._independent * self.samples.moving.sum(axis=0)
        weight = self._sure_noise / np.maximum(self.samples.moving.sum(axis=0), 1)
        fourth = float(np.sum(count * weight**2))
        if fourth == 0:
            return _LEAST
        freedom = float(np.sum(count * weight)) ** 2 / fourth
        rarely = scipy.stats.chi2.ppf(_RARELY, max(freedom - fitted, 1)) / freedom
        return min(_LEAST, float(rarely))

    def _sum(self, e: np.ndarray) -> float:
        return float(self._sums(e).sum())

    def _sums(self, e: np.ndarray) -> Float[np.ndarray, " n"]:
        return np.sum(np.where(self.samples.moving, e, 0.0) ** 2, axis=0)


def absorbed_noise(
    domain: Domain,
    samples: Samples,
    colour: tuple[NoiseModel, ...],
    old: np.ndarray,
    new: np.ndarray,
    *,
    stated: bool = True,
) -> float:
    """Return the part of the noise that the new model's drive filters out and the old one's does not.

    Noise of the logged force exists in the log only. A drive that filters the force filters that noise
    too, and would gain by it without explaining anything. If the noise of the force is not stated, all that
    the old model leaves may be such noise.

    Args:
        domain: Domain in which residuals are compared.
        samples: Samples of the log.
        colour: Noise expected from the sensors, by joint.
        old, new: All unknowns of the two models.
        stated: Whether the case states the noise of the force.

    Returns:
        Difference of the mean squares of whitened noise, at most 0.9; as a part of the first one if the noise
        is not stated.
    """
    if not samples.noisier:
        return 0.0
    whitener = ev.Whitener(colour, samples.moving)
    squares = []
    for theta in (old, new):
        e, _ = domain.evaluate(samples, theta, ())
        noisier = domain.noisier(samples, theta)
        squares.append(float(np.mean(whitener((noisier - e)[..., None]) ** 2)))
    absorbed = squares[0] - squares[1]
    return min(absorbed if stated else absorbed / max(squares[0], 1e-300), 0.9)
