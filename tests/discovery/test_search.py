"""Discovery on logs of an independent simulator: every effect, none, two, and none of these."""

import ast
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from jaxid.commands.discover import discover
from jaxid.effects import EFFECTS
from tests.discovery.test_without_force import HIDDEN
from tests.support.axis_log import log_of
from truth.axis import machines
from truth.axis.cases import case_text, write_case
from truth.axis.hidden_effects import AT_REST, COULOMB, PAIRS, SEARCH_CASES, VISCOUS, SearchCase

# Cogging is searched for by the notebook of the first tour, with the quick tests too.
FAST = ("coulomb_friction", "input_delay", "hysteresis")


def kinds_to_test():
    slow = pytest.mark.slow
    return [pytest.param(k, marks=() if k in FAST else slow) for k in SEARCH_CASES]


def searched(case: SearchCase, folder):
    fit, other = (log_of(case.setup(seed)) for seed in (0, 7))
    return discover(write_case(folder, case.text()), fit, validate=[other], refit=False)


def closed(d) -> float:
    """Part of what the truth closes in RMS: the truth leaves the noise floor."""
    before, after = (g[1].force.rms[0] for g in (d.gaps_before, d.gaps_after))
    return (before - after) / (before - min(d.noise_floor[0], after))


# Effects of other machines than the axis, with the test that searches for each.
ELSEWHERE = {
    "backlash": ("plants/test_flexible_axis.py", "test_names_the_clearance_of_a_coupling"),
    "joint_flexibility": (
        "plants/test_flexible_axis.py",
        "test_names_the_flexibility_that_a_rigid_model_lacks",
    ),
    "velocity_hysteresis": (
        "discovery/test_stage_search.py",
        "test_the_friction_of_the_table_is_named_both_ways",
    ),
    "command_delay": (
        "discovery/test_without_force.py",
        "test_a_missing_delay_is_named_and_put_into_the_controller",
    ),
    "velocity_limit": (
        "discovery/test_velocity_limit.py",
        "test_a_limited_velocity_of_the_command_is_named_with_its_value",
    ),
}
# Effects that only a log without a force is searched for, in `discovery/test_without_force.py`.
IN_LOOP = {"command_lag", "acceleration_limit", "dead_band", "load_friction"}


# The damping by a drive's voltage is known from its data; as a force it is viscous friction.
NOT_SEARCHED_FOR = {"back_emf_damping"}


def test_every_effect_has_a_case():
    searched_for = {k for k in EFFECTS if ":" not in k} - NOT_SEARCHED_FOR
    assert set(SEARCH_CASES) | set(ELSEWHERE) | IN_LOOP == searched_for
    assert set(HIDDEN) >= IN_LOOP
    assert not set(SEARCH_CASES) & set(ELSEWHERE)


@pytest.mark.parametrize("kind", ELSEWHERE)
def test_an_effect_of_another_machine_is_searched_for_there(kind):
    """The named test asserts that `discover` finds the kind."""
    file, function = ELSEWHERE[kind]
    text = (Path(__file__).parents[1] / file).read_text()
    tree = ast.parse(text)
    (body,) = [ast.unparse(f) for f in tree.body if isinstance(f, ast.FunctionDef) and f.name == function]
    assert "jaxid.discover(" in text
    asserted = [line for line in body.splitlines() if line.strip().startswith("assert")]
    assert any(f"'{kind}" in line for line in asserted), asserted


@pytest.mark.parametrize("kind", kinds_to_test())
def test_the_missing_effect_is_found(kind, tmp_path):
    case = SEARCH_CASES[kind]
    d = searched(case, tmp_path)
    assert d.verdict == "found"
    named = {d.kinds[0], *(s.candidate.kind for s in d.effects[0].alternatives)}
    assert len(d.kinds) == 1
    assert kind in named
    assert d.kinds[0] in {kind, *case.also}
    assert kind in AT_REST or closed(d) >= 0.9
    ripples = [case.values["period"]] if kind == "cogging" else []
    assert d.where.periods == pytest.approx(ripples, rel=0.01)
    assert any("found at the starts from rest" in note for note in d.after.notes) == (
        kind == "static_friction"
    )
    if d.kinds[0] != kind:
        # The rival's values are not the truth's; the two must be equally likely.
        leader = d.effects[0].score
        (truth,) = [s for s in d.effects[0].alternatives if s.candidate.kind == kind]
        threshold = next(r.step.threshold for r in d.rounds if r.step.added)
        assert abs(leader.evidence - truth.evidence) < threshold
        return
    for name, true in case.values.items():
        at = d.after.machine.parameters.names.index(f"{kind}.{name}")
        std = d.after.precision.std[at]
        assert abs(d.after.theta[at] - true) < 3 * std, name
        assert std < case.tolerance * abs(true), name


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_two_effects_at_once(pair, tmp_path):
    d = searched(PAIRS[pair], tmp_path)
    assert set(d.kinds) == set(pair.split(" + "))
    assert closed(d) >= 0.9


@pytest.mark.parametrize(
    ("preset", "motion", "seed", "duration", "sensor"),
    [
        (machines.emps_like, "linear", 3, 8.0, True),
        (machines.emps_like, "linear", 4, 8.0, False),
        (machines.servo, "rotary", 1, 2.0, True),
        (machines.heavy_slide, "linear", 2, 2.0, True),
    ],
)
def test_nothing_is_missing(preset, motion, seed, duration, sensor, tmp_path):
    setup = preset(seed, 1.0, duration)
    declared = [*setup.machine.effects.items()]
    text = case_text(setup, declared, off=1.5, motion=motion, sensor=sensor)
    d = discover(write_case(tmp_path, text), log_of(setup), refit=False)
    assert d.verdict == "nothing_missing"
    assert d.effects == ()
    assert d.where is None


def unlogged(**changes):
    setup = machines.emps_like(5, 1.0, 12.0)
    machine = dataclasses.replace(setup.machine, **changes)
    return dataclasses.replace(setup, machine=machine)


@pytest.mark.slow
def test_unlogged_bursts_are_unexplained(tmp_path):
    bursts = machines.random_bursts(11.0, 6, 0.05, 25.0, seed=2)
    setup = unlogged(bursts=bursts)
    text = case_text(setup, (VISCOUS, COULOMB))
    d = discover(write_case(tmp_path, text), log_of(setup), refit=False)
    assert d.verdict == "unexplained"
    assert d.effects == ()
    # The forces did not say; the loop may.
    assert "[within_prior] prior" in str(d)
    seen = [any(a - 0.05 <= s + 0.025 <= b + 0.05 for a, b in d.where.intervals) for s, *_ in bursts]
    assert np.mean(seen) >= 0.8


@pytest.mark.slow
def test_an_unlogged_clock_force_is_unexplained(tmp_path):
    setup = unlogged(clock_force=(4.0, 7.3))
    text = case_text(setup, (VISCOUS, COULOMB))
    d = discover(write_case(tmp_path, text), log_of(setup), refit=False)
    assert d.verdict == "unexplained"
    assert d.where.frequency_hz == pytest.approx(7.3, abs=0.15)
