"""Guesses as a prior of the unknowns: how far from each the truth may be."""

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
    """Guesses and how far from them the unknowns may be: physical values, and in units of that.

    What must be positive is log-normal about its guess, the rest normal.
    """

    base: Float[Array, " p"]
    scale: Float[Array, " p"]
    log: Bool[Array, " p"]
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]

    def outward(self, w: Float[Array, " p"]) -> Float[Array, " p"]:
        """Physical values, within their bounds."""
        moved = jnp.where(self.log, self.base * jnp.exp(self.scale * w), self.base + self.scale * w)
        return jnp.clip(moved, self.lower, self.upper)

    def inward(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """In units of the prior."""
        ratio = np.where(self.log, np.maximum(theta, 1e-300) / np.where(self.log, self.base, 1.0), 1.0)
        return np.where(self.log, np.log(ratio), theta - self.base) / self.scale

    def slope(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Physical change for a change of one prior."""
        return np.where(self.log, theta, 1.0) * self.scale

    @classmethod
    def of(
        cls,
        machine: Machine,
        width: float,
        nuisance: Float[np.ndarray, " k"],
        own: Mapping[str, float] | None = None,
    ) -> Prior:
        """Of a machine's guesses, a relative width around each or its own, and of nuisances about zero.

        Raises:
            InputError: If a guess is zero, of which nothing can be a part.
        """
        free = machine.parameters.free
        own = own or {}
        for f in free:
            if f.guess == 0.0 and f.name not in own:
                raise InputError(
                    f"{f.name} has a guess of zero, which a relative prior says nothing of",
                    where="prior",
                    hint="give it a guess of its natural size",
                )
        guess, (lower, upper) = machine.parameters.guess, machine.parameters.bounds
        log = Transform.of(machine.parameters).log
        none = np.zeros(nuisance.size)
        scale = np.where(log, width, width * np.abs(guess))
        scale = np.array([own.get(f.name, s) for f, s in zip(free, scale, strict=True)])
        return cls(
            np.concatenate([guess, none]),
            np.concatenate([scale, nuisance]),
            np.concatenate([log, none.astype(bool)]),
            np.concatenate([lower, none - np.inf]),
            np.concatenate([upper, none + np.inf]),
        )
