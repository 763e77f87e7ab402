"""The hidden cases on chains, and what their oracle calls visible."""

import tomllib

import numpy as np
import pytest

import jaxid
from benchmarks.hidden_run import logged
from jaxid.commands.discover import discover, start_search, where_of
from jaxid.discovery import candidates as cand
from jaxid.discovery.search import Step
from jaxid.discovery.where import variables
from jaxid.plants.chain import Chain
from jaxid.session import open_session
from truth.axis.cases import write_case
from truth.chain.stepper import elongations, name_of
from truth.hidden.bench import text_of
from truth.hidden.chain_oracle import (
    baseline_forces,
    effect_force,
    fading,
    noise_density,
    of_spring,
    rival_forces,
    sights,
)
from truth.hidden.chains import KINDS, NOISES, ChainCase, cases, text_of_chain, write_files
from truth.hidden.oracle import Sight, Whitener

EVERY = [*cases("test")]
HIDING = [c for c in EVERY if c.hidden]
named = {"ids": lambda c: c.id}


def hiding(kind: str, scale: str = "chain3", **values) -> ChainCase:
    """A case with some parameters set."""
    case = ChainCase(kind, scale, 1.0, 11)
    case.effects[kind, case.place].update(values)
    return case


def seen(case: ChainCase) -> Sight:
    """Return what the log shows of the one hidden effect."""
    return sights(case)[case.names[0]]


def test_splits_share_no_seed_and_hide_as_much():
    other = [*cases("calibrate")]
    assert not {c.seed for c in EVERY} & {c.seed for c in other}
    assert len({c.id for c in EVERY}) == len(EVERY)
    for split in (EVERY, other):
        assert {c.what for c in split} == {*KINDS, "null"}
        assert sum(not c.hidden for c in split) >= 6
        assert {c.noise for c in split} == set(NOISES)
        for sort, count in (("joint", 3), ("spring", 3)):
            assert len({c.place for c in split if c.hidden and c.sort == sort}) >= count


def test_ids_say_what_is_hidden_where():
    case = ChainCase("cubic_stiffness", "chain3", 1.0, 3000)
    assert case.id == f"chains/cubic_stiffness/spring{case.place}/chain3/n1/s3000"
    assert f"cubic_stiffness[spring {case.place}]" in case.values
    assert ChainCase("null", "chain2", 0.3, 5, False).id == "chain_nulls/null/chain2/n0.3/s5/unstated"


@pytest.mark.parametrize("case", EVERY[::5], **named)
def test_the_loop_follows_and_stretches_the_springs(case):
    setup = case.setup()
    log = setup.run()
    driven = setup.machine.driven
    off = (log["true_position"] - log["reference"])[:, driven]
    assert np.all(np.abs(off).max(0) < 0.3 * np.ptp(log["reference"][:, driven], axis=0))
    jump = np.std(np.diff(log["true_command"], axis=0), axis=0) / np.std(log["true_command"], axis=0)
    assert np.all(jump < 0.2)  # an oscillating loop commands anew at each sample
    assert np.abs(log["true_command"]).max() < 0.5 * setup.loops[0].limit
    assert np.all(np.ptp(elongations(log["true_position"]), axis=0) > 0.01)
    assert np.all(np.abs(log["true_velocity"]).max(0) > 0.1)
    # each moves for a good part of the log, the one that no drive moves too
    assert np.all(np.mean(log["true_velocity"] == 0.0, axis=0) < 0.75)


@pytest.mark.parametrize("case", EVERY, **named)
def test_resonances_are_slow_enough_to_be_excited(case):
    assert np.all((case.machine.frequencies() > 2.8) & (case.machine.frequencies() < 11.0))


@pytest.mark.parametrize("case", EVERY[::6], **named)
def test_the_validation_is_another_tour(case):
    fit, other = (case.setup(validation=v) for v in (False, True))
    assert fit.seed != other.seed
    for one, two in zip(fit.loops, other.loops, strict=True):
        assert np.corrcoef(one.reference, two.reference)[0, 1] < 0.8
        assert abs(np.ptp(one.reference) / np.ptp(two.reference) - 1.0) > 1e-3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scale", ["chain3", "chain2"])
