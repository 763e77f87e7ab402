"""The figures of a report, one function each.

Functions `plot_*` return `matplotlib.figure.Figure` objects and leave pyplot's state alone; functions
`draw_*` draw on axes that they are given. The colours are those of Okabe and Ito, which colour-blind
readers can distinguish.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxid.results.report.axes import FONT, TEXT, bucket_count, dress, legend, span, time_axes, time_label
from jaxid.results.report.curves import binned_mean, drawable, envelope, segments, thinned
from jaxid.results.report.data import CandidateScore, ExperimentView, LogView, SearchStep, WherePlot
from jaxid.results.report.numbers import is_number, nats, scaled_unit, short

MEASURED = "#8a8a8a"
BEFORE = "#d55e00"
AFTER = "#0072b2"
_IDLE = "#b4bcc4"
# Darker shades for the means, which are drawn on a cloud of the same colour.
_DARK = {BEFORE: "#7a3600", AFTER: "#00344f"}
_MOST_POINTS = 4000
_FEW = 200
# Pieces of a line over time on axes of the user's, whose width may change: that of the widest of a report.
_MANY = bucket_count((11.5, 4.8))
_JOINTS = (AFTER, "#009e73", "#cc79a7", "#56b4e9")


def plot_fit(view: LogView, units: Mapping[str, str], *, size: tuple[float, float] = (11.5, 4.8)) -> Figure:
    """Draw measured and simulated position over time, with the difference below.

    Args:
        view: The log; without simulated positions only the measured one is drawn.
        units: Labels of "position" and "time".
        size: Width and height [inch].

    Returns:
        The figure.
    """
    return _compared(view, drawable(view.position_measured), _simulated(view), "position", units, size)


def plot_drive(view: LogView, units: Mapping[str, str], *, size: tuple[float, float] = (11.5, 4.8)) -> Figure:
    """Draw the declared force of the drive over time, as logged and as the simulated loop commands it.

    Args:
        view: The log; it must have both.
        units: Labels of "force" and "time".
        size: Width and height [inch].

    Returns:
        The figure, with the difference below.
    """
    if view.drive_measured is None or view.drive_simulated is None:
        raise ValueError(f"log {view.name!r} has no force of the drive to compare.")
    simulated = [("simulated", AFTER, drawable(view.drive_simulated))]
    return _compared(view, drawable(view.drive_measured), simulated, "force", units, size)


def _compared(
    view: LogView,
    measured: np.ndarray,
    simulated: Sequence[tuple[str, str, np.ndarray]],
    what: str,
    units: Mapping[str, str],
    size: tuple[float, float],
) -> Figure:
    """Draw a measured quantity and lines beside it over time, with the differences below."""
    figure, top, below = time_axes(size, 2 if simulated else 1, ratios=(3, 2))
    many = bucket_count(size)
    _draw_compared(top, view, measured, simulated, what, units, many)
    if below is not None:
        top.set_xlabel("")
        _draw_difference(below, view, measured, simulated, what, units, many)
    return figure


def _draw_compared(
    ax: Axes,
    view: LogView,
    measured: np.ndarray,
    simulated: Sequence[tuple[str, str, np.ndarray]],
    what: str,
    units: Mapping[str, str],
    many: int,
) -> None:
    """Draw a measured quantity and its simulations over time."""
    factor, unit = scaled_unit(units[what], [measured])
    ax.plot(*envelope(view.time, measured / factor, many), color=MEASURED, lw=3.0, label="measured")
    for label, color, line in simulated:
        ax.plot(*envelope(view.time, line / factor, many), color=color, lw=1.1, label=label)
    span(ax, view)
    dress(ax, time_label(units), f"{what} [{unit}]")
    legend(ax)


def _draw_difference(
    ax: Axes,
    view: LogView,
    measured: np.ndarray,
    simulated: Sequence[tuple[str, str, np.ndarray]],
    what: str,
    units: Mapping[str, str],
    many: int,
) -> None:
    """Draw measured minus simulated over time."""
    small, unit = scaled_unit(units[what], [measured - line for *_, line in simulated])
    for label, color, line in simulated:
        gap = (measured - line) / small
        ax.plot(*envelope(view.time, gap, many), color=color, lw=1.1, label=label)
    ax.axhline(0.0, color=TEXT, lw=0.6, zorder=0)
    dress(ax, time_label(units), f"measured −\nsimulated [{unit}]")


def draw_fit(ax: Axes, view: LogView, units: Mapping[str, str]) -> None:
    """Draw the measured and the simulated position over time on one axes.

    Args:
        ax: The axes to draw on.
        view: The log; without simulated positions only the measured one is drawn.
        units: Labels of "position" and "time".
    """
    measured, lines = drawable(view.position_measured), _simulated(view)
    _draw_compared(ax, view, measured, lines, "position", units, _MANY)


def draw_difference(ax: Axes, view: LogView, units: Mapping[str, str]) -> None:
    """Draw measured minus simulated position over time on one axes.

    Args:
        ax: The axes to draw on.
        view: The log; it must have a simulated position.
        units: Labels of "position" and "time".
    """
    measured, lines = drawable(view.position_measured), _simulated(view)
    _draw_difference(ax, view, measured, lines, "position", units, _MANY)
    span(ax, view)
    legend(ax)


def draw_force(ax: Axes, view: LogView, units: Mapping[str, str], *, many: int = _MANY) -> None:
    """Draw the measured force over time on one axes.

    Args:
        ax: The axes to draw on.
        view: The log.
        units: Labels of "force" and "time".
        many: Pieces into which the line is cut before it is thinned.
    """
    factor, unit = scaled_unit(units["force"], [view.force_measured])
    line = envelope(view.band_time, np.asarray(view.force_measured) / factor, many)
    ax.plot(*line, color=MEASURED, lw=1.0)
    span(ax, view)
    dress(ax, time_label(units), f"force\nmeasured [{unit}]")


def draw_residual(
    ax: Axes,
    view: LogView,
    units: Mapping[str, str],
    *,
    noise_floor: float | None = None,
    many: int = _MANY,
) -> None:
    """Draw the force residual over time on one axes.

    Args:
        ax: The axes to draw on.
        view: The log; it must have a residual.
        units: Labels of "force" and "time".
        noise_floor: RMS that sensor noise alone leaves, drawn as a pair of lines; may be None.
        many: Pieces into which each line is cut before it is thinned.
    """
    residuals = _residuals(view)
    small, small_unit = scaled_unit(units["force"], [r[2] for r in residuals])
    for label, color, residual in residuals:
        line = envelope(view.band_time, residual / small, many)
        ax.plot(*line, color=color, lw=0.9, label=label)
    if noise_floor is not None and is_number(noise_floor):
        style = {"color": TEXT, "lw": 0.9, "ls": (0, (4, 3))}
        ax.axhline(-noise_floor / small, **style)
        ax.axhline(noise_floor / small, **style, label="± noise floor (RMS)")
    ax.axhline(0.0, color=TEXT, lw=0.6, zorder=0)
    dress(ax, time_label(units), f"force residual [{small_unit}]")
    legend(ax)


def plot_residual_against(
    view: LogView,
    units: Mapping[str, str],
    *,
    variables: Sequence[str] = ("velocity", "position", "time"),
    size: tuple[float, float] | None = None,
) -> Figure:
    """Draw the force residual against other quantities: before above, after below, on one scale.

    Args:
        view: The log.
        units: Labels of "force" and of the variables.
        variables: Abscissas among "velocity", "position" and "time", one column each.
        size: Width and height [inch]; by default by the number of panels.

    Returns:
        The figure: samples as dots, their mean over bins as a line.

    Raises:
        ValueError: If the log has no residual at all.
    """
    residuals = _residuals(view)
    if not residuals:
        raise ValueError(f"log {view.name!r} has no force residual to plot.")
    rows, columns = len(residuals), len(variables)
    size = size or (4.3 * columns, 0.7 + 1.75 * rows)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharey=True, sharex="col", squeeze=False)
    small, unit = scaled_unit(units["force"], [r[2] for r in residuals])
    for column, variable in enumerate(variables):
        x, factor, x_unit = _abscissa(view, variable, units)
        for row, (label, color, residual) in enumerate(residuals):
            ax = axes[row, column]
            _cloud(ax, x / factor, residual / small, color, _groups(variable, x), "mean")
            name = f"{variable} [{x_unit}]" if row == rows - 1 else ""
            dress(ax, name, f"residual [{unit}]" if column == 0 else "")
            ax.set_title(label, loc="left", fontsize=FONT, color=color, fontweight="bold")
    return figure


def draw_residual_against(
    ax: Axes, view: LogView, units: Mapping[str, str], variable: str = "velocity"
) -> None:
    """Draw the force residual against one quantity on one axes: samples as dots, their mean as a line.

    Args:
        ax: The axes to draw on.
        view: The log; it must have a residual.
        units: Labels of "force" and of the variable.
        variable: One of "velocity", "position" and "time".
    """
    residuals = _residuals(view)
    small, unit = scaled_unit(units["force"], [r[2] for r in residuals])
    x, factor, x_unit = _abscissa(view, variable, units)
    for label, color, residual in residuals:
        _cloud(ax, x / factor, residual / small, color, _groups(variable, x), label)
    dress(ax, f"{variable} [{x_unit}]", f"force residual [{unit}]")
    legend(ax)


def _abscissa(view: LogView, variable: str, units: Mapping[str, str]) -> tuple[np.ndarray, float, str]:
    """Return a quantity of a view, the factor of its unit's prefix, and the label of that unit."""
    if variable == "time":
        return np.asarray(view.band_time), *scaled_unit(units["time"], [])
    x = np.asarray(getattr(view, variable))
    return x, *scaled_unit(units[variable], [x])


