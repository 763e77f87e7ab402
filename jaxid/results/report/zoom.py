"""The lines of a figure as data of the page, for charts in which a reader zooms and reads values.

The page has each figure as a picture, which needs no script. On demand its script draws a chart, with uPlot.
"""

from __future__ import annotations

import base64
import hashlib
import json
from importlib import resources
from importlib.resources.abc import Traversable

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

# Levels of a value between the least and the most of its line, and the one that stands for a gap.
_LEVELS, _GAP = 65534, 65535
# A line of fewer points is decoration.
_FEWEST = 3
_SOLID = "-"


def charts_of(figure: Figure) -> str:
    """Return the panels of a figure with lines or dots on linear scales as JSON; empty if there are none.

    Each panel has the names of its axes and its series. A series has a label, a colour, whether it is `dots`
    and whether it is `dashed`. Both coordinates are `low`, `high`, and whole numbers of 16 bits between them.

    Args:
        figure: The figure.
    """
    shared = [ax.get_xlabel() for ax in figure.axes if ax.get_xlabel()]
    panels = []
    for ax in figure.axes:
        series = [] if ax.containers or {ax.get_xscale(), ax.get_yscale()} != {"linear"} else _series(ax)
        if series:
            x_name = ax.get_xlabel() or (shared[-1] if shared else "")
            y_name = ": ".join(filter(None, (ax.get_title("left"), ax.get_ylabel())))
            panels.append({"x": _plain(x_name), "y": _plain(y_name), "series": series})
    return json.dumps(panels, separators=(",", ":")) if panels else ""


def _series(ax: Axes) -> list[dict]:
    out = []
    for band in ax.collections:
        if isinstance(band, PolyCollection):
            out += _edges(band)
    for line in ax.lines:
        x, y = (np.asarray(v, float).ravel() for v in (line.get_xdata(), line.get_ydata()))
        if line.get_transform() != ax.transData or np.sum(np.isfinite(x) & np.isfinite(y)) < _FEWEST:
            continue
        label, style = str(line.get_label()), line.get_linestyle()
        dots = style in ("None", "", " ")
        shown = {
            "label": "" if label.startswith("_") else _plain(label),
            "color": to_hex(line.get_color()),
            "dots": dots,
            "dashed": not dots and style != _SOLID,
        }
        out.append(
            shown | {"at": _packed(_beside_gaps(x)), "value": _packed(np.where(np.isnan(x), np.nan, y))}
        )
    return out


def _beside_gaps(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the places of a line with those of its gaps between their neighbours."""
    known = np.flatnonzero(np.isfinite(x))
    return np.interp(np.arange(len(x)), known, x[known])


def _edges(band: PolyCollection) -> list[dict]:
    """Return the lower and the upper edge of a filled band."""
    out = []
    for path in band.get_paths():
        # The outline has a first point, one edge, a turning point, the other edge, and points that close it.
        corners = np.asarray(path.vertices)
        size = (len(corners) - 3) // 2
        if size < _FEWEST:
            continue
        edges = corners[1 : size + 1], corners[size + 2 : 2 * size + 2][::-1]
        shown = {
            "label": "",
            "color": to_hex(tuple(np.atleast_2d(np.asarray(band.get_facecolor()))[0])),
            "dots": False,
            "dashed": True,
        }
        out += [shown | {"at": _packed(edge[:, 0]), "value": _packed(edge[:, 1])} for edge in edges]
    return out


def _packed(values: Float[np.ndarray, " n"]) -> dict:
    """Return numbers as their range, and their place in it as whole numbers in base64."""
    finite = np.isfinite(values)
    low, high = (float(f(values[finite])) if finite.any() else 0.0 for f in (np.min, np.max))
    place = np.zeros(values.shape) if high == low else (np.where(finite, values, low) - low) / (high - low)
    whole = np.where(finite, np.rint(place * _LEVELS), _GAP).astype("<u2")
    return {"low": low, "high": high, "points": base64.b64encode(whole.tobytes()).decode("ascii")}


def _plain(text: str) -> str:
    return text.replace("\n", " ").strip()


def script() -> str:
    """Return the script of the page: uPlot, and the charts of the report."""
    folder = resources.files("jaxid.results.report")
    return _read(folder / "uplot" / "uPlot.js") + "\n" + _read(folder / "charts.js")


def script_style() -> str:
    """Return the style of uPlot."""
    return _read(resources.files("jaxid.results.report") / "uplot" / "uPlot.css")


def _read(file: Traversable) -> str:
    return file.read_text(encoding="utf-8")


def digest(text: str) -> str:
    """Return the digest by which the policy of the page allows this script and no other."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
