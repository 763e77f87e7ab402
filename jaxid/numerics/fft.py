"""Transforms of real signals by scipy, typed as arrays."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray


def fast_length(least: int) -> int:
    """Return the smallest length from `least` on whose real transform is fast."""
    return int(scipy.fft.next_fast_len(least, real=True))  # pyright: ignore[reportArgumentType]  # stubs: None


def rfft(x: np.ndarray, length: int | None = None, axis: int = -1) -> NDArray[np.complex128]:
    """Return the transform of a real signal, padded with zeros to a length if one is given."""
    return np.asarray(scipy.fft.rfft(x, length, axis=axis))


def irfft(spectrum: np.ndarray, length: int | None = None, axis: int = -1) -> NDArray[np.float64]:
    """Return the real signal of a spectrum."""
    return np.asarray(scipy.fft.irfft(spectrum, length, axis=axis))
