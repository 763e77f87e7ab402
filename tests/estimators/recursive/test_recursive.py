"""The method `recursive` on logs of exact steppers, from starts far off."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxid.commands.identify import identify, identify_many
from jaxid.errors import InputError
from jaxid.estimators.recursive.estimate import start_of
from jaxid.estimators.recursive.precision import precision_of
from jaxid.estimators.recursive.recursion import Recursion, run
from jaxid.estimators.recursive.rows import Rows
from jaxid.logs.log import Log
from jaxid.results.report.build import history_of, identification_data
from jaxid.results.report.history_plots import plot_history
from jaxid.results.report.page import render
from jaxid.session import open_session
from tests.estimators.recursive.test_recursion import gain_regression
from tests.support.axis_log import log_of
from tests.support.recursive_axis import (
    COULOMB,
    GAIN,
    TRUTH,
    VISCOUS,
    estimate,
    slide,
    with_table,
    written_axis,
)
from truth.axis.cases import case_text, write_case
from truth.axis.machines import moves, servo
from truth.axis.stepper import Loop, Sensor
from truth.chain.stepper import ChainMachine, simulate_chain


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    return written_axis(tmp_path_factory.mktemp("axis"))


def test_an_axis_from_a_start_far_off(axis):
    """The inertia from a third, friction from zero; nothing forgotten, it is inverse dynamics."""
    session = open_session(*axis)
    np.testing.assert_array_equal(start_of(session.machine), [TRUTH[0] / 3, 0.0, 0.0])
    found = estimate(*axis)
    assert found.converged
    np.testing.assert_allclose(found.theta, TRUTH, rtol=5e-3)
    assert np.all(np.abs(found.theta - TRUTH) < 4 * found.std)
    batch = estimate(*axis, "inverse_dynamics")
    # The start counts as a thousandth of a sample among thousands.
    np.testing.assert_allclose(found.theta, batch.theta, rtol=1e-5)
    np.testing.assert_allclose(found.std, batch.std, rtol=1e-3)


def test_many_logs_in_one_call(axis):
    logs = [log_of(slide(seed=seed)) for seed in (1, 2)]
    together = identify_many(axis[0], logs, method="recursive", lanes=2)
    one = estimate(axis[0], logs[1])
    np.testing.assert_allclose(together[1].theta, one.theta, rtol=1e-12)
    assert np.any(together[0].theta != together[1].theta)


def test_many_logs_each_by_a_case_of_its_own(axis, tmp_path):
    """The second's start counts for a whole sample, and is felt."""
    logs = [log_of(slide(seed=seed)) for seed in (1, 1)]
    text = Path(axis[0]).read_text() + "\n[recursive]\nregularization = 1.0\n"
    (tmp_path / "case.toml").write_text(text)
    cases = [axis[0], tmp_path / "case.toml"]
    found = identify_many(cases, logs, method="recursive", lanes=2)
    for one, case in zip(found, cases, strict=True):
        np.testing.assert_allclose(one.theta, estimate(case, logs[0]).theta, rtol=1e-12)
    assert np.any(np.abs(found[0].theta / found[1].theta - 1) > 1e-6)
    with pytest.raises(InputError, match="1 cases for 2 logs"):
        identify_many(cases[:1], logs, method="recursive")


def test_forgetting_follows_a_drift(tmp_path):
    """Friction grows by 2 % a second. What is not forgotten is the mean of the log."""
    setup = slide(20.0, friction_drift={"rate": 0.02})
    text = case_text(setup, [VISCOUS, COULOMB], off=2.0)
    end = COULOMB[1]["level"] * (1 + 0.02 * 20.0)
    found = {}
    for table in ("", "\n[recursive]\nhalf_life = 1.0\n"):
        found[table] = estimate(write_case(tmp_path, text + table), log_of(setup))
    plain, quick = (e.value("coulomb_friction.level") for e in found.values())
    assert plain < 0.9 * end
    # A half-life of 1 s of motion lags by its mean age, 1.4 s, or 2.4 s with the rests, of 2 % a second.
    assert abs(quick / end - 1) < 0.035
    details = found["\n[recursive]\nhalf_life = 1.0\n"].details["recursive"]
    history = details["history"]
    late = history["time"] > 8.0
    true = COULOMB[1]["level"] * (1 + 0.02 * history["time"])
    off = history["value"]["coulomb_friction.level"] / true - 1
    assert np.max(np.abs(off[late])) < 0.08
    assert details["effective_samples"] < 0.5 * details["samples"]


