"""Geometry of the Mitsubishi PA-10 with seven joints."""

from __future__ import annotations

import numpy as np

from jaxid.plants.denavit_hartenberg import DenavitHartenberg

# From the shoulder to the elbow, on to the wrist, and to the flange [m]. Illustrative: the report names them
# d_3, d_5 and d_7 without numbers; these are of the size of the machine's.
SHOULDER_TO_ELBOW = 0.45
ELBOW_TO_WRIST = 0.5
WRIST_TO_FLANGE = 0.08


def pa10(
    d3: float = SHOULDER_TO_ELBOW, d5: float = ELBOW_TO_WRIST, d7: float = WRIST_TO_FLANGE
) -> DenavitHartenberg:
    """Return the geometry of seven revolute joints, z of the base upwards.

    Args:
        d3, d5, d7: Offsets of joints 3, 5 and 7 along their axes [m].

    Source:
        "PA-10 traineeship", table 2.1; its rows list a_{i-1} and alpha_{i-1}, and row 7 is theta_7.
    """
    twist = np.pi / 2
    twists = (0.0, -twist, twist, -twist, twist, -twist, twist)
    offsets = (0.0, 0.0, d3, 0.0, d5, 0.0, d7)
    return DenavitHartenberg.of_rows(
        [("revolute", alpha, 0.0, d, 0.0) for alpha, d in zip(twists, offsets, strict=True)]
    )
