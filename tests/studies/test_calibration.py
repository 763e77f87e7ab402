"""Verdicts on intervals: sound ones pass as often as promised, others do not; partial fits are successes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from jaxid.studies.calibration import (
    accepted_range,
    calibration_of,
    coverage_of,
    ecdf_band,
    leaves_band,
    normal_pit,
    verdict_of,
    verdict_words,
)
from jaxid.studies.result import Study, summarised

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("runs", [25, 120, 1000])
def test_uniform_places_leave_the_band_in_five_of_a_hundred_studies(runs):
    """Fresh draws: 2000 studies know that to 0.5 %; what is discrete makes it no more than five."""
    rng = np.random.default_rng(7)
    out = np.mean([leaves_band(rng.uniform(size=runs)) for _ in range(2000)])
    assert 0.02 < out < 0.065
    points, low, high = ecdf_band(runs)
    assert len(points) == min(runs, 100) - 1
    assert np.all((low < 0) & (high > 0))


@pytest.mark.parametrize(
    ("scale", "bias", "verdict"),
    [(1.0, 0.0, "hold"), (1.7, 0.0, "too narrow"), (0.5, 0.0, "too wide"), (1.0, 1.0, "too narrow")],
)
def test_verdicts(scale, bias, verdict):
    """Errors wider, narrower and off by one deviation, of four hundred runs."""
    error = bias + scale * np.random.default_rng(3).standard_normal(400)
    row = calibration_of(normal_pit(error, np.ones(400)))
    assert row["verdict"] == verdict
    assert row["pit_uniform"] == (verdict == "hold")
    words = verdict_words("mass", row)
    opening = {
        "hold": "intervals of mass hold: 9",
        "too narrow": "do not rely on the intervals of mass: ",
        "too wide": "intervals of mass are wider than needed: ",
    }[verdict]
    assert words.startswith(opening)
    assert "% of 95 % intervals contain the truth, " in words
    assert "the range of 400 sound ones, " in words


def test_coverage_is_that_of_the_deviations():
    error = np.array([0.1, -0.9, 1.1, 1.9, -2.1, 0.6])
    pit = normal_pit(error, np.ones(6))
    for level, width in ((0.5, 0.6745), (0.68, 0.9945), (0.8, 1.2816), (0.95, 1.96)):
        assert coverage_of(pit, level) == np.mean(np.abs(error) <= width)
    # The place of the truth is low in the reported distribution if the estimate is too high.
    assert pit[2] < 0.5 < pit[1]
    assert verdict_of(pit) is None
    low, high = accepted_range(1000)
    assert (low, high) == pytest.approx((0.931, 0.967), abs=0.002)


def test_a_middle_that_is_too_wide_is_said():
    """Errors of half a deviation, but one in twenty far out: 95 % hold, and no other level does."""
    error = 0.5 * np.random.default_rng(4).standard_normal(1000)
    error[::20] = 3.0
    row = calibration_of(normal_pit(error, np.ones(1000)))
    assert row["verdict"] == "hold"
    assert row["coverage_50"] > 0.7
    assert "not at every level" in verdict_words("mass", row)


def made_up(combinations: bool) -> xr.Dataset:
    """Forty runs of two parameters: ten fail, ten identify the first, and ten nothing but combinations."""
    rng, shape, each = np.random.default_rng(0), (1, 1, 40, 2), ("estimator", "noise", "run", "parameter")
    told = np.ones(shape, np.int8)
    told[0, 0, 10:20, 1] = 0
    told[0, 0, 20:30] = 0
    estimate = np.where(told, 1.0 + 0.1 * rng.standard_normal(shape), np.nan)
    converged = np.ones(shape[:3], np.int8)
    converged[0, 0, :10] = 0
    counts = np.zeros(shape[:3], np.int32)
    counts[0, 0, 10:30] = 1
    errors = np.full(shape, np.nan)
    errors[0, 0, 10:30, 0] = np.linspace(-2.5, 2.5, 20)
    more = {"combinations": (each[:3], counts), "combination_error": (each, errors)} if combinations else {}
    return xr.Dataset(
        {
            "estimate": (each, estimate),
            "std": (each, np.where(told, 0.1, np.nan)),
            "identifiable": (each, told),
            "converged": (each[:3], converged),
            "message": (each[:3], np.where(converged, "converged", "no convergence").astype(object)),
            "named": (each[:3], np.full(shape[:3], "", object)),
            "truth": (each[2:], np.ones((40, 2))),
            "bound": (("noise", "parameter"), np.full((1, 2), np.nan)),
            "unit": (("parameter",), np.array(["kg", "N"], object)),
            **more,
        },
        coords={"estimator": ["a"], "noise": [1.0], "parameter": np.array(["m", "f"], object)},
    )


def test_a_fit_that_identifies_a_part_is_a_success():
    first, second = summarised(made_up(combinations=True))
    assert (first["failed"], second["failed"]) == (0.25, 0.25)
    assert (first["used"], second["used"]) == (20, 10)
    assert first["identifiable"] == pytest.approx(20 / 30)
    assert second["identifiable"] == pytest.approx(10 / 30)
    assert (first["intervals"], second["intervals"]) == (20, 10)
    study = Study(made_up(combinations=True), 1.0, "made up")
    assert [(f["why"], f["runs"]) for f in study.failures] == [("no convergence", 10)]
    assert [(p["unidentifiable"], p["runs"]) for p in study.partial] == [(["f"], 10), (["m", "f"], 10)]
    (row,) = study.combinations
    assert (row["runs"], row["mean"], row["intervals"]) == (20, 1.0, 20)
    assert row["coverage_95"] == pytest.approx(np.mean(np.abs(np.linspace(-2.5, 2.5, 20)) < 1.96))
    text = str(study)
    assert "10 of 40: without f" in text
    assert "f: " in text
    assert "10 intervals are too few for a verdict" in text


def test_a_fit_that_identifies_nothing_has_failed():
    """Without combinations, nothing is left of ten fits."""
    first, _ = summarised(made_up(combinations=False))
    assert first["failed"] == 0.5
    study = Study(made_up(combinations=False), 1.0, "made up")
    assert {f["why"]: f["runs"] for f in study.failures} == {
        "no convergence": 10,
        "nothing is identifiable": 10,
    }
    assert study.combinations == []


@pytest.mark.slow
def test_the_stage_is_no_failure(tmp_path):
    """The study of the benchmarks: no fit fails, and the combinations that it identifies are counted."""
    out = tmp_path / "out"
    command = ["study", ROOT / "benchmarks" / "cases" / "stage.toml", "--runs", "24", "-o", out, "--quiet"]
    subprocess.run([sys.executable, "-m", "jaxid.cli", *map(str, command)], check=True, cwd=ROOT)
    content = json.loads((out / "summary.json").read_text("utf-8"))
    assert content["failures"] == []
    assert all(r["failed"] == 0.0 for r in content["rows"])
    shares = {r["parameter"]: r["identifiable"] for r in content["rows"]}
    assert shares["motor_inertia"] > 0.8
    assert shares["cogging[2].phase"] == 0.0
    (row,) = content["combinations"]
    assert row["runs"] == 24
    assert row["intervals"] >= 48
    # Two to four a run, correlated: the coverage of some seventy is known to 4 %.
    assert row["coverage_95"] > 0.8