def test_the_gate_leaves_out_what_sticks(tmp_path):
    """A servo that rests after every move under an integral that still pushes, which looks like an offset."""
    base = servo()
    t, stops = np.arange(10000) / 1000.0, [0.0, 1.0, 4.0, 2.0, 5.0]
    reference = moves(t, stops, [3.0, 8.0, 15.0, 5.0, 10.0], 400.0, 0.5)
    setup = dataclasses.replace(base, loop=dataclasses.replace(base.loop, reference=reference))
    declared = [*setup.machine.effects.items(), ("constant_force", {"level": 0.0})]
    text, log = case_text(setup, declared, off=2.0, motion="rotary"), log_of(setup)
    text += "\n[preprocess]\ncutoff_hz = 80.0\ndecimation = 1\nalign_hold = true\n[recursive]\n"
    gates = ("0.0\n", "0.05\ngate_acceleration = 50.0\n", "0.05\n")
    every, both, fast = (estimate(write_case(tmp_path, f"{text}gate_velocity = {g}"), log) for g in gates)
    kept = open_session(write_case(tmp_path, text), log).fit.data.kept
    stuck = np.abs(setup.run()["true_velocity"][kept]) < 1e-9
    assert 0.3 < stuck.mean() < 0.45
    assert np.isfinite(every.residual[stuck]).mean() > 0.9
    assert np.isfinite(both.residual[stuck]).mean() < 0.02
    # An acceleration lets slow samples pass.
    assert fast.samples < both.samples < 0.6 * every.samples
    assert abs(every.value("constant_force.level")) > 2e-3
    assert abs(both.value("constant_force.level")) < 2e-4
    np.testing.assert_allclose(both.value("coulomb_friction.level"), 0.01, rtol=0.05)
    residual = [e.details["recursive"]["running_residual"] for e in (every, both)]
    assert residual[0] > 3 * residual[1]


CHAIN = """
[plant]
kind = "chain"
[plant.parameters]
mass = [{ guess = 1.0 }, { guess = 3.0 }]
damping = [{ guess = 4.0 }, 8.0]
stiffness = [{ guess = 900.0 }, 1500.0, 1500.0]
[[effects]]
kind = "coulomb_friction"
level = [{ guess = 1.0 }, { guess = 1.0 }]
[log]
time = "t"
position = ["q1", "q2"]
force = ["u1", "u2"]
"""


def test_rows_of_a_chain_summed_and_full(tmp_path):
    """Both tell all six; a sum has half of the rows, and its deviations are larger."""
    t = np.arange(6000) / 1000.0
    friction = {("coulomb_friction", i): {"level": level} for i, level in ((1, 4.0), (2, 2.5))}
    machine = ChainMachine([2.0, 1.5], [8.0, 8.0], [1500.0] * 3, friction)
    speeds = np.array([0.2, 0.3, 0.15])
    loops = [
        Loop("pd", reference=moves(t, tour, speeds * k, 4.0), kp=2000.0, kd=60.0)
        for k, tour in ((1.0, [0.0, 0.03, -0.02]), (1.3, [0.0, -0.02, 0.035]))
    ]
    sensor = Sensor(position_resolution=1e-7, position_noise=3e-7, force_noise=0.01)
    run = simulate_chain(machine, loops, sensor, rate=1000.0, duration=6.0, seed=1)
    log = Log(run["t"], run["position"], run["force"], source="chain.csv")
    truth = np.array([2.0, 1.5, 8.0, 1500.0, 4.0, 2.5])
    full, summed = (
        estimate(write_case(tmp_path, CHAIN + f'\n[recursive]\nrows = "{rows}"\n'), log)
        for rows in ("full", "summed")
    )
    for found in (full, summed):
        np.testing.assert_allclose(found.theta, truth, rtol=2e-2)
        assert np.all(np.abs(found.theta - truth) < 4 * found.std)
    assert full.residual.shape[1] == 2
    assert summed.residual.shape[1] == 1
    assert np.all(summed.std > full.std)


def test_a_sum_is_over_the_rows_that_count():
    y, counts = np.arange(12.0).reshape(2, 2, 3), np.array([[True, False], [True, True]])
    one = Rows(y, y[..., 0], counts, y[..., 1]).summed
    np.testing.assert_array_equal(one.rows[:, 0], [y[0, 0], y[1, 0] + y[1, 1]])
    np.testing.assert_array_equal(one.target[:, 0], [0.0, 15.0])
    np.testing.assert_array_equal(one.force[:, 0], [1.0, 17.0])
    assert one.counts.tolist() == [[True], [True]]


@pytest.mark.parametrize("instrument", [False, True])
def test_precision_of_forgotten_rows_under_white_noise(instrument):
    """What the recursion says of white noise, and what the weighted rows do with a model of its colour."""
    y, r, _ = gain_regression(4000, 3.0, 5)
    counts, start = np.ones_like(r, bool), np.array([0.0, 0.0, 1.0])
    recursion = Recursion(start, np.full(3, 1e-6), np.asarray(0.995), False, (2,), instrument)
    _, told, z = run(recursion, recursion.memory(), y, r, counts, 100)
    told = jax.tree.map(np.asarray, told)
    guess = SimpleNamespace(names=["a", "b", "c"], guess=np.ones(3))
    rows = Rows(y, r, counts, y[..., 2])
    z = np.asarray(z) if instrument else y
    machine = SimpleNamespace(parameters=guess)
    precision, inflation = precision_of(machine, rows, z, recursion, told, 100, True)
    np.testing.assert_allclose(precision.std, told.std[-1], rtol=0.1)
    np.testing.assert_allclose(inflation, 1.0, rtol=0.1)


