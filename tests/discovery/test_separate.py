"""Experiments that would tell effects apart: within their limits, honest, and right when run."""

import dataclasses
import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.case.case import load_case
from jaxid.commands.discover import discover
from jaxid.discovery.separating import propose as separate
from jaxid.discovery.separating.rivals import Experiment, loss
from jaxid.errors import InputError
from jaxid.experiment_design.improve import improved
from jaxid.experiment_design.shapes import Shapes, basis
from jaxid.files import signal_csv
from jaxid.machine import Machine
from jaxid.model.units import Units
from jaxid.model.unknowns import Parameters
from jaxid.plants import Axis
from jaxid.references import make_reference
from jaxid.results.proposals import proposal_json, sentence
from tests.support.axis_log import log_of
from tests.support.cli_setup import run
from tests.support.proposals import proposed_for
from truth.axis import ambiguous as setups
from truth.axis.cases import case_text, write_case
from truth.axis.stepper import write_csv

AXIS = Machine(Axis(1.0), Parameters(()), np.ones(1), Units())
SPRINGS = ("cubic_stiffness", "quadratic_stiffness")


# What was minimised on the way to a proposal: arguments, value and gradient.
CALLS = []


@pytest.fixture(scope="module")
def springs(tmp_path_factory):
    def watched(*arguments):
        CALLS.append((arguments, loss(*arguments)))
        return CALLS[-1][1]

    setup, declared = setups.curved(4.0)
    folder = tmp_path_factory.mktemp("springs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(separate, "loss", watched)
        return setup, proposed_for(setup, declared, SPRINGS, folder, more=setups.WIDER)


def test_forces_are_whitened_by_the_filter_of_each_joint():
    rng = np.random.default_rng(0)
    e, whiten = rng.standard_normal((50, 3)), rng.standard_normal((3, 11))
    out = Experiment.white(SimpleNamespace(whiten=jnp.asarray(whiten)), jnp.asarray(e))
    expected = np.stack([np.convolve(x, w)[:50] for x, w in zip(e.T, whiten, strict=True)], axis=1)
    np.testing.assert_allclose(out, expected, atol=1e-12)


def test_every_signal_of_the_family_keeps_within_its_limits():
    low, high, speed, period = np.array([0.1]), np.array([0.25]), np.array([0.2]), 0.001
    functions, starts = basis(2000, period, 5.0, (0.15, 0.2, 1.0), None)
    shapes = Shapes.within(functions, low, high, speed * period)
    random = np.random.default_rng(3)
    for p in [*(shapes.numbers(s) for s in starts), *random.normal(0, 3, (20, functions.shape[1] + 2))]:
        signal = np.asarray(shapes(jnp.asarray(p)))
        assert low < signal.min() <= signal.max() < high
        assert np.abs(np.diff(signal, axis=0)).max() < speed * period
        # From rest to rest at one place: the rise is a cube at first, 10 / 80^3 in its first sample.
        assert signal[0] == pytest.approx(signal[-1], abs=1e-12)
        assert np.abs(signal[1] - signal[0]) < 0.01 * speed * period


def test_smaller_is_the_same_signal_with_less_amplitude():
    functions, starts = basis(500, 0.001, 5.0, (0.15, 0.2, 1.0), None)
    shapes = Shapes.within(functions, np.zeros(1), np.ones(1), np.full(1, np.inf))
    p = shapes.numbers(starts[1], centre=0.2)
    whole, half = (np.asarray(shapes(jnp.asarray(shapes.smaller(p, f)))) for f in (1.0, 0.5))
    np.testing.assert_allclose(whole, np.asarray(shapes(jnp.asarray(p))), atol=1e-9)
    np.testing.assert_allclose(half - half[0], 0.5 * (whole - whole[0]), atol=1e-9)


@pytest.mark.slow
def test_the_gradient_through_the_simulation_is_that_of_differences(springs):
    (p, *rest), (_, slope) = CALLS[2]
    for k in range(0, p.size, 4):
        step = jnp.zeros(p.size).at[k].set(1e-4)
        above, below = (float(loss(p + s, *rest)[0]) for s in (step, -step))
        # Central differences are off by the third derivative, here some 1e-4 of the slope.
        assert slope[k] == pytest.approx((above - below) / 2e-4, rel=2e-3, abs=1e-3)


def test_an_experiment_is_found_that_separates(springs):
    _, proposal = springs
    # On the log itself the two are one.
    assert abs(proposal.present) < 3.0
    assert proposal.separates
    assert proposal.expected > 5 * proposal.needed


def test_the_true_machine_keeps_within_the_limits(springs):
    setup, proposal = springs
    ran = setups.again(setup, proposal.values[:, 0], float(proposal.start[0]))
    limits = proposal.limits
    assert (limits.low[0], limits.high[0], limits.speed[0]) == (0.0, 0.25, 0.15)
    assert limits.stated == ("stroke", "speed")
    assert limits.low[0] <= ran["true_position"].min()
    assert ran["true_position"].max() <= limits.high[0]
    assert np.abs(ran["true_velocity"]).max() <= limits.speed[0]
    assert np.abs(ran["true_command"]).max() <= limits.force[0] == 10.0


def test_the_csv_is_read_back_as_the_reference(springs, tmp_path):
    _, proposal = springs
    (tmp_path / proposal.file).write_text(signal_csv(proposal.signal, proposal.time, proposal.values))
    table = {"kind": "csv", "file": proposal.file, "time": "t", "column": "reference"}
    read = make_reference(table, 1000.0, len(proposal.time) / 1000.0, tmp_path)
    np.testing.assert_allclose(read, proposal.values, atol=1e-12)
    told = proposal_json(proposal, AXIS)
    assert told["file"] == proposal.file == "separate_cubic_stiffness_from_quadratic_stiffness.csv"
    assert told["start"] == proposal.values[0, 0]
    assert told["limits"]["stroke"] == [0.0, 0.25]
    assert told["nats"]["expected"] > told["nats"]["needed"]
    json.dumps(told, allow_nan=False)


def test_what_is_one_by_another_name_is_told_so(tmp_path):
    setup, declared = setups.heavier()
    kinds = ("added_mass", "actuator_gain")
    proposal = proposed_for(setup, declared, kinds, tmp_path, inertia_known=True)
    assert not proposal.separates
    assert proposal.expected < proposal.needed
    told = sentence(proposal, AXIS)
    assert told.startswith("no experiment within these limits separates added_mass from actuator_gain (exp")
    assert proposal_json(proposal, AXIS)["file"] is None


@pytest.mark.slow
def test_an_open_loop_gets_an_input(tmp_path):
    setup, declared = setups.sprung()
    kinds = ("quadratic_drag", "cubic_friction")
    proposal = proposed_for(setup, declared, kinds, tmp_path, more="[limits]\nforce = 2.5\n")
    assert proposal.signal == "input"
    assert np.abs(proposal.values).max() < 2.5
    ran = setups.again(setup, proposal.values[:, 0], float(proposal.start[0]))
    assert ran["true_position"].max() <= proposal.limits.high[0]
    assert signal_csv(proposal.signal, proposal.time, proposal.values).startswith("t,input\n0.0,")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("stroke = [0.2, 0.1]", "stroke = [0.2, 0.1] is not a range"),
        ("stroke = 0.2", "stroke = 0.2 is not a list"),
        ("stroke = [0.1, 0.2, 0.3]", "is not a range"),
        ("speed = 0.0", "speed = 0.0 is not positive"),
        ("force = -1.0", "force = -1.0 is not positive"),
        ("speeds = 1.0", "unknown key 'speeds'; did you mean 'speed'?"),
    ],
)
def test_limits_that_cannot_be(text, told, tmp_path):
    setup, declared = setups.curved(0.1)
    case = write_case(tmp_path, case_text(setup, declared) + f"[limits]\n{text}\n")
    with pytest.raises(InputError) as error:
        load_case(case)
    assert "[limits]" in str(error.value)
    assert told in str(error.value)


