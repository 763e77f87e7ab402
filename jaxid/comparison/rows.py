"""Logs of a comparison: residuals and columns of each, and their whitened rows, block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxid.comparison.model import Model
from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.noise import NUMERICS, sensor_colour
from jaxid.gap import noise_floor
from jaxid.machine import Machine
from jaxid.numerics.precision import NoiseModel
from jaxid.session import OpenedLog

# Stretches of each log between which estimates are compared.
STRETCHES = 20


@dataclass(frozen=True)
class ComparedLog:
    """One log of a comparison.

    Args:
        name: Its name.
        runs: The log, or its pieces.
        samples: The samples that the comparison uses.
        colour: Noise that the sensors cause in its balance, by joint.
        floor: RMS of that noise, by joint.
        smallest: Residual below which nothing counts, by joint: noise and errors of numerics.
        numerics: Sum of squares that errors of filtering and integration may cause, in units of `smallest`.
    """

    name: str
    runs: tuple[OpenedLog, ...]
    samples: cand.CandidateSamples
    colour: tuple[NoiseModel, ...]
    floor: Float[np.ndarray, " n"]
    smallest: Float[np.ndarray, " n"]
    numerics: float

    @classmethod
    def of(cls, runs: Sequence[OpenedLog], machine: Machine, superset: cand.CandidateModel) -> ComparedLog:
        """Open a log, of which there may be several pieces, for a comparison.

        Args:
            runs: The log, or its pieces.
            machine: The machine of the case.
            superset: The machine with all candidates.
        """
        first = runs[0]
        own = first.machine(machine)
        ones = np.ones(first.log.position.shape[1])
        views = []
        for run in runs:
            assert run.own is not None, "each of several logs has values of its own, or none"
            views.append(cand.View.of(superset.machine, run.own, ones))
        noise = own.sensor.force_noise
        noise = None if noise is None else np.asarray(noise) * own.gain
        more = [(run.data, view) for run, view in zip(runs[1:], views[1:], strict=True)]
        samples = cand.CandidateSamples(first.data, noise, views[0], more)
        floor = noise_floor(own, first.log, first.data)
        force = first.data.force - first.data.force.mean(axis=0)
        numerics = NUMERICS * float(np.sqrt(np.mean(force**2)))
        smallest = np.hypot(floor, numerics)
        name = first.own.log if first.own is not None else first.name
        colour = sensor_colour(own, first.log, first.data)
        errors = float(np.sum(samples.moving.sum(axis=0) * (numerics / smallest) ** 2))
        return cls(name, tuple(runs), samples, colour, floor, smallest, errors)

    @property
    def counts(self) -> Bool[np.ndarray, "kept n"]:
        """Mask of the samples that count."""
        return self.samples.moving

    @property
    def independent(self) -> float:
        """Part of its samples that is independent."""
        return self.runs[0].data.recipe.independent

    def evaluate(
        self, superset: cand.CandidateModel, theta: np.ndarray, wanted: Sequence[int] = ()
    ) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
        """Compute the residual of the superset at values that hold in this log, and its Jacobian.

        Args:
            superset: The machine with all candidates.
            theta: All unknowns of the superset, (p,).
            wanted: Indices of the unknowns that need derivatives.
        """
        return cand.evaluate(superset, self.samples, theta, list(wanted))

    def squares(self, e: Float[np.ndarray, "kept n"]) -> float:
        """Return the sum of squares of a residual in units of the noise."""
        total = float(np.sum((np.where(self.counts, e, 0.0) / self.smallest) ** 2))
        return total if np.isfinite(total) else np.inf

    def rms(self, e: Float[np.ndarray, "kept n"]) -> Float[np.ndarray, " n"]:
        """Return the RMS of a residual, by joint; NaN for a joint that never moves."""
        samples = self.counts.sum(axis=0)
        total = np.sum(np.where(self.counts, e, 0.0) ** 2, axis=0)
        return np.sqrt(total / np.where(samples > 0, samples, np.nan))


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

    def base(
        self, model: Model, jacobians: Sequence[Float[np.ndarray, "kept n p"]]
    ) -> list[Float[np.ndarray, "row u"]]:
        """Return the columns of the fitted numbers of a model, by log."""
        out = []
        for k, (whitener, jacobian) in enumerate(zip(self.whiteners, jacobians, strict=True)):
            own = [j for j, u in enumerate(model.unknowns) if k in u.logs]
            rows = np.zeros((len(self.blocks[k]), len(model.unknowns)))
            rows[:, own] = whitener(jacobian[..., [model.unknowns[j].index for j in own]])
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
