"""Weights of the joints of a machine, by what a fit of the balance of forces leaves of each."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# Least residual of a joint, as a part of the largest: a joint that an exact log leaves nothing of does not
# count alone.
_LEAST = 1e-4


def joint_weights(
    residual: Float[np.ndarray, "time n"], counts: Bool[np.ndarray, "time n"]
) -> Float[np.ndarray, " n"] | None:
    """Return the weight of each joint's rows, one over the RMS of its residual and one on the average.

    The torque of a shoulder has many times the noise of that of a wrist. Without weights the rows of the
    shoulder decide what the wrist shows better.

    Args:
        residual: Residual of a fit without weights [N or N m], (time, n).
        counts: Mask of the samples that count, (time, n).

    Returns:
        The weights, (n,); None if fewer than two joints have samples, or the fit failed.

    Source:
        Gautier (1997), IEEE International Conference on Robotics and Automation, 3278-3283.
    """
    samples = counts.sum(axis=0)
    moved = samples > 0
    squares = np.where(counts, residual, 0.0) ** 2
    rms = np.sqrt(squares.sum(axis=0) / np.maximum(samples, 1))
    most = float(rms.max(initial=0.0))
    if moved.sum() < 2 or not np.isfinite(most) or most == 0:
        return None
    rms = np.where(moved, np.maximum(rms, _LEAST * most), most)
    # The weighted residual has the size of the residual.
    return float(np.sqrt(squares.sum() / np.sum(squares / rms**2))) / rms
