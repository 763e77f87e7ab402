"""Studies: the same bits however they are cut short, nothing dropped, and numbers that mean what they say."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import scipy.stats
import xarray as xr

import jaxid
from jaxid.commands.report import report
from jaxid.errors import InputError
from jaxid.numerics.lanes import SolveRequest, run_alone, run_batched
from jaxid.studies import plan as planned
from jaxid.studies.plan import Plan
from jaxid.studies.result import summarised
from tests.support.cli_setup import run
from truth.arm.two_links_case import TRUTH, written
from truth.axis.cases import write_case

AXIS = """
[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 1.4, true = 2.0 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 5.0, true = 3.0 }
[sensor]
position_noise = 3e-5
[input]
kind = "multisine"
band_hz = [0.5, 4.0]
period = 2.0
amplitude = 8.0
[simulation]
duration = 2.0
sample_rate = 200.0
[preprocess]
cutoff_hz = 20.0
"""
STUDY = """
[study]
estimators = ["inverse_dynamics", "algebraic"]
noise = [0.5, 1.0]
runs = 7
chunk = 3
start_spread = 0.2
draw = 0.1
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A study that nothing interrupted, on disk."""
    folder = tmp_path_factory.mktemp("study")
    case = write_case(folder, AXIS + STUDY)
    return case, jaxid.study(case, folder=folder / "out", seed=3), folder / "out"


def read(folder) -> xr.Dataset:
    with xr.open_dataset(folder / "study.nc", engine="scipy") as table:
        return table.load()


def test_the_table_is_what_others_read(whole):
    _, study, folder = whole
    table = read(folder)
    assert table["estimate"].dims == ("estimator", "noise", "run", "parameter")
    assert table["estimate"].shape == (2, 2, 7, 2)
    assert [str(n) for n in table.parameter.values] == ["inertia", "viscous_friction.coefficient"]
    assert [str(u) for u in table["unit"].values] == ["kg", "N s/m"]
    np.testing.assert_array_equal(table["estimate"], study.table["estimate"])
    rows = json.loads((folder / "summary.json").read_text())["rows"]
    assert len(rows) == 2 * 2 * 2
    assert "All numbers" in (folder / "report.html").read_text()


def test_draws_are_spread_about_truth_and_guess(whole):
    table = whole[1].table
    truth, start = table["truth"].values, table["start"].values
    assert len(np.unique(truth[:, 0])) == len(np.unique(start[:, 0])) == 7
    assert np.abs(np.log(truth / [2.0, 3.0])).max() < 0.5
    assert np.abs(np.log(start / [1.4, 5.0])).max() < 1.0
    # Estimates follow the truth of their own run.
    error = np.abs(table["estimate"] / table["truth"] - 1).isel(parameter=0)
    assert float(error.max()) < 0.02


def test_noise_scales_the_errors(whole):
    table = whole[1].table.sel(estimator="algebraic", parameter="inertia")
    spread = (table["estimate"] - table["truth"]).std("run")
    # Both levels see the same draws, so that errors double to first order. (The error of the friction
    # goes with the draw of its truth: the log starts at rest.)
    np.testing.assert_allclose(spread.isel(noise=1) / spread.isel(noise=0), 2.0, rtol=0.2)


def test_noise_does_not_move_the_mean_of_inverse_dynamics(whole):
    """The bias by noise of readings, which grows with its square, is taken off: 0.004 kg with it."""
    table = whole[1].table.sel(estimator="inverse_dynamics", parameter="inertia")
    error = (table["estimate"] - table["truth"]).mean("run").values
    assert abs(error[1] - error[0]) < 0.002


VARIED = STUDY.replace("[0.5, 1.0]", "[1.0]").replace(
    "[study]\n", "[study]\nsample_rate = [200.0, 400.0]\nposition_resolution = [1e-6, 1e-3]\n"
)


@pytest.mark.slow
def test_sampling_and_resolution_are_varied_with_each_other(tmp_path):
    study = jaxid.study(write_case(tmp_path, AXIS + VARIED), runs=4)
    table = study.table
    assert table["estimate"].dims[:4] == ("estimator", "sample_rate", "position_resolution", "noise")
    spread = (table["estimate"] - table["truth"]).std("run").sel(parameter="inertia", noise=1.0)
    one = spread.sel(estimator="inverse_dynamics")
    # A thousandth is 30 deviations of the readings' noise.
    assert np.all(one.sel(position_resolution=1e-3) > 2 * one.sel(position_resolution=1e-6))
    settings = [(r["sample_rate"], r["position_resolution"]) for r in study.summary[::2]]
    assert settings[:4] == [(200.0, 1e-6), (200.0, 1e-3), (400.0, 1e-6), (400.0, 1e-3)]
    # More samples hold more, at the same noise of each.
    bound = table["bound"].sel(parameter="inertia", position_resolution=1e-6, noise=1.0)
    assert float(bound[0] / bound[1]) == pytest.approx(np.sqrt(2), rel=0.02)
    page = (study.save(tmp_path / "out") / "report.html").read_text()
    assert "400 Hz, resolution 0.001, noise 1" in page
    # The page is made again from the files.
    again = report(tmp_path / "out")
    assert "400 Hz, resolution 0.001, noise 1" in again
    assert again.count("<tr>") == page.count("<tr>")
    with xr.open_dataset(tmp_path / "out" / "study.nc", engine="scipy") as saved:
        np.testing.assert_array_equal(saved["estimate"], table["estimate"])


def test_the_loop_stays_where_its_log_is_sampled_otherwise(tmp_path):
    """Gains without a period belong to the rate of [simulation]."""
    text = CHAIN.replace("period = 0.001\n", "").replace("runs = 3", "sample_rate = [500.0, 250.0]")
    plan = Plan.of(jaxid.load_case(write_case(tmp_path, text)))
    assert [level.scene.machine.controller.period for level in plan.levels] == [0.002, 0.002]
    assert [level.scene.every for level in plan.levels] == [1, 2]
    wrong = text.replace("250.0]", "400.0]")
    with pytest.raises(InputError, match="a loop of 500 Hz cannot be logged at sample_rate = 400"):
        jaxid.study(write_case(tmp_path, wrong))


def test_a_run_is_the_same_whatever_else_is_varied(whole, tmp_path):
    run_alone = jaxid.study(whole[0], runs=3, seed=3)
    both = jaxid.study(write_case(tmp_path, AXIS + STUDY.replace(
        "[study]\n", "[study]\nsample_rate = [200.0, 400.0]\n"
    )), runs=3, seed=3)  # fmt: skip
    own = both.table["estimate"].sel(sample_rate=200.0)
    np.testing.assert_array_equal(own, run_alone.table["estimate"])


def test_resumed_to_the_same_bits(whole, tmp_path):
    case, _, folder = whole
    out = tmp_path / "out"
    jaxid.study(case, folder=out, seed=3)
    for number in (0, 4, 5):
        (out / "chunks" / f"{number:06d}.npz").unlink()
    for name in ("study.nc", "summary.json", "report.html"):
        (out / name).unlink()
    jaxid.study(case, folder=out, seed=3, resume=True)
    assert (out / "study.nc").read_bytes() == (folder / "study.nc").read_bytes()


def test_a_run_does_not_depend_on_those_beside_it(whole):
    case, study, _ = whole
    few = jaxid.study(case, runs=2, seed=3)
    np.testing.assert_array_equal(few.table["estimate"], study.table["estimate"].isel(run=slice(2)))


@pytest.mark.slow
def test_discover_names_what_is_hidden_from_the_model(tmp_path):
    """Simulated with a constant force that the model does not have: estimators are biased by it."""
    more = '[[effects]]\nkind = "constant_force"\nlevel = 2.0\n[sensor]'
    text = AXIS.replace("[sensor]", more).replace("duration = 2.0", "duration = 10.0")
    text += '[study]\nestimators = ["discover"]\nhidden = ["constant_force"]\nruns = 3\n'
    study = jaxid.study(write_case(tmp_path, text))
    assert [(n["what"], n["runs"]) for n in study.named] == [("constant_force", 3)]
    assert [str(n) for n in study.table.parameter.values] == ["inertia", "viscous_friction.coefficient"]
    assert "constant_force" in str(study)
    study.save(tmp_path / "out")
    assert "What discover named" in (tmp_path / "out" / "report.html").read_text()


def test_what_is_hidden_must_be_there(tmp_path):
    text = AXIS + '[study]\nhidden = ["cogging"]\n'
    with pytest.raises(InputError, match="'cogging' is not among the effects.*viscous_friction"):
        jaxid.study(write_case(tmp_path, text))


@pytest.mark.slow
def test_killed_and_resumed_to_the_same_bits(whole, tmp_path):
    case, _, folder = whole
    out, command = tmp_path / "out", [sys.executable, "-m", "jaxid.cli", "study", str(case), "--seed", "3"]
    with subprocess.Popen([*command, "-o", str(out)]) as process:
        while process.poll() is None and len(list(out.glob("chunks/*.npz"))) < 2:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not (out / "study.nc").exists()
    there = {p.name: p.read_bytes() for p in out.glob("chunks/*.npz")}
    assert 2 <= len(there) < 6
    subprocess.run([*command, "-o", str(out), "--resume"], check=True, stdout=subprocess.DEVNULL)
    assert all((out / "chunks" / name).read_bytes() == content for name, content in there.items())
    assert (out / "study.nc").read_bytes() == (folder / "study.nc").read_bytes()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::DeprecationWarning")
def test_a_worker_that_dies_loses_nothing(whole, tmp_path):
    """Two workers of a Dask cluster; the one that is given work first is killed under it."""
    from distributed import LocalCluster

    case, _, folder = whole
    killed = []
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with LocalCluster(**options, worker_dashboard_address=None) as cluster:

        def kill(done: int, runs: int) -> None:
            if not killed and done:
                killed.append(next(iter(cluster.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        out = tmp_path / "out"
        jaxid.study(case, folder=out, seed=3, scheduler=cluster.scheduler_address, progress=kill)
    assert killed
    assert (out / "study.nc").read_bytes() == (folder / "study.nc").read_bytes()


def test_a_scheduler_that_does_not_answer(whole, monkeypatch, tmp_path):
    monkeypatch.setattr("jaxid.studies.remote._PATIENCE", 1)
    with pytest.raises(InputError, match="no scheduler answers at tcp://127.0.0.1:9"):
        jaxid.study(whole[0], runs=2, scheduler="tcp://127.0.0.1:9", folder=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_chain_in_its_loop(tmp_path):
    """Several joints, lists of parameters, the loop's command at every tick of a slower log."""
    study = jaxid.study(write_case(tmp_path, CHAIN))
    assert study.failures == []
    assert all(r["rmse"] < 0.05 * abs(r["true"]) for r in study.summary)
    # Squares of three errors sum to chi-square times the variance: 99.9 % of them are within these limits, if
    # the estimator attains the bound, as output error does. Inverse dynamics does not: between the rows of a
    # slower log it does not know the command, and the error of two values is 40 times the bound.
    low, high = np.sqrt(scipy.stats.chi2.ppf([5e-4, 1 - 5e-4], 3) / 3)
    ratios = {(r["estimator"], r["parameter"]): r["rmse"] / r["bound"] for r in study.summary}
    assert all(low < ratio < high for (name, _), ratio in ratios.items() if name == "output_error"), ratios


