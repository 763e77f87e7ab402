"""Step size of the integration, from the fastest rate of a machine, and limits on its stiffness."""

from __future__ import annotations

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
from jaxid.numerics.kept import kept_jit

# Largest product of step and fastest rate that a fourth-order step follows to 1e-5.
_FINE = 0.2
# Up to _EACH steps any number is used; beyond, only _AN_OCTAVE numbers per doubling.
_EACH, _AN_OCTAVE = 8, 4
# No plausible machine needs more integration steps per sample; a fit has diverged, or a guess is far off.
_MOST_STEPS = 2000
# Damping ratio of a spring that rings faster than a log samples, and the part of the steps that its ringing
# would need. Friction that falls with speed excites such a ring: slopes along 2000 samples of a stage grow
# to 1e14 times the residual of a fit, also with a ratio of 0.05; with this ratio they stay below 100 times.
# The result then does not depend on the phase of the ring. Half a radian per step suffices if a load's
# position is compared. For the motor's current alone one radian suffices: with 31 steps per sample the
# current of that stage is as near to the one with 248 steps as with 62; with 16 steps it grows without
# bounds if the spring is much stiffer.
_CALM, _COARSER, _COARSEST = 0.3, 0.4, 0.2


class TooStiffError(InputError):
    """Error for a machine so stiff, or so light, that its simulation would not end."""


def needed_steps(machine: Machine, log: Log, *, finer: float = 1.0) -> int:
    """Return the integration steps per sample that the smooth part of the plant needs along a log.

    Args:
        machine: The machine.
        log: The log.
        finer: Factor on the steps.

    Raises:
        TooStiffError: If that is more than any plausible machine needs.
    """
    period = machine.controller.period if machine.controller is not None else log.period
    picks = np.linspace(0, log.samples - 1, 50).astype(int)
    q, u = log.filled[picks], log.force[picks] * np.asarray(machine.gain)
    steps = finer * float(fastest_rate(machine.plant, q, u)) * period / _FINE
    if not np.isfinite(steps):
        raise TooStiffError(
            "the plant's forces have no finite slope where the log begins to move",
            where=log.source,
            hint="check the guesses, and user-defined effects at zero velocity",
        )
    if steps > _MOST_STEPS:
        raise TooStiffError(
            f"the plant would need {steps:.2g} integration steps every {period:.3g} s",
            where=log.source,
            hint="the inertia is far too small, or a stiffness or damping far too large: check the guesses, "
            "or declare fewer effects",
        )
    return _rounded(max(1, int(np.ceil(steps))))


def _rounded(steps: int) -> int:
    """Round up by at most a fifth to one of few numbers, because each new number compiles all code again."""
    if steps <= _EACH:
        return steps
    octave = np.ceil(_AN_OCTAVE * np.log2(steps / _EACH)) / _AN_OCTAVE
    return int(np.ceil(_EACH * 2**octave))


@kept_jit
def fastest_rate(plant: Plant, q: Array, u: Array) -> Array:
    """Return the fastest rate of the plant without dry friction, linearised at rest at some positions."""

    def rate(q: Array, u: Array) -> Array:
        zero = jnp.zeros_like(q)
        internal = plant.initial_states(u)
        none = jnp.zeros_like(plant.ports(q))

        def acc(q: Array, v: Array) -> Array:
            return acceleration(plant, State(q, v, internal), u, jnp.zeros(()), none)

        stiffness, damping = (_slope(of) for of in jax.jacfwd(acc, argnums=(0, 1))(q, zero))
        motion = jnp.maximum(jnp.sqrt(stiffness), damping)
        return jnp.maximum(motion, _swing(plant, State(q, zero, internal), u, none))

    return jax.vmap(rate)(q, u).max()


def _slope(matrix: Array) -> Array:
    """Return the largest geometric mean of a slope and its transposed one.

    Joints may have different units and very different masses: for a motor with a screw k R / J alone is not
    the square of a rate, but its geometric mean with k R / M is.
    """
    return jnp.sqrt(jnp.abs(matrix * matrix.T)).max()


def _swing(plant: Plant, x: State, u: Array, reaction: Array) -> Array:
    """Return the fastest rate [1/s] of effects with an oscillator, which the steps do not solve exactly."""
    worst = jnp.zeros(())
    for i, z in enumerate(x.own):
        if z is None or z.ndim == 0:
            continue

        def rates(value: Array, i: int = i) -> Array:
            internal = (*x.own[:i], value, *x.own[i + 1 :])
            return derivative(plant, State(x.q, x.qd, internal), u, jnp.zeros(()), reaction).own[i]

        slope = jax.jacfwd(rates)(z)
        frequency = jnp.sqrt(jnp.abs(slope[0, 0] * slope[1, 1] - slope[0, 1] * slope[1, 0]))
        worst = jnp.maximum(worst, jnp.maximum(frequency, jnp.abs(jnp.trace(slope))))
    return worst


def with_numerical_damping(plant: Plant, q: Float[Array, " n"], period: float) -> Plant:
    """Return the plant with damping on springs that ring above the Nyquist frequency.

    Args:
        plant: The plant with its springs.
        q: Position at which stiffness and damping are evaluated, (n,).
        period: Sampling time [s].

    Returns:
        The plant itself if it has no such spring, or enough damping; else the plant with `viscous_friction`
        on the elongation of the spring, after all other effects. Critical damping is 2 (k m)^(1/2) with m
        the mass that rings on the spring if both its ends are free.
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
    """Return the steps per sample that suffice for damped ringing; `on` is the compared output."""
    return max(1, int(np.ceil((_COARSEST if on == "force" else _COARSER) * steps)))