def test_limits_may_be_given_by_joint(tmp_path):
    setup, declared = setups.curved(0.1)
    text = case_text(setup, declared) + "[limits]\nstroke = [[0.0, 0.3]]\nspeed = [0.1]\n"
    limits = load_case(write_case(tmp_path, text)).limits
    assert limits.stroke == ((0.0, 0.3),)
    assert limits.speed == (0.1,)
    assert limits.force is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "more"),
    [
        pytest.param(setups.curved, setups.WIDER, id="springs"),
        pytest.param(setups.one_speed, "", id="friction"),
    ],
)
def test_running_it_separates(make, more, tmp_path, capsys):
    """From the first log to the verdict, as a user goes, on a simulator that shares nothing."""
    setup, declared = make()
    true = next(kind for kind in setup.machine.effects if kind not in dict(declared))
    case = write_case(tmp_path, case_text(setup, declared) + more)
    write_csv(setup.run(initial_position=setups.started(setup)), tmp_path / "log.csv")
    ran = run(capsys, "discover", case, tmp_path / "log.csv", folder=tmp_path / "out")
    assert ran.status == 0
    found = ran.json("discovery.json")
    effect, experiment = found["effects"][0], found["experiments"][0]
    rivals = {effect["kind"], *(a["kind"] for a in effect["alternatives"])}
    assert true in rivals
    assert len(rivals) > 1
    assert experiment["text"] in ran.out
    assert experiment["possible"]
    assert experiment["file"] in ran.out
    assert 'id="experiments"' in (ran.folder / "report.html").read_text("utf-8")

    table = {"kind": "csv", "file": experiment["file"], "time": "t", "column": "reference"}
    reference = make_reference(table, setup.rate, experiment["duration"], ran.folder)[:, 0]
    loop = dataclasses.replace(setup.loop, reference=reference)
    for seed in (5, 6, 9, 10):
        second = dataclasses.replace(setup, loop=loop, seed=seed, duration=experiment["duration"])
        log = log_of(second, initial_position=experiment["start"])
        after = discover(case, log, validate=[tmp_path / "log.csv"], refit=False)
        assert after.kinds == [true]
        left = {s.candidate.kind for s in after.effects[0].alternatives}
        assert not left & rivals


def test_no_more_evaluations_than_may_be_spent():
    """A line search may take twenty by itself; what is best so far counts."""
    asked = []

    def bowl(p):
        asked.append(p.copy())
        return float(np.sum((p - 3.0) ** 4)), 4 * (p - 3.0) ** 3

    start = np.zeros(3)
    value, where = improved(bowl, start, bowl(start), 4)
    assert len(asked) == 1 + 4
    assert value == min(np.sum((p - 3.0) ** 4) for p in asked)
    assert value < np.sum((start - 3.0) ** 4)
    assert any(np.array_equal(where, p) for p in asked)
