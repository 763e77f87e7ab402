"""The history of a recursive estimate: each parameter over time, with its standard deviation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxid.results.report.axes import FONT, TEXT, dress, time_label
from jaxid.results.report.data import HistoryView
from jaxid.results.report.numbers import pretty_unit, scaled_unit

_VALUE = "#0072b2"
_UNDETERMINED = "#8a8a8a"
_RESIDUAL = "#d55e00"
# Fraction of the history that the scale ignores: the transient may be much larger than all that follows.
_SETTLED = 0.1
_MARGIN = 0.15
# Width that panels beside each other need [in].
_TWO = 8.0


def plot_history(
    view: HistoryView, units: Mapping[str, str], *, size: tuple[float, float] = (11.5, 2.2)
) -> Figure:
    """Draw every parameter over time in a separate panel, and the running residual in the last.

    Args:
        view: The history.
        units: Labels of "time" and "force".
        size: Width, and height of a row of panels at most [in].
    """
    columns = 2 if size[0] >= _TWO else 1
    rows = -(-(len(view.names) + 1) // columns)
    figure = Figure(figsize=(size[0], min(size[1], 2.2) * rows), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for ax, name in zip(axes, view.names, strict=False):
        draw_history(ax, view, units, name)
        ax.set_xlabel("")
    last = axes[len(view.names)]
    factor, unit = scaled_unit(units["force"], [view.residual])
    last.set_title("running residual (RMS)", loc="left", fontsize=FONT, color=TEXT, fontweight="bold")
    last.plot(view.time, view.residual / factor, color=_RESIDUAL, lw=1.2)
    last.set_ylim(bottom=0.0)
    dress(last, "", f"[{unit}]")
    for ax in axes[len(view.names) + 1 :]:
        ax.set_visible(False)
    for ax in axes[: len(view.names) + 1][-columns:]:
        ax.set_xlabel(time_label(units), fontsize=FONT, color=TEXT)
        ax.tick_params(labelbottom=True)
    return figure


def draw_history(ax: Axes, view: HistoryView, units: Mapping[str, str], name: str) -> None:
    """Draw one parameter over time on one axes, with a band of one standard deviation.

    Args:
        ax: The axes to draw on.
        view: The history.
        units: Label of "time".
        name: Name of the parameter.
    """
    k = list(view.names).index(name)
    ax.set_title(name, loc="left", fontsize=FONT, color=TEXT, fontweight="bold")
    _parameter(ax, view.time, view.value[:, k], view.std[:, k])
    dress(ax, time_label(units), f"[{pretty_unit(view.units[k]) or '1'}]")


def _parameter(ax: Axes, time: np.ndarray, value: np.ndarray, std: np.ndarray) -> None:
    """Draw a line with a band of one standard deviation, grey while only the start determines the value."""
    determined = np.isfinite(std)
    ax.plot(time, value, color=_UNDETERMINED, lw=1.0, ls=(0, (4, 3)))
    ax.plot(time, np.where(determined, value, np.nan), color=_VALUE, lw=1.3)
    ax.fill_between(time, value - std, value + std, color=_VALUE, alpha=0.25, lw=0)
    settled = slice(int(np.ceil(_SETTLED * len(time))), None)
    wide = np.nan_to_num(std[settled])
    ends = np.concatenate([value[settled] - wide, value[settled] + wide])
    ends = ends[np.isfinite(ends)]
    if ends.size and np.ptp(ends) > 0:
        margin = _MARGIN * np.ptp(ends)
        ax.set_ylim(ends.min() - margin, ends.max() + margin)
