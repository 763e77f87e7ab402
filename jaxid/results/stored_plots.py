"""Pictures of a result that was written before, by their kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from jaxid.errors import InputError, suggest
from jaxid.results.report import plots
from jaxid.results.report.axes import FONT, TEXT, dress
from jaxid.results.report.data import LogView, ReportData
from jaxid.results.report.force_plots import plot_forces, plot_frictions
from jaxid.results.report.history_plots import plot_history
from jaxid.results.report.numbers import is_number
from jaxid.results.report.pose_plots import plot_poses
from jaxid.results.report.profile_plots import plot_profiles
from jaxid.results.report.telling import telling_variable
from jaxid.results.report.words import where_region

_AGAINST = ("velocity", "position", "time")
# Half the width of a 95 % interval, in standard deviations.
_INTERVAL = 1.96


@dataclass(frozen=True)
class Chosen:
    """The part of a result that a picture shows.

    Args:
        data: Content of the report.
        log: Name or number of the log.
        joint: Joint of several, 1-based.
        against: Abscissa of a scatter; None: the one that the residual follows most.
    """

    data: ReportData
    log: str = "0"
    joint: int = 1
    against: str | None = None

    @property
    def view(self) -> LogView:
        """The joint of the log, as it is drawn."""
        if not self.data.views:
            raise InputError("this result has no log to draw", hint="choose another plot")
        # The views of a log follow each other, a joint each.
        joints = list(dict.fromkeys(view.joint + 1 for view in self.data.views))
        if self.joint not in joints:
            hint = f"choose one of {', '.join(map(str, joints))}"
            raise InputError(f"joint {self.joint} has no measured position", hint=hint)
        of_joint = [view for view in self.data.views if view.joint + 1 == self.joint]
        names = [view.name.split(", joint ")[0] for view in of_joint]
        if self.log in names:
            return of_joint[names.index(self.log)]
        if self.log.isdigit() and int(self.log) < len(of_joint):
            return of_joint[int(self.log)]
        raise InputError(f"log {self.log!r} is not in this result", hint=suggest(self.log, names))

    @property
    def units(self) -> dict[str, str]:
        """The labels at the joint."""
        return {**self.data.units, **self.view.units}


def picture(
    data: ReportData, kind: str, *, log: str = "0", joint: int = 1, against: str | None = None
) -> Figure:
    """Draw one picture of a result.

    Args:
        data: Content of its report.
        kind: One of `jaxid.names.PICTURES`.
        log: Name or number of the log.
        joint: Joint of several, 1-based.
        against: Abscissa of "scatter"; None: the one that the residual follows most.

    Raises:
        InputError: If the result has nothing to draw of that kind.
    """
    if kind not in _DRAW:
        raise InputError(f"plot {kind!r} is not known", hint=suggest(kind, _DRAW))
    figure = _DRAW[kind](Chosen(data, log, joint, against))
    if figure is None:
        raise InputError(f"this result has no {kind} to draw", hint="choose another plot")
    return figure


def _floor(chosen: Chosen) -> float | None:
    floors = np.atleast_1d(np.asarray(chosen.data.gap.get("noise_floor"), dtype=float))
    floor = floors[min(chosen.view.joint, floors.size - 1)]
    return float(floor) if is_number(floor) else None


def _forces(chosen: Chosen) -> Figure | None:
    view = chosen.view
    return plot_forces(view, chosen.units, noise_floor=_floor(chosen)) if len(view.band_time) else None


def _residual(chosen: Chosen) -> Figure | None:
    view = chosen.view
    if view.residual_after is None or not len(view.band_time):
        return None
    figure = Figure(figsize=(11.5, 2.9), layout="constrained")
    plots.draw_residual(figure.add_subplot(), view, chosen.units, noise_floor=_floor(chosen))
    return figure


def _scatter(chosen: Chosen) -> Figure | None:
    view = chosen.view
    against = chosen.against or telling_variable(view)
    if against not in _AGAINST:
        raise InputError(f"against {against!r} is not known", hint=suggest(against, _AGAINST))
    if view.residual_after is None or not len(view.band_time):
        return None
    return plots.plot_residual_against(view, chosen.units, variables=(against,), size=(7.0, 4.2))


def _friction(chosen: Chosen) -> Figure | None:
    return plot_frictions(chosen.data.friction, chosen.data.units) if chosen.data.friction else None


def _fit(chosen: Chosen) -> Figure | None:
    return None if chosen.view.steady else plots.plot_fit(chosen.view, chosen.units)


def _parameters(chosen: Chosen) -> Figure | None:
    """Draw 95 % intervals as percentages of the estimates."""
    rows = [r for r in chosen.data.parameters if r.identifiable and is_number(r.value) and r.value]
    rows = [r for r in rows if is_number(r.std)]
    if not rows:
        return None
    half = np.array([100.0 * _INTERVAL * float(r.std or 0) / abs(float(r.value or 1)) for r in rows])
    figure = Figure(figsize=(7.0, 0.9 + 0.28 * len(rows)), layout="constrained")
    ax = figure.add_subplot()
    at = np.arange(len(rows))
    ax.errorbar(np.zeros(len(rows)), at, xerr=half, fmt="o", color=plots.AFTER, ms=4, capsize=3)
    ax.axvline(0.0, color=TEXT, lw=0.6)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    dress(ax, "95 % interval [% of the estimate]", "")
    ax.set_yticks(at, [r.name for r in rows], fontsize=FONT - 0.5)
    return figure


def _history(chosen: Chosen) -> Figure | None:
    history = chosen.data.history
    return None if history is None else plot_history(history, chosen.data.units)


def _where(chosen: Chosen) -> Figure | None:
    plot = chosen.data.where_plot
    if plot is None or not len(plot[2]):
        return None
    return plots.plot_where(plot, chosen.data.units, where_region(chosen.data))


def _candidates(chosen: Chosen) -> Figure | None:
    scored = [step for step in chosen.data.steps if step.candidates]
    return plots.plot_candidates(scored[0]) if scored else None


def _profiles(chosen: Chosen) -> Figure | None:
    profiles = (chosen.data.precision or {}).get("profiles")
    return plot_profiles(profiles) if profiles else None


def _motion(chosen: Chosen) -> Figure | None:
    poses = chosen.data.poses
    return None if poses is None else plot_poses(poses)


_DRAW: dict[str, Callable[[Chosen], Figure | None]] = {
    "forces": _forces,
    "residual": _residual,
    "scatter": _scatter,
    "friction": _friction,
    "fit": _fit,
    "parameters": _parameters,
    "history": _history,
    "where": _where,
    "candidates": _candidates,
    "profiles": _profiles,
    "motion": _motion,
}


def signals_csv(data: ReportData) -> str:
    """Return measured and simulated signals of all logs as text, as PlotJuggler reads it.

    A row is a sample. Forces stand in the rows of the samples that the balance uses; other cells are empty.
    Names of columns have the form "log/joint 1/position/measured"; the unit stands behind each name.

    Args:
        data: Content of the report.

    Raises:
        InputError: If the rows of the logs have no time.
    """
    views = [view for view in data.views if not view.steady]
    if not views:
        raise InputError("rows of steady speeds have no time", hint="choose another plot")
    time = np.unique(np.concatenate([view.time for view in views]))
    columns: dict[str, np.ndarray] = {}
    for view in views:
        name = view.name.split(", joint ")[0]
        units = {**data.units, **view.units}
        before, after = view.residual_before, view.residual_after
        signals = {
            "position/measured": (view.time, view.position_measured, "position"),
            "position/simulated before": (view.time, view.position_simulated_before, "position"),
            "position/simulated": (view.time, view.position_simulated_after, "position"),
            "force/measured": (view.band_time, view.force_measured, "force"),
            "force/model": (view.band_time, None if after is None else view.force_measured - after, "force"),
            "force/residual before": (view.band_time, before, "force"),
            "force/residual": (view.band_time, after, "force"),
        }
        for what, (at, values, quantity) in signals.items():
            if values is not None and len(values):
                column = np.full(time.size, np.nan)
                column[np.searchsorted(time, at)] = values
                columns[f"{name}/joint {view.joint + 1}/{what} [{units[quantity]}]"] = column
    heads = ",".join(["time", *[name.replace(",", ";") for name in columns]])
    table = np.column_stack([time, *columns.values()])
    rows = [",".join("" if np.isnan(x) else f"{x:.12g}" for x in row) for row in table]
    return "\n".join([heads, *rows]) + "\n"
