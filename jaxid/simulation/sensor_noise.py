"""Noise of position readings, as stated or as estimated from a log."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics import filters as signals


def position_noise(machine: Machine, log: Log) -> Float[np.ndarray, " n"]:
    """Return the standard deviation of a reading of each joint, (n,) [m or rad].

    It is the stated one, or else an estimate from the high band of the log. A joint without an encoder has
    zero.
    """
    stated = machine.sensor.position_std
    if stated is None:
        stated = signals.high_band_std(log.filled)
    return np.broadcast_to(np.asarray(stated), log.position.shape[1]) * log.measured
