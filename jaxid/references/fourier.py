"""Finite Fourier series."""

from typing import Any

import numpy as np

from jaxid.references.family import Family, Grid, is_number_list, number_list
from jaxid.schema import Key, number


def _sample(values: dict[str, Any], grid: Grid) -> np.ndarray:
    sine, cosine = values["sine"], values["cosine"]
    harmonics = max(len(sine), len(cosine))
    if not harmonics:
        raise grid.fault("neither sine nor cosine is given", "give the coefficients of one of them")
    highest = harmonics * values["base_frequency_hz"]
    if highest >= grid.rate_hz / 2.0:
        hint = "lower base_frequency_hz, give fewer coefficients or raise the sampling rate"
        what = f"harmonic {harmonics} at {highest:g} Hz is beyond half the sampling rate"
        raise grid.fault(what, hint)
    angle = 2.0 * np.pi * values["base_frequency_hz"] * grid.time
    position = np.full(grid.samples, values["offset"])
    for k, coefficient in enumerate(sine, start=1):
        position += coefficient * np.sin(k * angle)
    for k, coefficient in enumerate(cosine, start=1):
        position += coefficient * np.cos(k * angle)
    return position


_COEFFICIENTS = number_list(1)

FOURIER = Family(
    kind="fourier",
    doc="offset + sum over k of sine[k] sin(2 pi k f t) + cosine[k] cos(2 pi k f t)",
    keys={
        "base_frequency_hz": Key(number("positive"), "frequency of the first harmonic", True, "Hz"),
        "sine": Key(
            _COEFFICIENTS, "coefficients of the sines", unit="position", default=(), single=is_number_list
        ),
        "cosine": Key(
            _COEFFICIENTS, "coefficients of the cosines", unit="position", default=(), single=is_number_list
        ),
        "offset": Key(number(), "mean", unit="position", default=0.0),
    },
    sample=_sample,
)
