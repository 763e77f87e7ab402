"""A strip of frames: an arm as a stick figure at instants of a log, measured and simulated."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxid.results.report.axes import FONT, TEXT
from jaxid.results.report.data import PoseStrip
from jaxid.results.report.figure_tables import FigureTable
from jaxid.results.report.numbers import short
from jaxid.results.report.plots import AFTER, MEASURED

_MM = 1e3


def plot_poses(
    strip: PoseStrip, *, size: tuple[float, float] = (11.5, 4.0), columns: int = 8, first: str = "measured"
) -> Figure:
    """Draw an arm at some instants, from the side and from above, all in one scale.

    Args:
        strip: The poses.
        size: Width and height of the figure [inch].
        columns: Most frames beside each other; a row of them has both views.
        first: Name of the poses that a strip always has.
    """
    figure = Figure(figsize=size, layout="constrained")
    count = len(strip.time)
    groups = math.ceil(count / columns)
    panels = np.asarray(figure.subplots(2 * groups, min(columns, count), squeeze=False))
    along = _along(strip)
    views = [("from the side", along, strip.up), ("from above", along, np.cross(strip.up, along))]
    limits = [_limits(strip, right, upward) for _, right, upward in views]
    for frame in range(2 * groups * panels.shape[1]):
        row, column = divmod(frame, panels.shape[1])
        group, view = divmod(row, 2)
        k, ax = group * panels.shape[1] + column, panels[row, column]
        ax.set_axis_off()
        if k >= count:
            continue
        words, right, upward = views[view]
        _draw(ax, strip, k, right, upward)
        (left, low), (wide, high) = limits[view]
        ax.set(xlim=(left, wide), ylim=(low, high), aspect="equal")
        if view == 0:
            ax.set_title(f"{strip.time[k]:.2f} s", fontsize=FONT, color=TEXT)
        if column == 0:
            side = {"transform": ax.transAxes, "rotation": 90, "ha": "right", "va": "center"}
            ax.text(0.0, 0.5, words, fontsize=FONT - 1, color="#777777", **side)
    _legend(figure, panels[0, 0], limits[0], strip, first)
    return figure


def pose_table(strip: PoseStrip) -> FigureTable:
    """Return the place of the end at each instant, and how far the simulated one is from it."""
    heads = ["time [s]", *[f"end, {axis} [mm]" for axis in "xyz"]]
    ends = _MM * strip.measured[:, -1]
    columns = [strip.time, *ends.T]
    if strip.simulated is not None:
        heads += ["simulated end off by [mm]", "joint that is furthest off by [mm]"]
        off = _MM * np.linalg.norm(strip.simulated - strip.measured, axis=2)
        columns += [off[:, -1], off.max(axis=1)]
    rows = tuple(tuple(short(float(x), 4) for x in row) for row in zip(*columns, strict=True))
    return FigureTable("", tuple(heads), rows)


def _draw(ax: Axes, strip: PoseStrip, k: int, right: np.ndarray, upward: np.ndarray) -> None:
    drawn = [(strip.measured, MEASURED, 4.0)]
    if strip.simulated is not None:
        drawn.append((strip.simulated, AFTER, 1.4))
    for places, color, width in drawn:
        x, y = places[k] @ right, places[k] @ upward
        for a, b in strip.bones:
            ax.plot(x[[a, b]], y[[a, b]], color=color, lw=width, solid_capstyle="round")
        ax.plot(x[1:], y[1:], ".", color=color, ms=2.2 * width)
    ax.plot(0.0, 0.0, "s", color=TEXT, ms=4)


def _along(strip: PoseStrip) -> Float[np.ndarray, " 3"]:
    """Return the horizontal direction in which the arm reaches out most."""
    flat = strip.measured.reshape(-1, 3)
    flat = flat - np.outer(flat @ strip.up, strip.up)
    direction = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][0]
    direction = direction - (direction @ strip.up) * strip.up
    size = float(np.linalg.norm(direction))
    if size < 1e-9:  # it stands upright throughout
        direction = np.cross(strip.up, np.eye(3)[int(np.argmin(np.abs(strip.up)))])
        size = float(np.linalg.norm(direction))
    direction = direction / size
    # To the right is where the arm is most of the time.
    return direction if float(np.sum(flat @ direction)) >= 0 else -direction


def _limits(
    strip: PoseStrip, right: np.ndarray, upward: np.ndarray
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Return the corners of the frame that holds all poses, at most twice as large as the measured ones."""
    plane = np.stack([right, upward], axis=1)
    inside = strip.measured @ plane
    low, high = inside.min(axis=(0, 1)), inside.max(axis=(0, 1))
    margin = 0.08 * float(np.max(high - low))
    if strip.simulated is not None:
        other = strip.simulated @ plane
        most = 0.5 * (high - low)
        low = np.maximum(np.minimum(low, other.min(axis=(0, 1))), low - most)
        high = np.minimum(np.maximum(high, other.max(axis=(0, 1))), high + most)
    return low - margin, high + margin


def _legend(
    figure: Figure, ax: Axes, limits: tuple[np.ndarray, np.ndarray], strip: PoseStrip, first: str
) -> None:
    """Name the lines, and draw a bar of a round length."""
    (left, low), (wide, _) = limits
    length = 10.0 ** math.floor(math.log10(max(wide - left, 1e-9) / 2))
    ax.plot([left, left + length], [low, low], color=TEXT, lw=1.2, clip_on=False)
    text = f"{short(_MM * length)} mm" if length < 1 else f"{short(length)} m"
    below = {"xytext": (0.0, -3.0), "textcoords": "offset points", "va": "top", "annotation_clip": False}
    ax.annotate(text, (left, low), fontsize=FONT - 1, color=TEXT, **below)
    handles = [Line2D([], [], color=MEASURED, lw=4.0, label=first)]
    if strip.simulated is not None:
        handles.append(Line2D([], [], color=AFTER, lw=1.4, label="simulated"))
    figure.legend(handles=handles, loc="outside upper left", ncols=2, frameon=False, fontsize=FONT)
