r"""Recursive least squares with forgetting and a regularisation that stays, one sample at a time.

After n samples the estimate minimises

    sum_k beta^(n-k) |Y_k theta - r_k|^2 + (theta - theta_0)' L_n (theta - theta_0),

with L_n the diagonal `information` of the start, within the (1 - beta^p) that one round over the p unknowns
takes. The paper's regularisation is beta^n lambda |theta|^2: it is printed towards zero, where gains start at
one, and it fades, so that what is not excited for long runs away (its covariance grows as beta^-n). Here one
unknown a sample is reminded of its start, in turn, with as much weight as all have forgotten meanwhile: the
covariance never exceeds that of the start by more than that round.

A row changes the covariance P by Woodbury's identity, which for a single row needs no inverse. It acts on a
square root S of P = S S' (Potter), so that P stays symmetric and positive however long it goes on; a plain P
loses that after a start far less certain than the data. Several rows a sample are taken one after the other,
which is the same.

Nothing here knows of plants: rows come from `jaxid.estimators.recursive.estimate`.

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

# Of the variance with which an unknown starts, what may be left where the rows tell it: it is then by less
# than a hundredth of the start's own error off.
IDENTIFIED = 0.01
# Below this part of the force a column is nothing.
_NOTHING = 1e-9
# A gain below this part of its start makes no model of the drive's force.
_LEAST_GAIN = 0.1


class RecursiveMemory(eqx.Module):
    """What is kept from sample to sample, and all that a warm restart needs.

    Args:
        theta: Estimate of least squares, (p,).
        root: S, with S S' the covariance for rows of unit noise, (p, p).
        spread: Sum of beta^2(n-k) z z': what noise of the rows does, (p, p).
        cost: Weighted squares of the residual at the estimate.
        weight: Sum of the weights of all rows.
        squares: Sum of the squares of what each row left after its own update; not forgotten.
        rows: How many that were.
        samples: That counted.
        normal, moment: Sums of z y' and z r, start included, (p, p) and (p,); of no use without
            instruments.
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
    """What a memory says.

    Args:
        theta: Estimate, by instruments where there are any.
        covariance: For white noise, and the square of `pull`; says nothing of unknowns that are not `told`.
        pull: By how much the start holds the estimate back, to first order, (p,).
        identifiable: Whether the rows, and not the start, determine an unknown.
        noise: Standard deviation of a row's noise.
        residual: Root mean square of what every row left after its own update, (49).
        effective: Sum of the weights of all rows.
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
        """Standard deviations; NaN where not told."""
        return jnp.sqrt(
            jnp.where(self.identifiable, jnp.diagonal(self.covariance, axis1=-2, axis2=-1), jnp.nan)
        )


class Recursion(eqx.Module):
    """The estimator; `update` may stand in a scan.

    Args:
        start: theta_0, (p,).
        information: Of the start: variance of a row's noise over that of the start, (p,).
        forgetting: beta, weight that a sample keeps when the next comes; 1: nothing is forgotten.
        summed: Whether the rows of a sample are summed to one before all else.
        gains: For instruments, which unknown is the gain of the drive in each row; None where none is.
        instrument: Whether the drive's force is noisy, so that its columns need an instrument: the force
            that the model of least squares so far asks for along the measured motion.
    """

    start: Float[Array, " p"]
    information: Float[Array, " p"]
    forgetting: Float[Array, ""]
    summed: bool = eqx.field(static=True, default=False)
    gains: tuple[int | None, ...] = eqx.field(static=True, default=())
    instrument: bool = eqx.field(static=True, default=False)

    def memory(self) -> RecursiveMemory:
        """Before the first sample."""
        p = self.start.size
        zero, square = jnp.zeros(()), jnp.zeros((p, p))
        information = jnp.asarray(self.information)
        return RecursiveMemory(
            jnp.asarray(self.start),
            jnp.diag(1 / jnp.sqrt(information)),
            square,
            zero,
            zero,
            zero,
            zero,
            jnp.zeros((), int),
            jnp.diag(information),
            information * self.start,
        )

    def update(
        self,
        memory: RecursiveMemory,
        rows: Float[Array, "m p"],
        target: Float[Array, " m"],
        counts: Bool[Array, " m"],
    ) -> tuple[RecursiveMemory, Float[Array, "k p"]]:
        """Take one sample more.

        Args:
            memory: So far.
            rows: Y of this sample.
            target: r of this sample.
            counts: Which of its rows count; where none does, the memory stays bit for bit what it was.

        Returns:
            The new memory, and the rows' instruments, k = 1 where summed (the rows themselves without).
        """
        z = self._instruments(memory.theta, rows, target)
        rows, target, z = (jnp.where(_alike(counts, x), x, 0.0) for x in (rows, target, z))
        moved = jnp.any(counts)
        number = jnp.sum(counts).astype(float)
        if self.summed:
            rows, target, z = (jnp.sum(x, axis=0)[None] for x in (rows, target, z))
            number = moved.astype(float)
        beta = jnp.where(moved, self.forgetting, 1.0)
        theta, root, cost = memory.theta, memory.root / jnp.sqrt(beta), beta * memory.cost
        for y, r in zip(rows, target, strict=True):
            theta, root, left = _taken(theta, root, y, r)
            cost = cost + left
        theta, root = self._reminded(theta, root, beta, memory.samples)
        square = jnp.sum((rows @ theta - target) ** 2)
        kept = jnp.diag((1 - beta) * self.information)
        return RecursiveMemory(
            theta,
            root,
            beta**2 * memory.spread + z.T @ z,
            cost,
            beta * memory.weight + number,
            memory.squares + square,
            memory.rows + number,
            memory.samples + moved,
            beta * memory.normal + kept + z.T @ rows,
            beta * memory.moment + (1 - beta) * self.information * self.start + z.T @ target,
        ), z

    def estimate(self, memory: RecursiveMemory) -> RecursiveEstimate:
        """What a memory says."""
        inverse = memory.root @ memory.root.T
        noise = memory.weight - jnp.sum(inverse * memory.spread)
        variance = jnp.where(noise > 0, memory.cost / jnp.where(noise > 0, noise, 1.0), jnp.nan)
        told = jnp.diagonal(inverse) * self.information < IDENTIFIED
        theta = memory.theta
        if self.instrument:
            scale = jnp.sqrt(jnp.abs(jnp.diagonal(memory.normal)))
            both = jnp.concatenate([memory.moment[:, None], jnp.eye(scale.size)], axis=1) / scale[:, None]
            both = eliminated(memory.normal / jnp.outer(scale, scale), both) / scale[:, None]
            theta, inverse = both[:, 0], both[:, 1:]
        pull = inverse @ (self.information * (theta - self.start))
        covariance = variance * inverse @ memory.spread @ inverse.T + jnp.outer(pull, pull)
        residual = jnp.sqrt(memory.squares / jnp.maximum(memory.rows, 1.0))
        return RecursiveEstimate(theta, covariance, pull, told, jnp.sqrt(variance), residual, memory.weight)

    def _reminded(self, theta: Array, root: Array, beta: Array, samples: Array) -> tuple[Array, Array]:
        """One unknown's start as a row, with what it has lost since its last turn."""
        p = theta.size
        turn = samples % p
        size = jnp.sqrt((1 - beta**p) * self.information[turn])
        unit = size * (jnp.arange(p) == turn)
        return _taken(theta, root, unit, size * self.start[turn])[:2]

    def _instruments(self, theta: Array, rows: Array, target: Array) -> Array:
        """The rows with the drive's columns as the model at theta has them.

        Let c be the column of a gain g, minus the measured force. The model's force is the one at which the
        row's residual e vanishes: its column is c - e / g. Noise of the measured force is in c and in e / g
        alike: the difference has none.
        """
        if not self.instrument:
            return rows
        out = rows
        for k, g in enumerate(self.gains):
            if g is not None:
                sound = jnp.abs(theta[g]) > _LEAST_GAIN * jnp.abs(self.start[g])
                gain = jnp.where(sound, theta[g], self.start[g])
                out = out.at[k, g].add(-(rows[k] @ theta - target[k]) / gain)
        return out


