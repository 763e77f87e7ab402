"""The search for what differs, on two logs of an exact axis and with few effects: it compiles fast."""

import dataclasses
from functools import cache

import numpy as np
import pytest

import jaxid
from jaxid.commands.compare import _by_log, _comparable, fitted_machine
from jaxid.comparison.rows import ComparedLog
from jaxid.comparison.search import Search
from jaxid.discovery.superset import build_candidate_model
from jaxid.effects import EFFECTS
from jaxid.logs.log import Log
from tests.support.several_logs import axis_setup
from truth.axis.cases import case_text, recorded, write_case
from truth.axis.machines import Setup

SPRING = 1000.0


@cache
def axis(seed: int) -> Setup:
    return axis_setup(seed, noise=0.3, seconds=2.5)


def rougher(setup: Setup, factor: float) -> Setup:
    level = setup.machine.effects["coulomb_friction"]["level"]
    return setup.with_effect("coulomb_friction", level=factor * level)


def sprung(setup: Setup) -> Setup:
    return setup.with_effect("linear_stiffness", coefficient=SPRING)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    setup = axis(0)
    text = case_text(setup, [*setup.machine.effects.items()], off=1.2)
    return write_case(tmp_path_factory.mktemp("case"), text)


def searched(case, *setups: Setup):
    """Return what the search ends with: its model, and the differences."""
    logs = [Log(**(recorded(s) | {"source": f"{k}.csv"})) for k, s in enumerate(setups)]
    session = jaxid.open_session(case, logs, align_hold=True)
    machine = fitted_machine(session)
    few = [EFFECTS[kind] for kind in ("linear_stiffness", "asymmetric_viscous")]
    superset = build_candidate_model(machine, session.fit.data, few)
    logs = tuple(ComparedLog.of(runs, machine, superset) for runs in _by_log(session))
    search = Search(superset, logs, _comparable(session, superset.base))
    start = search.start(superset.neutral)
    model, named = search.run(start, 5)
    return search, start, model, named


def test_logs_of_one_machine_do_not_differ(case):
    search, _, model, named = searched(case, axis(1), axis(2))
    assert named == []
    assert model.changes == ()
    assert search.differ_unexplained(model) == ""


def test_a_friction_that_differs_is_named(case):
    search, _, model, (named,) = searched(case, axis(1), rougher(axis(2), 1.2))
    assert named.change.label == "coulomb_friction.level"
    assert named.evidence > named.threshold
    assert named.false_alarm < 1e-6
    final, values, std = search.estimate(model, None)
    by_log = [k for k, u in enumerate(final.unknowns) if u.index == named.change.index]
    true = axis(1).machine.effects["coulomb_friction"]["level"] * np.array([1.0, 1.2])
    assert np.all(np.abs(values[by_log] - true) < 4 * std[by_log])
    assert np.all(std[by_log] < 0.02 * true)


def test_an_effect_of_one_log_is_named_with_that_log(case):
    _, _, _, (named,) = searched(case, axis(1), sprung(axis(2)))
    assert (named.change.label, named.change.logs) == ("linear_stiffness", (1,))
    _, _, _, (named,) = searched(case, sprung(axis(1)), axis(2))
    assert (named.change.label, named.change.logs) == ("linear_stiffness", (0,))


def test_an_effect_that_both_lack_alike_is_no_difference(case):
    search, _, model, named = searched(case, sprung(axis(1)), sprung(axis(2)))
    assert named == []
    assert [(c.label, c.alike) for c in model.changes] == [("linear_stiffness", True)]
    # A difference beside it is still seen.
    search, _, model, (named,) = searched(case, sprung(axis(1)), rougher(sprung(axis(2)), 1.2))
    assert named.change.label == "coulomb_friction.level"
    assert {c.label for c in model.changes} == {"linear_stiffness", "coulomb_friction.level"}
    assert search.differ_unexplained(model) == ""


def test_a_disturbance_of_one_log_is_unexplained(case):
    disturbed = axis(2)
    level = disturbed.machine.effects["coulomb_friction"]["level"]
    bursts = [(t, 0.03, s * level) for t, s in ((0.3, 1.0), (0.8, -1.0), (1.4, 1.0), (1.9, -1.0))]
    machine = dataclasses.replace(disturbed.machine, bursts=bursts)
    search, _, model, named = searched(case, axis(1), dataclasses.replace(disturbed, machine=machine))
    assert named == []
    assert "1 leaves a residual" in search.differ_unexplained(model)