@pytest.mark.slow
def test_what_a_law_found_in_its_loop_is_a_row(tmp_path):
    """As `simulate` has it of the same machine; beside it how far the loop is off its reference."""
    case = written(tmp_path, "velocity_average = 4\nreach = 8", duration=1.2)
    case.write_text(case.read_text() + '[study]\nestimators = ["in_loop"]\nruns = 2\n')
    study = jaxid.study(case)
    run = jaxid.simulate(case)
    last = np.asarray(run.trajectory.found.theta)[-1]
    np.testing.assert_allclose(study.table["estimate"][0, 0, 1], last, rtol=1e-9)
    assert np.abs(last / TRUTH - 1).max() < 0.02
    error = (run.log.reference - np.asarray(run.trajectory.position))[-1200:]
    rms = study.table["tracking_rms"][0]
    np.testing.assert_allclose(rms[0], np.sqrt(np.mean(error**2, axis=0)), rtol=1e-6)
    np.testing.assert_allclose(study.table["tracking_peak"][0, 0], np.abs(error).max(axis=0), rtol=1e-6)
    assert [r["drive"] for r in study.tracking] == [1, 2]
    assert study.tracking[0]["rms"]["worst"] == pytest.approx(rms[:, 0].max().item())
    assert "tracking error, last quarter of each run" in str(study)
    strict = case.read_text().replace("velocity_average = 4", "tolerance = 1e-9\nvelocity_average = 4")
    case.write_text(strict)
    early = jaxid.study(case)
    assert [f["why"] for f in early.failures] == ["the law never trusted its estimate"]
    assert np.isfinite(early.tracking[0]["rms"]["median"])


