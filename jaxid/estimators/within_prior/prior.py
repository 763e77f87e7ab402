"""Prior distribution of the unknowns: the guesses of a case and their standard deviations."""

from __future__ import annotations

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.machine import Machine


class Prior(eqx.Module):
    """Independent prior of each unknown, and the whitening by it.

    Unknowns that must be positive are log-normal about their guess, the others are normal. Whitened
    coordinates `w` have a standard normal prior: zero is the guess, one is a standard deviation.

    Args:
        base: Median of each unknown, its guess, (p,) [units of the unknowns].
        scale: Standard deviation, of the logarithm if `log`, else in the unknown's unit, (p,).
        log: Mask of the unknowns that are log-normal, (p,).
        lower, upper: Bounds on the physical values, (p,) [units of the unknowns].
    """

    base: Float[Array, " p"]
    scale: Float[Array, " p"]
    log: Bool[Array, " p"]
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]

    def outward(self, w: Float[Array, " p"]) -> Float[Array, " p"]:
        """Return the physical values at whitened coordinates, clipped to their bounds."""
        moved = jnp.where(self.log, self.base * jnp.exp(self.scale * w), self.base + self.scale * w)
        return jnp.clip(moved, self.lower, self.upper)

    def inward(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return the whitened coordinates of physical values."""
        ratio = np.where(self.log, np.maximum(theta, 1e-300) / np.where(self.log, self.base, 1.0), 1.0)
        return np.where(self.log, np.log(ratio), theta - self.base) / self.scale

    def slope(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return the derivative of each physical value in its whitened coordinate."""
        return np.where(self.log, theta, 1.0) * self.scale

    @classmethod
    def of(
        cls,
        machine: Machine,
        width: float,
        nuisance: Float[np.ndarray, " k"],
        widths: Mapping[str, float] | None = None,
    ) -> Prior:
        """Build the prior of a machine's unknowns, followed by nuisance parameters about zero.

        Args:
            machine: The machine, whose guesses are the medians.
            width: Relative standard deviation of the guesses.
            nuisance: Standard deviations of the nuisance parameters, (k,).
            widths: Standard deviations of single unknowns by name, in place of `width`.

        Raises:
            InputError: If a guess is zero and `widths` has no standard deviation for it.
        """
        free = machine.parameters.free
        widths = widths or {}
        for f in free:
            if f.guess == 0.0 and f.name not in widths:
                raise InputError(
                    f"a relative prior needs a nonzero guess, and {f.name} has guess = 0",
                    where="prior",
                    hint="give it a guess of its natural size",
                )

        guess, (lower, upper) = machine.parameters.guess, machine.parameters.bounds
        log = Transform.of(machine.parameters).log
        scale = np.where(log, width, width * np.abs(guess))
        scale = np.array([widths.get(f.name, s) for f, s in zip(free, scale, strict=True)])

        none = np.zeros(nuisance.size)
        return cls(
            base=np.concatenate([guess, none]),
            scale=np.concatenate([scale, nuisance]),
            log=np.concatenate([log, none.astype(bool)]),
            lower=np.concatenate([lower, none - np.inf]),
            upper=np.concatenate([upper, none + np.inf]),
        )
