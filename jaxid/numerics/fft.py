"""Transforms of real signals, typed as arrays: scipy's, or JAX's in compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.fft

from jaxid.arrays import Array, library


def fast_length(least: int) -> int:
    """Return the smallest length from `least` on whose real transform is fast."""
    return int(scipy.fft.next_fast_len(least, real=True))  # pyright: ignore[reportArgumentType]  # stubs: None


def rfft(x: Array, length: int | None = None, axis: int = -1) -> Any:
    """Return the transform of a real signal, padded with zeros to a length if one is given."""
    xp = library(x)
    return np.asarray(scipy.fft.rfft(x, length, axis=axis)) if xp is np else xp.fft.rfft(x, length, axis=axis)


def irfft(spectrum: Array, length: int | None = None, axis: int = -1) -> Any:
    """Return the real signal of a spectrum."""
    xp = library(spectrum)
    if xp is np:
        return np.asarray(scipy.fft.irfft(spectrum, length, axis=axis))
    return xp.fft.irfft(spectrum, length, axis=axis)
