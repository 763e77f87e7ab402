"""The report: it stands alone, holds the numbers, and copes with what is absent."""

import base64
import hashlib
import html
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from jaxid.results.report import (
    CandidateScore,
    LogView,
    ParameterRow,
    ReportData,
    SearchStep,
    WherePlot,
    render,
)


def _view(name="fit", samples=2000, *, simulated=True, before=True, after=True):
    """A slow axis with dry friction of 20 N that the first model lacks; noise of 6 N."""
    rng = np.random.default_rng(len(name))
    time = np.arange(samples) * 1e-3
    velocity = 0.2 * np.sin(2.0 * time)
    position = -0.1 * np.cos(2.0 * time)
    moving = np.flatnonzero(np.abs(velocity) > 1e-2)[::4]
    noise = 6.0 * rng.standard_normal(moving.size)
    friction = 20.0 * np.sign(velocity[moving])
    return LogView(
        name=name,
        time=time,
        position_measured=position + 2e-6 * rng.standard_normal(samples),
        position_simulated_before=position + 0.01 * np.sin(2.1 * time) if simulated else None,
        position_simulated_after=position + 1e-4 * np.sin(2.1 * time) if simulated else None,
        band_time=time[moving],
        velocity=velocity[moving],
        position=position[moving],
        force_measured=friction + 40.0 * position[moving] + noise,
        residual_before=friction + noise if before else None,
        residual_after=noise if after else None,
    )


def _step():
    scores = (("cogging", -3.0), ("coulomb_friction", 812.4), ("hysteresis", 811.2))
    candidates = [CandidateScore(k, e, k == "coulomb_friction") for k, e in scores]
    failed = CandidateScore("backlash", float("nan"))
    return SearchStep("coulomb_friction", None, 6.1, 6.9, (*candidates, failed), 12.5)


def _discovery(**changes):
    speeds = np.linspace(-0.2, 0.2, 21)
    mean = 20.0 * np.sign(speeds)
    level = {"value": 20.123, "std": 0.31, "unit": "N"}
    effect = {"kind": "coulomb_friction", "joint": 1, "parameters": {"level": level}}
    effect |= {"evidence": 812.4, "alternatives": [{"kind": "hysteresis", "evidence": 811.2}]}
    gap = {"unit": "N", "band_hz": 60.0, "before": 20.7, "after": 6.9, "noise_floor": 5.8}
    data = ReportData(
        title="Axis of the test stand",
        command="discover",
        case_name="axis.toml",
        log_name="axis.csv",
        verdict="found",
        gap={**gap, "on": "validation", "simulation": {"unit": "m", "before": 0.011, "after": 0.0}},
        parameters=(
            ParameterRow("inertia", 95.1034, 0.2134, "kg m^2"),
            ParameterRow("added_mass.mass", None, None, "kg", identifiable=False),
        ),
        unidentifiable=({"combination": {"inertia": 0.71, "added_mass.mass": -0.71}},),
        effects=(effect,),
        where={
            "joint": 1,
            "variable": "velocity",
            "region": [-0.02, 0.02],
            "intervals": [[1.2, 1.31]],
            "text": "It jumps at rest.",
        },
        steps=(SearchStep(None, None, 21.0, 20.7), _step()),
        where_plot=WherePlot("velocity", "m/s", speeds, mean, mean - 2.0, mean + 2.0),
        views=(_view(), _view("pulses")),
        notes=("Reverse more often.",),
        versions={"jaxid": "0.1.0"},
    )
    return replace(data, **changes)


def _identification(**changes):
    data = ReportData(
        title="Axis",
        command="identify",
        case_name="axis.toml",
        log_name="axis.csv",
        verdict=None,
        gap={
            "unit": "N",
            "band_hz": 60.0,
            "fit": 6.1,
            "validation": 7.0,
            "noise_floor": None,
            "relative": {"fit": 0.031, "validation": None},
            "simulation": None,
        },
        parameters=(ParameterRow("inertia", 95.1, 0.2, "kg"),),
    )
    return replace(data, **changes)


def _words(page):
    """The page's text as a reader sees it."""
    body = page[page.index("<body>") :].partition("<script>")[0].replace("<wbr>", "")
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", body)).replace("\u00a0", " ").split())


@pytest.fixture(scope="module")
def page():
    return render(_discovery())


