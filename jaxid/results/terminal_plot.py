"""A curve as text, for a terminal."""

from __future__ import annotations

import numpy as np


def terminal_plot(x: np.ndarray, y: np.ndarray, *, width: int = 60, height: int = 13) -> str:
    """Return points as a picture of characters, with the ends of both axes.

    Args:
        x: Abscissa, (N,).
        y: Ordinate, (N,).
        width: Number of columns of the picture.
        height: Number of its lines.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if x.size == 0:
        return "nothing to draw"
    low, high = float(y.min()), float(y.max())
    # A constant is a line in the middle.
    low, high = (low - 1.0, high + 1.0) if low == high else (low, high)
    left, right = float(x.min()), float(x.max())
    columns = np.rint((x - left) / ((right - left) or 1.0) * (width - 1)).astype(int)
    lines = np.rint((high - y) / (high - low) * (height - 1)).astype(int)
    canvas = np.full((height, width), " ")
    if low < 0 < high:
        canvas[round(high / (high - low) * (height - 1))] = "·"
    if left < 0 < right:
        canvas[:, round(-left / (right - left) * (width - 1))] = "·"
    canvas[lines, columns] = "●"
    ends = {0: f"{high:.3g}", height - 1: f"{low:.3g}"}
    margin = max(map(len, ends.values()))
    out = [f"{ends.get(k, '').rjust(margin)} │{''.join(row).rstrip()}" for k, row in enumerate(canvas)]
    out.append(f"{' ' * margin} └{'─' * width}")
    first, last = f"{left:.3g}", f"{right:.3g}"
    out.append(f"{' ' * (margin + 2)}{first}{last.rjust(width - len(first))}")
    return "\n".join(out)
