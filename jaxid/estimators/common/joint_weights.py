"""Weights of the joints of a machine, by what a fit of the balance of forces leaves of each."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jaxid.model.plant import Plant

# Least residual of a joint, as a part of the largest: a joint that an exact log leaves nothing of does not
# count alone.
_LEAST = 1e-4


def joint_weights(
    plant: Plant, residual: Float[np.ndarray, "time n"], counts: Bool[np.ndarray, "time n"]
) -> Float[np.ndarray, " n"] | None:
    """Return the weight of each joint's rows, one over the RMS of its residual and one on the average.

    The torque of a shoulder has many times the noise of that of a wrist. Without weights the rows of the
    shoulder decide what the wrist shows better. A joint without a drive has weight one: its residual is small
    because no force is measured there, and all of it is noise of the regressors, which biases the estimates.

    Args:
        plant: The machine's plant, for its drives.
        residual: Residual of a fit without weights [N or N m], (time, n).
        counts: Mask of the samples that count, (time, n).

    Returns:
        The weights, (n,); None if fewer than two driven joints have samples, or the fit failed.

    Source:
        Gautier (1997), IEEE International Conference on Robotics and Automation, 3278-3283.
    """
    driven = np.asarray(plant.driven(plant.joints), dtype=int)
    samples = counts.sum(axis=0)[driven]
    squares = (np.where(counts, residual, 0.0) ** 2).sum(axis=0)[driven]
    rms = np.sqrt(squares / np.maximum(samples, 1))
    most = float(rms.max(initial=0.0))
    if (samples > 0).sum() < 2 or not np.isfinite(most) or most == 0:
        return None
    rms = np.where(samples > 0, np.maximum(rms, _LEAST * most), most)

    weights = np.ones(counts.shape[1])
    # The weighted residual has the size of the residual.
    weights[driven] = np.sqrt(squares.sum() / np.sum(squares / rms**2)) / rms
    return weights
