"""Solvers of diffrax, by name, from one sample of the command to the next.

The command jumps at its samples, and in a loop it is not known before its tick. Each interval is
therefore solved separately, so that no step contains a jump, whatever the hold. The error control takes
many steps near a reversal and otherwise one.
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

# Allowed error of a step relative to the state; near zero, relative to a tenth of the motion's size.
RELATIVE = 1e-8
_NEAR_ZERO = 0.1
# Largest number of steps from one sample to the next; a motion that needs more has diverged.
_MOST_STEPS = 4096


class AdaptiveStep(eqx.Module):
    """A diffrax solver under step-size control, differentiable forward.

    Args:
        name: Name of the solver, one of `SOLVERS`.
        absolute: Allowed error of a state near zero, in the unit of each state.
    """

    name: str = eqx.field(static=True)
    absolute: Float[Array, ""]

    @classmethod
    def sized(cls, name: str, *sizes: float) -> AdaptiveStep:
        """Return a solver by name for a motion of given size.

        Args:
            name: Name of the solver, one of `SOLVERS`.
            sizes: Typical sizes of position and velocity; the smallest sets the absolute error.

        Raises:
            InputError: If there is no such solver.
        """
        if name not in SOLVERS:
            raise InputError(f"solver {name!r} is not known", hint=suggest(name, SOLVERS))
        return cls(name, jnp.asarray(_NEAR_ZERO * RELATIVE * min(sizes), dtype=jnp.float64))

    def __call__(self, plant: Plant, x: State, ends: tuple[Array, ...], t: Array, h: Array) -> State:
        """Return the state at t + h.

        Args:
            plant: The plant; its dry friction is smoothed.
            x: State at the time t.
            ends: Declared force at the ends of the interval, delay applied; a held force is given once.
            t, h: Time and length of the interval [s].

        Returns:
            The state; NaN if the solver failed, so that a fit rejects the step.
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
