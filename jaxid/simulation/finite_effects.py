"""A check that user-defined effects are finite along a log, before anything is fitted to it."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.logs.prepare import Prepared
from jaxid.model.balance import port_motion
from jaxid.model.effect import Effect, Signals
from jaxid.model.plant import Plant

# Largest number of samples at which an effect is evaluated.
_ROWS = 200


def need_finite_effects(plant: Plant, data: Prepared, source: str) -> None:
    """Refuse a user-defined effect whose force, or a derivative of it, is not finite along a log.

    Args:
        plant: Plant with the guesses as its parameters.
        data: The prepared log; its moving samples are used.
        source: Name of the log, for the message.

    Raises:
        InputError: If an effect gives a force or a derivative that is not finite.
    """
    user_defined = [e for e in plant.effects if not type(e).__module__.startswith("jaxid.")]
    moving = data.kept[data.moving.any(axis=1)]
    if not user_defined or not moving.size:
        return

    rows = moving[np.linspace(0, moving.size - 1, min(_ROWS, moving.size)).astype(int)]
    q, qd, qdd, force = (jnp.asarray(x[rows]) for x in (data.q, data.qd, data.qdd, data.force))
    times = jnp.asarray(data.start + data.period * rows)
    for effect in user_defined:
        finite, y, yd = (np.asarray(x) for x in _finite(plant, effect, q, qd, qdd, force, times))
        if finite.all():
            continue
        k = int(np.argmin(finite))
        what = (
            f"act gives a force, or a derivative of it, that is not finite at {np.sum(~finite)} of "
            f"{finite.size} moving samples of {source}, first at y = {y[k]:.3g}, yd = {yd[k]:.3g}"
        )
        hint = "correct act, or its guesses: a root or a power of a negative number is not finite"
        raise InputError(what, where=f"effect {effect.kind}", hint=hint)


@eqx.filter_jit
def _finite(
    plant: Plant, effect: Effect, q: Array, qd: Array, qdd: Array, u: Array, t: Array
) -> tuple[Array, Array, Array]:
    """Return at each sample whether an effect is finite, and the position and velocity of its port."""
    port, drive = effect.port, plant.drive_of(effect.port, u.shape[1])
    leaves, structure = jax.tree.flatten(effect)

    def at(q: Array, qd: Array, qdd: Array, u: Array, t: Array) -> tuple[Array, Array, Array]:
        y, yd, ydd = (x[port] for x in port_motion(plant, q, qd, qdd))
        force = jnp.zeros(()) if drive is None else u[drive]
        others = (plant.port_gravity(q), plant.port_normal(q), *plant.port_spring(q))
        gravity, normal, stiffness, damping = (x[port] for x in others)
        width = plant.port_width(q)[port]
        x = Signals(
            y=y,
            yd=yd,
            ydd=ydd,
            u=force,
            t=t,
            width=width,
            dry_scale=jnp.ones(()),
            gravity=gravity,
            normal=normal,
            stiffness=stiffness,
            damping=damping,
            field=plant.field,
        )

        def forces(leaves: list[Array]) -> tuple[list[Array], list[Array]]:
            action = jax.tree.unflatten(structure, leaves).act(x, effect.initial_state(force))
            out = [a for a in jax.tree.leaves(action) if eqx.is_array(a)]
            return out, out

        slopes, values = jax.jacfwd(forces, has_aux=True)(leaves)
        each = [jnp.all(jnp.isfinite(a)) for a in jax.tree.leaves((slopes, values))]
        return jnp.all(jnp.stack(each)) if each else jnp.ones((), bool), y, yd

    return jax.vmap(at)(q, qd, qdd, u, t)
