"""The force that held a joint without a drive at rest, from the measured motion of its neighbours.

No force of a drive says when such a joint must break loose. A drive that starts late makes it start late too,
as if its friction were larger; the force of the coupling at that moment shows whether it is.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.discovery.at_rest.break_away import BreakAway
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit

# Rows before a joint leaves, of which the largest force counts.
_BEFORE = 3


def was_held(machine: Machine, data: Prepared, found: BreakAway, joint: int) -> bool:
    """Check that the force on a joint before it left its rests reached a level of break-away friction.

    Args:
        machine: The machine at its estimate, without that friction.
        data: The first prepared log.
        found: The level, with the times at which the joint left.
        joint: Index of the joint.

    Returns:
        True if it did, or the joint has a drive, or left no rest of this log.
    """
    driven = np.asarray(machine.plant.driven(machine.plant.joints))
    if joint in driven or not found.times.size:
        return True
    forces = force_at_rest(machine, data, found.times, joint)
    sliding = sum(
        float(getattr(e, e.sliding_level))
        for e in machine.plant.effects
        if e.sliding_level is not None and e.port == joint
    )
    # A joint is seen to leave its rest a little late, when the force has grown further.
    return bool(np.median(forces) > sliding + found.level)


def force_at_rest(
    machine: Machine, data: Prepared, times: Float[np.ndarray, " start"], joint: int
) -> Float[np.ndarray, " start"]:
    """Return the force without friction on a joint at rest, the largest of the last rows before it leaves.

    Args:
        machine: The machine at its estimate.
        data: The prepared log.
        times: Times at which the joint leaves a rest, from the start of the log [s], (start,).
        joint: Index of the joint.

    Returns:
        Absolute forces [N or N m], (start,).
    """
    last = np.round((times - data.start) / data.period).astype(int)
    rows = np.clip(last[:, None] - np.arange(_BEFORE), 0, len(data.q) - 1)
    qd, qdd = data.qd[rows].copy(), data.qdd[rows].copy()
    qd[..., joint] = qdd[..., joint] = 0.0
    forces = _forces(machine.plant, data.q[rows], qd, qdd, data.force[rows])
    return np.max(np.abs(np.asarray(forces)[..., joint]), axis=1)


@kept_jit
def _forces(plant: Plant, q: Array, qd: Array, qdd: Array, u: Array) -> Array:
    """Return the residual of the balance at each sample, (start, row, n)."""

    def one(q: Array, qd: Array, qdd: Array, u: Array) -> Array:
        return plant.balance(q, qd, qdd, u, jnp.zeros(()), plant.initial_states(u)).residual

    return jax.vmap(jax.vmap(one))(q, qd, qdd, u)
