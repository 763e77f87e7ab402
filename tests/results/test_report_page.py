"""The report of a fit and of a search: first page, curves on disk, and the page made from them again."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import jaxid
from jaxid.effects import EFFECTS
from jaxid.names import PICTURES
from jaxid.results.effect_words import CONTROLLER, DRIVE, GEAR, LOAD, words_of
from jaxid.results.report.build import discovery_data, identification_data
from jaxid.results.report.data import LogView
from jaxid.results.report.figure_tables import tables_of
from jaxid.results.report.first_page import completeness, first_values
from jaxid.results.report.force_plots import plot_frictions
from jaxid.results.report.page import render
from jaxid.results.report.store import packed, unpacked
from jaxid.results.report.telling import share_explained, telling_variable
from tests.support.cli_setup import VISCOUS, place, recorded, run, text

FRICTION = ("viscous_friction.coefficient", "coulomb_friction.level")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("page")
    place(made, recorded())
    (made / "bare.toml").write_text(text([VISCOUS]))
    return made


@pytest.fixture(scope="module")
def fitted(folder):
    return jaxid.identify(folder / "case.toml", folder / "log.csv", method="inverse_dynamics")


@pytest.fixture(scope="module")
def found(folder):
    return jaxid.discover(folder / "bare.toml", folder / "log.csv", refit=False, max_effects=1)


def words(page):
    body = page[page.index("<body>") :].replace("<wbr>", "")
    return " ".join(re.sub(r"<[^>]*>", " ", body).replace("\u00a0", " ").split())


# The first page


def test_friction_over_velocity_is_that_of_the_model_with_its_band(fitted):
    (curve,) = identification_data(fitted).friction
    viscous, dry = (fitted.value(name) for name in FRICTION)
    v = curve.velocity
    np.testing.assert_allclose(curve.force, viscous * v + dry * np.sign(v), rtol=1e-9)
    # To first order the band is that of a straight line in both parameters.
    names = fitted.estimate.names
    pick = [names.index(name) for name in FRICTION]
    covariance = fitted.covariance.matrix[np.ix_(pick, pick)]
    rows = np.stack([v, np.sign(v)], axis=1)
    half = 1.96 * np.sqrt(np.einsum("ki,ij,kj->k", rows, covariance, rows))
    np.testing.assert_allclose(curve.high - curve.force, half, rtol=1e-4)
    np.testing.assert_allclose(curve.force - curve.low, half, rtol=1e-4)
    # Measured force less inertia lies about the curve, as far as the residual.
    expected = viscous * curve.velocity_measured + dry * np.sign(curve.velocity_measured)
    left = curve.force_measured - expected
    assert np.sqrt(np.mean(left**2)) == pytest.approx(float(fitted.gaps[0].force.rms[0]), rel=0.1)
    figure = plot_frictions([curve], {"force": "N", "velocity": "m/s"})
    assert figure.axes[0].get_xlabel().startswith("velocity [")


def test_what_was_found_stands_in_the_chain_and_in_words(found):
    data = discovery_data(found)
    marks = {part.name: [(m.text, m.found) for m in part.marks] for part in data.chain}
    assert [*marks] == ["controller", "drive", "gear or belt", "load"]
    assert marks["load"] == [("coulomb friction", True), ("viscous friction", False)]
    facts = dict(data.facts)
    assert facts["machine"] == "bare (axis)"
    assert facts["log"] == "log.csv: 4 s at 500 Hz, 2000 samples"
    assert facts["command"] == "jaxid.discover(...) from Python"
    page = words(render(data))
    level = found.parameters["coulomb_friction.level"]
    assert f"Dry friction ( coulomb_friction ): −level · sign v with level = {level}." in page
    assert "Before and after: force residual over velocity" in page
    assert "1.96 σ" in page
    assert page.index("What was found") < page.index("The drive chain") < page.index("This run")


def test_a_ripple_is_drawn_over_the_position_folded_at_its_period(found):
    data = discovery_data(found)
    where = {"joint": 1, "text": "joint 1: the residual repeats", "periods": [0.0125, 0.3]}
    page = render(replace(data, where={**data.where, **where}))
    assert "Before and after: force residual over position, folded at 12.5 mm" in words(page)
    # A figure of the log has it over the whole position.
    assert ': force residual over position"' in page
    elsewhere = words(render(replace(data, where={**data.where, **where, "joint": 2})))
    assert "folded at" not in elsewhere


@pytest.mark.parametrize(("fitted", "drawn"), [(0.0127, "12.7 mm"), (0.02, "12.5 mm")])
def test_a_ripple_that_was_found_is_folded_at_its_fitted_period(found, fitted, drawn):
    data = discovery_data(found)
    where = {**data.where, "joint": 1, "text": "joint 1: the residual repeats", "periods": [0.0125]}
    [effect] = data.effects
    ripple = {**effect, "parameters": {**effect["parameters"], "period": {"value": fitted, "unit": "m"}}}
    assert f"folded at {drawn}" in words(render(replace(data, where=where, effects=(effect, ripple))))


def test_the_place_of_an_unexplained_residual_is_said_first(found):
    data = discovery_data(found)
    where = {**data.where, "text": "joint 1: the residual repeats over the position"}
    sentence = "Joint 1: the residual repeats over the position."
    page = words(render(replace(data, where=where, verdict="unexplained")))
    assert page.index(sentence) < page.index("The drive chain")
    assert sentence not in words(render(replace(data, where=where)))


def test_effects_of_one_kind_at_many_joints_are_one_entry(found):
    data = discovery_data(found)
    [one] = data.effects
    joints = [3, 1, 2, 4, 5]
    page = words(render(replace(data, effects=tuple({**one, "joint": k} for k in joints))))
    assert "found: coulomb_friction at 5 places" in page
    assert page.count("Dry friction (") == 1
    at = [page.index(f"joint {k}: level = ") for k in range(1, 6)]
    assert at == sorted(at)
    # A few stand one by one, in the order in which they were found.
    few = words(render(replace(data, effects=tuple({**one, "joint": k} for k in joints[:2]))))
    assert "found: coulomb_friction (joint 3), then coulomb_friction (joint 1)" in few


def test_a_long_list_of_values_begins_with_what_is_known(fitted):
    data = identification_data(fitted)
    rows = [replace(data.parameters[0], name=f"mass[{k}]", identifiable=k > 20) for k in range(40)]
    shown, more = first_values(replace(data, parameters=tuple(rows), derived=()))
    assert [line["name"] for line in shown] == [f"mass[{k}]" for k in range(21, 29)]
    assert more == 32
    page = render(replace(data, parameters=tuple(rows), derived=()))
    assert "32 more stand" in words(page)
    # All stand in the folded table, and what is not identifiable is folded too.
    assert page.count(">mass[39]<") == 1
    assert '<details class="sheet" id="missing">' in page
    assert page.count("<details") == page.count("</details>")
    assert page.count("<section") == page.count("</section>")


def test_sums_of_inertias_and_vague_values_come_last(fitted):
    data = identification_data(fitted)
    one = replace(data.parameters[0], identifiable=True, value=2.0, std=0.01)
    sums = [replace(one, name=f"inertia_xx[{k}]") for k in range(30)]
    frictions = [replace(one, name=f"viscous_friction[{k}].coefficient") for k in range(1, 8)]
    vague = [replace(one, name=f"first_moment_x[{k}]", std=3.0) for k in range(9)]
    shown, _ = first_values(replace(data, parameters=(*vague, *sums, *frictions), derived=()))
    assert [line["name"] for line in shown] == ["inertia_xx[0]", *(row.name for row in frictions)]


def test_every_effect_has_words():
    for kind, cls in EFFECTS.items():
        assert cls.title, kind
        known = words_of(kind, cls.__doc__ or "", in_drive=cls.in_drive, of_spring=cls.of_spring)
        assert known.name
        assert known.formula
        assert known.part in (CONTROLLER, DRIVE, GEAR, LOAD)
        # Parameters that a formula names exist.
        names = {"cos", "sign", "exp", "force", "of", "the", "drive"} | {f for f in cls.__dataclass_fields__}
        if known.formula.startswith("−"):
            assert set(re.findall(r"[a-z_]{4,}", known.formula)) - {"while", "speed", "grows"} <= names, kind
    assert words_of("magnetic_pull", "Pull of a magnet.\n\nMore.").formula == "Pull of a magnet"


def _view(residual, position, velocity):
    time = np.arange(position.size) * 1e-3
    return LogView("fit", time, position, None, None, time, velocity, position, 0 * time, None, residual)


def test_the_figure_that_tells_most_is_chosen_by_the_residual():
    rng = np.random.default_rng(1)
    t = np.arange(8000) * 1e-3
    position = 0.1 * np.sin(1.3 * t) + 0.05 * np.sin(3.1 * t)
    velocity = np.gradient(position, t)
    noise = 0.3 * rng.standard_normal(t.size)
    ripple = np.cos(2 * np.pi * position / 0.01)
    assert telling_variable(_view(ripple + noise, position, velocity)) == "position"
    stribeck = np.exp(-((velocity / 0.05) ** 2)) * np.sign(velocity)
    assert telling_variable(_view(stribeck + noise, position, velocity)) == "velocity"
    assert telling_variable(_view(noise, position, velocity)) == "time"
    assert share_explained(position, ripple + noise) == pytest.approx(0.5 / (0.5 + 0.09), abs=0.05)
    # Bins alone explain 0.03 of noise; that is taken off.
    assert abs(share_explained(position, noise)) < 0.015


def test_every_figure_has_its_numbers(fitted):
    page = render(identification_data(fitted))
    figures = page.count("<img ")
    assert figures > 4
    assert page.count("Numbers of this figure") == figures
    (curve,) = identification_data(fitted).friction
    (table,) = tables_of(plot_frictions([curve], {"force": "N", "velocity": "m/s"}))
    assert len(table.rows) <= 40
    cells = [float(c.replace("−", "-")) for c in table.rows[-1] if c != "–"]
    assert max(cells) == pytest.approx(curve.force[-1], rel=0.01)


# The curves on disk


def test_the_page_is_made_again_from_its_curves(folder, fitted, tmp_path, capsys):
    fitted.save(tmp_path / "out")
    first = (tmp_path / "out" / "report.html").read_text()
    (tmp_path / "out" / "report.html").unlink()
    ran = run(capsys, "report", tmp_path / "out")
    assert (ran.status, ran.err) == (0, "")
    again = (tmp_path / "out" / "report.html").read_text()
    # Drawings carry random names inside.
    bare = lambda page: words(re.sub(r"data:image[^\"]+", "", page))
    assert bare(again) == bare(first)
    (tmp_path / "out" / "result.npz").write_bytes(b"no archive")
    assert "result.npz: cannot be read" in run(capsys, "report", tmp_path / "out").err
    (tmp_path / "out" / "result.npz").unlink()
    assert "result.npz: is missing" in run(capsys, "report", tmp_path / "out").err


def test_each_picture_of_a_result(fitted, found, tmp_path, capsys):
    (tmp_path / "fit.npz").write_bytes(packed(identification_data(fitted)))
    (tmp_path / "search.npz").write_bytes(packed(discovery_data(found)))
    drawn = set()
    for kind in PICTURES:
        for name in ("fit", "search"):
            picture = tmp_path / f"{name}_{kind}.svg"
            ran = run(capsys, "plot", tmp_path / f"{name}.npz", kind, "-o", picture)
            if ran.status == 0:
                drawn.add(kind)
                assert picture.read_text().startswith("<?xml")
            else:
                assert f"this result has no {kind} to draw" in ran.err
    assert set(PICTURES) - drawn == {"history", "profiles", "motion"}
    ran = run(capsys, "plot", tmp_path / "fit.npz", "forces", "-o", tmp_path / "a.png", "--joint", 2)
    assert "joint 2 has no measured position; choose one of 1" in ran.err


def test_signals_as_a_table(fitted, tmp_path, capsys):
    (tmp_path / "fit.npz").write_bytes(packed(identification_data(fitted)))
    ran = run(capsys, "plot", tmp_path / "fit.npz", "signals", "-o", tmp_path / "signals.csv")
    assert (ran.status, ran.err) == (0, "")
    table = np.genfromtxt(tmp_path / "signals.csv", delimiter=",", names=True, deletechars="")
    log, gap = fitted.session.fit.log, fitted.gaps[0]
    np.testing.assert_allclose(table["time"], log.time)
    np.testing.assert_allclose(table["fit/joint_1/position/measured_[m]"], log.position[:, 0], rtol=1e-10)
    residual = table["fit/joint_1/force/residual_[N]"]
    known = gap.force.residual[np.isfinite(gap.force.residual)]
    np.testing.assert_allclose(residual[np.isfinite(residual)], known, rtol=1e-10)


def test_long_logs_are_thinned_on_disk(tmp_path, fitted):
    data = identification_data(fitted)
    (view,) = data.views
    n = 120_000
    long = replace(
        view, time=np.arange(n) * 1e-3, position_measured=np.zeros(n), position_simulated_after=np.zeros(n)
    )
    (tmp_path / "long.npz").write_bytes(packed(replace(data, views=(long,))))
    kept = unpacked(tmp_path / "long.npz").views[0]
    assert len(kept.time) == len(kept.position_simulated_after) == 40_000
    assert len(kept.velocity) == len(view.velocity)
    assert unpacked(tmp_path / "long.npz").gap == data.gap


def test_both_commands_keep_their_reports_in_one_folder(fitted, found, tmp_path):
    out = tmp_path / "out"
    title = lambda name: re.search(r"<h1>([^<]*)", (out / name).read_text())[1]
    fitted.save(out)
    found.save(out)
    assert title("report.html") == "What is missing in bare"
    assert title("report_identify.html") == "Identification of the axis"
    fitted.save(out)
    assert title("report.html") == "Identification of the axis"
    assert title("report_discover.html") == "What is missing in bare"
    assert not (out / "report_identify.html").exists()
    assert {"result.npz", "discovery.npz", "result.json", "discovery.json"} <= {p.name for p in out.iterdir()}


@pytest.mark.parametrize(("identified", "style"), [(True, "good"), (False, "open")])
def test_no_badge_is_green_where_nothing_is_identified(identified, style):
    shown = {"verdict": None, "model_complete": True, "findings": (), "explains": True}
    data = SimpleNamespace(**shown, parameters=("inertia",), identified=identified)
    assert completeness(data) == {"text": "model complete", "style": style}
