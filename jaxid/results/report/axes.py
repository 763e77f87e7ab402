"""The common style of all axes of a report."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxid.results.report.data import LogView

TEXT = "#222222"
FONT = 9.0  # pt


def time_axes(size: tuple[float, float], rows: int, ratios: tuple[int, int]) -> tuple:
    """Make one plot over time, or two on one time axis; the second is None if there is one."""
    figure = Figure(figsize=size, layout="constrained")
    if rows == 1:
        figure.set_size_inches(size[0], 0.6 * size[1])
        return figure, figure.add_subplot(), None
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=ratios)
    figure.align_ylabels()
    return figure, top, below


def bucket_count(size: tuple[float, float]) -> int:
    """Return the number of pieces into which a line is cut before it is thinned."""
    # Chosen: about one bucket a pixel of the drawn width.
    return max(200, int(80 * size[0]))


def time_label(units: Mapping[str, str]) -> str:
    """Return the label of the time axis."""
    return f"time [{units['time']}]"


def span(ax: Axes, view: LogView) -> None:
    """Give all plots over time of one log the same ends, so that they can be compared."""
    start, end = float(view.time[0]), float(view.time[-1])
    margin = 0.01 * (end - start) or 0.5
    ax.set_xlim(start - margin, end + margin)


def legend(ax: Axes) -> None:
    """Put the legend above the plot, at the right where a title stands at the left."""
    loc, x = ("lower right", 1.0) if ax.get_title("left") else ("lower left", 0.0)
    place = {"loc": loc, "bbox_to_anchor": (x, 1.0), "borderaxespad": 0.1}
    style = {"frameon": False, "fontsize": FONT, "handlelength": 1.6, "columnspacing": 1.2}
    ax.legend(ncols=3, **place, **style)


def dress(ax: Axes, xlabel: str, ylabel: str) -> None:
    """Label an axes and give it the report's style."""
    ax.set_xlabel(xlabel, fontsize=FONT, color=TEXT)
    ax.set_ylabel(ylabel, fontsize=FONT, color=TEXT)
    ax.tick_params(labelsize=FONT - 0.5, color="#999999", labelcolor=TEXT)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("#999999")
    ax.grid(color="#e6e6e6", lw=0.7)
    ax.set_axisbelow(True)
    figure = ax.get_figure(root=True)
    narrow = figure is not None and figure.get_figwidth() < 8
    ax.xaxis.set_major_locator(MaxNLocator(6 if narrow else 12))
    ax.yaxis.set_major_locator(MaxNLocator(5))
