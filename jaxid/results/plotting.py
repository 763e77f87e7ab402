"""The plots of a result, one axes each: axes in, axes out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from jaxid.errors import InputError, suggest
from jaxid.results.report import plots
from jaxid.results.report.axes import FONT, TEXT, dress, legend
from jaxid.results.report.build import history_of, search_step, units_of, view_of, where_plot
from jaxid.results.report.data import LogView
from jaxid.results.report.history_plots import draw_history
from jaxid.results.report.numbers import is_number, pretty_unit, scaled_unit
from jaxid.results.report.study_plots import draw_coverage, draw_ecdf, draw_errors, draw_scatter

if TYPE_CHECKING:
    import xarray as xr

    from jaxid.commands.identify import Identification
    from jaxid.discovery.result import Discovery
    from jaxid.studies.result import Study

    Fitted = Identification | Discovery

# Width and height of a figure made for a plot [inch].
_SIZE = (8.0, 3.6)
_AGAINST = ("velocity", "position", "time")
# Half the width of a 95 % interval, in standard deviations.
_INTERVAL = 1.96


@dataclass(frozen=True)
class Selection:
    """Options of a plot of a result.

    Args:
        log: Name or number of the log, the fitted one being "fit" or 0.
        joint: Joint of several, 1-based.
        against: Abscissa of a scatter: "velocity", "position" or "time".
        parameter: Name of the parameter, for a recursive estimate and for studies; None: the first.
        step: Step of a search, 0 being the baseline; setting of a study; None: the first that has something
            to show.
    """

    log: str | int = 0
    joint: int = 1
    against: str = "velocity"
    parameter: str | None = None
    step: int | None = None


def plot(result: Fitted, kind: str, ax: Axes | None, selection: Selection) -> Axes:
    """Draw one plot of a result.

    Args:
        result: An identification or a discovery.
        kind: One of `KINDS`.
        ax: Axes to draw on; None: a new figure of pyplot, which a notebook shows.
        selection: Log, joint and abscissa.

    Returns:
        The axes.

    Raises:
        InputError: If the kind is unknown, or the result has nothing to draw of that kind.
    """
    return _drawn(KINDS, result, kind, ax, selection)


def plot_study(result: Study, kind: str, ax: Axes | None, selection: Selection) -> Axes:
    """Draw one plot of a study for one parameter; arguments as of `plot`, the kind one of `STUDY_KINDS`."""
    return _drawn(STUDY_KINDS, result, kind, ax, selection)


def _drawn(kinds: Mapping[str, Callable], result: object, kind: str, ax: Axes | None, at: Selection) -> Axes:
    if kind not in kinds:
        raise InputError(f"plot {kind!r} is not known", hint=suggest(kind, kinds, limit=len(kinds)))
    if ax is not None:
        kinds[kind](ax, result, at)
        return ax
    # Imported only here, because a figure that the user gives does not need pyplot.
    from matplotlib import pyplot

    figure, ax = pyplot.subplots(figsize=_SIZE, layout="constrained")
    try:
        kinds[kind](ax, result, at)
    except BaseException:
        pyplot.close(figure)
        raise
    return ax


def _view(result: Fitted, at: Selection) -> LogView:
    """Return the log and the joint that are asked for."""
    names = [run.name for run in result.session.runs]
    log = names[at.log] if isinstance(at.log, int) and -len(names) <= at.log < len(names) else at.log
    if log not in names:
        raise InputError(f"log {at.log!r} is not in this result", hint=suggest(str(at.log), names))
    joints = [int(k) + 1 for k in np.flatnonzero(result.session.fit.log.measured)]
    if at.joint not in joints:
        raise InputError(
            f"joint {at.joint!r} has no measured position",
            hint=f"choose one of {', '.join(map(str, joints))}",
        )
    return view_of(result, names.index(log), at.joint - 1)


def _floor(result: Fitted, at: Selection) -> float | None:
    floor = np.atleast_1d(result.noise_floor)[at.joint - 1]
    return float(floor) if is_number(floor) else None


def _fit(ax: Axes, result: Fitted, at: Selection) -> None:
    plots.draw_fit(ax, _view(result, at), units_of(result.session))


def _difference(ax: Axes, result: Fitted, at: Selection) -> None:
    view = _view(result, at)
    if view.position_simulated_after is None and view.position_simulated_before is None:
        raise InputError(f"log {view.name!r} has no simulated position", hint="the simulation diverges")
    plots.draw_difference(ax, view, units_of(result.session))


def _force(ax: Axes, result: Fitted, at: Selection) -> None:
    plots.draw_force(ax, _view(result, at), units_of(result.session))


def _residual(ax: Axes, result: Fitted, at: Selection) -> None:
    plots.draw_residual(ax, _view(result, at), units_of(result.session), noise_floor=_floor(result, at))


def _scatter(ax: Axes, result: Fitted, at: Selection) -> None:
    if at.against not in _AGAINST:
        raise InputError(f"against {at.against!r} is not known", hint=suggest(at.against, _AGAINST))
    plots.draw_residual_against(ax, _view(result, at), units_of(result.session), at.against)


def _parameters(ax: Axes, result: Fitted, at: Selection) -> None:
    """Draw 95 % intervals as percentages of the estimates."""
    parameters = [p for p in result.parameters.values() if p.identifiable and p.value]
    if not parameters:
        raise InputError("no parameter is identifiable", hint="choose another plot")
    rows = np.arange(len(parameters))
    half = np.array([100.0 * _INTERVAL * p.std / abs(p.value) for p in parameters])
    ax.errorbar(np.zeros(len(rows)), rows, xerr=half, fmt="o", color=plots.AFTER, ms=4, capsize=3)
    for row, p, width in zip(rows, parameters, half, strict=True):
        style = {"fontsize": FONT - 1, "color": TEXT, "va": "center"}
        ax.annotate(pretty_unit(str(p)), (width, row), (6, 0), textcoords="offset points", **style)
    ax.axvline(0.0, color=TEXT, lw=0.6)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    # Room on the right for the numbers.
    ax.set_xlim(-1.15 * half.max(), 2.2 * half.max())
    dress(ax, "95 % interval [% of the estimate]", "")
    ax.set_yticks(rows, [p.name for p in parameters], fontsize=FONT - 0.5)


def _correlation(ax: Axes, result: Fitted, at: Selection) -> None:
    covariance = result.covariance
    figure = ax.get_figure(root=True)
    assert figure is not None, "axes to draw on belong to a figure"
    image = ax.imshow(covariance.correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    places = np.arange(len(covariance.names))
    ax.set_xticks(places, covariance.names, rotation=45, ha="right", fontsize=FONT - 0.5)
    ax.set_yticks(places, covariance.names, fontsize=FONT - 0.5)
    figure.colorbar(image, ax=ax, label="correlation [-]")


def _gaps(ax: Axes, result: Fitted, at: Selection) -> None:
    """Draw the RMS force residual on each log as a bar."""
    _view(result, at)
    before = getattr(result, "gaps_before", ())
    sides = [("before", plots.BEFORE, before), ("after", plots.AFTER, result.gaps)] if before else []
    sides = sides or [("RMS residual", plots.AFTER, result.gaps)]
    joint, floor = at.joint - 1, _floor(result, at)
    values = [[g.force.rms[joint] for g in gaps] for _, _, gaps in sides]
    factor, unit = scaled_unit(units_of(result.session)["force"], values)
    rows, height = np.arange(len(result.gaps)), 0.8 / len(sides)
    for k, ((label, color, _), rms) in enumerate(zip(sides, values, strict=True)):
        at_rows = rows + (k - 0.5 * (len(sides) - 1)) * height
        ax.barh(at_rows, np.array(rms) / factor, height=0.9 * height, color=color, label=label)
    if floor is not None:
        ax.axvline(floor / factor, color=TEXT, lw=0.9, ls=(0, (4, 3)), label="noise floor (RMS)")
    ax.set_ylim(len(rows) - 0.4, -0.6)
    dress(ax, f"force residual, RMS [{unit}]", "")
    ax.set_yticks(rows, [g.name for g in result.gaps], fontsize=FONT - 0.5)
    legend(ax)


def _history(ax: Axes, result: Fitted, at: Selection) -> None:
    history = history_of(result.estimate)
    if history is None:
        raise InputError("only a recursive estimate has a history", hint="choose another plot")
    draw_history(ax, history, units_of(result.session), _named(at.parameter, history.names))


def _where(ax: Axes, result: Fitted, at: Selection) -> None:
    shown = where_plot(result)
    if shown is None or not len(shown.x):
        raise InputError("this result has no curve of the mean residual", hint="choose another plot")
    where = getattr(result, "where", None)
    plots.draw_where(ax, shown, units_of(result.session), None if where is None else where.region)


def _candidates(ax: Axes, result: Fitted, at: Selection) -> None:
    scored = {k: r for k, r in enumerate(getattr(result, "rounds", ())) if r.step.scores}
    if not scored:
        raise InputError("this result has no candidates", hint="choose another plot")
    step = min(scored) if at.step is None else at.step
    if step not in scored:
        hint = f"choose one of {', '.join(map(str, scored))}"
        raise InputError(f"step {step} has no candidates", hint=hint)
    plots.draw_candidates(ax, search_step(scored[step]))


def _named(name: str | None, names: Sequence[str]) -> str:
    """Return a name after a check that it is known; the first one if none is given."""
    if name is not None and name not in names:
        raise InputError(f"parameter {name!r} is not known", hint=suggest(name, names))
    return names[0] if name is None else name


def _errors(ax: Axes, result: Study, at: Selection) -> None:
    rows = result.summary
    draw_errors(ax, rows, _named(at.parameter, _parameters_of(result)))
    legend(ax)


def _coverage(ax: Axes, result: Study, at: Selection) -> None:
    draw_coverage(ax, result.summary, _named(at.parameter, _parameters_of(result)))
    legend(ax)


def _study_scatter(ax: Axes, result: Study, at: Selection) -> None:
    draw_scatter(ax, _setting_of(result, at), _named(at.parameter, _parameters_of(result)))
    legend(ax)


def _setting_of(result: Study, at: Selection) -> xr.Dataset:
    """Return the part of a study's table under the chosen setting."""
    from jaxid.studies.result import conditions

    settings = [own for _, own in conditions(result.table)]
    number = at.step or 0
    if not -len(settings) <= number < len(settings):
        raise InputError(f"the study has no setting {number}", hint=f"choose 0 to {len(settings) - 1}")
    return settings[number]


def _study_ecdf(ax: Axes, result: Study, at: Selection) -> None:
    draw_ecdf(ax, _setting_of(result, at), _named(at.parameter, _parameters_of(result)))
    legend(ax)


def _parameters_of(result: Study) -> list[str]:
    return [str(name) for name in result.table.parameter.values]


# Plots of an identification and a discovery, by kind.
KINDS: dict[str, Callable[[Axes, Fitted, Selection], None]] = {
    "fit": _fit,
    "difference": _difference,
    "force": _force,
    "residual": _residual,
    "scatter": _scatter,
    "parameters": _parameters,
    "correlation": _correlation,
    "gaps": _gaps,
    "history": _history,
    "where": _where,
    "candidates": _candidates,
}
# Plots of a study, by kind.
STUDY_KINDS: dict[str, Callable[[Axes, Study, Selection], None]] = {
    "errors": _errors,
    "coverage": _coverage,
    "scatter": _study_scatter,
    "ecdf": _study_ecdf,
}