def _without_script(page: str) -> str:
    """The page without its one script, which its policy allows by the digest."""
    [code] = re.findall(r"<script>(.*?)</script>", page, re.S)
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    assert (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'" in page
    )
    rest = page.replace(f"<script>{code}</script>", "")
    assert "<script" not in rest
    return rest


def test_the_page_stands_alone(page):
    page = _without_script(page)
    assert page.lstrip().startswith("<!DOCTYPE html>")
    assert "http://" not in page
    assert "https://" not in page
    targets = re.findall(r'(?:src|href|srcset)="([^"]*)"', page)
    assert targets
    assert all(target.startswith(("#", "data:image/")) for target in targets)
    assert "url(" not in page
    assert "@import" not in page


def test_anchors_lead_somewhere_and_images_have_words(page):
    for anchor in re.findall(r'href="#([^"]*)"', page):
        assert page.count(f'id="{anchor}"') == 1
    images = re.findall(r"<img[^>]*>", page)
    # Each log: position, force, three clouds, of which the one that tells most is on the first page; then the
    # ranking and the place.
    assert len(images) == 2 * 5 + 1 + 1
    assert all(re.search(r'alt="[^"]{10,}"', image) for image in images)


def test_the_page_holds_the_numbers(page):
    words = _words(page)
    assert "found: coulomb_friction The declared model lacks physics that the log shows." in words
    assert "force validation 20.7 N 6.90 N 5.80 N 1.19" in words
    assert "force fit 21.0 N 6.10 N" in words
    assert "simulated position validation 11.0 mm 0 mm" in words
    assert "inertia 95.10 kg m² 94.69 to 95.52 0.21 0.22 %" in words
    assert "added_mass.mass – kg not identifiable" in words
    assert "Dry friction ( coulomb_friction ): −level · sign v with level = 20.12 ± 0.31 N." in words
    assert "Met in guides, bearings and seals under preload" in words
    assert "hysteresis (811.2)" in words
    assert "inertia by +0.71 and added_mass.mass by −0.71" in words
    assert "1 coulomb_friction added 6.10 6.90 4 812.4 12.5" in words
    assert "−0.02 to 0.02 m/s" in words
    # A pattern over velocity is shown over velocity, and its instants are not listed.
    assert "1.2–1.31 s" not in words
    over_time = {**_discovery().where, "variable": "time"}
    assert "1.2–1.31 s" in _words(render(_discovery(where=over_time, where_plot=None, views=())))
    assert "Reverse more often." in words
    assert "jaxid 0.1.0" in words


def test_sections_stand_in_the_promised_order(page):
    order = ["found", "figures", "parameters", "log-0", "gap", "missing", "notes"]
    order += ["effects", "search", "where", "log-1"]
    places = [page.index(f'id="{name}"') for name in order]
    assert places == sorted(places)


def test_hostile_names_are_escaped():
    bad = "<script>alert(1)</script>\"'"
    data = _discovery(
        title=bad,
        case_name=bad,
        log_name=bad,
        parameters=(ParameterRow(bad, 1.0, 0.1, bad),),
        unidentifiable=({"combination": {bad: 1.0}},),
        effects=({"kind": bad, "parameters": {}, "evidence": None, "alternatives": []},),
        where={"joint": 1, "variable": bad, "text": bad},
        steps=(SearchStep(bad, None, 1.0),),
        where_plot=None,
        views=(_view(bad, 400, simulated=False, before=False),),
        notes=(bad,),
        versions={bad: bad},
    )
    page = _without_script(render(data))
    assert page.count("&lt;script&gt;") >= 12


@pytest.mark.parametrize(
    "data",
    [
        _identification(),
        _identification(gap={}, parameters=(), converged=False),
        _identification(views=(_view(simulated=False, before=False),)),
        _identification(views=(_view(simulated=False, before=False, after=False),)),
        _discovery(verdict="unexplained", effects=(), views=(), where_plot=None),
        _discovery(verdict="nothing_missing", effects=(), where=None, steps=(), views=()),
        _discovery(where={"joint": None, "variable": None, "region": None, "text": None}, views=()),
        _discovery(effects=({"kind": "backlash", "spring": 2, "parameters": {}},), views=()),
    ],
)
def test_what_is_absent_is_left_out(data):
    words = _words(render(data))
    assert not re.search(r"\b(nan|none|inf)\b", words, re.IGNORECASE)