def test_a_law_that_does_not_identify_is_not_asked(tmp_path):
    for text in (AXIS + STUDY, CHAIN):
        text = text[: text.index("[study]")] + '[study]\nestimators = ["in_loop"]\n'
        with pytest.raises(InputError, match="no law identifies in this case"):
            jaxid.study(write_case(tmp_path, text))
    case = written(tmp_path)
    hides = '[study]\nestimators = ["in_loop"]\nhidden = ["viscous_friction"]\n'
    case.write_text(case.read_text() + hides)
    with pytest.raises(InputError, match="leave hidden out"):
        jaxid.study(case)


CHAIN = """
[plant]
kind = "chain"
actuated = [1]
[plant.parameters]
mass = [{ guess = 1.5, true = 2.0 }, { guess = 2.0, true = 1.5 }]
damping = [8.0, 8.0]
stiffness = [{ guess = 1200.0, true = 1500.0 }, 1500.0, 1500.0]
[controller]
kind = "pd"
kp = 2000.0
kd = 60.0
period = 0.001
[sensor]
position_noise = 1e-6
[reference]
kind = "trapezoid"
start = 0.0
targets = [0.03, -0.02, 0.01]
speed = 0.2
acceleration = 4.0
[simulation]
duration = 3.0
sample_rate = 500.0
[study]
estimators = ["output_error", "inverse_dynamics"]
runs = 3
"""