def ranked(step: SearchStep) -> list[CandidateScore]:
    """Order the candidates of a step, best first; those that could not be fitted come last."""

    def key(candidate: CandidateScore) -> float:
        return -candidate.evidence if is_number(candidate.evidence) else np.inf

    return sorted(step.candidates, key=key)


def plot_candidates(step: SearchStep) -> Figure:
    """Draw the evidence of all candidates of one step, best first, against the threshold.

    Args:
        step: The step; candidates that could not be fitted are listed without a bar.

    Returns:
        The figure.
    """
    height = 0.95 + 0.235 * max(len(step.candidates), 1)
    figure = Figure(figsize=(4.9, height), layout="constrained")
    draw_candidates(figure.add_subplot(), step)
    return figure


def draw_candidates(ax: Axes, step: SearchStep) -> None:
    """Draw the evidence of all candidates of one step on one axes.

    Args:
        ax: The axes to draw on.
        step: The step; candidates that could not be fitted are listed without a bar.
    """
    candidates = ranked(step)
    scores = np.array([c.evidence if is_number(c.evidence) else 0.0 for c in candidates])
    right = max(scores.max(initial=0.0), step.threshold, 1e-9)
    # A candidate with a large loss must not compress the other bars.
    left = max(scores.min(initial=0.0), -0.5 * right)

    rows = np.arange(len(candidates))
    colors = [AFTER if c.accepted else _IDLE for c in candidates]
    ax.barh(rows, np.maximum(scores, left), color=colors, height=0.68)
    for row, (candidate, score) in enumerate(zip(candidates, scores, strict=True)):
        text = nats(candidate.evidence) if is_number(candidate.evidence) else "not fitted"
        text += " (bar cut)" if score < left else ""
        weight = "bold" if candidate.accepted else "normal"
        style = {"fontsize": FONT - 1, "color": TEXT, "va": "center", "fontweight": weight}
        # On white, as the threshold's line may pass behind it.
        style["bbox"] = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
        at = (max(score, 0.0), row)
        ax.annotate(text, at, (4, 0), textcoords="offset points", **style)

    ax.axvline(step.threshold, color=BEFORE, lw=1.2, ls=(0, (4, 3)))
    ax.axvline(0.0, color=TEXT, lw=0.6)
    ax.set_title(f"threshold {short(step.threshold)}", loc="right", fontsize=FONT - 0.5, color=_DARK[BEFORE])
    ax.set_xlim(left * 1.05, right * 1.18)
    ax.set_ylim(len(candidates) - 0.4, -0.6)
    dress(ax, "evidence: gain in held-out log-likelihood [nats]", "")
    ax.set_yticks(rows, [c.kind for c in candidates], fontsize=FONT - 0.5)
    ax.grid(axis="y", visible=False)


