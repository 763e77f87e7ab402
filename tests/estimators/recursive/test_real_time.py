"""The method `recursive` a sample at a time, on true motion of an exact stepper."""

import jax
import numpy as np
import pytest

from jaxid import RealTime
from jaxid.errors import InputError
from jaxid.session import open_session
from tests.support.recursive_axis import TRUTH, slide, written_axis


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    return written_axis(tmp_path_factory.mktemp("axis"))


@pytest.fixture(scope="module")
def live(axis):
    """A machine's rows in real time, on true motion: no filter stands between the two."""
    machine = open_session(*axis).machine
    truth = slide(4.0).run()
    motion = [truth[f"true_{x}"][:, None] for x in ("position", "velocity", "acceleration", "command")]
    options = {"noise": 0.1, "spread": [50.0, 200.0, 20.0], "gate_velocity": 1e-3}
    return RealTime.of(machine, 1e-3, **options), motion, machine


def test_a_sample_at_a_time(live):
    """Against ridge regression on columns written by hand. The command has no noise: 1e-9."""
    estimator, (q, v, a, u), _ = live
    memory = estimator.memory()
    memory = jax.lax.scan(lambda m, now: (estimator.update(m, *now), None), memory, (q, v, a, u))[0]
    moving = np.abs(v[:, 0]) > 1e-3
    columns = np.stack([a, v, np.tanh(v / (1e-3 / 3))], axis=-1)[moving, 0]
    normal = columns.T @ columns + np.diag(np.square(0.1 / np.array([50.0, 200.0, 20.0])))
    start = np.array([TRUTH[0] / 3, 0.0, 0.0])
    pulled = np.square(0.1 / np.array([50.0, 200.0, 20.0])) * start
    expected = np.linalg.solve(normal, columns.T @ (35.15065 * u[moving, 0]) + pulled)
    told = estimator.estimate(memory)
    assert np.array_equal(estimator.told(memory).theta, told.theta), "the name of version 0.1"
    assert int(memory.samples) == moving.sum() < len(moving)
    np.testing.assert_allclose(told.theta, expected, rtol=1e-6)
    np.testing.assert_allclose(told.theta, TRUTH, rtol=2e-3)


def test_real_time_goes_on_from_a_memory(live):
    estimator, motion, _ = live
    memory = estimator.memory()
    for k in range(600):
        memory = estimator.update(memory, *(x[k] for x in motion))
        if k == 299:
            kept = jax.tree.map(np.asarray, memory)
    assert float(memory.weight) > 0
    for k in range(300, 600):
        kept = estimator.update(kept, *(x[k] for x in motion))
    for one, other in zip(jax.tree.leaves(memory), jax.tree.leaves(kept), strict=True):
        np.testing.assert_array_equal(one, other)


def test_real_time_refuses(live):
    machine = live[2]
    good = {"noise": 0.1, "spread": [1.0, 1.0, 1.0], "gate_velocity": 1e-3}
    for change, message in (
        ({"half_life": 0.0}, "half_life = 0.0 is not positive"),
        ({"noise": -1.0}, "noise = -1.0 is not positive"),
        ({"spread": [1.0]}, "give one value for each of inertia"),
        ({"gate_velocity": 0.0}, "gate_velocity = 0.0 is not positive"),
        (
            {"gate_velocity": [1e-3, 1e-3]},
            r"gate_velocity has shape \(2,\); give one value for all joints, or 1",
        ),
        ({"gate_acceleration": -1.0}, "gate_acceleration = -1.0 is negative"),
        ({"start": [80.0]}, r"start has shape \(1,\); give one value for each of inertia"),
    ):
        with pytest.raises(InputError, match=message):
            RealTime.of(machine, 1e-3, **(good | change))