def test_verdicts_are_in_plain_words():
    nothing = {"verdict": "nothing_missing", "effects": (), "views": ()}
    assert "nothing is missing" in _words(render(_discovery(**nothing, model_complete=True)))
    unknown = _words(render(_discovery(**nothing, model_complete=None)))
    assert "nothing was found" in unknown
    assert "nothing is missing" not in unknown
    assert "unexplained" in _words(render(_discovery(verdict="unexplained", views=())))
    words = _words(render(_identification()))
    assert "1 parameter identified" in words
    assert "The force residual on the fit log is 6.10 N (RMS)." in words
    assert "did not converge" in _words(render(_identification(converged=False)))
    place = {"kind": "coulomb_friction", "joint": 2, "parameters": {}}
    assert "found: coulomb_friction (joint 2)" in _words(render(_discovery(effects=(place,), views=())))


@pytest.mark.parametrize(("complete", "style"), [(True, "good"), (None, "open"), (False, "open")])
def test_only_a_complete_model_has_a_green_badge(complete, style):
    assert f'<p class="badge {style}">' in render(_identification(model_complete=complete))


def test_gap_of_several_joints_and_logs():
    words = _words(
        render(
            _identification(
                gap={
                    "unit": ["N", "N m"],
                    "fit": [6.1, 0.5],
                    "validation": [7.0, 0.6],
                    "validations": {"slow": [7.0, 0.55], "fast": [6.5, 0.6]},
                    "noise_floor": [5.0, None],
                }
            )
        )
    )
    assert "force, joint 1 fit 6.10 N 5.00 N 1.22" in words
    assert "force, joint 2 validation: fast 0.600 N m" in words


def test_joints_of_unlike_units_are_not_put_in_one_range():
    gap = {"unit": ["N", "N m", "N m", "N"], "fit": [6.1, 0.5, 0.7, 2.0], "noise_floor": [5.0, 0.4, 0.6, 2.0]}
    words = _words(render(_identification(views=(), gap=gap)))
    assert "of joints 1 and 4 on the fit log is 2.00–6.10 N (RMS), at noise floors of 2.00–5.00 N." in words
    assert "of joints 2 and 3 on the fit log is 0.500–0.700 N m (RMS)" in words
    assert "4 joints" not in words


def test_a_fault_in_the_reading_of_the_force_is_no_missing_physics():
    drift = ("The force seems to drift.", "Subtract the zero of the sensor.")
    words = _words(render(_discovery(views=(), findings=drift, misread=True)))
    assert "completeness not known The force seems to drift." in words
    assert "lacks physics" not in words


def test_logs_are_not_mixed_in_the_answer():
    """Steps of a search hold one number for all joints, of the other log."""
    gap = {"unit": "N", "before": [4.1, 3.5], "after": [1.0, 0.02], "noise_floor": [1.0, 0.016]}
    data = _discovery(views=(), gap={**gap, "on": "validation"})
    words = _words(render(data))
    assert "force residual of joint 1 on the validation log falls from 4.10 N to 1.00 N" in words
    assert "3 joints" not in words
    assert "force, worst joint fit 21.0 N" in words


def test_a_line_in_the_spectrum_has_no_region():
    data = _discovery(views=())
    assert "region" in _words(render(data))
    assert "region" not in _words(render(replace(data, where={**data.where, "frequency_hz": 33.0})))


def test_non_finite_data_neither_fail_nor_show():
    view = _view()
    diverged = view.position_measured.copy()
    diverged[900:] = np.inf
    rough = replace(
        view,
        position_simulated_after=diverged,
        residual_before=np.full_like(view.residual_before, np.nan),
    )
    page = render(_discovery(views=(rough,), gap={"unit": "N", "before": float("nan")}))
    assert "nan" not in _words(page).lower()


def test_tiny_and_constant_logs_can_be_drawn():
    one = np.ones(1)
    none = np.ones(0)
    render(_discovery(views=(LogView("one", one, one, one, one, one, one, one, one, one, one),)))
    render(_discovery(views=(LogView("rest", one, one, None, None, *[none] * 6),)))
    flat = replace(_view(), velocity=np.zeros_like(_view().velocity))
    render(_discovery(views=(flat,)))


def test_long_logs_stay_small():
    page = render(_discovery(views=(_view(samples=25_000), _view("pulses", 25_000))))
    assert len(page.encode()) < 3e6


def test_importing_the_report_leaves_jax_and_pyplot_alone():
    code = "import sys, jaxid.results.report; sys.exit(len({'jax', 'matplotlib.pyplot'} & {*sys.modules}))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
