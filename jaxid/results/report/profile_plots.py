"""The figure of profile likelihoods, beside the parabolas of the covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.interpolate
import scipy.stats
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxid.results.report.axes import TEXT, dress, legend
from jaxid.results.report.numbers import pretty_unit

_COLUMNS = 3
_BLUE = "#0072b2"


def plot_profiles(profiles: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw the profile of each unknown, a panel each.

    Args:
        profiles: The object `profiles` of result.json.
    """
    columns = min(len(profiles), _COLUMNS)
    lines = -(-len(profiles) // columns)
    figure = Figure(figsize=(3.8 * columns, 2.9 * lines), layout="constrained")
    axes: Sequence[Axes] = figure.subplots(lines, columns, squeeze=False).ravel().tolist()
    for ax, (name, entry) in zip(axes, profiles.items(), strict=False):
        draw_profile(ax, name, entry)
    for ax in axes[len(profiles) :]:
        ax.remove()
    legend(axes[0])
    return figure


def draw_profile(ax: Axes, name: str, entry: Mapping[str, Any]) -> None:
    """Draw one profile on one axes.

    Args:
        ax: The axes to draw on.
        name: Name of the unknown.
        entry: Its entry in `profiles`.
    """
    value, std = entry["value"], entry["std"]
    at = np.array([*entry["at"], value])
    rise = np.array([np.nan if r is None else r for r in entry["rise"]] + [0.0])
    order = np.argsort(at)
    at, rise = at[order], rise[order]
    known = np.isfinite(rise)
    if known.sum() > 2:
        # The signed root is nearly a line, and so is drawn without a wiggle.
        root = np.sign(at - value) * np.sqrt(np.maximum(rise, 0.0))
        fine = np.linspace(at[known][0], at[known][-1], 200)
        curve = scipy.interpolate.PchipInterpolator(at[known], root[known])(fine) ** 2
        ax.plot(fine, curve, color=_BLUE, lw=1.4, label="profile")
    ax.plot(at[known], rise[known], "o", color=_BLUE, ms=4)
    parabola = np.linspace(value - 3 * std, value + 3 * std, 200)
    ax.plot(parabola, ((parabola - value) / std) ** 2, color=TEXT, lw=0.9, ls="--", label="covariance")
    for level in (68, 95):
        height = float(scipy.stats.chi2.ppf(level / 100, 1))
        ax.axhline(height, color="#999999", lw=0.6)
        ax.annotate(f"{level} %", (1.0, height), xycoords=("axes fraction", "data"), fontsize=7, ha="right")
    ax.set_ylim(0, 12)
    dress(ax, f"{name} [{pretty_unit(entry['unit'])}]", "rise [-]")
