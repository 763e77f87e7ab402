"""Logs of a comparison: residuals and columns of each, and their whitened rows, block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxid.comparison.model import Unknown
from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.acceptance import absorbed_noise
from jaxid.discovery.domain import Domain, ForceDomain
from jaxid.discovery.noise import NUMERICS, sensor_colour
from jaxid.gap import noise_floor
from jaxid.machine import Machine
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.own_values import OwnValues
from jaxid.session import OpenedLog

# Stretches of each log between which estimates are compared.
STRETCHES = 20


@dataclass(frozen=True)
class ComparedLog:
    """One log of a comparison.

    Args:
        name: Its name.
        runs: The log, or its pieces.
        domain: What a model is compared with: forces, or the positions of a simulated loop.
        samples: The samples that the comparison uses, as the domain takes them.
        view: The unknowns as this log has them.
        colour: Noise that the sensors cause in its residual, by joint.
        floor: RMS of that noise, by joint.
        smallest: Residual below which nothing counts, by joint: noise and errors of numerics.
        numerics: Sum of squares that errors of filtering and integration may cause, in units of `smallest`.
        independent: Part of its samples that is independent.
        times: Time of the samples [s].
        position, velocity: Motion at the samples.
    """

    name: str
    runs: tuple[OpenedLog, ...]
    domain: Domain
    samples: Any
    view: cand.View
    colour: tuple[NoiseModel, ...]
    floor: Float[np.ndarray, " n"]
    smallest: Float[np.ndarray, " n"]
    numerics: float
    independent: float
    times: Float[np.ndarray, " kept"]
    position: Float[np.ndarray, "kept n"]
    velocity: Float[np.ndarray, "kept n"]

    @classmethod
    def of(cls, runs: Sequence[OpenedLog], machine: Machine, superset: cand.CandidateModel) -> ComparedLog:
        """Open a log, of which there may be several pieces, for a comparison of forces.

        Args:
            runs: The log, or its pieces.
            machine: The machine of the case.
            superset: The machine with all candidates.
        """
        first = runs[0]
        own = first.machine(machine)
        ones = np.ones(first.log.position.shape[1])
        views = [cand.View.of(superset.machine, own_values(run), ones) for run in runs]
        noise = own.sensor.force_noise
        noise = None if noise is None else np.asarray(noise) * own.gain
        more = [(run.data, view) for run, view in zip(runs[1:], views[1:], strict=True)]
        samples = cand.CandidateSamples(first.data, noise, views[0], more)

        floor = noise_floor(own, first.log, first.data)
        force = first.data.force - first.data.force.mean(axis=0)
        numerics = NUMERICS * float(np.sqrt(np.mean(force**2)))
        smallest = np.hypot(floor, numerics)
        parts = samples.parts
        return cls(
            name=own_values(first).log,
            runs=tuple(runs),
            domain=ForceDomain(superset),
            samples=samples,
            view=views[0],
            colour=sensor_colour(own, first.log, first.data),
            floor=floor,
            smallest=smallest,
            numerics=float(np.sum(samples.moving.sum(axis=0) * (numerics / smallest) ** 2)),
            independent=first.data.recipe.independent,
            times=np.concatenate([p.times for p in parts]),
            position=np.concatenate([p.at_kept(p.q) for p in parts]),
            velocity=np.concatenate([p.at_kept(p.qd) for p in parts]),
        )

    @property
    def counts(self) -> Bool[np.ndarray, "kept n"]:
        """Mask of the samples that count."""
        return self.samples.moving

    def evaluate(
        self, theta: np.ndarray, wanted: Sequence[int] = ()
    ) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
        """Compute the residual of the superset at values that hold in this log, and its Jacobian.

        Args:
            theta: All unknowns of the superset, (p,).
            wanted: Indices of the unknowns that need derivatives.
        """
        return self.domain.evaluate(self.samples, theta, list(wanted))

    def points(self, rest: list[cand.Candidate], theta: np.ndarray, e: np.ndarray) -> list[cand.Point]:
        """Linearise candidates at each of their starts, beside values that leave a residual."""
        return self.domain.points(rest, self.samples, theta, e)

    def renewed(self, theta: np.ndarray, effects: Sequence[cand.Candidate] = ()) -> ComparedLog:
        """Return the log with what its residual depends on at some values; nothing for forces.

        Args:
            theta: All unknowns of the superset.
            effects: Effects that act in this log.
        """
        return self

    def drawn_noise(
        self, theta: np.ndarray, effects: Sequence[cand.Candidate], runs: int
    ) -> Float[np.ndarray, "runs kept n"] | None:
        """Draw residuals by noise alone; None if only the residual itself shows the noise.

        Args:
            theta, effects: As in `renewed`.
            runs: Number of draws.
        """
        return None

    def absorbed(self, old: np.ndarray, new: np.ndarray) -> float:
        """Return the part of the noise that new values of the drive filter out."""
        return absorbed_noise(self.domain, self.samples, self.colour, old, new)

    def squares(self, e: Float[np.ndarray, "kept n"]) -> float:
        """Return the sum of squares of a residual in units of the noise."""
        total = float(np.sum((np.where(self.counts, e, 0.0) / self.smallest) ** 2))
        return total if np.isfinite(total) else np.inf

    def rms(self, e: Float[np.ndarray, "kept n"]) -> Float[np.ndarray, " n"]:
        """Return the RMS of a residual, by joint; NaN for a joint that never moves."""
        samples = self.counts.sum(axis=0)
        total = np.sum(np.where(self.counts, e, 0.0) ** 2, axis=0)
        return np.sqrt(total / np.where(samples > 0, samples, np.nan))

    def within(self, other: ComparedLog) -> Bool[np.ndarray, "kept n"]:
        """Return which samples lie within the range of position and velocity of another log."""
        inside = np.ones(self.counts.shape, bool)
        pairs = ((self.position, other.position), (self.velocity, other.velocity))
        for here, others in pairs:
            inside &= (here >= others.min(axis=0)) & (here <= others.max(axis=0))
        return inside


def own_values(run: OpenedLog) -> OwnValues:
    """Return the values of its own that a log has; each log of several has some, or none."""
    assert run.own is not None, "each of several logs has values of its own, or none"
    return run.own


class Whitened:
    """Rows of unit noise of several logs, block by block.

    Sums of products of columns are kept by log, so that a column that belongs to some of the logs costs no
    more than one that belongs to all.

    Args:
        whiteners: Map from a residual to rows of unit noise, by log.
    """

    def __init__(self, whiteners: Sequence[ev.Whitener]) -> None:
        self.whiteners = tuple(whiteners)
        self.blocks = [w.blocks() for w in whiteners]

    @property
    def rows(self) -> int:
        """Number of rows of all logs."""
        return sum(len(b) for b in self.blocks)

    def columns(
        self, unknowns: Sequence[Unknown], jacobians: Sequence[Float[np.ndarray, "kept n p"]]
    ) -> list[Float[np.ndarray, "row u"]]:
        """Return the columns of some numbers of a model, by log."""
        out = []
        for k, (whitener, jacobian) in enumerate(zip(self.whiteners, jacobians, strict=True)):
            own = [j for j, u in enumerate(unknowns) if k in u.logs]
            rows = np.zeros((len(self.blocks[k]), len(unknowns)))
            rows[:, own] = whitener(jacobian[..., [unknowns[j].index for j in own]])
            out.append(rows)
        return out

    def residual(self, e: Sequence[Float[np.ndarray, "kept n"]]) -> list[Float[np.ndarray, "row 1"]]:
        """Return whitened residuals, by log."""
        return [w(x[..., None]) for w, x in zip(self.whiteners, e, strict=True)]

    def held_out(
        self, columns: Sequence[Float[np.ndarray, "row u"]], e: Sequence[Float[np.ndarray, "row r"]]
    ) -> Float[np.ndarray, " r"]:
        """Return the held-out sums of squares of residuals after a fit of columns."""
        grams = [ev.grams(c, b) for c, b in zip(columns, self.blocks, strict=True)]
        pairs = [ev.products(c, x, b) for c, x, b in zip(columns, e, self.blocks, strict=True)]
        mixed, squares = (np.sum([p[i] for p in pairs], axis=0) for i in (0, 1))
        return ev.held_out(np.sum(grams, axis=0), mixed, squares)

    def left_out(
        self, columns: Sequence[Float[np.ndarray, "row u"]], e: Sequence[Float[np.ndarray, "row 1"]]
    ) -> tuple[Float[np.ndarray, " u"], Float[np.ndarray, "stretch u"], Float[np.ndarray, "u u"]]:
        """Solve for the columns' coefficients, with all rows and without each stretch of a log.

        Returns:
            Coefficients of a fit to all rows; to all rows but one stretch; and their covariance for noise of
            unit variance.
        """
        norm = np.sqrt(sum(np.sum(c**2, axis=0) for c in columns))
        norm = np.where(norm > 0, norm, 1.0)
        grams, mixed = [], []
        for c, x, whitener in zip(columns, e, self.whiteners, strict=True):
            stretch = whitener.stretches(STRETCHES)
            for k in range(STRETCHES):
                some = stretch == k
                part = c[some] / norm
                grams.append(part.T @ part)
                mixed.append(part.T @ x[some, 0])
        total, right = np.sum(grams, axis=0), np.sum(mixed, axis=0)
        ridge = 1e-12 * np.eye(len(total))
        whole = np.linalg.solve(total + ridge, right)
        apart = np.linalg.solve(total - np.array(grams) + ridge, (right - np.array(mixed))[..., None])[..., 0]
        covariance = np.linalg.inv(total + ridge) / np.outer(norm, norm)
        return -whole / norm, -apart / norm, covariance
