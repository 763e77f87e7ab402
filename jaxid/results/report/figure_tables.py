"""The numbers of a figure as a table, for readers who want them or cannot see the figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from jaxid.results.report.numbers import short

# Rows of a table; a line of more points is given by its range in so many stretches.
_ROWS = 40
# Fewest points of a line that are no decoration.
_FEWEST = 2


@dataclass(frozen=True)
class FigureTable:
    """The numbers of one panel.

    Args:
        title: Name of the panel; empty for the only one.
        heads: Names of the columns, with units.
        rows: Cells as text.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables_of(figure: Figure) -> tuple[FigureTable, ...]:
    """Return a table for each panel of a figure that has lines or bars; clouds of dots are left out."""
    out = []
    shared = _shared_label(figure.axes)
    for ax in figure.axes:
        table = _bars(ax) or _lines(ax, shared)
        out += [table] if table is not None else []
    return tuple(out)


def _shared_label(axes: Sequence[Axes]) -> str:
    """Return the label of an abscissa that only the lowest panel shows."""
    labels = [ax.get_xlabel() for ax in axes if ax.get_xlabel()]
    return labels[-1] if labels else ""


def _title(ax: Axes) -> str:
    texts: list[str] = [ax.get_title(loc) for loc in ("left", "center", "right")]
    return " ".join([*[t for t in texts if t], ax.get_ylabel()]).replace("\n", " ").strip()


def _lines(ax: Axes, shared: str) -> FigureTable | None:
    # Lines across the whole panel and clouds of dots are not data.
    drawn = [line for line in ax.lines if line.get_transform() == ax.transData]
    drawn = [line for line in drawn if line.get_linestyle() not in ("None", "", " ") or _few(line)]
    drawn = [line for line in drawn if len(np.ravel(line.get_xdata())) >= _FEWEST]
    if not drawn:
        return None
    x_name = (ax.get_xlabel() or shared).replace("\n", " ")
    lines = [(_label(line, k), *_data(line)) for k, line in enumerate(drawn)]
    first = lines[0][1]
    if len(first) <= _ROWS and all(len(x) == len(first) and np.array_equal(x, first) for _, x, _ in lines):
        heads = (x_name, *[name for name, *_ in lines])
        rows = [tuple(_text(v) for v in (x, *[y[k] for *_, y in lines])) for k, x in enumerate(first)]
        return FigureTable(_title(ax), heads, tuple(rows))
    heads = (f"{x_name}, from", "to", *[f"{name}, {end}" for name, *_ in lines for end in ("least", "most")])
    low, high = min(x.min() for _, x, _ in lines if x.size), max(x.max() for _, x, _ in lines if x.size)
    edges = np.linspace(low, high, _ROWS // 2 + 1)
    rows = []
    for start, end in zip(edges, edges[1:], strict=False):
        cells = [start, end]
        for _, x, y in lines:
            inside = y[(x >= start) & (x <= end)]
            cells += [inside.min(), inside.max()] if inside.size else [np.nan, np.nan]
        rows.append(tuple(_text(v) for v in cells))
    return FigureTable(_title(ax), heads, tuple(rows))


def _few(line: Line2D) -> bool:
    return len(np.ravel(line.get_xdata())) <= _ROWS


def _label(line: Line2D, number: int) -> str:
    name = str(line.get_label())
    return f"line {number + 1}" if name.startswith("_") else name


def _data(line: Line2D) -> tuple[np.ndarray, np.ndarray]:
    x, y = (np.asarray(v, float).ravel() for v in (line.get_xdata(), line.get_ydata()))
    good = np.isfinite(x) & np.isfinite(y)
    return x[good], y[good]


def _bars(ax: Axes) -> FigureTable | None:
    """Return the lengths of horizontal bars, by the names at the left."""
    if not ax.containers or not ax.patches:
        return None
    names: list[Text] = ax.get_yticklabels()
    texts = [name.get_text() for name in names]
    # The numbers beside the bars are exact where a bar is cut.
    beside = {round(note.xy[1]): note.get_text() for note in ax.texts if hasattr(note, "xy")}  # pyright: ignore[reportAttributeAccessIssue]  # annotations
    if not beside or len(texts) != len(beside):
        return None
    rows = tuple((text, beside[k]) for k, text in enumerate(texts) if k in beside)
    return FigureTable(_title(ax), ("", ax.get_xlabel()), rows)


def _text(value: float) -> str:
    return short(value, 4) if np.isfinite(value) else "–"