def test_the_balance_closes_with_the_effect(kind, scale):
    """Baseline and effect, as the oracle has them, are all that the drives move."""
    case = hiding(kind, scale)
    setup = case.setup()
    log = setup.run()
    m = setup.machine
    true = [*m.mass, *m.damping, *-np.array(m.stiffness)]
    true += [case.effects[place]["level"] for place in case.declared]
    needed = sum(x * force for x, force in zip(true, baseline_forces(case, log), strict=True))
    error = log["true_force"] + effect_force(kind, case.place, m, log) - needed
    assert np.abs(error[log["true_velocity"] != 0.0]).max() < 1e-10


def test_a_spring_pulls_both_ends():
    tension = np.array([2.0, 3.0])
    np.testing.assert_array_equal(of_spring(1, tension, 3), np.outer(tension, [1.0, -1.0, 0.0]))
    np.testing.assert_array_equal(of_spring(0, tension, 3), np.outer(tension, [-1.0, 0.0, 0.0]))
    np.testing.assert_array_equal(of_spring(3, tension, 3), np.outer(tension, [0.0, 0.0, 1.0]))


@pytest.mark.parametrize("scale", ["chain3", "chain2"])
def test_the_noise_of_a_log_is_white_after_whitening(scale):
    case = ChainCase("null", scale, 1.0, 11)
    setup = case.setup()
    fades = fading(setup.run())
    random, sensor, machine = np.random.default_rng(0), setup.sensor, setup.machine
    count, n = fades.shape
    std = np.hypot(sensor.position_noise, sensor.position_resolution / np.sqrt(12.0))
    noise = std * random.standard_normal((count, n))
    w = 2.0 * np.pi * np.fft.rfftfreq(count, 1.0 / setup.rate)[:, None]
    spectrum = np.fft.rfft(noise, axis=0)
    own = (1j * w * machine.damping - w**2 * machine.mass) * spectrum
    force = np.fft.irfft(own, count, axis=0)
    force -= np.diff(elongations(noise) * machine.stiffness, axis=1)
    drives = sensor.force_noise * random.standard_normal((count, len(machine.driven)))
    force[:, machine.driven] += machine.gains * drives
    for i in range(n):
        whiten = Whitener(setup, fades[:, i], lambda s, f, i=i: noise_density(i, s, f))
        assert np.sum(whiten(force[:, i]) ** 2) / count == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("kind", "parameter"),
    [("constant_force", "level"), ("cogging", "amplitude"), ("cubic_stiffness", "coefficient")],
)
def test_an_effect_shows_by_its_size(kind, parameter):
    assert seen(hiding(kind)).visible
    faint = hiding(kind)
    faint.effects[kind, faint.place][parameter] *= 1e-4
    assert not seen(faint).visible
    assert max(seen(faint).evidence) < 30.0


def test_faint_drags_are_tied_and_clear_ones_are_not():
    case = hiding("quadratic_drag")
    assert seen(case).ties == ()
    case.effects["quadratic_drag", case.place]["coefficient"] *= 0.002
    assert name_of("cubic_friction", case.place) in seen(case).ties


def test_rivals_leave_out_what_the_case_has():
    case = ChainCase("coulomb_friction", "chain3", 1.0, 11)
    rivals = rival_forces(case, case.run())
    assert not [name for name in rivals if name.startswith("coulomb")]
    assert {"cubic_stiffness[spring 4]", "constant_force[1]", "actuator_gain[2]"} <= set(rivals)
    assert sights(ChainCase("null", "chain2", 1.0, 11)) == {}


@pytest.mark.parametrize("case", [HIDING[0], HIDING[3], HIDING[27], EVERY[-1]], **named)
def test_the_case_file_knows_nothing_of_what_is_hidden(case):
    guess, known = (tomllib.loads(text_of_chain(case, known=k)) for k in (False, True))
    names = ("mass", "damping", "stiffness")
    for name in names:
        true = np.array(getattr(case.machine, name))
        start = np.array([x["guess"] for x in guess["plant"]["parameters"][name]])
        assert np.all(np.abs(np.log(start / true)) >= np.log(1.2) - 1e-9)
        assert np.all(np.abs(np.log(start / true)) <= np.log(1.6) + 1e-9)
        assert known["plant"]["parameters"][name] == pytest.approx(true)
    assert [e["kind"] for e in guess["effects"]] == ["coulomb_friction"]
    assert len(guess["effects"][0]["joint"]) == case.count - (case.what == "coulomb_friction")
    assert len(known["effects"]) == 1 + len(case.hidden)
    assert guess["plant"].get("actuated", [1, 2, 3]) == list(case.machine.actuated)
    assert ("sensor" in guess) == case.sensor


