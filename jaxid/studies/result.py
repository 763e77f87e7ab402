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
import xarray as xr

from jaxid.files import json_text, write_results
from jaxid.model.units import joined
from jaxid.studies.calibration import calibration_of, normal_pit, verdict_words
from jaxid.studies.rows import COLUMNS, Arrays, variables
from jaxid.studies.settings import SETTINGS, setting_of, words_of

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes

    from jaxid.machine import Machine
    from jaxid.studies.plan import Plan

FILES = ("study.nc", "summary.json", "report.html")


@dataclass(frozen=True, repr=False)
class Study:
    """Result of `study`.

    Args:
        table: Every run: `estimate`, `std`, `identifiable` (estimator, noise, run, parameter),
            `converged`, `steps`, `message`, `named` (estimator, noise, run), `truth` and `start` (run,
            parameter), and `bound`, the Cramer-Rao bound on the deviation (noise, parameter).
            `combinations` (estimator, noise, run) and `combination_error` (estimator, noise, run,
            parameter) are number and errors of the combinations that a fit within a prior identifies, the
            errors in units of their deviation. For loops it has `tracking_rms` and `tracking_peak` (noise,
            run, drive) in the last quarter of a run. SI units. `sample_rate` [Hz] and `position_resolution`
            come before noise if the study varies them.
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
        """Reasons (`why`) for which runs failed, with their number of `runs`.

        A run fails if its fit does not converge, or identifies nothing at all; see `partial` for fits that
        identify some parameters only. Rows are by estimator and setting. Reasons that differ only in numbers
        count as one.
        """
        out = []
        for estimator, setting, own in cells(self.table):
            firsts: dict[str, str] = {}
            counts: Counter[str] = Counter()
            converged, messages = own["converged"].values, own["message"].values
            for k in np.flatnonzero(~_succeeded(own)):
                why = "nothing is identifiable" if converged[k] else str(messages[k])
                kind = re.sub(r"\d[\d.e+-]*", "#", why)
                firsts.setdefault(kind, why)
                counts[kind] += 1
            out += [
                {"estimator": estimator, **setting, "why": firsts[kind], "runs": runs}
                for kind, runs in counts.most_common()
            ]
        return out

    @property
    def partial(self) -> list[dict[str, Any]]:
        """Parameters (`unidentifiable`, a list) that fits did not identify, with the number of `runs`.

        Such fits are successes: the log does not determine all parameters. Rows are by estimator and setting,
        and a row for each set of parameters.
        """
        out = []
        for estimator, setting, own in cells(self.table):
            names, shown = own.parameter.values, own["identifiable"].values.astype(bool)
            lacking = [tuple(map(str, names[~s])) for s in shown[_succeeded(own)] if not s.all()]
            out += [
                {"estimator": estimator, **setting, "unidentifiable": list(which), "runs": runs}
                for which, runs in Counter(lacking).most_common()
            ]
        return out

    @property
    def combinations(self) -> list[dict[str, Any]]:
        """Coverage of the combinations of parameters that fits within a prior identify.

        Rows are by estimator and setting: `runs` that identify any, `mean` number of combinations of these
        runs, and over all combinations `coverage_50` and so on, as in `summary`. Empty without such fits.
        """
        out = []
        for estimator, setting, own in cells(self.table):
            if "combinations" not in own:
                continue
            counts, good = own["combinations"].values, own["converged"].values.astype(bool)
            used = good & (counts > 0)
            if used.any():
                errors = own["combination_error"].values[used]
                pit = normal_pit(errors[np.isfinite(errors)], np.ones(1))
                row = {"runs": int(used.sum()), "mean": float(counts[used].mean()), **calibration_of(pit)}
                out.append({"estimator": estimator, **setting, **row})
        return out

    @property
    def verdicts(self) -> list[str]:
        """Sentences on the intervals of every estimator, setting and parameter: whether to rely on them."""
        rows = self.summary
        several = len({tuple(setting_of(r).items()) for r in rows}) > 1
        lines = [(r, verdict_words(r["parameter"], r)) for r in rows]
        lines += [(r, verdict_words("identified combinations", r)) for r in self.combinations]
        where = lambda r: f"{r['estimator']} at {words_of(r)}" if several else r["estimator"]
        return [f"{where(r)}: {line}" for r, line in lines if line]

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
            kind: "errors" (RMS error against the setting with most values), "coverage" (of 95 % intervals),
                "scatter" (errors in units of their reported deviation), or "ecdf" (of the truth's place in
                the reported distribution, minus the diagonal, with its simultaneous 95 % band).
            ax: Axes to draw on; None: a new figure, which a notebook shows.
            parameter: Name of the parameter; None: the first.
            step: Setting of "scatter" and "ecdf", in the order of the table; None: the first.

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
        words |= {"tracking": self.tracking, "partial": self.partial}
        words |= {"combinations": self.combinations, "verdicts": self.verdicts}
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


def _succeeded(runs: xr.Dataset) -> np.ndarray:
    """Return the mask of the runs that converged and identified any parameter or combination, (run,)."""
    any_told = (runs["identifiable"].values != 0).any(axis=-1)
    if "combinations" in runs:
        any_told = any_told | (runs["combinations"].values > 0)
    return runs["converged"].values.astype(bool) & any_told


def summarised(table: xr.Dataset) -> list[dict[str, Any]]:
    """Compute bias, spread and coverage of every estimator, setting and parameter.

    A run is a success if its fit converged and identified any parameter, or any combination of them.

    Returns:
        Rows with `runs`; `failed`, the fraction of runs that are no success; `identifiable`, the fraction of
        the successes that identify this parameter; and `used`, their number. Over the runs used `bias` (mean
        error), `bias_std` (standard deviation of the mean), `spread` (standard deviation of the error),
        `rmse`, `std` (mean of those reported), and `bound` (Cramer-Rao). Over their finite intervals
        `intervals` (number), `coverage_50`, `coverage_68`, `coverage_80` and `coverage_95`: the fraction of
        intervals of that nominal coverage that hold the truth; `accepted_95`: the range in which the last is
        with a probability of 99 % if the intervals are sound; `verdict`: see
        `jaxid.studies.calibration.verdict_of`; `pit_uniform`: whether the truth's place in the reported
        distribution is uniform, by the simultaneous band of its ECDF. NaN or None if no run has the quantity,
        such as for an estimator without a standard deviation.
    """
    rows = []
    for estimator, setting, whole in cells(table):
        good = _succeeded(whole)
        for k, name in enumerate(table.parameter.values):
            own = whole.isel(parameter=k)
            error, std = errors_of(own)
            used = good & np.isfinite(error)
            rows.append({
                "estimator": estimator, **setting, "parameter": str(name),
                "unit": str(own["unit"].values), "true": float(np.mean(own["truth"].values)),
                "runs": len(used), "used": int(used.sum()), "failed": float(1 - good.mean()),
                "identifiable": float(used.sum() / good.sum()) if good.any() else np.nan,
                **_moments(error[used], std[used]), "bound": float(own["bound"].values),
                **calibration_of(pits_of(own)),
            })  # fmt: skip
    return rows


def errors_of(own: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and reported deviations of one parameter under one setting, (run,) each."""
    return own["estimate"].values - own["truth"].values, own["std"].values


def pits_of(own: xr.Dataset) -> np.ndarray:
    """Return the truth's places in the reported distributions of one parameter, of the runs that have one.

    Args:
        own: Part of the table for one estimator, setting and parameter.
    """
    error, std = errors_of(own)
    used = own["converged"].values.astype(bool) & np.isfinite(error) & np.isfinite(std)
    return normal_pit(error[used], std[used])


def _moments(error: np.ndarray, std: np.ndarray) -> dict[str, float]:
    if not len(error):
        return dict.fromkeys(("bias", "bias_std", "spread", "rmse", "std"), np.nan)
    spread = float(np.std(error, ddof=1)) if len(error) > 1 else np.nan
    return {
        "bias": float(np.mean(error)),
        "bias_std": spread / np.sqrt(len(error)),
        "spread": spread,
        "rmse": float(np.sqrt(np.mean(error**2))),
        "std": float(np.mean(std)),
    }
