"""Coefficient matrices of a balance that is linear in motion away from rest, off the balance itself."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.minimal.polynomials import Matrix
from jaxid.model.balance import Balance
from jaxid.model.effect import Effect
from jaxid.model.plant import Plant
from jaxid.model.unknowns import effect_name
from jaxid.numerics.affine import depends, is_affine


class LinearBalance(eqx.Module):
    """P(s) q + S sign(q') + c = B u, s being d/dt.

    Args:
        motion: P: stiffness, damping and mass, (3, n, n).
        sign: S, levels of dry friction by the joint on which they act, (n, n).
        constant: c, weights and offsets, (n,).
        force: B, of the declared forces, (n, m).
    """

    motion: Matrix
    sign: Float[Array, "n n"]
    constant: Float[Array, " n"]
    force: Float[Array, "n m"]


def linear_balance(plant: Plant) -> LinearBalance:
    """Differentiate a plant's balance; only of use where `require_linear` lets it pass."""
    zeros = _at_rest(plant)

    def residual(*args: Array) -> Array:
        return _balance(plant, *args, jnp.zeros(())).residual

    stiffness, damping, mass, force, reaction = jax.jacfwd(residual, argnums=(0, 1, 2, 3, 4))(*zeros)
    n = plant.joints
    levels = _balance(plant, *zeros, jnp.zeros(())).dry
    return LinearBalance(
        jnp.stack([stiffness, damping, mass]), -(reaction * levels)[:, :n], residual(*zeros), -force
    )


def require_linear(plant: Plant, where: str) -> None:
    """See that away from rest the balance is linear in the motion, with constant coefficients.

    Args:
        plant: The plant.
        where: For the message.

    Raises:
        InputError: If it is not; the text names the effect.
    """
    hint = "leave it out of the case, or use inverse_dynamics or output_error"
    for k, effect in enumerate(plant.effects):
        name = effect_name(eqx.tree_at(lambda p: p.effects, plant, plant.effects[:k]), effect)
        alone = eqx.tree_at(lambda p: p.effects, plant, (effect,))
        if jax.tree.leaves(effect.initial_state(jnp.zeros(()))):
            raise InputError(f"{name} has a memory, which a minimal model has not", where=where, hint=hint)
        if not _linear(alone) and _linear(eqx.tree_at(lambda p: p.effects, plant, ())):
            raise InputError(
                f"{name} is not linear in the motion, as a minimal model is away from rest",
                where=where,
                hint=hint,
            )
        if any(i >= plant.joints for i in _slides(alone)):
            raise InputError(
                f"{name} is dry friction in a spring, whose direction no encoder tells",
                where=where,
                hint=hint,
            )
    if not _linear(plant):
        raise InputError(
            f"{plant.kind} with these effects is not linear in its motion, as a minimal model is",
            where=where,
            hint="use inverse_dynamics or output_error",
        )


def delays_command(effect: Effect) -> bool:
    """Whether an effect delays the command."""
    return type(effect).command_delay is not Effect.command_delay


def _at_rest(plant: Plant) -> tuple[Array, ...]:
    """Position, velocity, acceleration, declared force and reaction, all zero."""
    q = jnp.zeros(plant.joints)
    return q, q, q, jnp.zeros(len(plant.driven(plant.joints))), jnp.zeros(plant.ports(q).size)


def _balance(plant: Plant, q: Array, qd: Array, qdd: Array, u: Array, reaction: Array, t: Array) -> Balance:
    return plant.balance(q, qd, qdd, u, t, plant.initial_states(u), reaction)


def _slides(plant: Plant) -> tuple[int, ...]:
    found = []
    jax.eval_shape(lambda: found.append(_balance(plant, *_at_rest(plant), jnp.zeros(())).slides))
    return found[0]


def _linear(plant: Plant) -> bool:
    zeros, t = _at_rest(plant), jnp.zeros(())
    if not is_affine(lambda *args: _balance(plant, *args).residual, zeros, (t,)):
        return False
    return not depends(lambda *args: _balance(plant, *args).dry, (*zeros, t))
