"""Balance of forces whose model is compared with a force that was read late.

The model is delayed, not the logged force undone, which would amplify its noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize
from jaxtyping import Complex, Float

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.logs.prepare import Prepared

# Samples that are added at each end, which the transform joins to a circle.
_PAD = 256


@dataclass(frozen=True)
class LateModel:
    """A balance with the transform of its model.

    Args:
        fit: The balance.
        model: Transform of the model's force and of its columns at the kept samples, padded, (f, n, columns).
        frequency: Frequencies of the transform [Hz], (f,).
        period: Sampling time of the log [s].
        kept: Time between kept samples [s].
    """

    fit: BalanceFit
    model: Complex[np.ndarray, "f n columns"]
    frequency: Float[np.ndarray, " f"]
    period: float
    kept: float

    @classmethod
    def of(cls, fit: BalanceFit, data: Prepared) -> LateModel:
        """Transform the model of a balance along a prepared log."""
        model = np.concatenate([(fit.known + fit.force)[..., None], fit.columns, fit.potential], axis=2)
        padded = np.pad(model, [(_PAD, _PAD), (0, 0), (0, 0)], mode="edge")
        kept = data.period * data.recipe.decimation
        frequency = np.fft.rfftfreq(len(padded), kept)
        return cls(fit, np.fft.rfft(padded, axis=0), frequency, data.period, kept)

    def at(self, delay: float, lag: float = 0.0) -> BalanceFit:
        """Return the balance with a model that is read late.

        The low-pass is that of a drive, at the log's rate: w[k] = w[k-1] + a (u[k] - w[k-1]) with
        a = 1 - exp(-period / lag).

        Args:
            delay: Time by which the force is read after it acted, below zero if before [s].
            lag: Time constant of the low-pass, zero if there is none [s].
        """
        turn = 2j * np.pi * self.frequency
        keeps = np.exp(-self.period / lag) if lag > 0.0 else 0.0
        passes = np.exp(-turn * delay) * (1 - keeps) / (1 - keeps * np.exp(-turn * self.period))
        rows, p = len(self.fit.known) + 2 * _PAD, self.fit.columns.shape[2]
        late = np.fft.irfft(self.model * passes[:, None, None], rows, axis=0)[_PAD:-_PAD]
        known = late[..., 0] - self.fit.force
        return replace(self.fit, known=known, columns=late[..., 1 : 1 + p], potential=late[..., 1 + p :])


def least_near(
    cost: Callable[[float], float], tried: Float[np.ndarray, " tried"], close: float
) -> tuple[float, float]:
    """Return the value of least cost between the neighbours of the best one that is tried, and its cost.

    Args:
        cost: The cost.
        tried: Values that are tried first, in order.
        close: Tolerance of the value.
    """
    costs = [cost(value) for value in tried]
    k = int(np.argmin(costs))
    bounds = (tried[max(k - 1, 0)], tried[min(k + 1, tried.size - 1)])
    found = scipy.optimize.minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": close})
    x, fun = float(found.x), float(found.fun)  # pyright: ignore[reportAttributeAccessIssue]
    return (x, fun) if fun < costs[k] else (float(tried[k]), costs[k])
