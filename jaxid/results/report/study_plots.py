"""The figures of a study: error against noise, coverage, and how errors spread."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import matplotlib.ticker
import numpy as np
import scipy.stats
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxid.results.report.axes import FONT, TEXT, dress
from jaxid.results.report.numbers import pretty_unit
from jaxid.studies.calibration import ecdf_band
from jaxid.studies.result import pits_of
from jaxid.studies.settings import widest, words_of

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f3c8d", "#6b6b6b")
# One more than colours, so that pairs of both repeat late.
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*", "<")
_COLUMNS = 3
Dash = str | tuple[int, tuple[int, ...]]
# Standard deviations beyond which errors are counted in the outermost bar.
_REACH = 4.5
_DASHES: tuple[Dash, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
_AXES = {
    "noise": "noise, times the sensor's",
    "sample_rate": "sampling rate [Hz]",
    "position_resolution": "resolution of the position [m or rad]",
}


def plot_errors(rows: Sequence[dict], columns: int = _COLUMNS) -> Figure:
    """Draw the RMS error of every estimator against the setting with most values, a panel a parameter.

    Dashes distinguish the other settings that vary.

    Args:
        rows: `Study.summary`.
        columns: Most panels beside each other.
    """
    names, panels, figure = _panels(rows, columns)
    for name, ax in zip(names, panels, strict=True):
        draw_errors(ax, rows, name)
    others = others_of(rows)
    several = [(other, _DASHES[o % len(_DASHES)]) for o, other in enumerate(others)]
    _legend(figure, panels[0], several if len(others) > 1 else [("reported σ", ":")])
    return figure


def draw_errors(ax: Axes, rows: Sequence[dict], name: str) -> None:
    """Draw the RMS error of every estimator for one parameter on one axes, with the bound.

    Args:
        ax: The axes to draw on.
        rows: `Study.summary`.
        name: Name of the parameter.
    """
    against, others = widest(rows), others_of(rows)
    of_name = [r for r in rows if r["parameter"] == name]
    at = np.array(sorted({r[against] for r in of_name}))
    for o, other in enumerate(others):
        # Of more than there are dashes, the later lines are thinner.
        dash, width = _DASHES[o % len(_DASHES)], 1.3 / (1 + o // len(_DASHES))
        here = [r for r in of_name if words_of(r, without=against) == other]
        for k, estimator in _estimators(rows, "rmse"):
            line = {r[against]: r for r in here if r["estimator"] == estimator}
            style = {**_look(k), "ls": dash, "lw": width}
            values = np.array([line[x]["rmse"] for x in at])
            ax.plot(at, values, label=None if o else estimator, **style)
            if len(others) == 1:
                stated = np.array([line[x]["std"] for x in at])
                ax.plot(at, stated, lw=0.9, ls=":", color=_look(k)["color"])
        bound = np.array([next(r["bound"] for r in here if r[against] == x) for x in at])
        if np.any(np.isfinite(bound)):
            dash = "--" if len(others) == 1 else dash
            label = None if o else "Cramér–Rao bound"
            ax.plot(at, bound, color=TEXT, lw=0.8 * width, ls=dash, label=label)
    _named(ax, name, _AXES[against], f"RMS error [{pretty_unit(of_name[0]['unit'])}]")
    _logarithmic(ax, at)


def plot_coverage(rows: Sequence[dict], columns: int = _COLUMNS) -> Figure:
    """Draw the part of the 95 % intervals that hold the truth, a panel a parameter.

    Args:
        rows: `Study.summary`.
        columns: Most panels beside each other.
    """
    names, panels, figure = _panels(rows, columns)
    for name, ax in zip(names, panels, strict=True):
        draw_coverage(ax, rows, name)
    _legend(figure, panels[0])
    return figure


def draw_coverage(ax: Axes, rows: Sequence[dict], name: str) -> None:
    """Draw the coverage of one parameter on one axes, with the scatter of that number of runs.

    Args:
        ax: The axes to draw on.
        rows: `Study.summary`.
        name: Name of the parameter.
    """
    against, others = widest(rows), others_of(rows)
    sides = list(itertools.product(_estimators(rows, "coverage_95"), range(len(others))))
    of_name = [r for r in rows if r["parameter"] == name]
    places = sorted({r[against] for r in of_name})
    for side, ((k, estimator), o) in enumerate(sides):
        line = {
            r[against]: r
            for r in of_name
            if r["estimator"] == estimator and words_of(r, without=against) == others[o] and r["used"]
        }
        step = min(0.12, 0.8 / len(sides))
        at = np.array([places.index(x) for x in line]) + step * (side - 0.5 * (len(sides) - 1))
        held = np.array([r["coverage_95"] for r in line.values()])
        ends = np.array([_proportion(r["coverage_95"], r["used"]) for r in line.values()]).reshape(-1, 2)
        style = _look(k)
        ax.vlines(at, 100 * ends[:, 0], 100 * ends[:, 1], color=style["color"], lw=1.2)
        ax.plot(at, 100 * held, ls="", label=None if o else estimator, **style)
    ax.axhline(95.0, color=TEXT, lw=0.9, ls="--", zorder=0, label="nominal")
    _named(ax, name, _AXES[against], "in the 95 % interval [%]")
    ax.set_ylim(0, 103)
    ax.set_xlim(-0.5, len(places) - 0.5)
    ax.set_xticks(range(len(places)), [f"{x:g}" for x in places])


def plot_scatter(table: xr.Dataset, columns: int = _COLUMNS) -> Figure:
    """Draw the errors of all runs under one setting in units of their reported deviation.

    Args:
        table: `Study.table` under that setting.
        columns: Most panels beside each other.
    """
    names = [str(n) for n in table.parameter.values]
    figure, panels = _grid(len(names), columns)
    for name, ax in zip(names, panels, strict=True):
        draw_scatter(ax, table, name)
    _legend(figure, panels[0])
    return figure


def draw_scatter(ax: Axes, table: xr.Dataset, name: str) -> None:
    """Draw the errors of one parameter under one setting on one axes.

    Args:
        ax: The axes to draw on.
        table: `Study.table` under that setting.
        name: Name of the parameter.
    """
    reach = np.linspace(-_REACH, _REACH, 200)
    of_name = table.isel(parameter=[str(n) for n in table.parameter.values].index(name))
    for i, estimator in enumerate(table.estimator.values):
        one = of_name.isel(estimator=i)
        used = one["converged"].values.astype(bool) & np.isfinite(one["std"].values)
        z = ((one["estimate"] - one["truth"]) / one["std"]).values[used]
        if len(z):
            ends = np.linspace(-_REACH, _REACH, max(11, min(41, 2 * int(np.sqrt(len(z))) + 1)))
            style = {"color": _look(i)["color"], "lw": 1.4, "histtype": "step", "density": True}
            ax.hist(np.clip(z, -_REACH, _REACH), ends.tolist(), label=str(estimator), **style)
    ax.plot(reach, scipy.stats.norm.pdf(reach), color=TEXT, lw=0.9, ls="--", label="as reported")
    _named(ax, name, "error / its reported σ [-]", "density [-]")


def plot_ecdf(table: xr.Dataset, columns: int = _COLUMNS) -> Figure:
    """Draw the ECDF of the truth's place in the reported distribution, a panel a parameter; see `draw_ecdf`.

    Args:
        table: `Study.table` under one setting.
        columns: Most panels beside each other.
    """
    names = [str(n) for n in table.parameter.values]
    figure, panels = _grid(len(names), columns)
    for name, ax in zip(names, panels, strict=True):
        draw_ecdf(ax, table, name)
    _legend(figure, panels[0])
    return figure


def draw_ecdf(ax: Axes, table: xr.Dataset, name: str) -> None:
    """Draw the ECDF of one parameter minus the diagonal on one axes, with its simultaneous band.

    Args:
        ax: The axes to draw on.
        table: `Study.table` under one setting.
        name: Name of the parameter.
    """
    of_name = table.isel(parameter=[str(n) for n in table.parameter.values].index(name))
    pits = [pits_of(of_name.isel(estimator=i)) for i in range(len(table.estimator))]
    for i, pit in enumerate(pits):
        if len(pit):
            x = np.sort(pit)
            ends = np.concatenate([[0.0], np.repeat(x, 2), [1.0]])
            steps = np.concatenate([[0.0, 0.0], np.repeat(np.arange(1, len(x) + 1) / len(x), 2)])
            style = {"color": _look(i)["color"], "lw": 1.4}
            ax.plot(ends, steps - ends, label=str(table.estimator.values[i]), **style)
    most = max(len(pit) for pit in pits)
    if most:
        points, low, high = ecdf_band(most)
        for k, edge in enumerate((low, high)):
            ax.plot(points, edge, color=TEXT, lw=0.9, ls="--", label="95 % band" if k == 0 else None)
    ax.axhline(0.0, color=TEXT, lw=0.5)
    _named(ax, name, "place of the truth [-]", "ECDF minus diagonal [-]")
    ax.set_xlim(0, 1)


def others_of(rows: Sequence[dict]) -> list[str]:
    """Return the other settings in words; one empty text if nothing else is varied."""
    return list(dict.fromkeys(words_of(r, without=widest(rows)) for r in rows))


def _named(ax: Axes, name: str, xlabel: str, ylabel: str) -> None:
    """Label an axes, with the parameter above it: beside it a long name would run into the next panel."""
    dress(ax, xlabel, ylabel)
    ax.set_title(name, loc="left", fontsize=FONT, color=TEXT, fontweight="bold")


def _panels(rows: Sequence[dict], columns: int) -> tuple[list[str], list[Axes], Figure]:
    names = list(dict.fromkeys(r["parameter"] for r in rows))
    figure, panels = _grid(len(names), columns)
    return names, panels, figure


def _grid(count: int, columns: int) -> tuple[Figure, list[Axes]]:
    columns = min(count, columns)
    lines = -(-count // columns)
    figure = Figure(figsize=(3.8 * columns, 2.9 * lines + 0.5), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for ax in axes[count:]:
        ax.remove()
    return figure, list(axes[:count])


def _estimators(rows: Sequence[dict], what: str) -> list[tuple[int, str]]:
    """Return the estimators with a finite number, each with its position among all."""
    names = list(dict.fromkeys(r["estimator"] for r in rows))
    finite = {r["estimator"] for r in rows if np.isfinite(r[what])}
    return [(k, name) for k, name in enumerate(names) if name in finite]


def _look(k: int) -> dict:
    """Return the colour and mark of an estimator."""
    return {"color": COLOURS[k % len(COLOURS)], "marker": _MARKS[k % len(_MARKS)], "ms": 5}


def _logarithmic(ax: Axes, at: np.ndarray) -> None:
    ax.set_yscale("log")
    if len(at) > 1 and at.min() > 0:
        ax.set_xscale("log")
        ax.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    ax.set_xticks(at, [f"{n:g}" for n in at])


def _legend(figure: Figure, ax: Axes, more: Sequence[tuple[str, Dash]] = ()) -> None:
    handles, labels = ax.get_legend_handles_labels()
    for label, dash in more:
        handles.append(ax.plot([], [], color=TEXT, lw=0.9, ls=dash)[0])
        labels.append(label)
    # The number of columns that fit beside each other with the longest label.
    fits = int(figure.get_figwidth() / (0.6 + 0.075 * max(map(len, labels))))
    columns = max(1, min(4, fits))
    figure.legend(handles, labels, loc="outside upper left", ncols=columns, frameon=False, fontsize=FONT)


def _proportion(part: float, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a proportion by Wilson (1927)."""
    z = 1.96
    middle = (part + z**2 / (2 * of)) / (1 + z**2 / of)
    half = z / (1 + z**2 / of) * np.sqrt(part * (1 - part) / of + z**2 / (4 * of**2))
    return middle - half, middle + half