def _taken(theta: Array, root: Array, y: Array, r: Array) -> tuple[Array, Array, Array]:
    """Estimate and root with one row more, and what the row adds to the cost."""
    f = y @ root
    grown = 1.0 + f @ f
    e = r - y @ theta
    gain = root @ f / grown
    root = root - gain[:, None] * (f / (1.0 + jax.lax.rsqrt(grown)))
    return theta + gain * e, root, e * e / grown


def _alike(counts: Array, x: Array) -> Array:
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
    """Take all samples of a log.

    Args:
        recursion: The estimator.
        memory: Where it goes on from.
        rows, target, counts: As `Recursion.update` takes them, by sample.
        every: After so many samples, and at the end, it is written down what was told.

    Returns:
        The memory at the end; what was told, (times, ...), see `instants`; and the instruments of all
        rows, (time, k, p), None where there are none.
    """
    time = len(rows)
    blocks = -(-time // every)
    # Samples that do not count change nothing.
    more = [(0, blocks * every - time)]
    padded = [jnp.pad(x, more + [(0, 0)] * (x.ndim - 1)) for x in (rows, target, counts)]
    padded = [x.reshape(blocks, every, *x.shape[1:]) for x in padded]

    def sample(memory: RecursiveMemory, now: list) -> tuple[RecursiveMemory, Array | None]:
        memory, z = recursion.update(memory, *now)
        return memory, z if recursion.instrument else None

    def block(memory: RecursiveMemory, now: list) -> tuple[RecursiveMemory, tuple]:
        memory, z = jax.lax.scan(sample, memory, now)
        return memory, (recursion.estimate(memory), z)

    memory, (told, z) = jax.lax.scan(block, memory, padded)
    return memory, told, None if z is None else z.reshape(-1, *z.shape[2:])[:time]


def column_squares(
    rows: Float[Array, "time m p"],
    counts: Bool[Array, "time m"],
    force: Float[Array, "time m"],
    natural: Float[Array, " p"],
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Mean square of each column, and of the force, over the samples that count.

    Args:
        rows, counts: As `Recursion.update` takes them, by sample.
        force: Of the drives in each row.
        natural: Sizes of the unknowns: a column that never stirs is a billionth of the force over it.
    """
    moved = jnp.maximum(jnp.any(counts, axis=1).sum(), 1)
    square = jnp.sum(jnp.where(counts[..., None], rows, 0.0) ** 2, axis=(0, 1)) / moved
    force = jnp.sum(jnp.where(counts, force, 0.0) ** 2) / moved
    return jnp.maximum(square, _NOTHING**2 * jnp.maximum(force, 1e-300) / natural**2), force


def instants(samples: int, every: int) -> np.ndarray:
    """Index of the last sample that each of `run`'s told values has seen."""
    ends = np.arange(every, samples + every, every)
    return np.minimum(ends, samples) - 1
