"""Coefficient matrices of a balance that is linear in the motion away from rest, by differentiation."""

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
    """The linear balance P(s) q + S sign(q') + c = B u, with s = d/dt.

    Args:
        motion: Polynomial matrix P: stiffness, damping and mass, (3, n, n).
        sign: Matrix S of dry friction levels, by balance and joint, (n, n) [N or N m].
        constant: Weights and offsets c, (n,) [N or N m].
        force: Matrix B of the declared forces, (n, m).
    """

    motion: Matrix
    sign: Float[Array, "n n"]
    constant: Float[Array, " n"]
    force: Float[Array, "n m"]


def linear_balance(plant: Plant) -> LinearBalance:
    """Differentiate a plant's balance at rest; valid for plants that `require_linear` accepts."""
    zeros, t = _at_rest(plant), jnp.zeros(())

    def residual(q: Array, qd: Array, qdd: Array, u: Array, reaction: Array) -> Array:
        return _balance(plant, q, qd, qdd, u, reaction, t).residual

    stiffness, damping, mass, force, reaction = jax.jacfwd(residual, argnums=(0, 1, 2, 3, 4))(*zeros)
    n = plant.joints
    levels = _balance(plant, *zeros, t).dry
    return LinearBalance(
        motion=jnp.stack([stiffness, damping, mass]),
        sign=-(reaction * levels)[:, :n],
        constant=residual(*zeros),
        force=-force,
    )


def require_linear(plant: Plant, where: str) -> None:
    """Check that away from rest the balance is linear in the motion, with constant coefficients.

    Args:
        plant: The plant.
        where: Place that the error message names.

    Raises:
        InputError: If it is not linear; the message names the effect.
    """
    hint = "leave it out of the case, or use inverse_dynamics or output_error"
    for k, effect in enumerate(plant.effects):
        name = effect_name(eqx.tree_at(lambda p: p.effects, plant, plant.effects[:k]), effect)
        alone = eqx.tree_at(lambda p: p.effects, plant, (effect,))
        if jax.tree.leaves(effect.initial_state(jnp.zeros(()))):
            raise InputError(
                f"{name} has an internal state, and a minimal model cannot have one", where=where, hint=hint
            )
        if not _linear(alone) and _linear(eqx.tree_at(lambda p: p.effects, plant, ())):
            raise InputError(
                f"{name} is not linear in the motion, and a minimal model must be linear away from rest",
                where=where,
                hint=hint,
            )
        if any(i >= plant.joints for i in _slides(alone)):
            raise InputError(
                f"{name} is dry friction in a spring, and no encoder measures its direction",
                where=where,
                hint=hint,
            )
    if not _linear(plant):
        raise InputError(
            f"{plant.kind} with these effects is not linear in its motion, and a minimal model must be",
            where=where,
            hint="use inverse_dynamics or output_error",
        )


def delays_command(effect: Effect) -> bool:
    """Tell whether an effect delays the command."""
    return type(effect).command_delay is not Effect.command_delay


def _at_rest(plant: Plant) -> tuple[Array, Array, Array, Array, Array]:
    """Return position, velocity, acceleration, declared force and reaction, all zero."""
    q = jnp.zeros(plant.joints)
    return q, q, q, jnp.zeros(len(plant.driven(plant.joints))), jnp.zeros(plant.ports(q).size)


def _balance(plant: Plant, q: Array, qd: Array, qdd: Array, u: Array, reaction: Array, t: Array) -> Balance:
    return plant.balance(q, qd, qdd, u, t, plant.initial_states(u), reaction)


def _slides(plant: Plant) -> tuple[int, ...]:
    """Return the ports with sliding friction; they are static, and known after tracing."""
    slides = []
    jax.eval_shape(lambda: slides.append(_balance(plant, *_at_rest(plant), jnp.zeros(())).slides))
    return slides[0]


def _linear(plant: Plant) -> bool:
    """Tell whether the balance is affine in the motion, and friction levels do not depend on it."""

    def balance(*args: Array) -> Balance:
        q, qd, qdd, u, reaction, t = args
        return _balance(plant, q, qd, qdd, u, reaction, t)

    zeros, t = _at_rest(plant), jnp.zeros(())
    if not is_affine(lambda *args: balance(*args).residual, zeros, (t,)):
        return False
    return not depends(lambda *args: balance(*args).dry, (*zeros, t))
