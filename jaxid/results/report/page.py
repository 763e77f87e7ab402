"""The report as one HTML file that needs no network, and of which only the zooming needs its script."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Mapping
from dataclasses import replace
from importlib import resources

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from jaxid.results.notes import grouped_notes
from jaxid.results.report import first_page, plots, zoom
from jaxid.results.report import words as tables
from jaxid.results.report.data import ExperimentView, HistoryView, LogView, ReportData
from jaxid.results.report.figure_tables import tables_of
from jaxid.results.report.force_plots import plot_forces, plot_frictions
from jaxid.results.report.history_plots import plot_history
from jaxid.results.report.numbers import is_number, nats, pretty_unit, scaled_unit, short
from jaxid.results.report.pose_plots import plot_poses, pose_table
from jaxid.results.report.profile_plots import plot_profiles
from jaxid.results.report.telling import telling_variable

View = LogView | ExperimentView | HistoryView

_NARROW = (4.6, 4.4)  # inch; about a phone's width at the plots' text size
_HALF = (5.6, 3.5)  # inch; half the width of a page
_LOW = (11.5, 3.4)  # inch; its whole width
# Part by which the period of a fitted ripple may differ from that of the residual.
_SAME_PERIOD = 0.05
_RASTER_DPI = 130  # Chosen: sharp on a phone, and ten clouds stay below a megabyte


def render(data: ReportData) -> str:
    """Make the report's HTML.

    Args:
        data: Content of the report.

    Returns:
        The whole page.
    """
    lines, more = first_page.first_values(data)
    main = first_page.main_view(data)
    entries = [_view_entry(data, view, i) for i, view in enumerate(data.views)]
    telling = _telling(data, main)
    missing = [row.name for row in data.parameters if not row.identifiable]
    by_position = "noise_floor" in (data.gap.get("simulation") or {})
    return filled(
        "page.html",
        data=data,
        verdict=tables.verdict_words(data),
        verdict_class=tables.verdict_class(data),
        completeness=first_page.completeness(data),
        answer=tables.answer(data),
        findings=[tables.unbroken(finding) for finding in (*_place(data), *data.findings[1:])],
        found=first_page.found_entries(data),
        telling=telling,
        friction=_friction(data),
        facts=[(name, tables.unbroken(text)) for name, text in data.facts],
        first_values=lines,
        more_values=more,
        gap=tables.gap_table(data),
        parameters=tables.parameter_lines((*data.parameters, *data.derived)),
        effects=tables.effect_entries(data.effects),
        unidentifiable=tables.unidentifiable_lines(data.unidentifiable),
        directions=tables.direction_lines(data.within_prior["directions"]) if data.within_prior else [],
        within_prior_words=tables.within_prior_words(data.within_prior or {}),
        missing=missing,
        many_missing=first_page.many_unidentifiable(len(data.unidentifiable), len(missing)),
        steps=tables.step_lines(data),
        step_unit=pretty_unit(str(data.units["position" if by_position else "force"])),
        by_position=by_position,
        rankings=_rankings(data),
        where=tables.where_lines(data),
        notes=[tables.unbroken(note) for note in grouped_notes(data.notes)],
        where_figure=_where_figure(data),
        history=_history(data),
        poses=_poses(data),
        precision=_precision(data),
        experiments=[_experiment(data, view) for view in data.experiments],
        main=None if main is None else _beside(entries[main], telling),
        views=[entry for i, entry in enumerate(entries) if i != main],
        steady=any(view.steady for view in data.views),
    )


def filled(template: str, **entries: object) -> str:
    """Fill a page template of this folder, and add the common style."""
    folder = resources.files("jaxid.results.report")
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8")),
    )
    style = (folder / "page.css").read_text(encoding="utf-8") + zoom.script_style()
    code = zoom.script()
    common = {"style": Markup(style), "script": Markup(code), "digest": zoom.digest(code)}
    return environment.get_template(template).render(**common, **entries)


def _place(data: ReportData) -> list[str]:
    """Return where an unexplained residual lies, as a sentence. Effects that were found have their place."""
    text = (data.where or {}).get("text")
    return [f"{text[0].upper()}{text[1:]}."] if text and data.verdict == "unexplained" else []


def _telling(data: ReportData, main: int | None) -> dict | None:
    """Return the figure that convinces: the residual over the variable that it follows most, or positions."""
    if main is None:
        return None
    view = data.views[main]
    units = {**data.units, **view.units}
    both = view.residual_before is not None and view.residual_after is not None
    if (view.residual_before is None and view.residual_after is None) or not len(view.band_time):
        if view.steady or not _simulated(view):
            return None
        words = f"{view.name}: measured and simulated position over time"
        figure = image(plots.plot_fit(view, units, size=_HALF), words)
        return {"title": f"Measured and simulated position: {view.name}", "variable": None} | figure
    size = _LOW if len(data.friction) > 1 else _HALF
    variable = telling_variable(view)
    if not both and not view.steady and (data.model_complete or variable == "time"):
        # A residual without a pattern says nothing; the forces show how much is explained.
        words = f"{view.name}: measured force and model force over time"
        title = "Measured force and model force" + (f" ({view.name})" if len(data.views) > 1 else "")
        if size == _LOW:
            return {"title": title, "variable": "forces"} | _picture(words, plot_forces, view, units)
        return {"title": title, "variable": None} | image(plot_forces(view, units, size=size), words)
    period = _period(data, view)
    within = ""
    if period is not None:
        # Over a stroke of hundreds of periods nothing is seen; within one the samples lie on the ripple.
        view, variable = replace(view, position=np.mod(view.position, period)), "position"
        scale, unit = scaled_unit(units["position"], [period])
        within = f", folded at {short(period / scale, 4)} {unit}"
    figure = plots.plot_residual_against(view, units, variables=(variable,), size=size)
    title = f"{'Before and after: force' if both else 'Force'} residual over {variable}{within}"
    title += f" ({view.name})" if len(data.views) > 1 else ""
    drawn = image(figure, f"{view.name}: force residual over {variable}{within}")
    if size == _LOW:
        narrow = plots.plot_residual_against(view, units, variables=(variable,))
        drawn = with_narrow(drawn, narrow)
    return {"title": title, "variable": None if within else variable} | drawn


def _period(data: ReportData, view: LogView) -> float | None:
    """Return the period of the largest ripple in a residual: as fitted, or as the search saw it."""
    where = data.where or {}
    periods = where.get("periods") or []
    if not periods or where.get("joint") != view.joint + 1 or view.steady:
        return None
    effects = (e for e in data.effects if e["joint"] == where["joint"] and "period" in e["parameters"])
    fitted = [abs(effect["parameters"]["period"]["value"]) for effect in effects]
    return next((p for p in fitted if abs(p / periods[0] - 1) < _SAME_PERIOD), periods[0])


def _beside(entry: dict, telling: dict | None) -> dict | None:
    """Return the entry of a log without the figure that the first page has; None if nothing is left."""
    shown = telling["variable"] if telling else None
    against = [figure for figure in entry["against"] if figure["variable"] != shown]
    force = None if shown == "forces" else entry["force"]
    left = force or entry["fit"] or entry["drive"] or against
    return {**entry, "force": force, "against": against} if left else None


def _friction(data: ReportData) -> dict | None:
    """Return the figure of friction over velocity, a panel for each joint."""
    if not data.friction:
        return None
    band = any(view.low is not None for view in data.friction)
    words = f"Friction over velocity{' with its 95 % band' if band else ''}"
    drawn = image(plot_frictions(data.friction, data.units), words)
    if len(data.friction) > 1:
        drawn = with_narrow(drawn, plot_frictions(data.friction, data.units, columns=1))
    sampled = any(view.force_measured is not None and len(view.force_measured) for view in data.friction)
    return {"title": words, "wide": len(data.friction) > 1, "sampled": sampled} | drawn


def _view_entry(data: ReportData, view: LogView, number: int) -> dict:
    units = {**data.units, **view.units}
    floor = data.gap.get("noise_floor")
    floor = floor[view.joint] if isinstance(floor, list) else floor
    floor = floor if is_number(floor) else None
    simulated = _simulated(view)
    residual = view.residual_before is not None or view.residual_after is not None
    words = f"{view.name}: measured{' and simulated' if simulated else ''} position over time"
    entry = {
        "name": view.name,
        "anchor": f"log-{number}",
        "simulated": simulated,
        "fit": None if view.steady else _picture(words, plots.plot_fit, view, units),
        "drifted": data.drifted,
        "drive": None,
        "force": None,
        "against": [],
    }
    if view.drive_simulated is not None:
        words = f"{view.name}: force of the drive over time, measured and simulated"
        entry["drive"] = _picture(words, plots.plot_drive, view, units)
    if len(view.band_time) and not view.steady:
        words = f"{view.name}: measured force, model force and their difference over time"
        entry["force"] = _picture(words, plot_forces, view, units, noise_floor=floor)
    if residual and len(view.band_time):
        for variable in ("velocity",) if view.steady else ("velocity", "position", "time"):
            figure = plots.plot_residual_against(view, units, variables=(variable,))
            drawn = image(figure, f"{view.name}: force residual over {variable}")
            entry["against"].append({"variable": variable} | drawn)
    return entry


def _simulated(view: LogView) -> bool:
    pair = (view.position_simulated_before, view.position_simulated_after)
    return any(line is not None for line in pair)


def _rankings(data: ReportData) -> list[dict]:
    rankings = []
    for number, step in enumerate(data.steps):
        if step.candidates:
            best = plots.ranked(step)[0]
            words = (
                f"Step {number}: evidence of {len(step.candidates)} candidates; the best is "
                f"{best.kind} with {nats(best.evidence)}, threshold {short(step.threshold)}"
            )
            figure = plots.plot_candidates(step)
            title = f"Step {number}: {tables.step_words(number, step)}"
            rankings.append({"title": title, "image": image(figure, words)})
    return rankings


def _experiment(data: ReportData, view: ExperimentView) -> dict:
    entry = {"text": tables.unbroken(view.text), "image": None}
    if view.values is not None:
        words = f"Proposed {view.signal} over time"
        entry["image"] = _picture(words, plots.plot_experiment, view, data.units)
    return entry


def _history(data: ReportData) -> dict | None:
    if data.history is None:
        return None
    return _picture("Estimates and running residual over time", plot_history, data.history, data.units)


def _poses(data: ReportData) -> dict | None:
    """Return the figure of an arm at instants of the log, with the places of its end as a table."""
    if data.poses is None:
        return None
    words = f"{data.poses.name}: the arm at {len(data.poses.time)} instants, from the side and from above"
    wide = with_narrow(
        image(plot_poses(data.poses), words), plot_poses(data.poses, size=(4.6, 7.0), columns=4)
    )
    return {**wide, "tables": (pose_table(data.poses),)}


def _precision(data: ReportData) -> dict | None:
    """Return the section on precision: the kind of the covariance, profiles, and correlations."""
    if data.precision is None:
        return None
    profiles = data.precision["profiles"]
    figure = image(plot_profiles(profiles), "Profile likelihoods and parabolas") if profiles else None
    return {**data.precision, "figure": figure}


def _where_figure(data: ReportData) -> dict | None:
    if data.where_plot is None or len(data.where_plot[2]) == 0:
        return None
    figure = plots.plot_where(data.where_plot, data.units, tables.where_region(data))
    return image(figure, f"Mean force residual over {data.where_plot[0]}")


def _picture(words: str, draw, view: View, units: Mapping, **options: object) -> dict:
    """Draw a plot over time twice: wide, and again for narrow screens."""
    wide = image(draw(view, units, **options), words)
    return with_narrow(wide, draw(view, units, size=_NARROW, **options))


def with_narrow(wide: dict, figure: Figure) -> dict:
    """Return the attributes of an img element with another figure for narrow screens."""
    return {**wide, "narrow": image(figure, wide["alt"])}


def image(figure: Figure, words: str) -> dict:
    """Turn a figure into the attributes of an img element, with its numbers as tables.

    Args:
        figure: The figure.
        words: Description of the figure, for readers who cannot see it.
    """
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.set_dpi(_RASTER_DPI)
    # savefig would lay out and draw everything twice.
    FigureCanvasSVG(figure).print_svg(buffer, metadata=nothing)
    text = re.sub(r' d="[^"]+"', _rounded, buffer.getvalue())
    width, height = (round(96 * inches) for inches in figure.get_size_inches())
    # An image rather than an inline element: identifiers of several drawings cannot clash.
    code = base64.b64encode(text.encode()).decode("ascii")
    source = f"data:image/svg+xml;base64,{code}"
    return {
        "source": source,
        "alt": words,
        "width": width,
        "height": height,
        "narrow": None,
        "tables": tables_of(figure),
        "charts": zoom.charts_of(figure),
    }


def _rounded(path: re.Match) -> str:
    """Cut a path's coordinates to a hundredth of a point, which halves the file."""
    return re.sub(r"(\.\d\d)\d+", r"\1", path.group())
