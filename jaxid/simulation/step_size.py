"""How finely a machine must be integrated: its fastest rate, what is too stiff, and what no sample shows."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.dynamics.rhs import State, acceleration, derivative
from jaxid.effects.friction import ViscousFriction
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.parameter import as_array
from jaxid.model.plant import Plant

# Fastest rate of the linearised plant times step that a fourth-order step follows to 1e-5.
_FINE = 0.2
# Any number of steps up to this; beyond, so many numbers from one to its double.
_EACH, _AN_OCTAVE = 8, 4
# More integration steps a sample than that no machine asks for: a fit or a guess has run away.
_MOST_STEPS = 2000
# Damping ratio of a spring that rings faster than a log samples, and steps in parts of those that its ring
# asks for. Friction that falls with speed makes such a ring chatter: slopes along 2000 samples of a stage
# grow to 1e14 times what a fit leaves, with a ratio of 0.05 too; with this one they stay below 100 times.
# Nothing then hangs on the ring's phase. Half a radian a step does where a load's position is compared. For
# the motor's current alone a radian does: with 31 steps a sample that stage's is as near to that of 248 as
# with 62; with 16 it grows without bounds on a spring much stiffer.
_CALM, _COARSER, _COARSEST = 0.3, 0.4, 0.2


class TooStiffError(InputError):
    """A machine so stiff, or so light, that simulating it would not end."""


def needed_steps(machine: Machine, log: Log) -> int:
    """Return the integration steps a sample that the smooth part of the plant needs along a log.

    Raises:
        TooStiffError: If that is more than any sound machine asks for.
    """
    period = machine.controller.period if machine.controller is not None else log.period
    picks = np.linspace(0, log.samples - 1, 50).astype(int)
    q, u = jnp.asarray(log.filled[picks]), jnp.asarray(log.force[picks] * machine.gain)
    steps = float(_fastest(machine.plant, q, u)) * period / _FINE
    if not np.isfinite(steps):
        raise TooStiffError(
            "the plant's forces have no finite slope where the log begins to move",
            where=log.source,
            hint="check the guesses, and effects of your own at velocity zero",
        )
    if steps > _MOST_STEPS:
        raise TooStiffError(
            f"the plant would need {steps:.2g} integration steps every {period:.3g} s",
            where=log.source,
            hint="an inertia that is far too small, or a stiffness or damping far too large, does "
            "that: check the guesses, or declare less",
        )
    return _rounded(max(1, int(np.ceil(steps))))


def _rounded(steps: int) -> int:
    """Round up to one of few numbers, a fifth more at most: each other number compiles all code anew."""
    if steps <= _EACH:
        return steps
    octave = np.ceil(_AN_OCTAVE * np.log2(steps / _EACH)) / _AN_OCTAVE
    return int(np.ceil(_EACH * 2**octave))


@eqx.filter_jit
def _fastest(plant: Plant, q: Array, u: Array) -> Array:
    """Return the fastest rate of the plant without dry friction, linearised at rest at some positions."""

    def rate(q: Array, u: Array) -> Array:
        zero = jnp.zeros_like(q)
        own = plant.initial_states(u)
        none = jnp.zeros_like(plant.ports(q))

        def acc(q: Array, v: Array) -> Array:
            return acceleration(plant, State(q, v, own), u, jnp.zeros(()), none)

        stiffness, damping = (_slope(of) for of in jax.jacfwd(acc, argnums=(0, 1))(q, zero))
        motion = jnp.maximum(jnp.sqrt(stiffness), damping)
        return jnp.maximum(motion, _swing(plant, State(q, zero, own), u, none))

    return jax.vmap(rate)(q, u).max()


def _slope(matrix: Array) -> Array:
    """Return the largest entry of a matrix of slopes, each pair of joints taken together.

    Joints may be in different units, and one light beside the other: k R / J alone is no rate of a motor
    behind a screw, only with k R / M is it one.
    """
    return jnp.sqrt(jnp.abs(matrix * matrix.T)).max()


def _swing(plant: Plant, x: State, u: Array, reaction: Array) -> Array:
    """Return the fastest rate of the effects that are oscillators, which steps cannot take exactly."""
    worst = jnp.zeros(())
    for i, z in enumerate(x.own):
        if z is None or z.ndim == 0:
            continue

        def rates(value: Array, i: int = i) -> Array:
            own = (*x.own[:i], value, *x.own[i + 1 :])
            return derivative(plant, State(x.q, x.qd, own), u, jnp.zeros(()), reaction).own[i]

        slope = jax.jacfwd(rates)(z)
        frequency = jnp.sqrt(jnp.abs(slope[0, 0] * slope[1, 1] - slope[0, 1] * slope[1, 0]))
        worst = jnp.maximum(worst, jnp.maximum(frequency, jnp.abs(jnp.trace(slope))))
    return worst


def with_numerical_damping(plant: Plant, q: Float[Array, " n"], period: float) -> Plant:
    """Return the plant with damping beside springs that ring faster than samples can show.

    Args:
        plant: The plant.
        q: A position.
        period: Between samples [s].

    Returns:
        The same plant where there is no such spring, or enough damping; else with `viscous_friction` on its
        elongation, behind all other effects. Critical is 2 (k m)^(1/2), m the mass that rings on the spring,
        both its ends free.
    """
    mass = plant.own_inertia()
    if mass is None or not plant.springs(plant.joints):
        return plant
    stiffness, damping = (np.asarray(x) for x in plant.port_spring(q))
    stretched = np.asarray(jax.jacfwd(plant.ports)(q))
    for port in range(q.size, len(stretched)):
        reduced = 1.0 / np.sum(stretched[port] ** 2 / np.asarray(mass))
        rate = np.sqrt(max(float(stiffness[port]), 0.0) / reduced)
        lacking = 2 * _CALM * rate * reduced - float(damping[port])
        if rate * period > np.pi and lacking > 0:
            plant = plant.with_effect(ViscousFriction(as_array(lacking), port=port))
    return plant


def steps_with_numerical_damping(steps: int, on: str) -> int:
    """Return the steps that suffice once ringing is damped; `on` is the compared output."""
    return max(1, int(np.ceil((_COARSEST if on == "force" else _COARSER) * steps)))
