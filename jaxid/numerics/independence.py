"""Draws from a density that is about normal, by a Markov chain whose proposals do not depend on its state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Degrees of freedom of the proposals: their tails are heavier than those of a posterior, as they must be.
_FREEDOM = 5
# Steps at the start of each chain that are left out.
_WARM = 25


@dataclass(frozen=True)
class Chains:
    """Draws of several chains.

    Args:
        points: Draws, (chain, draw, p).
        log_density: Logarithm of the density there, up to a constant, (chain, draw).
        accepted: Share of the proposals that were accepted.
    """

    points: Float[np.ndarray, "chain draw p"]
    log_density: Float[np.ndarray, "chain draw"]
    accepted: float


def independence_chains(
    log_density: Callable[[Float[np.ndarray, "n p"]], Float[np.ndarray, " n"]],
    centre: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    *,
    draws: int,
    chains: int,
    rng: np.random.Generator,
) -> Chains:
    """Draw from a density by the independence sampler of Metropolis and Hastings.

    All proposals are known before, so that the density is computed of all of them in one call.

    Args:
        log_density: Logarithm of the density up to a constant; -inf or NaN where it is zero.
        centre: Centre of the proposals.
        covariance: Covariance of a normal distribution that is close to the density.
        draws: Number of draws of each chain.
        chains: Number of chains.
        rng: Source of random numbers.

    Source:
        Tierney (1994), Ann. Statist. 22, 1701-1728, section 2.3.3.
    """
    p, steps = centre.size, draws + _WARM
    size = chains * steps
    white = rng.standard_normal((size, p)) / np.sqrt(rng.chisquare(_FREEDOM, size) / _FREEDOM)[:, None]
    points = centre + white @ np.linalg.cholesky(covariance).T
    density = np.asarray(log_density(points), dtype=float)
    density = np.where(np.isnan(density), -np.inf, density)
    proposal = -0.5 * (_FREEDOM + p) * np.log1p(np.sum(white**2, axis=1) / _FREEDOM)
    ratio = (density - proposal).reshape(chains, steps)
    threshold = np.log(rng.uniform(size=(chains, steps)))

    taken, accepted = np.zeros((chains, steps), int), 0
    for chain in range(chains):
        at = 0
        for step in range(1, steps):
            # A chain that starts where the density is zero leaves at the first point where it is not.
            if ratio[chain, at] == -np.inf or threshold[chain, step] < ratio[chain, step] - ratio[chain, at]:
                at = step
                accepted += 1
            taken[chain, step] = at

    kept = (taken + steps * np.arange(chains)[:, None])[:, _WARM:]
    return Chains(points[kept], density[kept], accepted / (chains * (steps - 1)))
