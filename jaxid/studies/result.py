"""The result of a study: the table of all runs, and the statistics of every estimator."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.stats
import xarray as xr

from jaxid.files import json_text, write_results
from jaxid.model.units import joined
from jaxid.studies.rows import COLUMNS, Arrays, variables
from jaxid.studies.settings import SETTINGS

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes

    from jaxid.machine import Machine
    from jaxid.studies.plan import Plan

FILES = ("study.nc", "summary.json", "report.html")
# Nominal coverage of the intervals that are counted.
COVERAGES = (0.68, 0.95)


@dataclass(frozen=True, repr=False)
class Study:
    """Result of `study`.

    Args:
        table: Every run: `estimate`, `std`, `identifiable` (estimator, noise, run, parameter),
            `converged`, `steps`, `message`, `named` (estimator, noise, run), `truth` and `start` (run,
            parameter), and `bound`, the Cramer-Rao bound on the deviation (noise, parameter); for loops
            `tracking_rms` and `tracking_peak` (noise, run, drive) in the last quarter of a run. SI units.
            `sample_rate` [Hz] and `position_resolution` come before noise if the study varies them.
        seconds: Time of all chunks [s], added up over the threads, those of earlier starts included.
        title: Name of the case.
    """

    table: xr.Dataset
    seconds: float
    title: str

    @property
    def summary(self) -> list[dict[str, Any]]:
        """A row for every estimator, setting and parameter; see `summarised`."""
        return summarised(self.table)

    @property
    def tracking(self) -> list[dict[str, Any]]:
        """Tracking errors in the last quarter of a run, by setting and drive; empty for open loops.

        `rms` and `peak` hold the median of the runs, the value that 95 % of them stay below, and the worst.
        """
        if "tracking_rms" not in self.table:
            return []
        sizes = lambda x: {
            "median": float(np.median(x)),
            "most_95": float(np.percentile(x, 95)),
            "worst": float(np.max(x)),
        }
        rows = []
        for setting, own in conditions(self.table):
            rms, peak = own["tracking_rms"], own["tracking_peak"]
            for k in range(own.sizes["drive"]):
                used = np.isfinite(rms.values[:, k])
                if used.any():
                    both = {"rms": sizes(rms.values[used, k]), "peak": sizes(peak.values[used, k])}
                    # One label for all drives, or one for each (see `_tracking_unit`).
                    units = str(rms.attrs["unit"]).split(", ")
                    unit = units[k % len(units)]
                    rows.append({**setting, "drive": k + 1, "unit": unit, "runs": int(used.sum()), **both})
        return rows

    @property
    def failures(self) -> list[dict[str, Any]]:
        """Reasons (`why`) for which runs lack a value for some parameter, with their number of `runs`.

        Rows are by estimator and setting. Reasons that differ only in numbers count as one.
        """
        out = []
        for estimator, setting, own in cells(self.table):
            firsts: dict[str, str] = {}
            counts: Counter[str] = Counter()
            for k in range(own.sizes["run"]):
                why = _why(own.isel(run=k))
                if why:
                    kind = re.sub(r"\d[\d.e+-]*", "#", why)
                    firsts.setdefault(kind, why)
                    counts[kind] += 1
            out += [
                {"estimator": estimator, **setting, "why": firsts[kind], "runs": runs}
                for kind, runs in counts.most_common()
            ]
        return out

    @property
    def named(self) -> list[dict[str, Any]]:
        """Effects that discover named, or its verdict (`what`), with the number of `runs`, by setting."""
        return [
            {"estimator": estimator, **setting, "what": str(what), "runs": runs}
            for estimator, setting, own in cells(self.table)
            for what, runs in Counter(own["named"].values.tolist()).most_common()
            if what
        ]

    def plot(
        self, kind: str, ax: Axes | None = None, *, parameter: str | None = None, step: int | None = None
    ) -> Axes:
        """Draw one plot for one parameter.

        Args:
            kind: "errors" (RMS error against the setting with most values), "coverage" (of 95 % intervals)
                or "scatter" (errors in units of their reported deviation).
            ax: Axes to draw on; None: a new figure, which a notebook shows.
            parameter: Name of the parameter; None: the first.
            step: Setting of "scatter", in the order of the table; None: the first.

        Returns:
            The axes.

        Raises:
            InputError: If the kind or the parameter is unknown.
        """
        from jaxid.results.plotting import Selection, plot_study

        return plot_study(self, kind, ax, Selection(parameter=parameter, step=step))

    def to_pandas(self) -> pandas.DataFrame:
        """Return `summary` as a table; needs pandas. All runs are `table.to_dataframe()`."""
        from jaxid.results.parameters import frame

        return frame(self.summary)

    def __repr__(self) -> str:
        from jaxid.results.as_text import study_summary

        return study_summary(self)

    def _repr_html_(self) -> str:
        from jaxid.results.as_html import study_html

        return study_html(self)

    def __str__(self) -> str:
        from jaxid.results.as_text import study_table

        return study_table(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write `study.nc` (NetCDF), `summary.json` and `report.html` to a folder.

        Raises:
            InputError: If the folder holds what jaxid did not make and `overwrite` is not given.
        """
        from jaxid.results.report.study import study_report

        folder = Path(folder)
        words = {"case": self.title, "seconds": self.seconds}
        words |= {"rows": self.summary, "failures": self.failures, "named": self.named}
        words |= {"tracking": self.tracking}
        files = {
            "study.nc": bytes(self.table.to_netcdf(engine="scipy")),
            "summary.json": json_text(words),
            "report.html": study_report(self),
        }
        write_results(folder, files, overwrite=overwrite)
        return folder


