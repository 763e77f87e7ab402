"""Solvers of diffrax, by name, from one sample of the command to the next.

The command jumps at its samples, and in a loop it is not known before its tick: each interval is
solved by itself, so that no step straddles a jump, whatever the hold. Steps are as fine as the
error asks for, which near a reversal is many and elsewhere one.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.dynamics.rhs import State, derivative, hold_polynomial
from jaxid.errors import InputError, suggest
from jaxid.model.plant import Plant
from jaxid.names import SOLVERS

# Error of a step, relative to the state; near zero, to a tenth of the motion's size.
RELATIVE = 1e-8
_NEAR_ZERO = 0.1
# Most steps from one sample to the next; a motion that asks for more has diverged.
_MOST_STEPS = 4096


class AdaptiveStep(eqx.Module):
    """A diffrax solver under step-size control, differentiable forward.

    Args:
        name: One of `SOLVERS`.
        absolute: Error allowed of a state near zero, in the unit of each state.
    """

    name: str = eqx.field(static=True)
    absolute: Float[Array, ""]

    @classmethod
    def sized(cls, name: str, *sizes: float) -> AdaptiveStep:
        """Return the solver of that name for a motion of such position and velocity.

        Raises:
            InputError: If there is no such solver.
        """
        if name not in SOLVERS:
            raise InputError(f"solver {name!r} is not known", hint=suggest(name, SOLVERS))
        return cls(name, jnp.asarray(_NEAR_ZERO * RELATIVE * min(sizes), dtype=jnp.float64))

    def __call__(self, plant: Plant, x: State, ends: tuple[Array, ...], t: Array, h: Array) -> State:
        """State at t + h.

        Args:
            plant: The plant; its dry friction is smoothed.
            x: State at t.
            ends: Declared force at the ends of the interval, delay applied; once where it is held.
            t, h: Time and length of the interval [s].

        Returns:
            The state; not a number where the solver failed, so that a fit turns back.
        """
        import diffrax

        solver = getattr(diffrax, SOLVERS[self.name])()
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(_rate),
            solver,
            0.0,
            h,
            h,
            x,
            (plant, ends, t, h),
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.PIDController(rtol=RELATIVE, atol=self.absolute),
            adjoint=diffrax.ForwardMode(),
            max_steps=_MOST_STEPS,
            throw=False,
        )
        good = solution.result == diffrax.RESULTS.successful
        return jax.tree.map(lambda y: jnp.where(good, y[0], jnp.nan), solution.ys)


def _rate(since: ArrayLike, x: State, args: tuple) -> State:
    plant, ends, t, h = args
    since = jnp.asarray(since)
    return derivative(plant, x, hold_polynomial(ends)(since / h), t + since)
