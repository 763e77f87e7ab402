"""Effects that a search drops again, and what it takes for a closed gap."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.commands.discover import start_search
from jaxid.discovery.acceptance import Acceptance
from jaxid.discovery.search import Model, Search
from jaxid.session import open_session

GOOD, BAD = ("one", "two", "three"), "bad"


def dropped(losses) -> list[str]:
    """Names of what a search drops whose losses are a function of the effects in a model and without one."""
    search = SimpleNamespace(
        without=lambda model, c: Model(tuple(a for a in model.added if a != c), model.theta),
        loss=lambda model, smaller: losses(set(model.added), *(set(model.added) - set(smaller.added))),
        step=lambda model, dropped, threshold: dropped,
    )
    every = (*GOOD, BAD)
    model, steps = Search.drop_superfluous(search, Model(every, np.zeros(1)), 10.0, every)
    assert set(model.added) == set(every) - set(steps)
    return steps


def test_the_least_needed_goes_first():
    """An effect that a few samples hold spoils the held-out prediction of every model that has it."""

    def losses(model, gone):
        if BAD not in model:
            return 500.0, 0.9
        return (-800.0, 0.5) if gone == BAD else (-3.0, 0.9)

    assert dropped(losses) == [BAD]


def test_what_closes_hardly_anything_goes():
    assert dropped(lambda model, gone: (500.0, 0.01 if gone == BAD else 0.9)) == [BAD]


@pytest.mark.parametrize("part", [0.01, 0.9])
def test_an_effect_whose_loss_is_no_number_stays(part):
    assert dropped(lambda model, gone: (np.nan, part)) == []


def test_a_gap_that_closes_at_one_joint_counts():
    """A wrist's friction leaves the gap of the whole arm as it is, which the shoulder makes."""
    tests = object.__new__(Acceptance)
    tests.samples = SimpleNamespace(moving=np.ones((100, 2), bool))
    tests._noise, tests._numerics = np.array([1e-2, 1e-4]), np.array([1e-3, 1e-5])
    tests._numerics_of_joints = tests._numerics
    old = np.tile([10.0, 0.1], (100, 1))
    new = np.tile([10.0, 0.02], (100, 1))
    assert tests.closed(old, new) < 1e-3
    assert tests.closed_somewhere(old, new) == pytest.approx(0.96, abs=0.01)
    # What filtering leaves wrong at a joint is no gap.
    tests._numerics_of_joints = np.array([1e-3, 2.0])
    assert tests.closed_somewhere(old, new) < 1e-3


@pytest.mark.parametrize("driven", [1, 2])
def test_gaps_are_judged_by_joint_of_a_machine_with_fewer_drives(driven):
    """Two masses of which one is driven: the other has no force whose error counts."""
    t = np.arange(400) / 100
    columns = {"t": t, "q1": 0.01 * np.sin(7 * t), "q2": 0.01 * np.sin(7 * t + 0.3), "u": 5.0 * np.cos(9 * t)}
    case = {
        "plant": {
            "kind": "chain",
            "actuated": [driven],
            "parameters": {
                "mass": [{"guess": 1.0}, 2.0],
                "damping": [1.0, 1.0],
                "stiffness": [100.0, 100.0, 100.0],
            },
        },
        "log": {"time": "t", "position": ["q1", "q2"], "force": "u"},
    }
    session = open_session(case, columns, align_hold=True, method="discover")
    _, search = start_search(session)
    tests, e = search.acceptance, search.acceptance.residual(search.model.theta)
    assert e.shape[1] == 2
    assert tests.closed_somewhere(e, 0.5 * e) == pytest.approx(0.75, rel=0.05)
    # The mass without a drive alone.
    there = 2 - driven
    better = e.copy()
    better[:, there] *= 0.1
    assert tests.closed_somewhere(e, better) == pytest.approx(0.99, rel=0.05)
