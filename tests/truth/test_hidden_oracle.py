"""The oracle and the judge of the discovery bench: what they call visible, tied and right."""

import dataclasses
import itertools

import numpy as np
import pytest

from jaxid.effects import EFFECTS
from truth.axis.hidden_effects import SEARCH_CASES
from truth.hidden import judge
from truth.hidden.cases import FIRST_SEED, KINDS, HiddenCase, cases, declared_beside
from truth.hidden.oracle import View, Whitener, between, effect_force, faded, moving, sights

EVERY = [*cases("seen")]


def hiding(*kinds: str, scale: str = "emps_like", noise: float = 1.0, **values) -> HiddenCase:
    """A case with some parameters set."""
    case = HiddenCase("effects", " + ".join(kinds), scale, noise, 11, kinds, declared_beside(kinds))
    for name, value in values.items():
        kind, parameter = name.split("__")
        case.values[kind][parameter] = value
    return case


def test_every_effect_is_hidden_somewhere():
    """But those on request, and of joints that turn, which no case of the bench makes."""
    of_bench = lambda cls: not (cls.on_request or cls.of_rotary)
    assert set(KINDS) == {kind for kind in SEARCH_CASES if of_bench(EFFECTS[kind])}


def test_splits_share_no_seed():
    seeds = [{c.seed for c in cases(split)} for split in FIRST_SEED]
    assert sum(map(len, seeds)) == len(set().union(*seeds))
    assert len({c.id for c in EVERY}) == len(EVERY)


def test_there_are_enough_of_each():
    count = lambda group: sum(c.group == group for c in EVERY)
    assert count("nulls") >= 100
    assert len({c.what for c in EVERY if c.group == "pairs"}) >= 6
    short = [c for c in EVERY if c.group == "short"]
    assert {c.duration * c.rate for c in short} == {100.0, 200.0}


@pytest.mark.parametrize("case", EVERY[:180:9], ids=lambda c: c.id)
def test_the_validation_is_another_tour(case):
    fit, other = (case.setup(validation=v).loop.reference for v in (False, True))
    stroke, fastest = ([float(np.ptp(f(r))) for r in (fit, other)] for f in (np.asarray, np.gradient))
    assert abs(stroke[0] / stroke[1] - 1.0) > 0.05
    assert abs(fastest[0] / fastest[1] - 1.0) > 1e-3


@pytest.mark.parametrize("case", EVERY[::11], ids=lambda c: c.id)
def test_the_loop_is_stable(case):
    setup = case.setup()
    log = setup.run()
    off = log["true_position"] - log["reference"]
    assert np.abs(off).max() < 0.3 * np.ptp(log["reference"])
    # An oscillating loop commands anew at each sample.
    jump = np.std(np.diff(log["true_command"])) / np.std(log["true_command"])
    assert jump < 1.0


@pytest.mark.parametrize(
    ("kind", "parameter"),
    [("constant_force", "level"), ("cogging", "amplitude"), ("friction_drift", "rate")],
)
def test_an_effect_shows_by_its_size(kind, parameter):
    large = hiding(kind)
    none = hiding(kind, **{f"{kind}__{parameter}": 0.0})
    assert sights(large)[kind].visible
    assert not sights(none)[kind].visible
    assert max(sights(none)[kind].evidence) < 30.0


def test_a_faint_effect_is_lost_in_noise_and_not_without():
    faint = {"constant_force__level": 3e-4}
    noisy = hiding("constant_force", scale="servo", noise=30.0, **faint)
    clean = hiding("constant_force", scale="servo", noise=0.3, **faint)
    assert min(sights(noisy)["constant_force"].evidence) < 30.0
    assert min(sights(clean)["constant_force"].evidence) > 30.0


def test_the_noise_of_a_log_is_white_after_whitening():
    case = HiddenCase("nulls", "none", "emps_like", 1.0, 11, (), ("viscous_friction",))
    setup = case.setup()
    log = setup.run()
    random = np.random.default_rng(0)
    w = 2 * np.pi * np.fft.rfftfreq(len(log["t"]), 1 / setup.rate)
    sensor = setup.sensor
    std = np.hypot(sensor.position_noise, sensor.position_resolution / np.sqrt(12.0))
    position = np.fft.rfft(std * random.standard_normal(len(log["t"])))
    force = np.fft.irfft(-setup.machine.inertia * w**2 * position, len(log["t"]))
    force += setup.machine.actuator_gain * sensor.force_noise * random.standard_normal(len(force))
    rows = Whitener(setup, faded(moving(log["true_velocity"])))(force)
    assert np.mean(rows**2) * len(rows) / len(log["t"]) == pytest.approx(1.0, abs=0.1)


def test_gaps_are_left_out():
    counts = np.ones(100, bool)
    counts[[30, 60, 61, 62]] = False
    fade = faded(counts)
    assert not np.any(fade[~counts])
    assert fade[45] == pytest.approx(1.0)


