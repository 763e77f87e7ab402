"""The report of a comparison as one HTML page that needs neither network nor scripts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxid.comparison.result import Comparison, LogGap, Value
from jaxid.results.comparison import answer, comparison_notes, gap_rows, rival_words, value_rows
from jaxid.results.report.axes import TEXT, bucket_count, dress, legend, time_axes
from jaxid.results.report.curves import envelope
from jaxid.results.report.numbers import nats, plain, pretty_unit, scaled_unit, with_std
from jaxid.results.report.page import filled, image, with_narrow
from jaxid.results.report.plots import AFTER, BEFORE

_WIDE, _NARROW = (11.5, 3.0), (4.6, 4.6)  # inch; time_axes makes one plot lower
_CLASSES = {"same": "good", "differs": "open", "unexplained": "bad"}
# A false alarm that is less probable is not written with its exponent.
_NEVER = 1e-12


def comparison_report(result: Comparison) -> str:
    """Return the report of `compare` as one page of HTML."""
    quantity = result.quantity
    unit = result.session.machine.unit_by_joint(quantity)
    units = [unit] * len(result.gaps[0].floor) if isinstance(unit, str) else list(unit)
    several = len(result.gaps[0].floor) > 1

    residuals = []
    for gap in result.gaps:
        for joint in np.flatnonzero(np.isfinite(gap.shared)):
            name = f"{gap.name}, joint {joint + 1}" if several else gap.name
            words = f"{name}: unexplained {quantity} over time"
            draw = lambda size, gap=gap, joint=joint: plot_gap(
                gap, int(joint), units[joint], size, named=bool(result.differences)
            )
            residuals.append((name, with_narrow(image(draw(_WIDE), words), draw(_NARROW))))

    names = ", ".join(result.logs)
    return filled(
        "comparison.html",
        title=f"Comparison of {len(result.logs)} logs of {result.session.case.title}",
        case_name=result.session.case.name,
        logs=names,
        verdict=result.verdict,
        verdict_class=_CLASSES[result.verdict],
        answer=_sentence(answer(result)),
        values=value_rows(result),
        figure=image(plot_values(result), "Values by log") if _parameters(result) else None,
        evidence=[
            (
                d.label,
                nats(d.evidence),
                nats(d.threshold),
                f"below {_NEVER:.0e}" if d.false_alarm < _NEVER else f"{d.false_alarm:.1e}",
                ", ".join(rival_words(r) for r in d.alternatives) or "none",
            )
            for d in result.differences
        ],
        tried=result.tried,
        gaps=gap_rows(result),
        quantity=quantity,
        residuals=residuals,
        parameters=[_row(name, v) for name, v in result.parameters.items()],
        notes=comparison_notes(result),
    )


def plot_values(result: Comparison) -> Figure:
    """Draw the values of every parameter that differs, by log, with two standard deviations."""
    rows = _parameters(result)
    figure = Figure(figsize=(min(11.5, 4.2 * len(rows) + 1.0), 2.8), layout="constrained")
    at = np.arange(len(result.logs))
    for k, (name, values) in enumerate(rows):
        ax = figure.add_subplot(1, len(rows), k + 1)
        factor, unit = scaled_unit(values[0].unit, [np.array([v.value for v in values])])
        size = np.array([v.value for v in values]) / factor
        spread = 2 * np.array([v.std for v in values]) / factor
        ax.errorbar(at, size, np.nan_to_num(spread), fmt="o", color=TEXT, capsize=4, ms=5, lw=1.2)
        dress(ax, "log", f"{name} [{pretty_unit(unit)}]")
        # After the common style, which would put ticks between the logs.
        ax.set_xticks(at, result.logs)
        ax.set_xlim(-0.5, len(at) - 0.5)
    return figure


def plot_gap(gap: LogGap, joint: int, unit: str, size: tuple[float, float], *, named: bool) -> Figure:
    """Draw the unexplained force or position of one joint of one log over time.

    Args:
        gap: The log.
        joint: The joint, 0-based.
        unit: Unit of what was compared.
        size: Width and height [inch].
        named: Whether differences were found, so that there are two residuals.
    """
    figure, ax, _ = time_axes(size, 1, (1, 1))
    factor, label = scaled_unit(unit, [gap.before[:, joint]])
    lines = [("one machine", BEFORE, gap.before), ("with what differs", AFTER, gap.after)]
    for name, colour, residual in lines if named else lines[:1]:
        shown = np.isfinite(residual[:, joint])
        curve = envelope(gap.time[shown], residual[shown, joint] / factor, bucket_count(size))
        ax.plot(*curve, color=colour, lw=0.9, label=name)
    ax.axhline(0.0, color=TEXT, lw=0.6, zorder=0)
    dress(ax, "time [s]", f"unexplained [{label}]")
    legend(ax)
    return figure


def _parameters(result: Comparison) -> list[tuple[str, Sequence[Value]]]:
    """Return the values of each parameter that differs, by log."""
    return [
        (d.label, [v for v in d.by_log.values() if isinstance(v, Value)])
        for d in result.differences
        if d.parameter and not any(isinstance(v, Mapping) for v in d.by_log.values())
    ]


def _row(name: str, v: Value) -> tuple[str, str, str, str]:
    value, std = with_std(v.value, v.std) if np.isfinite(v.std) else (plain(v.value), plain(None))
    return name, value, std, pretty_unit(v.unit)


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."