def test_files_hold_what_the_case_names(tmp_path):
    paths = write_files(HIDING[3], tmp_path)
    case = tomllib.loads(paths[0].read_text())
    columns = paths[1].read_text().split("\n", 1)[0].split(",")
    named = [case["log"][k] for k in ("position", "force", "reference")]
    assert set(sum(named, [case["log"]["time"]])) <= set(columns)
    assert len(paths) == 3
    log = np.loadtxt(paths[2], delimiter=",", skiprows=1)
    np.testing.assert_allclose(log[:, 1], HIDING[3].run(validation=True)["position"][:, 0], rtol=1e-9)


@pytest.mark.slow
def test_where_points_at_the_spring(tmp_path):
    """Not at a position, nor at the moments in which a cubic spring is far from its line."""
    case = next(c for c in cases("calibrate") if c.what == "cubic_stiffness" and c.place == 2)
    session = open_session(write_case(tmp_path, text_of(case)), logged(case), align_hold=True)
    _, search = start_search(session)
    theta = cand.refine(search.superset, search.samples, search.theta, search.active)[0]
    step = Step(None, None, (), 0.0, theta, search.active)
    where = where_of(search, step, session)
    assert where.significant
    assert where.variable == "elongation of spring 2"
    assert where.joint in (1, 2)
    assert where.region[1] > where.region[0]
    assert "force" not in variables(session.fit.data, 0, Chain(*np.ones((2, 3)), np.ones(4), actuated=(1,)))


@pytest.mark.slow
def test_break_away_friction_is_told_from_its_neighbours(tmp_path):
    """At one mass of three: that one is named with its level, and no other."""
    case = ChainCase("null", "chain3", 0.3, 3028)
    case.effects["static_friction", 2] = {"level": 6.0}
    found = discover(write_case(tmp_path, text_of(case)), logged(case), refit=False)
    assert [e.label for e in found.effects] == ["static_friction[2]"]
    assert found.after.value("static_friction[2].level") == pytest.approx(6.0, rel=0.15)


@pytest.mark.slow
def test_a_stribeck_curve_in_a_chain_has_intervals_that_hold():
    """With four steps a sample in the last fit the speed of the curve was 6 sigma off."""
    case = next(c for c in cases("fresh") if c.seed == 5013)
    kind, mass = next(place for place in case.effects if place not in case.declared)
    true = case.effects[kind, mass]
    lines = [f"{name} = {{ guess = {1.3 * value!r} }}" for name, value in true.items()]
    text = "\n".join([text_of(case), "[[effects]]", f'kind = "{kind}"', f"joint = {mass}", *lines])
    fit = jaxid.identify(tomllib.loads(text), logged(case), method="prediction_error").estimate
    assert fit.converged
    off = fit.theta - [case.truth[name] for name in fit.names]
    assert np.all(np.abs(off) < 3.5 * fit.std)


@pytest.mark.slow
def test_a_rival_that_ran_away_gets_no_experiment(tmp_path):
    """Its presliding stiffness of 1e130 N/m ended the process while an experiment was designed."""
    case = next(c for c in cases("last") if c.seed == 7003)
    found = discover(write_case(tmp_path, text_of(case)), logged(case), refit=False)
    assert [e.label for e in found.effects] == ["coulomb_friction[2]"]
    assert not any(p.separates for p in found.proposals)


@pytest.mark.slow
def test_an_experiment_on_three_masses_ends():
    """The convolution of XLA ended the process while it was designed."""
    case = next(c for c in cases("new") if c.seed == 9002)
    found = discover(tomllib.loads(text_of(case)), logged(case), refit=False)
    assert [e.label for e in found.effects] == ["coulomb_friction[3]"]
    assert [p.rival for p in found.proposals] == ["hysteresis[3]"]