@pytest.mark.parametrize(("split", "seed", "seen"), [("seen_too", 6392, True), ("test", 8392, False)])
def test_a_ripple_beyond_half_the_sampling_rate_is_not_in_the_positions(split, seed, seen):
    """At the samples the acceleration holds it all the same, as a slow one."""
    case = next(c for c in cases(split) if c.seed == seed)
    setup = case.setup()
    log = setup.run()
    assert View.of(case, "cogging", setup, log).evidence > 100.0
    assert (between(case, "cogging", setup, log) > 30.0) == seen


@pytest.mark.parametrize("kind", ["constant_force", "cubic_stiffness", "quadratic_drag", "actuator_gain"])
def test_between_samples_smooth_effects_show_as_at_them(kind):
    case = hiding(kind)
    setup = case.setup()
    log = setup.run()
    at = View.of(case, kind, setup, log).evidence
    assert between(case, kind, setup, log) == pytest.approx(at, rel=0.25)


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "static_friction"])
def test_the_balance_closes_with_the_effect(kind):
    """The force that the oracle ascribes to an effect is what the truth is missing without it."""
    case = hiding(kind)
    setup = case.setup()
    log = setup.run()
    view = View.of(case, kind, setup, log)
    own = effect_force(kind, setup, log)
    whitened = Whitener(setup, faded(moving(log["true_velocity"])))(own)
    both = np.column_stack([view.columns, whitened])
    left = view.force - both @ np.linalg.lstsq(both, view.force, rcond=None)[0]
    assert 0.5 * np.sum(left**2) < 1e-3 * view.evidence


def test_a_gain_and_a_mass_are_tied():
    assert sights(hiding("added_mass"))["added_mass"].ties == ("actuator_gain",)
    assert sights(hiding("actuator_gain"))["actuator_gain"].ties == ("added_mass",)


def test_shapes_of_drag_are_tied_at_one_speed_only():
    case = hiding("cubic_friction")
    assert sights(case)["cubic_friction"].ties == ()
    faint = hiding("cubic_friction", scale="servo", noise=30.0, cubic_friction__coefficient=1e-7)
    assert "quartic_friction" in sights(faint)["cubic_friction"].ties


def test_each_of_a_pair_is_seen_beside_the_other():
    pair = hiding("constant_force", "cogging", cogging__amplitude=0.0)
    seen = sights(pair)
    assert seen["constant_force"].visible
    assert not seen["cogging"].visible


def record(**changes) -> dict:
    """A record of a case in which a mass was hidden."""
    sight = {"visible": True, "evidence": [99.0], "share": [0.1], "ties": ["actuator_gain"]}
    return {
        "hidden": ["added_mass"], "oracle": {"added_mass": sight}, "verdict": "found",
        "named": ["added_mass"], "alternatives": [[]],
        "gap": {"before": [9.0, 10.0], "after": [2.0, 2.0], "truth": [1.0, 2.0]},
        "parameters": {"added_mass.mass": [1.0, 1.1, 0.05], "inertia": [1.0, None, None]},
    } | changes  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "right"),
    [
        ({}, True),
        ({"verdict": "unexplained", "named": [], "alternatives": []}, False),
        ({"named": ["actuator_gain"], "alternatives": [["added_mass"]]}, True),
        ({"named": ["actuator_gain"], "alternatives": [[]]}, False),
        ({"named": ["input_delay"], "alternatives": [["added_mass"]]}, False),
        ({"named": ["added_mass", "cogging"], "alternatives": [[], []]}, False),
    ],
)
def test_what_counts_as_right(changes, right):
    assert judge.right(record(**changes)) is right


def test_closing_and_deviations():
    assert judge.closed(record()) == pytest.approx(1.0)
    assert judge.deviations(record()) == [pytest.approx(2.0)]


@pytest.mark.parametrize(
    ("clock", "where", "right"),
    [
        ([1.0, 7.0], {"frequency_hz": 7.05, "intervals": []}, True),
        ([1.0, 7.0], {"frequency_hz": 9.0, "intervals": []}, False),
        ([0.0, 0.0], {"frequency_hz": None, "intervals": [[1.0, 1.1], [3.0, 3.1]]}, True),
        ([0.0, 0.0], {"frequency_hz": None, "intervals": [[1.0, 1.1]]}, False),
        ([0.0, 0.0], {"frequency_hz": None, "intervals": [[0.0, 9.0]]}, False),
    ],
)
def test_what_counts_as_pointed_at(clock, where, right):
    outside = {"bursts": [[1.02, 0.05, 9.0], [3.02, 0.05, 9.0]], "clock": clock}
    said = record(verdict="unexplained", where=where, outside=outside)
    assert judge.pointed_at(said) is right


def test_bursts_come_while_it_moves_and_apart():
    for case in itertools.islice((c for c in EVERY if c.what == "bursts"), 9):
        setup = case.setup()
        log = dataclasses.replace(setup).run()
        starts = [b[0] for b in setup.machine.bursts]
        assert len(starts) >= 4
        assert np.diff(starts).min() > 2 * setup.machine.bursts[0][1]
        moves = moving(log["true_velocity"])
        held = [np.mean(moves[round(s * case.rate) :][:3]) for s in starts]
        assert np.mean(held) > 0.8