def plot_where(
    plot: WherePlot | tuple, units: Mapping[str, str], region: Sequence[float] | None = None
) -> Figure:
    """Draw the residual's mean over one variable, and the region in which it is significant.

    Args:
        plot: The bins.
        units: Label of "force".
        region: The two ends of the stretch where the residual stands out; may be None.

    Returns:
        The figure.
    """
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    draw_where(figure.add_subplot(), plot, units, region)
    return figure


def draw_where(
    ax: Axes, plot: WherePlot | tuple, units: Mapping[str, str], region: Sequence[float] | None = None
) -> None:
    """Draw the residual's mean over one variable on one axes.

    Args:
        ax: The axes to draw on.
        plot: The bins.
        units: Label of "force".
        region: The two ends of the stretch where the residual stands out; may be None.
    """
    plot = plot if isinstance(plot, WherePlot) else WherePlot(*plot)
    small, unit = scaled_unit(units["force"], [plot.mean, plot.low, plot.high])
    factor, x_unit = scaled_unit(plot.unit, [plot.x])
    x = np.asarray(plot.x) / factor
    mean, low, high = (drawable(v) / small for v in (plot.mean, plot.low, plot.high))
    if region is not None and len(region) == 2 and all(is_number(r) for r in region):
        ends = [r / factor for r in region]
        ax.axvspan(*ends, color="#f0e442", alpha=0.28, lw=0, label="region named")
    ax.fill_between(x, low, high, color=BEFORE, alpha=0.25, lw=0, label="confidence band")
    ax.plot(x, mean, color=BEFORE, lw=1.4, marker="o", ms=3, label="mean residual")
    ax.axhline(0.0, color=TEXT, lw=0.6, zorder=0)
    dress(ax, f"{plot.variable} [{x_unit}]", f"force residual [{unit}]")
    legend(ax)