def cells(table: xr.Dataset) -> Iterator[tuple[str, dict[str, float], xr.Dataset]]:
    """Estimator, setting and runs of every combination of them."""
    for k, estimator in enumerate(table.estimator.values):
        for setting, own in conditions(table):
            yield str(estimator), setting, own.isel(estimator=k)


def conditions(table: xr.Dataset) -> Iterator[tuple[dict[str, float], xr.Dataset]]:
    """Yield every setting with the part of the table under it."""
    dims = [name for name in SETTINGS if name in table.dims]
    for index in itertools.product(*[range(table.sizes[name]) for name in dims]):
        own = table.isel(dict(zip(dims, index, strict=True)))
        yield {name: float(own[name]) for name in dims}, own


def gathered(plan: Plan, chunks: list[Arrays], bound: np.ndarray) -> Study:
    """Gather the chunks, in their order, in one table."""
    levels = [[c for c, (level, _) in zip(chunks, plan.chunks, strict=True) if level == k]
              for k in range(len(plan.levels))]  # fmt: skip
    settings = plan.settings
    sizes = tuple(len(values) for values in settings.values())

    def by_run(name: str) -> np.ndarray:
        whole = np.stack([np.concatenate([c[name] for c in own], axis=1) for own in levels], axis=1)
        return whole.reshape(len(whole), *sizes, *whole.shape[2:])

    run = ("estimator", *settings, "run")
    once = {n: np.concatenate([c[n] for c in levels[0]]) for n in ("truth", "start")}
    free = plan.machine.parameters.free
    table = xr.Dataset(
        {
            **variables({name: by_run(name) for name in COLUMNS}, run),
            "truth": (("run", "parameter"), once["truth"]),
            "start": (("run", "parameter"), once["start"]),
            "bound": ((*settings, "parameter"), bound.reshape(*sizes, -1)),
            "unit": (("parameter",), np.array([f.unit for f in free], dtype=object)),
        },
        coords={
            "estimator": np.array(plan.estimators, dtype=object),
            **settings,
            "run": np.arange(plan.runs, dtype=np.int32),
            "parameter": np.array(plan.names, dtype=object),
        },
        attrs={"case": plan.case.name, "seed": plan.seed},
    )
    tracking = by_run("tracking")[0]
    if tracking.shape[-2]:
        own, unit = (*settings, "run", "drive"), {"unit": _tracking_unit(plan.machine)}
        for k, name in enumerate(("tracking_rms", "tracking_peak")):
            table[name] = own, tracking[..., k], unit
        table = table.assign_coords(drive=np.arange(1, tracking.shape[-2] + 1, dtype=np.int32))
    seconds = float(sum(c["seconds"] for c in chunks))
    return Study(table, seconds, plan.case.title)


def _tracking_unit(machine: Machine) -> str:
    """Return the unit of the tracking error, or one for each drive, separated by commas."""
    return joined(machine.unit_by_joint("position", machine.plant.driven(machine.plant.joints)))


def _why(run: xr.Dataset) -> str:
    """Return the reason for which a run lacks a value for some parameter; empty if it has all."""
    if not run["converged"].item():
        return str(run["message"].item())
    missing = run.parameter.values[run["identifiable"].values == 0]
    return f"not identifiable: {', '.join(map(str, missing))}" if len(missing) else ""


def summarised(table: xr.Dataset) -> list[dict[str, Any]]:
    """Compute bias, spread and coverage of every estimator, setting and parameter.

    Returns:
        Rows with `runs` and `used` (converged, and the parameter identifiable); `failed`, the fraction of
        the others; over the runs used `bias` (mean error), `bias_std` (standard deviation of the mean),
        `spread` (standard deviation of the error), `rmse`, `std` (mean of those reported), `bound`
        (Cramer-Rao), and `coverage_68`, `coverage_95`: the fraction of intervals of that nominal coverage
        that hold the truth. NaN if no run has the quantity, such as for an estimator without a
        standard deviation.
    """
    rows = []
    for estimator, setting, whole in cells(table):
        for k, name in enumerate(table.parameter.values):
            own = whole.isel(parameter=k)
            truth, std = own["truth"].values, own["std"].values
            error = own["estimate"].values - truth
            used = own["converged"].values.astype(bool) & np.isfinite(error)
            rows.append({
                "estimator": estimator, **setting, "parameter": str(name),
                "unit": str(own["unit"].values), "true": float(np.mean(truth)),
                "runs": len(used), "used": int(used.sum()), "failed": float(1 - used.mean()),
                **_moments(error[used], std[used]), "bound": float(own["bound"].values),
            })  # fmt: skip
    return rows


def _moments(error: np.ndarray, std: np.ndarray) -> dict[str, float]:
    if not len(error):
        coverages = [f"coverage_{_percent(c)}" for c in COVERAGES]
        return dict.fromkeys(("bias", "bias_std", "spread", "rmse", "std", *coverages), np.nan)
    spread = float(np.std(error, ddof=1)) if len(error) > 1 else np.nan
    widths = {c: scipy.stats.norm.ppf(0.5 + 0.5 * c) for c in COVERAGES}
    held = {c: np.where(np.isfinite(std), np.abs(error) <= w * std, np.nan) for c, w in widths.items()}
    return {
        "bias": float(np.mean(error)),
        "bias_std": spread / np.sqrt(len(error)),
        "spread": spread,
        "rmse": float(np.sqrt(np.mean(error**2))),
        "std": float(np.mean(std)),
        **{f"coverage_{_percent(c)}": float(np.mean(x)) for c, x in held.items()},
    }


def _percent(part: float) -> int:
    return round(100 * part)
