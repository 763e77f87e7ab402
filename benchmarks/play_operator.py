"""A play operator with a delay and a lag: where a joint goes when told, without physics.

Four numbers of a joint: the delay and the time constant of a first-order lag of the command [s], half the
width of the play [rad], and an offset [rad]. The joint stands where it is until the lagged command has left
the play, and is then dragged along. This is what a model of a servo has to beat.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution

from jaxid.numerics.delays import lagged, shifted

# Largest delay and lag [s], half width and offset [rad] that are tried.
BOUNDS = ((0.0, 0.2), (1e-3, 0.2), (0.0, 0.15), (-0.1, 0.1))
# Sets of numbers of one generation, and generations.
POPULATION, GENERATIONS = 64, 200


@jax.jit
def followed(numbers: jax.Array, command: jax.Array, start: jax.Array, row: jax.Array) -> jax.Array:
    """Return the positions [rad], (rows,), that a play operator takes from the commands of a motion.

    `numbers` are delay, lag, half width and offset, `start` is the first position that was measured, and
    `row` the time between two rows [s].
    """
    delay, lag, half, offset = numbers
    delayed = shifted(command[:, None], delay / row)
    wanted = lagged(delayed, 1 - jnp.exp(-row / lag))[:, 0]

    def step(at: jax.Array, middle: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = jnp.clip(at, middle - half, middle + half)
        return at, at + offset

    _, positions = jax.lax.scan(step, start - offset, wanted)
    return positions


def fitted(motions: list[tuple[np.ndarray, np.ndarray]], row: float) -> np.ndarray:
    """Return the numbers (4,) that leave least of motions, (command, position) each, of one length."""
    commands, positions = (jnp.asarray(np.stack(x)) for x in zip(*motions, strict=True))
    over_motions = jax.vmap(followed, (None, 0, 0, None))

    @jax.jit
    def left(sets: jax.Array) -> jax.Array:
        simulated = jax.vmap(over_motions, (0, None, None, None))(sets, commands, positions[:, 0], row)
        return jnp.mean((simulated - positions) ** 2, axis=(1, 2))

    found = differential_evolution(
        lambda sets: np.asarray(left(jnp.asarray(sets.T))),
        BOUNDS,
        popsize=POPULATION // len(BOUNDS),
        maxiter=GENERATIONS,
        vectorized=True,
        updating="deferred",
        rng=0,
        polish=False,
    )
    return found.x


def left_of(numbers: np.ndarray, command: np.ndarray, position: np.ndarray, row: float) -> float:
    """Return the RMS [rad] that a play operator leaves of a motion that begins at the measured position."""
    simulated = followed(jnp.asarray(numbers), jnp.asarray(command), position[0], row)
    return float(np.sqrt(np.mean((np.asarray(simulated) - position) ** 2)))
