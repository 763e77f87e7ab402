"""The figures of forces: measured and model over each other, and friction over velocity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxid.results.report.axes import FONT, TEXT, bucket_count, dress, legend, span, time_axes, time_label
from jaxid.results.report.curves import binned_mean, drawable, envelope
from jaxid.results.report.data import FrictionView, LogView
from jaxid.results.report.numbers import scaled_unit
from jaxid.results.report.plots import AFTER, MEASURED, draw_residual

# Most panels beside each other, and widths of several and of one [inch].
_COLUMNS = 4
_WIDE, _NARROW = 11.5, 4.6


def plot_forces(
    view: LogView,
    units: Mapping[str, str],
    *,
    noise_floor: float | None = None,
    size: tuple[float, float] = (11.5, 4.8),
) -> Figure:
    """Draw measured force and model force over each other, and below it their difference.

    Args:
        view: The log.
        units: Labels of "force" and "time".
        noise_floor: RMS that sensor noise alone leaves, drawn as a pair of lines; may be None.
        size: Width and height [inch].

    Returns:
        The figure; without a residual the measured force alone.
    """
    residual = view.residual_before is not None or view.residual_after is not None
    figure, top, below = time_axes(size, 2 if residual else 1, ratios=(3, 2))
    many = bucket_count(size)
    draw_forces(top, view, units, many=many)
    if below is not None:
        top.set_xlabel("")
        draw_residual(below, view, units, noise_floor=noise_floor, many=many)
    return figure


def draw_forces(ax: Axes, view: LogView, units: Mapping[str, str], *, many: int) -> None:
    """Draw measured force and model force over time on one axes.

    Args:
        ax: The axes to draw on.
        view: The log; without a residual the measured force is drawn alone.
        units: Labels of "force" and "time".
        many: Pieces into which each line is cut before it is thinned.
    """
    measured = drawable(view.force_measured)
    left = view.residual_after if view.residual_after is not None else view.residual_before
    factor, unit = scaled_unit(units["force"], [measured])
    ax.plot(*envelope(view.band_time, measured / factor, many), color=MEASURED, lw=3.0, label="measured")
    if left is not None:
        model = measured - drawable(left)
        ax.plot(*envelope(view.band_time, model / factor, many), color=AFTER, lw=1.1, label="model")
    span(ax, view)
    dress(ax, time_label(units), f"force [{unit}]")
    legend(ax)


def plot_frictions(
    views: Sequence[FrictionView], units: Mapping[str, str], *, columns: int = _COLUMNS
) -> Figure:
    """Draw the friction of each joint over its velocity, with its band and the samples of the log.

    Args:
        views: The joints, a panel each.
        units: Labels of "force" and "velocity".
        columns: Most panels beside each other.
    """
    columns = min(len(views), columns)
    rows = -(-len(views) // columns)
    width = _WIDE if columns > 1 else _NARROW
    size = (5.6, 3.5) if len(views) == 1 else (width, 2.4 * rows + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, view in zip(axes, views, strict=False):
        draw_friction(ax, view, {**units, **view.units})
        if len(views) > 1:
            ax.set_title(f"joint {view.joint + 1}", loc="left", fontsize=FONT, color=TEXT, fontweight="bold")
            ax.get_legend().remove()
            ax.xaxis.set_major_locator(MaxNLocator(4))
    if len(views) > 1:
        lines, labels = axes[0].get_legend_handles_labels()
        shown = figure.legend(lines, labels, loc="outside upper left", ncols=4, frameon=False, fontsize=FONT)
        _darken(shown)
    for ax in axes[len(views) :]:
        ax.remove()
    return figure


def draw_friction(ax: Axes, view: FrictionView, units: Mapping[str, str]) -> None:
    """Draw the friction of a joint over its velocity on one axes.

    Args:
        ax: The axes to draw on.
        view: The friction.
        units: Labels of "force" and "velocity".
    """
    measured = () if view.force_measured is None else (view.force_measured,)
    factor, unit = scaled_unit(units["force"], [view.force, *measured])
    speed, speed_unit = scaled_unit(units["velocity"], [view.velocity])

    if view.velocity_measured is not None and view.force_measured is not None:
        x, y = view.velocity_measured / speed, drawable(view.force_measured) / factor
        few = len(x) <= 200
        # A few rows are drawn on the curve, thousands of samples below it.
        style = (
            {"ms": 6.0, "color": TEXT, "zorder": 3} if few else {"ms": 2.8, "color": MEASURED, "alpha": 0.35}
        )
        ax.plot(x, y, ".", mew=0, rasterized=not few, label="samples", **style)
        if not few:
            mean = binned_mean(x, y, bins=60, group=(x >= 0).astype(int))
            ax.plot(*mean, color=TEXT, lw=1.2, ls=(0, (4, 2)), label="their mean")

    # The curve jumps at rest, and so is drawn in two halves.
    gap = int(np.searchsorted(view.velocity, 0.0))
    cut = lambda line: np.insert(line, gap, np.nan)
    x = cut(view.velocity / speed)
    if view.low is not None and view.high is not None:
        low, high = (cut(drawable(end) / factor) for end in (view.low, view.high))
        ax.fill_between(x, low, high, color=AFTER, alpha=0.25, lw=0, label="95 % band")
    ax.plot(x, cut(drawable(view.force) / factor), color=AFTER, lw=1.6, label="model")

    ax.axhline(0.0, color=TEXT, lw=0.6, zorder=0)
    dress(ax, f"velocity [{speed_unit}]", f"friction [{unit}]")
    place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.1, "ncols": 4}
    shown = ax.legend(frameon=False, fontsize=FONT, handlelength=1.6, columnspacing=1.2, **place)
    _darken(shown)


def _darken(shown: Legend) -> None:
    """Darken the dot of the samples in a legend: dots are pale where thousands of them overlap."""
    for handle in shown.legend_handles:
        if isinstance(handle, Line2D) and handle.get_label() == "samples":
            handle.set_alpha(1.0)
            handle.set_markersize(6.0)
