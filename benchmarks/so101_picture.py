"""Picture of motions of the SO-101 that no fit has seen: measured, by the community's file, and by jaxid."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

# Size of the picture and of a panel, and places of the first panel [units of the view box].
WIDTH, HEIGHT, PANEL = 840, 660, 204
LEFT, RIGHT, TOP, GAP = 70, 24, 100, 88
# Most points of a curve.
POINTS = 500
# Curves from back to front: key, words, colour, width.
CURVES = (
    ("file", "the file that people use", "#d9822b", 3.0),
    ("measured", "measured", "#1b1b1b", 5.0),
    ("corrected", "by jaxid", "#2f7fd6", 2.6),
)
FONT = "font-family='Helvetica, Arial, sans-serif'"


def picture(
    content: dict[str, Any], shown: Sequence[tuple[str, int, int, int]], joints: Sequence[str], row: float
) -> str:
    """Return an SVG with a panel for each motion shown; those without a fitted curve are left out.

    Args:
        content: What `benchmarks.so101` has found.
        shown: Motion, joint (1-based), first and last row of each panel.
        joints: Names of the joints.
        row: Time between two rows [s].
    """
    panels = []
    records = {r["joint"]: r for r in content["joints"]}
    for name, joint, *_ in shown:
        curves = dict(content["compared"]["shown"][name])
        if name in records.get(joint, {}).get("shown", {}):
            curves["corrected"] = records[joint]["shown"][name]
        words = f"{joints[joint - 1]}, {name}".replace("_", " ")
        panels.append((words, {k: np.degrees(np.asarray(v)) for k, v in curves.items()}))
    body = [legend()]
    for k, (words, curves) in enumerate(panels):
        body.append(panel(words, curves, row, TOP + k * (PANEL + GAP)))
    head = f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' role='img'>"
    title = "<title>Two joints of an SO-101: measured, simulated by the community's file and by jaxid</title>"
    paper = f"<rect width='{WIDTH}' height='{HEIGHT}' rx='10' fill='#ffffff'/>"
    return "\n".join([head, title, paper, *body, "</svg>"]) + "\n"


def legend() -> str:
    """Return the names of the curves in their colours."""
    out, x = [], LEFT
    for _, words, colour, width in (CURVES[1], CURVES[0], CURVES[2]):
        out.append(
            f"<path d='M{x} 36h34' stroke='{colour}' stroke-width='{width + 1}' stroke-linecap='round'/>"
        )
        out.append(text(words, x + 44, 44, "start", 24))
        x += 44 + 11 * len(words) + 40
    return "\n".join(out)


def panel(words: str, curves: dict[str, Float[np.ndarray, " rows"]], row: float, top: float) -> str:
    """Return one panel with its axes.

    Args:
        words: Its title.
        curves: Angles by curve [degrees].
        row: Time between two rows [s].
        top: Its upper edge.
    """
    count = len(next(iter(curves.values())))
    every = np.concatenate([curves[key] for key, *_ in CURVES if key in curves])
    low, high = float(every.min()), float(every.max())
    low, high = low - 0.08 * (high - low), high + 0.08 * (high - low)

    def x(k: np.ndarray | float) -> np.ndarray:
        return LEFT + np.asarray(k) / (count - 1) * (WIDTH - LEFT - RIGHT)

    def y(angle: np.ndarray | float) -> np.ndarray:
        return top + (high - np.asarray(angle)) / (high - low) * PANEL

    out = [text(words, LEFT, top - 12, "start", 22, "#555555")]
    for mark in ticks(low, high):
        at = float(y(mark))
        out.append(f"<path d='M{LEFT} {at:.1f}H{WIDTH - RIGHT}' stroke='#e3e3e3' stroke-width='1.5'/>")
        out.append(text(f"{mark:g}°", LEFT - 10, at + 8, "end", 22))
    apart = next(s for s in (2, 5, 10, 20) if count * row / s < 6)
    for second in range(0, int(count * row) + 1, apart):
        at = min(float(x(second / row)), WIDTH - RIGHT - 8.0)
        out.append(text(f"{second} s", at, top + PANEL + 28, "middle", 22))
    for key, _, colour, width in CURVES:
        if key in curves:
            some = np.arange(0, count, -(-count // POINTS))
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x(some), y(curves[key][some]), strict=True))
            out.append(
                f"<polyline points='{points}' fill='none' stroke='{colour}' stroke-width='{width}' "
                "stroke-linejoin='round' stroke-linecap='round'/>"
            )
    return "\n".join(out)


def ticks(low: float, high: float) -> list[float]:
    """Return two to five round numbers between two values."""
    step = next(s for s in (0.5, 1, 2, 5, 10, 20, 50) if (high - low) / s <= 4.5)
    return [k * step for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def text(words: str, x: float, y: float, anchor: str, size: int, colour: str = "#333333") -> str:
    """Return a line of text."""
    style = f"{FONT} font-size='{size}' fill='{colour}' text-anchor='{anchor}'"
    return f"<text x='{x:.0f}' y='{y:.0f}' {style}>{words}</text>"
