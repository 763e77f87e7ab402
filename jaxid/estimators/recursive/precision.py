"""What a recursive estimate is worth, and its history as results hold it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.estimators.recursive.recursion import Recursion, RecursiveEstimate, RecursiveMemory
from jaxid.estimators.recursive.rows import Rows
from jaxid.machine import Machine
from jaxid.numerics.precision import NoiseModel, Precision, assess, sandwich
from jaxid.settings import Recursive


def weights(rows: Rows, forgetting: float) -> Float[np.ndarray, " kept"]:
    """Weight that each sample has at the end."""
    moved = rows.moved
    return forgetting ** (np.cumsum(moved[::-1])[::-1] - moved)


def precision_of(
    machine: Machine,
    rows: Rows,
    z: Float[np.ndarray, "kept m p"],
    recursion: Recursion,
    told: RecursiveEstimate,
    every: int,
    whole: bool,
) -> tuple[Precision, Float[np.ndarray, " p"]]:
    """Precision at the end, and by how much the residual's colour widens what white noise would leave.

    Args:
        machine: The machine.
        rows: As they were used.
        z: Their instruments; the rows themselves without.
        recursion: The estimator.
        told: What it told, by instant.
        every: After so many samples.
        whole: Whether these rows are all that the estimate has seen; else what the memory held counts as
            of this log's noise.

    Returns:
        The precision: of the weighted rows, by the formula of least squares, with the colour of the residual
        and the square of how far the start still pulls; and the factors.
    """
    names = machine.parameters.names
    w, counts = weights(rows, float(recursion.forgetting))[:, None], rows.counts
    root = np.where(counts, np.sqrt(w), 0.0)
    e = _residual(rows, root, recursion, told, every)
    seen = root[..., None] * (rows.rows if not recursion.instrument else _seen(rows.rows, z, root))
    flat = seen.reshape(-1, len(names))
    jacobian = root[..., None] * seen
    signal = float(np.linalg.norm(root**2 * rows.force))
    natural = np.where(machine.parameters.guess == 0, 1.0, machine.parameters.guess)
    found = assess(names, jacobian, e, counts, signal, natural, flat.T @ flat)
    inflation = _inflation(jacobian, e, counts)
    covariance = told.covariance[-1] * np.outer(inflation, inflation)
    if whole:
        covariance = found.covariance + np.outer(told.pull[-1], told.pull[-1])
        ratio = np.sqrt(np.diag(covariance) / np.diag(told.covariance[-1]))
        # All columns together say more than each alone.
        inflation = np.where(np.isfinite(ratio), ratio, inflation)
    sure = told.identifiable[-1] & (found.identifiable if whole else np.isfinite(inflation))
    covariance[~sure], covariance[:, ~sure] = np.nan, np.nan
    named = found.unidentifiable if whole else []
    lost = [{n: 1.0} for k, n in enumerate(names) if not sure[k] and not any(n in c for c in named)]
    return replace(found, covariance=covariance, identifiable=sure, unidentifiable=[*named, *lost]), inflation


def _residual(
    rows: Rows, root: np.ndarray, recursion: Recursion, told: RecursiveEstimate, every: int
) -> Float[np.ndarray, "kept m"]:
    """Residual whose colour and size are those of the noise that the estimate has.

    Its size is that of the weighted samples. Its colour is that of the whole log, at what was told at the
    time: few samples of large weight tell no colour, and a drift is none.
    """
    last = np.where(rows.counts, rows.rows @ told.theta[-1] - rows.target, 0.0)
    if recursion.forgetting == 1.0:
        return last
    block = np.arange(len(last)) // every
    then = np.where(told.identifiable.all(axis=1)[block, None], told.theta[block], told.theta[-1])
    e = np.where(rows.counts, np.einsum("tmp,tp->tm", rows.rows, then) - rows.target, 0.0)
    mean = lambda x, weight: np.sum(weight * x**2, axis=0) / np.maximum(np.sum(weight, axis=0), 1e-300)
    return e * np.sqrt(mean(last, root**2) / np.maximum(mean(e, rows.counts), 1e-300))


def _seen(rows: np.ndarray, z: np.ndarray, root: np.ndarray) -> np.ndarray:
    """The rows as their instruments span them: with these the formulas of least squares hold."""
    weighted = [(root[..., None] * x).reshape(-1, x.shape[-1]) for x in (rows, z)]
    scale = np.linalg.norm(weighted[1], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    inside = np.linalg.lstsq(weighted[1] / scale, weighted[0], rcond=None)[0] / scale[:, None]
    return z @ inside


def _inflation(jacobian: np.ndarray, e: np.ndarray, counts: np.ndarray) -> Float[np.ndarray, " p"]:
    """Standard deviation under the residual's colour over that under white noise, by column alone."""
    coloured = white = np.zeros(jacobian.shape[-1])
    for i in range(e.shape[1]):
        own = jacobian[:, i]
        model = NoiseModel.fit(e[:, i], counts[:, i])
        coloured = coloured + np.diag(sandwich(own, model))
        white = white + np.sum(own**2, axis=0) * np.sum(e[:, i] ** 2) / max(counts[:, i].sum(), 1)
    there = white > 0
    return np.sqrt(np.where(there, coloured / np.where(there, white, 1.0), 1.0))


def details_of(
    machine: Machine,
    recursion: Recursion,
    memory: RecursiveMemory,
    told: RecursiveEstimate,
    times: np.ndarray,
    inflation: np.ndarray,
    settings: Recursive,
) -> dict[str, Any]:
    """The `recursive` object of result.json: settings, history, and the memory for a warm restart."""
    names = machine.parameters.names
    variance = np.where(told.identifiable, np.diagonal(told.covariance, axis1=1, axis2=2), np.nan)
    std = np.sqrt(variance) * inflation
    return {
        "half_life": settings.half_life,
        "rows": "summed" if recursion.summed else "full",
        "instrument": "model" if recursion.instrument else "none",
        "forgetting": float(recursion.forgetting),
        "effective_samples": float(told.effective[-1]),
        "noise": float(told.noise[-1]),
        "running_residual": float(told.residual[-1]),
        "samples": int(memory.samples),
        "history": {
            "time": times,
            "value": {n: told.theta[:, k] for k, n in enumerate(names)},
            "std": {n: std[:, k] for k, n in enumerate(names)},
            "residual": told.residual,
        },
        "restart": {
            "names": names,
            "start": np.asarray(recursion.start),
            "information": np.asarray(recursion.information),
            "summed": recursion.summed,
            "instrument": recursion.instrument,
            "memory": {k: np.asarray(v) for k, v in vars(memory).items()},
        },
    }
