"""The report of a study as one HTML page that needs neither network nor scripts."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from jaxid.results.report.numbers import pretty_unit, short
from jaxid.results.report.page import filled, image, with_narrow
from jaxid.results.report.study_plots import others_of, plot_coverage, plot_ecdf, plot_errors, plot_scatter
from jaxid.studies.calibration import FEWEST
from jaxid.studies.result import conditions
from jaxid.studies.settings import SETTINGS, setting_of, words_of

if TYPE_CHECKING:
    from jaxid.studies.result import Study

# Nominal coverages in tables [%].
LEVELS = (50, 68, 80, 95)


def study_report(result: Study) -> str:
    """Return the report of a study as one page of HTML.

    Args:
        result: The study.
    """
    rows, table = result.summary, result.table
    others = others_of(rows)
    figures = [
        (
            "Errors",
            "The RMS error of all runs that were used, bias included. "
            + ("" if len(others) > 1 else "Dotted: the mean σ that the estimator reports. ")
            + "Black: the lower bound of any unbiased estimate from the readings, with start and "
            "command known exactly.",
            _drawn(plot_errors, rows, "RMS error of every estimator, by parameter"),
        ),
        (
            "Part of the intervals that hold the truth",
            "Bars are the uncertainty (95 %) from the number of runs."
            + (f" Of each estimator from left to right: {'; '.join(others)}." if len(others) > 1 else ""),
            _drawn(plot_coverage, rows, "Coverage of 95 % intervals, by parameter"),
        ),
    ]

    folded = []
    for setting, own in conditions(table):
        title = f"Errors in units of their reported σ: {words_of(setting)}"
        words = "Beyond 4.5 σ everything is counted in the outermost bar."
        folded.append((title, words, _drawn(plot_scatter, own, title)))
        if own.sizes["run"] >= FEWEST:
            title = f"Where the truth lies in the reported distribution: {words_of(setting)}"
            words = (
                "ECDF of the place of the truth in the normal distribution of estimate and σ, minus the "
                "diagonal. The ECDF of sound intervals stays inside the dashed band, of as many runs as the "
                "estimator with most, at all points at once in 95 of 100 studies. An arch below on the left "
                "and above on the right: too wide; the other way round: too narrow; all on one side: biased."
            )
            folded.append((title, words, _drawn(plot_ecdf, own, title)))

    settings = [name for name in SETTINGS if name in table.dims]
    tried = "; ".join(
        f"{name.replace('_', ' ')} {', '.join(f'{x:g}' for x in table[name].values)}" for name in settings
    )
    return filled(
        "study.html",
        title=result.title,
        rows=[_line(r) for r in rows],
        settings=settings,
        failures=[f | {"where": words_of(f)} for f in result.failures],
        doubtful=[line for line in result.verdicts if "do not rely" in line],
        verdicts=[line for line in result.verdicts if "do not rely" not in line],
        partial=[
            p | {"where": words_of(p), "without": ", ".join(p["unidentifiable"])} for p in result.partial
        ],
        combinations=[_combined(r) for r in result.combinations],
        named=[n | {"where": words_of(n)} for n in result.named],
        runs=table.sizes["run"],
        seconds=short(result.seconds, 3),
        figures=figures,
        folded=folded,
        tried=tried,
        answer=_answer(result),
        tracking=[_followed(r) for r in result.tracking],
    )


def _drawn(draw: Callable[..., Figure], of: Any, words: str) -> dict:
    """Draw a figure of several panels, and again with one below the other for narrow screens."""
    return with_narrow(image(draw(of), words), draw(of, columns=1))


def _followed(row: dict) -> dict:
    return {
        **row,
        "unit": pretty_unit(row["unit"]),
        "settings": [f"{x:g}" for x in setting_of(row).values()],
        "sizes": [short(x, 3) for name in ("rms", "peak") for x in row[name].values()],
    }


def _combined(row: dict) -> dict:
    names = [f"coverage_{level}" for level in LEVELS]
    return {
        **row,
        "settings": [f"{x:g}" for x in setting_of(row).values()],
        "mean": short(row["mean"], 3),
        "coverages": [f"{100 * row[name]:.1f}" for name in names],
    }


def _line(row: dict) -> dict:
    percent = lambda x: f"{100 * x:.1f}" if np.isfinite(x) else "–"
    number = lambda x: short(x, 3) if np.isfinite(x) else "–"
    return {
        **row,
        "unit": pretty_unit(row["unit"]),
        "true": number(row["true"]),
        "settings": [f"{x:g}" for x in setting_of(row).values()],
        **{k: number(row[k]) for k in ("bias", "spread", "rmse", "std", "bound")},
        **{k: percent(row[k]) for k in ("identifiable", "failed")},
        "coverages": [percent(row[f"coverage_{level}"]) for level in LEVELS],
    }


def _answer(result: Study) -> str:
    """Return the study in one or two sentences."""
    rows = [r for r in result.summary if r["used"]]
    if not rows:
        return "No run gave an estimate."
    held: dict[str, list[float]] = {}
    for r in rows:
        held.setdefault(r["estimator"], []).append(r["coverage_95"])
    # Some estimators give no standard deviation.
    finite = {name: np.array(x)[np.isfinite(x)] for name, x in held.items()}
    parts = [f"{name}: {100 * np.mean(x):.0f} %" for name, x in finite.items() if len(x)]
    failed = sum(f["runs"] for f in result.failures)
    fits = result.table["converged"].size
    lines = [f"{failed} of {fits} fits failed."]
    if parts:
        held_words = "95 % intervals held the truth, over all parameters and settings, in: "
        lines.insert(0, f"{held_words}{'; '.join(parts)}.")
    silent = [str(name) for name in result.table.estimator.values if str(name) not in held]
    lines += [f"{', '.join(silent)} gave none at all."] if silent else []
    return " ".join(lines)