REFUSED = {
    "another study is there": ({}, None, "holds a study already"),
    "another seed": ({"seed": 4, "resume": True}, None, "another study: seed differ"),
    "other runs": ({"runs": 3, "seed": 3, "resume": True}, None, "another study: runs differ"),
    "a changed case": ({"resume": True, "seed": 3}, "draw = 0.1", "the case or a file that it names"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_what_does_not_belong_together_is_refused(whole, fault, tmp_path):
    case, _, folder = whole
    options, without, message = REFUSED[fault]
    if without:
        case = write_case(tmp_path, case.read_text().replace(without, "draw = 0.2"))
    with pytest.raises(InputError, match=message):
        jaxid.study(case, folder=folder, **options)


def test_nothing_to_resume(whole, tmp_path):
    with pytest.raises(InputError, match="holds no study"):
        jaxid.study(whole[0], folder=tmp_path / "empty", resume=True)
    assert not (tmp_path / "empty").exists()
    with pytest.raises(InputError, match="nothing to resume"):
        jaxid.study(whole[0], resume=True)


def test_a_broken_chunk_is_named(whole, tmp_path):
    out = tmp_path / "out"
    jaxid.study(whole[0], folder=out, runs=2, seed=3)
    path = out / "chunks" / "000001.npz"
    good = path.read_bytes()
    other = (whole[2] / "chunks" / "000001.npz").read_bytes()
    for bad, why in ((b"half", ""), (b"", ""), (good[:-200], ""), (other, "belongs to another study")):
        path.write_bytes(bad)
        with pytest.raises(InputError, match=rf"000001\.npz.*{why}.*remove this file"):
            jaxid.study(whole[0], folder=out, runs=2, seed=3, resume=True)
    (out / "study.json").write_text("{")
    with pytest.raises(InputError, match=r"study\.json.*cannot be read"):
        jaxid.study(whole[0], folder=out, runs=2, seed=3, resume=True)


def test_a_run_that_fails_is_a_row_that_says_so(tmp_path):
    """Windows of the algebraic method need motion; a log that mostly rests has none."""
    sines = AXIS[AXIS.index("[input]") : AXIS.index("[simulation]")]
    text = AXIS.replace(sines, PULSE).replace("[sensor]", COULOMB) + STUDY
    study = jaxid.study(write_case(tmp_path, text), runs=2)
    failed = [r for r in study.summary if r["estimator"] == "algebraic"]
    assert all(r["failed"] == 1.0 and r["used"] == 0 and np.isnan(r["rmse"]) for r in failed)
    assert all(f["runs"] == 2 and "are without a rest" in f["why"] for f in study.failures)
    assert {f["estimator"] for f in study.failures} == {"algebraic"}
    assert "are without a rest" in str(study)


PULSE = '[input]\nkind = "trapezoid"\nstart = 0.0\ntargets = [6.0, 0.0]\nspeed = 200.0\nacceleration = 5e3\n'
COULOMB = '[[effects]]\nkind = "coulomb_friction"\nlevel = 4.0\n[sensor]'


def test_bound_is_that_of_the_closed_form(tmp_path):
    """Of a mass alone q = s / m: the bound is sigma m^2 / |s|."""
    text = AXIS.replace(AXIS[AXIS.index("[[effects]]") : AXIS.index("[sensor]")], "")
    case = write_case(tmp_path, text + '[study]\nestimators = ["inverse_dynamics"]\n')
    study = jaxid.study(case, runs=2)
    clean = jaxid.simulate(write_case(tmp_path, text.replace("position_noise = 3e-5", "")))
    size = np.linalg.norm(clean.log.position)
    assert study.table["bound"].item() == pytest.approx(3e-5 * 2.0 / size, rel=1e-3)


def made_up(errors, std, converged=None) -> xr.Dataset:
    each = ("estimator", "noise", "run", "parameter")
    shape = (1, 1, len(errors), 1)
    converged = np.ones(len(errors)) if converged is None else converged
    return xr.Dataset(
        {
            "estimate": (each, 5.0 + np.reshape(errors, shape)),
            "std": (each, np.full(shape, std)),
            "converged": (each[:3], np.reshape(converged, shape[:3])),
            "identifiable": (each, np.ones(shape, int)),
            "message": (each[:3], np.full(shape[:3], "converged", object)),
            "named": (each[:3], np.full(shape[:3], "", object)),
            "truth": (each[2:], np.full((len(errors), 1), 5.0)),
            "bound": (("noise", "parameter"), np.full((1, 1), np.nan)),
            "unit": (("parameter",), np.array(["kg"], object)),
        },
        coords={"estimator": ["a"], "noise": [1.0], "parameter": ["m"]},
    )


def test_summary_of_known_errors():
    errors = np.array([-0.1, 0.1, 0.3, 0.5, 9.0])
    (row,) = summarised(made_up(errors, 0.2, converged=[1, 1, 1, 1, 0]))
    assert (row["runs"], row["used"], row["failed"]) == (5, 4, pytest.approx(0.2))
    assert row["bias"] == pytest.approx(0.2)
    assert row["spread"] == pytest.approx(np.std(errors[:4], ddof=1))
    assert row["rmse"] == pytest.approx(np.sqrt(np.mean(errors[:4] ** 2)))
    assert (row["coverage_68"], row["coverage_95"]) == (0.5, 0.75)


def test_coverage_of_sound_intervals_is_nominal():
    (row,) = summarised(made_up(np.random.default_rng(1).normal(0, 0.2, 20_000), 0.2))
    assert row["coverage_68"] == pytest.approx(0.68, abs=0.015)
    assert row["coverage_95"] == pytest.approx(0.95, abs=0.007)


def test_steps_alone_and_together():
    def twice(x, y):
        return {"sum": x + y}

    def steps(x, fails=False):
        first = yield SolveRequest(twice, (np.asarray(x), np.ones(2)))
        if fails:
            raise InputError("this one ends", hint="let it")
        second = yield SolveRequest(twice, (np.asarray(first["sum"]), np.asarray(first["sum"])))
        return np.asarray(second["sum"])

    xs = [np.array([k, -k], float) for k in range(5)]
    found = run_batched([steps(x, fails=k == 3) for k, x in enumerate(xs)], 2)
    assert isinstance(found[3], InputError)
    for k in (0, 1, 2, 4):
        np.testing.assert_array_equal(found[k], 2 * (xs[k] + 1))
        np.testing.assert_array_equal(run_alone(steps(xs[k])), found[k])


FAULTS = {
    "a level twice": ("noise = [0.5, 1.0]", "noise = [1, 1.0]", "1 is given twice"),
    "no sensor": ("[sensor]\nposition_noise = 3e-5", "", "no noise to multiply"),
    "nothing unknown": ("{ guess = 1.4, true = 2.0 }", "1.4", None),
    "no simulation": ("duration = 2.0\n", "", "no duration"),
    "an estimator that keeps no bodies": (
        '[study]\nestimators = ["inverse_dynamics", "algebraic"]',
        "[identification]\nphysically_consistent = true\n"
        '[study]\nestimators = ["algebraic", "minimal_model"]',
        "does not go with minimal_model",
    ),
    "an estimator that is not there": ('"algebraic"', '"recursion"', "did you mean 'recursive'?"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_one_line(fault, capsys, tmp_path):
    old, new, message = FAULTS[fault]
    text = (AXIS + STUDY).replace(old, new)
    if message is None:
        text = text.replace("{ guess = 5.0, true = 3.0 }", "3.0")
        message = "no parameter is unknown"
    ran = run(capsys, "study", write_case(tmp_path, text), folder=tmp_path / "out")
    assert ran.status == 2
    assert message in ran.err
    assert ran.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_command_prints_and_writes(capsys, tmp_path):
    case = write_case(tmp_path, AXIS + STUDY)
    ran = run(capsys, "study", case, "--runs", 2, folder=tmp_path / "out")
    assert ran.status == 0
    assert "inverse_dynamics" in ran.out
    assert {"study.nc", "summary.json", "report.html"} <= {p.name for p in ran.folder.iterdir()}
    assert run(capsys, "study", case, "--runs", 0).status == 2


def test_an_accelerator_is_filled_by_one_chunk(tmp_path, monkeypatch):
    """Where cores share the runs out."""
    case = write_case(tmp_path, AXIS + STUDY.replace("chunk = 3\n", ""))
    monkeypatch.setattr(planned, "cores", lambda: 4)
    shared = Plan.of(jaxid.load_case(case), runs=64)
    monkeypatch.setattr(planned, "accelerator", lambda: True)
    monkeypatch.setattr(planned, "_memory", lambda: 8e10)
    whole = Plan.of(jaxid.load_case(case), runs=64)
    # One chunk is drawn while the other is computed.
    assert planned.at_once() == 2
    assert shared.chunk == 16
    assert (whole.chunk, whole.lanes) == (64, 64)