def test_an_instrument_where_torque_noise_biases_the_gain(tmp_path):
    """A force noise of 0.3 V, a band that lets it through, and an encoder so fine that it adds none."""
    setup = slide(10.0, actuator_gain=GAIN[1])
    fine = Sensor(position_resolution=5e-8, position_noise=1.2e-8, force_noise=0.3)
    setup = dataclasses.replace(setup, sensor=fine)
    text = case_text(setup, [VISCOUS, COULOMB, GAIN], off=2.0, inertia_known=True)
    text += "\n[preprocess]\ncutoff_hz = 100.0\ndecimation = 1\nalign_hold = true\n[recursive]\n"
    log = log_of(setup)
    plain, free = (
        estimate(write_case(tmp_path, text + f'instrument = "{k}"\n'), log) for k in ("none", "model")
    )
    assert plain.value("actuator_gain.gain") < 0.97 * GAIN[1]["gain"]
    np.testing.assert_allclose(free.value("actuator_gain.gain"), GAIN[1]["gain"], rtol=5e-3)
    assert np.all(np.abs(free.theta - [*TRUTH[1:], GAIN[1]["gain"]]) < 4 * free.std)


def test_what_a_log_cannot_tell_has_a_name(tmp_path):
    setup = slide()
    text = case_text(setup, [VISCOUS, COULOMB], off=2.0)
    text += '[[effects]]\nkind = "added_mass"\nmass = { guess = 1.0 }\n'
    found = estimate(write_case(tmp_path, text), log_of(setup))
    assert found.identifiable.tolist() == [False, True, True, False]
    assert any({"inertia", "added_mass.mass"} == set(c) for c in found.precision.unidentifiable)
    assert np.isnan(found.std[0])
    np.testing.assert_allclose(found.theta[1:3], TRUTH[1:], rtol=1e-2)


def test_a_start_that_counts_for_much_is_said(axis, tmp_path):
    """As many samples as the log has: it is not the log that tells."""
    path = with_table(tmp_path, axis, '\n[recursive]\nregularization = 1e5\nstart = "guess"\n')
    found = estimate(path, axis[1])
    assert not found.identifiable.any()
    assert {"inertia": 1.0} in found.precision.unidentifiable
    light = estimate(with_table(tmp_path, axis, "\n[recursive]\nregularization = 0.3\n"), axis[1])
    assert light.identifiable.all()
    # What the start pulls is part of the deviation.
    assert np.all(np.abs(light.theta - TRUTH) < 4 * light.std)
    assert np.all(light.std > estimate(*axis).std)


def test_it_goes_on_from_a_result(axis, tmp_path):
    """The same log again: every sample counts twice, from the memory in result.json."""
    identify(*axis, method="recursive").save(tmp_path / "first")
    once = estimate(*axis)
    path = with_table(tmp_path, axis, '\n[recursive]\nrestart = "first/result.json"\n')
    twice = estimate(path, axis[1])
    details = [e.details["recursive"] for e in (once, twice)]
    assert details[1]["samples"] == 2 * details[0]["samples"]
    np.testing.assert_allclose(twice.theta, once.theta, rtol=1e-6)
    np.testing.assert_allclose(twice.std, once.std / np.sqrt(2), rtol=0.1)
    saved = json.loads((tmp_path / "first" / "result.json").read_text())["recursive"]["restart"]["memory"]
    for name, value in details[0]["restart"]["memory"].items():
        np.testing.assert_array_equal(saved[name], value)


def test_output_error_starts_from_it(axis, tmp_path):
    path = with_table(tmp_path, axis, '\n[output_error]\nstart = "recursive"\n')
    found, usual = estimate(path, axis[1], "output_error"), estimate(*axis, "output_error")
    assert found.converged
    np.testing.assert_allclose(found.theta, usual.theta, rtol=1e-6)
    path = with_table(tmp_path, axis, '\n[output_error]\nstart = "guess"\n')
    guess = estimate(path, axis[1], "output_error")
    np.testing.assert_allclose(found.theta, guess.theta, rtol=1e-5)
    assert found.steps < guess.steps


def test_the_report_shows_how_it_went(axis):
    result = identify(*axis, method="recursive")
    view = history_of(result.estimate)
    figure = plot_history(view, {"time": "s", "force": "N"})
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels[:3] == ["[kg]", "[N s/m]", "[N]"]
    assert [ax.get_title(loc="left") for ax in figure.axes][:3] == list(result.estimate.names)
    assert figure.axes[3].get_xlabel() == "time [s]"
    assert np.all(np.diff(view.time) > 0)
    np.testing.assert_allclose(view.std[-1], result.estimate.std, rtol=1e-9)
    assert "How the estimate went" in render(identification_data(result))
    assert history_of(estimate(*axis, "inverse_dynamics")) is None