def plot_experiment(
    view: ExperimentView, units: Mapping[str, str], *, size: tuple[float, float] = (11.5, 4.8)
) -> Figure:
    """Draw a proposed signal over time within its limits, and below a reference its speed.

    Args:
        view: The experiment, with its values.
        units: Labels of "velocity" and "time".
        size: Width and height [inch].

    Returns:
        The figure.
    """
    if view.values is None:
        raise ValueError("the experiment has no values to plot.")
    figure, top, below = time_axes(size, 1 if view.speed is None else 2, ratios=(3, 2))
    many, joints = bucket_count(size), view.values.shape[1]
    factor, unit = scaled_unit(view.unit, [view.values])
    for k, values in enumerate(view.values.T):
        name = view.signal if joints == 1 else f"{view.signal}, joint {k + 1}"
        top.plot(*envelope(view.time, values / factor, many), lw=1.2, label=name, color=_JOINTS[k % 4])
    _limits(top, view.limits / factor)
    dress(top, "" if view.speed is not None else time_label(units), f"{view.signal} [{unit}]")
    legend(top)
    if view.speed is not None:
        speed = np.gradient(view.values, view.time, axis=0)
        factor, unit = scaled_unit(units["velocity"], [speed])
        for k, values in enumerate(speed.T):
            below.plot(*envelope(view.time, values / factor, many), lw=1.0, color=_JOINTS[k % 4])
        _limits(below, np.stack([-view.speed, view.speed], axis=1) / factor)
        dress(below, time_label(units), f"velocity [{unit}]")
    return figure


def _limits(ax: Axes, limits: np.ndarray) -> None:
    """Draw dashed lines at the ends of every joint's range."""
    for k, value in enumerate(np.unique(limits)):
        ax.axhline(value, color=BEFORE, lw=1.0, ls=(0, (4, 3)), label="limits" if k == 0 else None)


def _simulated(view: LogView) -> list[tuple[str, str, np.ndarray]]:
    before, after = view.position_simulated_before, view.position_simulated_after
    return _present((("simulated before", BEFORE, before), ("after", AFTER, after)), "simulated")


def _residuals(view: LogView) -> list[tuple[str, str, np.ndarray]]:
    both = (("before", BEFORE, view.residual_before), ("after", AFTER, view.residual_after))
    return _present(both, "residual")


def _present(
    lines: Sequence[tuple[str, str, np.ndarray | None]], alone: str
) -> list[tuple[str, str, np.ndarray]]:
    """Return the lines that have values; a single one, neither before nor after another, under a name."""
    present = [(label, color, drawable(line)) for label, color, line in lines if line is not None]
    return present if len(present) > 1 else [(alone, color, line) for _, color, line in present]


def _groups(variable: str, x: np.ndarray) -> np.ndarray | None:
    """Assign numbers to the stretches over which a mean may be drawn as one line."""
    if variable == "time":
        return segments(np.asarray(x))
    # Dry friction jumps when the velocity changes its sign.
    return (np.asarray(x) >= 0.0).astype(int) if variable == "velocity" else None


def _cloud(
    ax: Axes, x: np.ndarray, y: np.ndarray, color: str, groups: np.ndarray | None, label: str | None = None
) -> None:
    """Draw samples as dots, and their mean over bins as a line."""
    some = thinned(len(x), _MOST_POINTS)
    # As an image, because thousands of dots would be megabytes of SVG; a few dots are drawn one by one.
    few = len(x) <= _FEW
    size, alpha = (6.0, 0.7) if few else (2.8, 0.4)
    ax.plot(x[some], y[some], ".", color=color, mew=0, rasterized=not few, ms=size, alpha=alpha)
    ax.axhline(0.0, color=TEXT, lw=0.6)
    ax.plot(*binned_mean(x, y, bins=60, group=groups), color=_DARK[color], lw=1.8, label=label)
