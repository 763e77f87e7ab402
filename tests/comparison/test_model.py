"""Models of several logs: which values they share, and what a change frees."""

import numpy as np

from jaxid.comparison.model import Change, Model, effect_changes, parameter_changes
from jaxid.discovery.candidates import Candidate

# Index 0 and 1: unknowns of the case; 2: that of an effect.
NEUTRAL = np.array([0.0])
SPRING = Candidate("spring", "spring", 0, np.array([2]), NEUTRAL, np.array([[1.0]]), np.array([True]))


def model(logs: int, *changes: Change) -> Model:
    return Model(np.tile([1.0, 2.0, 0.0], (logs, 1)), (0, 1), changes)


def friction(logs: int, *own: int, apart: bool = True) -> Change:
    return Change("friction", own, logs, index=1, apart=apart)


def test_without_a_change_all_logs_share_all_values():
    assert [(u.index, u.logs) for u in model(3).unknowns] == [(0, (0, 1, 2)), (1, (0, 1, 2))]


def test_a_parameter_that_differs_has_a_value_for_each_set_of_logs():
    assert model(2, friction(2, 1)).partition(1) == ((0,), (1,))
    assert model(3, friction(3, 1)).partition(1) == ((0, 2), (1,))
    assert model(3, friction(3, 1, 2)).partition(1) == ((0,), (1,), (2,))
    assert model(3, friction(3, 1), friction(3, 2)).partition(1) == ((0,), (2,), (1,))
    assert model(3, friction(3, 1)).partition(0) == ((0, 1, 2),)


def test_values_go_to_the_logs_they_belong_to():
    moved = model(2, friction(2, 1)).at(np.array([5.0, 6.0, 7.0]))
    assert moved.theta.tolist() == [[5.0, 6.0, 0.0], [5.0, 7.0, 0.0]]
    assert moved.values().tolist() == [5.0, 6.0, 7.0]


def test_an_effect_in_one_log_leaves_the_others_neutral():
    change = Change("spring", (1,), 2, effect=SPRING)
    with_spring = model(2).with_change(change, np.array([3.0]))
    assert with_spring.theta[:, 2].tolist() == [0.0, 3.0]
    assert with_spring.fitted_in(0) == [0, 1]
    assert with_spring.fitted_in(1) == [0, 1, 2]
    assert with_spring.differences == (change,)
    assert with_spring.without(change).theta[:, 2].tolist() == [0.0, 0.0]


def test_an_effect_in_all_logs_is_no_difference():
    change = Change("spring", (0, 1), 2, effect=SPRING)
    assert change.alike
    assert model(2).with_change(change, np.array([3.0])).differences == ()


def test_logs_that_share_again_take_the_mean():
    change = friction(2, 1)
    apart = model(2, change).at(np.array([5.0, 6.0, 8.0]))
    assert apart.without(change).theta[:, 1].tolist() == [7.0, 7.0]


def test_changes_that_are_tried():
    names = ["inertia", "friction", "spring"]
    two = parameter_changes(model(2), names, (0, 1), 2)
    assert [(c.label, c.logs) for c in two] == [("inertia", (1,)), ("friction", (1,))]
    three = parameter_changes(model(3), names, (1,), 3)
    # Each log may be the only one that differs, or all do.
    assert [(c.logs, c.unknowns) for c in three] == [((0,), 1), ((1,), 1), ((2,), 1), ((1, 2), 2)]
    assert parameter_changes(model(2, friction(2, 1)), names, (1,), 2) == []


def test_an_effect_is_tried_in_each_log_and_in_all():
    tried = effect_changes([SPRING], model(2), 2)
    # The first log is the base: a later one comes first.
    assert [c.logs for c in tried] == [(1,), (0,), (0, 1)]
    assert effect_changes([SPRING], model(2, tried[0]), 2) == []


def test_a_value_that_gives_the_scale_is_held_in_the_first_log_only():
    payload = Change("inertia", (1,), 2, index=0)
    held = Model(np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 0.0]]), (1,), held=(0,))
    assert [u.index for u in held.unknowns] == [1]
    assert [(u.index, u.logs) for u in held.fixed] == [(0, (0, 1))]

    loaded = held.with_change(payload)
    assert [(u.index, u.logs) for u in loaded.unknowns] == [(1, (0, 1)), (0, (1,))]
    assert [(u.index, u.logs) for u in loaded.fixed] == [(0, (0,))]
    moved = loaded.at(np.array([3.0, 5.0]))
    assert moved.theta[:, 0].tolist() == [1.0, 5.0]
    # It keeps its value where the logs share it again, and takes no mean.
    assert moved.without(payload).theta[:, 0].tolist() == [1.0, 1.0]
