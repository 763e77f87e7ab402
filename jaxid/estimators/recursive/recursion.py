r"""Recursive least squares with forgetting and a regularisation that stays, one sample at a time.

After n samples the estimate minimises

    sum_k beta^(n-k) |Y_k theta - r_k|^2 + (theta - theta_0)' L_n (theta - theta_0),

with L_n the diagonal `information` of the start, up to the (1 - beta^p) of one round over the p unknowns. The
paper's regularisation is beta^n lambda |theta|^2. As printed it pulls towards zero, although gains start at
one, and it fades: an unknown that is not excited for long runs away, because its covariance grows as beta^-n.
Here the start of one unknown per sample is added again as a row, in turn, with the weight that was forgotten
since its last turn. The covariance exceeds that of the start by no more than the forgetting of one round.

A row changes the covariance P by Woodbury's identity, which needs no inverse for a single row. It is applied
to a square root S of P = S S' (Potter), so that P stays symmetric and positive definite; an update of P
itself loses that after a start that is far less certain than the data. Several rows per sample are taken one
after the other, which is equivalent.

This module is independent of plants: rows come from `jaxid.estimators.recursive.estimate`.

Source:
    Righettini et al. (2025), Robotics 14, 36, (14) and (49); Potter (1963) in Bierman (1977), Factorization
    Methods, II.6; Gunnarsson (1996), IEEE Trans. Signal Process. 44, for a regularisation that stays; Young
    (2011), Recursive Estimation, 7, for instruments from an auxiliary model.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import eliminated

# An unknown is identifiable if its variance is below this fraction of the variance of its start: the error of
# the start then contributes less than a hundredth of itself.
IDENTIFIED = 0.01
# A column below this fraction of the force is zero.
_NOTHING = 1e-9
# A gain below this fraction of its start is not used to model the drive's force.
_LEAST_GAIN = 0.1


class RecursiveMemory(eqx.Module):
    """State of the estimator between samples, which is all that a warm restart needs.

    Args:
        theta: Estimate by least squares, (p,).
        root: S, with S S' the covariance for rows of unit noise, (p, p).
        spread: Sum of beta^2(n-k) z z', by which noise of the rows spreads, (p, p).
        cost: Weighted sum of squares of the residual at the estimate.
        weight: Sum of the weights of all rows.
        squares: Sum of squares of each row's residual after its update, without forgetting.
        rows: Number of rows that counted.
        samples: Number of samples that counted.
        normal, moment: Sums of z y' and z r, start included, (p, p) and (p,); used with instruments only.
    """

    theta: Float[Array, " p"]
    root: Float[Array, "p p"]
    spread: Float[Array, "p p"]
    cost: Float[Array, ""]
    weight: Float[Array, ""]
    squares: Float[Array, ""]
    rows: Float[Array, ""]
    samples: Int[Array, ""]
    normal: Float[Array, "p p"]
    moment: Float[Array, " p"]


class RecursiveEstimate(eqx.Module):
    """Estimate and precision from a memory.

    Args:
        theta: Estimate, by instruments if there are any, (p,).
        covariance: Covariance for white noise plus the square of `pull`, (p, p); meaningless for unknowns
            that are not `identifiable`.
        pull: Bias of the estimate towards the start, to first order, (p,).
        identifiable: Mask of the unknowns that are determined by the rows and not by the start, (p,).
        noise: Standard deviation of a row's noise [N or N m].
        residual: Root mean square of each row's residual after its update, (49) [N or N m].
        effective: Sum of the weights of all rows, the effective number of rows.
    """

    theta: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    pull: Float[Array, " p"]
    identifiable: Bool[Array, " p"]
    noise: Float[Array, ""]
    residual: Float[Array, ""]
    effective: Float[Array, ""]

    @property
    def std(self) -> Float[Array, " p"]:
        """Standard deviations, NaN for unknowns that are not identifiable, (p,)."""
        return jnp.sqrt(
            jnp.where(self.identifiable, jnp.diagonal(self.covariance, axis1=-2, axis2=-1), jnp.nan)
        )


class Recursion(eqx.Module):
    """Recursive least squares with forgetting; `update` may stand in a scan.

    Args:
        start: Start of the estimate, theta_0, (p,).
        information: Variance of a row's noise over the variance of the start, (p,).
        forgetting: Factor beta of a sample's weight when the next sample comes; 1: nothing is forgotten.
        summed: Whether the rows of a sample are summed to one row first.
        gains: For instruments, index of the unknown that is the gain of the drive in each row, or None.
        instrument: Whether the drive's force is noisy, so that its columns need an instrument: the force
            that the model predicts along the measured motion, by the estimate so far.
    """

    start: Float[Array, " p"]
    information: Float[Array, " p"]
    forgetting: Float[Array, ""]
    summed: bool = eqx.field(static=True, default=False)
    gains: tuple[int | None, ...] = eqx.field(static=True, default=())
    instrument: bool = eqx.field(static=True, default=False)

    def memory(self) -> RecursiveMemory:
        """Return the memory before the first sample."""
        p = self.start.size
        zero, square = jnp.zeros(()), jnp.zeros((p, p))
        information = jnp.asarray(self.information)
        return RecursiveMemory(
            theta=jnp.asarray(self.start),
            root=jnp.diag(1 / jnp.sqrt(information)),
            spread=square,
            cost=zero,
            weight=zero,
            squares=zero,
            rows=zero,
            samples=jnp.zeros((), int),
            normal=jnp.diag(information),
            moment=information * self.start,
        )

    def update(
        self,
        memory: RecursiveMemory,
        rows: Float[Array, "m p"],
        target: Float[Array, " m"],
        counts: Bool[Array, " m"],
    ) -> tuple[RecursiveMemory, Float[Array, "k p"]]:
        """Add one sample.

        Args:
            memory: The memory so far.
            rows: Rows Y of this sample, (m, p).
            target: Right-hand side r of this sample, (m,) [N or N m].
            counts: Mask of the rows that count, (m,); if none does, the memory stays the same bit for bit.

        Returns:
            The new memory, and the instruments of the rows, (k, p), or the rows themselves if there are none;
            k = 1 if the rows are summed, else m.
        """
        z = self._instruments(memory.theta, rows, target)
        rows, target, z = (jnp.where(_expanded(counts, x), x, 0.0) for x in (rows, target, z))
        moved = jnp.any(counts)
        number = jnp.sum(counts).astype(float)
        if self.summed:
            rows, target, z = (jnp.sum(x, axis=0)[None] for x in (rows, target, z))
            number = moved.astype(float)

        # Forget, then update by one row after the other, and add the start of one unknown again.
        beta = jnp.where(moved, self.forgetting, 1.0)
        theta, root, cost = memory.theta, memory.root / jnp.sqrt(beta), beta * memory.cost
        for y, r in zip(rows, target, strict=True):
            theta, root, added = _updated(theta, root, y, r)
            cost = cost + added
        theta, root = self._with_start_of_one(theta, root, beta, memory.samples)

        square = jnp.sum((rows @ theta - target) ** 2)
        kept = jnp.diag((1 - beta) * self.information)
        return RecursiveMemory(
            theta=theta,
            root=root,
            spread=beta**2 * memory.spread + z.T @ z,
            cost=cost,
            weight=beta * memory.weight + number,
            squares=memory.squares + square,
            rows=memory.rows + number,
            samples=memory.samples + moved,
            normal=beta * memory.normal + kept + z.T @ rows,
            moment=beta * memory.moment + (1 - beta) * self.information * self.start + z.T @ target,
        ), z

    def estimate(self, memory: RecursiveMemory) -> RecursiveEstimate:
        """Return estimate and precision from a memory."""
        inverse = memory.root @ memory.root.T
        noise = memory.weight - jnp.sum(inverse * memory.spread)
        variance = jnp.where(noise > 0, memory.cost / jnp.where(noise > 0, noise, 1.0), jnp.nan)
        identifiable = jnp.diagonal(inverse) * self.information < IDENTIFIED

        # With instruments the estimate solves their normal equations, scaled to a diagonal of one.
        theta = memory.theta
        if self.instrument:
            scale = jnp.sqrt(jnp.abs(jnp.diagonal(memory.normal)))
            both = jnp.concatenate([memory.moment[:, None], jnp.eye(scale.size)], axis=1) / scale[:, None]
            both = eliminated(memory.normal / jnp.outer(scale, scale), both) / scale[:, None]
            theta, inverse = both[:, 0], both[:, 1:]

        pull = inverse @ (self.information * (theta - self.start))
        covariance = variance * inverse @ memory.spread @ inverse.T + jnp.outer(pull, jnp.asarray(pull))
        residual = jnp.sqrt(memory.squares / jnp.maximum(memory.rows, 1.0))
        return RecursiveEstimate(
            theta=theta,
            covariance=covariance,
            pull=pull,
            identifiable=identifiable,
            noise=jnp.sqrt(variance),
            residual=residual,
            effective=memory.weight,
        )

    def _with_start_of_one(
        self, theta: Array, root: Array, beta: Array, samples: Array
    ) -> tuple[Array, Array]:
        """Update by the start of one unknown as a row, with the weight forgotten since its last turn."""
        p = theta.size
        turn = samples % p
        size = jnp.sqrt((1 - beta**p) * self.information[turn])
        unit = size * (jnp.arange(p) == turn)
        theta, root, _ = _updated(theta, root, unit, size * self.start[turn])
        return theta, root

    def _instruments(self, theta: Array, rows: Array, target: Array) -> Array:
        """Return the rows with the force that the model predicts at theta in the columns of the gains.

        Let c be the column of a gain g, minus the measured force. The model's force is the one at which the
        row's residual e vanishes: its column is c - e / g. The noise of the measured force is the same in c
        and in e / g, and the difference has none.
        """
        if not self.instrument:
            return rows
        out = jnp.asarray(rows)
        for k, g in enumerate(self.gains):
            if g is not None:
                sound = jnp.abs(theta[g]) > _LEAST_GAIN * jnp.abs(self.start[g])
                gain = jnp.where(sound, theta[g], self.start[g])
                out = out.at[k, g].add(-(rows[k] @ theta - target[k]) / gain)
        return out


def _updated(theta: Array, root: Array, y: Array, r: Array) -> tuple[Array, Array, Array]:
    """Return estimate and root after one more row, and the cost that the row adds."""
    f = y @ root
    grown = 1.0 + f @ f
    e = r - y @ theta
    gain = root @ f / grown
    root = root - gain[:, None] * (f / (1.0 + jax.lax.rsqrt(grown)))
    return theta + gain * e, root, e * e / grown


def _expanded(counts: Array, x: Array) -> Array:
    """Return a mask with as many axes as x."""
    return counts.reshape(-1, *[1] * (x.ndim - 1))


@eqx.filter_jit
def run(
    recursion: Recursion,
    memory: RecursiveMemory,
    rows: Float[Array, "time m p"],
    target: Float[Array, "time m"],
    counts: Bool[Array, "time m"],
    every: int = 1,
) -> tuple[RecursiveMemory, RecursiveEstimate, Array | None]:
    """Run the estimator over all samples of a log.

    Args:
        recursion: The estimator.
        memory: The memory to continue from.
        rows, target, counts: Arguments of `Recursion.update` by sample.
        every: Number of samples between the estimates of the history; the end is included.

    Returns:
        The memory at the end; the history of estimates, (times, ...), see `instants`; and the instruments of
        all rows, (time, k, p), None if there are none.
    """
    time = len(rows)
    blocks = -(-time // every)
    # The last block is filled up with samples that do not count, which change nothing.
    more = [(0, blocks * every - time)]
    padded = [jnp.pad(x, more + [(0, 0)] * (x.ndim - 1)) for x in (rows, target, counts)]
    padded = [x.reshape(blocks, every, *x.shape[1:]) for x in padded]

    def sample(memory: RecursiveMemory, now: list) -> tuple[RecursiveMemory, Array | None]:
        memory, z = recursion.update(memory, *now)
        return memory, z if recursion.instrument else None

    def block(memory: RecursiveMemory, now: list) -> tuple[RecursiveMemory, tuple]:
        memory, z = jax.lax.scan(sample, memory, now)
        return memory, (recursion.estimate(memory), z)

    memory, (history, z) = jax.lax.scan(block, memory, padded)
    return memory, history, None if z is None else z.reshape(-1, *z.shape[2:])[:time]


def column_squares(
    rows: Float[Array, "time m p"],
    counts: Bool[Array, "time m"],
    force: Float[Array, "time m"],
    natural: Float[Array, " p"],
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Return the mean square of each column, and of the force, over the samples that count.

    Args:
        rows, counts: Arguments of `Recursion.update` by sample.
        force: Force of the drives in each row, (time, m) [N or N m].
        natural: Natural sizes of the unknowns, (p,). The floor of a column, times its unknown's size, is a
            billionth of the force.
    """
    moved = jnp.maximum(jnp.any(counts, axis=1).sum(), 1)
    square = jnp.sum(jnp.where(counts[..., None], rows, 0.0) ** 2, axis=(0, 1)) / moved
    force = jnp.sum(jnp.where(counts, force, 0.0) ** 2) / moved
    return jnp.maximum(square, _NOTHING**2 * jnp.maximum(force, 1e-300) / natural**2), force


def instants(samples: int, every: int) -> np.ndarray:
    """Return the index of the last sample before each estimate in the history of `run`."""
    ends = np.arange(every, samples + every, every)
    return np.minimum(ends, samples) - 1
