"""Precision of a recursive estimate, and its history as part of the results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxid.estimators.recursive.recursion import Recursion, RecursiveEstimate, RecursiveMemory
from jaxid.estimators.recursive.rows import Rows
from jaxid.machine import Machine
from jaxid.numerics.coloured_noise import NoiseModel, sandwich
from jaxid.numerics.precision import Precision, assess_from_sums
from jaxid.numerics.rows import Rows as Residual
from jaxid.settings import Recursive


def weights(rows: Rows, forgetting: float) -> Float[np.ndarray, " kept"]:
    """Return the weight of each sample at the end."""
    moved = rows.moved
    return forgetting ** (np.cumsum(moved[::-1])[::-1] - moved)


def weights_together(logs: Sequence[Rows], forgetting: Sequence[float]) -> Float[np.ndarray, " kept"]:
    """Return the weight of each sample of logs that were run one after the other, at the end of the last."""
    out, later = [], 1.0
    for rows, factor in zip(reversed(logs), reversed(forgetting), strict=True):
        out.append(later * weights(rows, factor))
        later *= factor ** rows.moved.sum()
    return np.concatenate(out[::-1])


def precision_of(
    machine: Machine,
    rows: Rows,
    z: Float[np.ndarray, "kept m p"],
    recursion: Recursion,
    history: RecursiveEstimate,
    every: int,
    whole: bool,
    weight: Float[np.ndarray, " kept"] | None = None,
    block: Int[np.ndarray, " kept"] | None = None,
    logs: Sequence[int] = (),
) -> tuple[Precision, Float[np.ndarray, " p"]]:
    """Compute the precision at the end, and the factors by which coloured noise widens white deviations.

    Args:
        machine: The machine whose unknowns were estimated.
        rows: The rows that were used.
        z: Their instruments, or the rows themselves if there are none.
        recursion: The estimator.
        history: Its estimates, by instant.
        every: Number of samples between them.
        whole: Whether the estimate is from these rows alone; else the earlier rows in the memory are taken to
            have the noise of this log.
        weight: Weight of each sample at the end; None: that of one log.
        block: Number of the estimate after each sample in the history; None: that of one log.
        logs: Samples of each log, if several stand one behind the other.

    Returns:
        The precision: that of weighted least squares, with the colour of the residual and the square of the
        remaining pull of the start; and the factors, (p,).
    """
    names = machine.parameters.names
    weight = weights(rows, float(recursion.forgetting)) if weight is None else weight
    block = np.arange(len(rows.rows)) // every if block is None else block
    w, counts = weight[:, None], rows.counts
    root = np.where(counts, np.sqrt(w), 0.0)
    e = _residual(rows, root, recursion, history, block)

    # Least squares on the weighted rows, or on their projection on the instruments.
    weighted = root[..., None] * (rows.rows if not recursion.instrument else _projected(rows.rows, z, root))
    flat = weighted.reshape(-1, len(names))
    jacobian = root[..., None] * weighted
    signal = float(np.linalg.norm(root**2 * rows.force))
    natural = np.where(machine.parameters.guess == 0, 1.0, machine.parameters.guess)
    # Each log has a colour of its own.
    edges, gram, meat = np.cumsum(logs)[:-1], np.zeros((len(names),) * 2), np.zeros((len(names),) * 2)
    for j, x, c in zip(*(np.split(y, edges) for y in (jacobian, e, counts)), strict=True):
        own, coloured = Residual(j, x, c, signal).matrices(np.ones(len(names)))
        gram, meat = gram + own, meat + coloured
    precision = assess_from_sums(names, gram, meat, signal, natural, solved=flat.T @ flat)

    inflation = _inflation(jacobian, e, counts)
    covariance = history.covariance[-1] * np.outer(inflation, inflation)
    if whole:
        covariance = precision.covariance + np.outer(history.pull[-1], history.pull[-1])
        ratio = np.sqrt(np.diag(covariance) / np.diag(history.covariance[-1]))
        # The factors from all columns together are more precise than those of single columns.
        inflation = np.where(np.isfinite(ratio), ratio, inflation)

    identifiable = np.asarray(history.identifiable)[-1]
    identifiable = identifiable & (precision.identifiable if whole else np.isfinite(inflation))
    covariance[~identifiable], covariance[:, ~identifiable] = np.nan, np.nan
    named = precision.unidentifiable if whole else []
    single = [{n: 1.0} for k, n in enumerate(names) if not identifiable[k] and not any(n in c for c in named)]
    return replace(
        precision, covariance=covariance, identifiable=identifiable, unidentifiable=[*named, *single]
    ), inflation


def _residual(
    rows: Rows, root: np.ndarray, recursion: Recursion, history: RecursiveEstimate, block: np.ndarray
) -> Float[np.ndarray, "kept m"]:
    """Return a residual with the colour and size of the noise that acts on the estimate.

    Its size is that of the weighted samples. Its colour is that of the whole log, with the estimate at the
    time of each sample: few samples of large weight do not determine a colour, and a drift of the unknowns is
    not noise.
    """
    last = np.where(rows.counts, rows.rows @ history.theta[-1] - rows.target, 0.0)
    if recursion.forgetting == 1.0:
        return last
    known = np.asarray(history.identifiable.all(axis=1))
    then = np.where(known[block, None], history.theta[block], history.theta[-1])
    e = np.where(rows.counts, np.einsum("tmp,tp->tm", rows.rows, then) - rows.target, 0.0)

    def mean_square(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        return np.sum(weight * x**2, axis=0) / np.maximum(np.sum(weight, axis=0), 1e-300)

    return e * np.sqrt(mean_square(last, root**2) / np.maximum(mean_square(e, rows.counts), 1e-300))


def _projected(rows: np.ndarray, z: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return the rows projected on their instruments, for which the formulas of least squares hold."""
    weighted = [(root[..., None] * x).reshape(-1, x.shape[-1]) for x in (rows, z)]
    scale = np.linalg.norm(weighted[1], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    inside = np.linalg.lstsq(weighted[1] / scale, weighted[0], rcond=None)[0] / scale[:, None]
    return z @ inside


def _inflation(jacobian: np.ndarray, e: np.ndarray, counts: np.ndarray) -> Float[np.ndarray, " p"]:
    """Return the ratio of coloured to white standard deviations, for each column separately."""
    coloured = white = np.zeros(jacobian.shape[-1])
    for i in range(e.shape[1]):
        columns = jacobian[:, i]
        model = NoiseModel.fit(e[:, i], counts[:, i])
        coloured = coloured + np.diag(sandwich(columns, model))
        white = white + np.sum(columns**2, axis=0) * np.sum(e[:, i] ** 2) / max(counts[:, i].sum(), 1)
    nonzero = white > 0
    return np.sqrt(np.where(nonzero, coloured / np.where(nonzero, white, 1.0), 1.0))


def details_of(
    machine: Machine,
    recursion: Recursion,
    memory: RecursiveMemory,
    history: RecursiveEstimate,
    times: np.ndarray,
    inflation: np.ndarray,
    settings: Recursive,
) -> dict[str, Any]:
    """Return the `recursive` object of result.json: settings, history, and the memory for a warm restart.

    Args:
        machine: The machine whose unknowns were estimated.
        recursion: The estimator.
        memory: Its memory at the end.
        history: Its estimates, by instant.
        times: Time of each estimate [s].
        inflation: Factors by which coloured noise widens standard deviations, (p,).
        stated: Keys of the case's [recursive].
    """
    names = machine.parameters.names
    variance = np.where(history.identifiable, np.diagonal(history.covariance, axis1=1, axis2=2), np.nan)
    std = np.sqrt(variance) * inflation
    return {
        "half_life": settings.half_life,
        "rows": "summed" if recursion.summed else "full",
        "instrument": "model" if recursion.instrument else "none",
        "forgetting": float(recursion.forgetting),
        "effective_samples": float(history.effective[-1]),
        "noise": float(history.noise[-1]),
        "running_residual": float(history.residual[-1]),
        "samples": int(memory.samples),
        "history": {
            "time": times,
            "value": {n: history.theta[:, k] for k, n in enumerate(names)},
            "std": {n: std[:, k] for k, n in enumerate(names)},
            "residual": history.residual,
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
