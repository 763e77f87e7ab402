"""Natural frequencies of plants by hand, however damped, with the slopes of the formula."""

import jax
import numpy as np
import pytest

from jaxid.dynamics.frequencies import Modes, natural_frequencies
from jaxid.effects import EFFECTS
from jaxid.plants import PLANTS

J1, J2, K = 72.3, 34.8, 8e5


def two_masses(p):
    """Motor inertia, load inertia, stiffness."""
    return np.sqrt(p[2] / p[0] + p[2] / p[1]) / (2 * np.pi)


def flexible(damping: float):
    """An axis that is damped at both ends and between."""
    friction = [EFFECTS["viscous_friction"](damping, port=i) for i in (0, 1)]
    plant = PLANTS["flexible_axis"](J1, J2, K, damping, effects=tuple(friction))
    return plant, tuple(((n,), None) for n in ("motor_inertia", "load_inertia", "stiffness", "damping"))


def found_spring(damping: float):
    """A rigid axis with part of its inertia behind a spring of its own, which is damped too."""
    spring = EFFECTS["joint_flexibility"](K, damping, J2)
    plant = PLANTS["axis"](J1 + J2, effects=(EFFECTS["viscous_friction"](damping), spring))
    fields = ("load_inertia", "stiffness", "damping")
    return plant, (*((("effects", 1, n), None) for n in fields), (("inertia",), None))


@pytest.mark.parametrize("damping", [0.0, 126.0, 2500.0])
def test_damping_is_left_out(damping):
    """With it 2500 N s/m at each place would move the size of the eigenvalues by 0.5 %."""
    expected = np.array([J1, J2, K, damping])
    plant, places = flexible(damping)
    slopes = jax.grad(lambda p: jax.numpy.sqrt(p[2] / p[0] + p[2] / p[1]) / (2 * np.pi))(expected)
    modes = natural_frequencies(plant, places, expected)
    np.testing.assert_allclose(modes.hz, [two_masses(expected)], rtol=1e-12)
    np.testing.assert_allclose(modes.slopes, [slopes], rtol=1e-9)
    assert modes.slopes[0, 3] == 0.0
    if damping == 0.0:
        return
    plant, places = found_spring(damping)
    modes = natural_frequencies(plant, places, np.array([J2, K, damping, J1 + J2]))
    np.testing.assert_allclose(modes.hz, [two_masses(expected)], rtol=1e-12)
    # The motor's inertia is the whole less the load's.
    np.testing.assert_allclose(modes.slopes[0], [slopes[1] - slopes[0], slopes[2], 0.0, slopes[0]], rtol=1e-9)


def test_a_heavily_damped_axis_keeps_its_mode():
    plant, places = flexible(1e5)
    modes = natural_frequencies(plant, places, np.array([J1, J2, K, 1e5]))
    assert modes.hz == pytest.approx([two_masses((J1, J2, K))], rel=1e-12)


def test_joints_are_held():
    plant, places = flexible(126.0)
    theta = np.array([J1, J2, K, 126.0])
    for held, inertia in (((0,), J2), ((1,), J1)):
        modes = natural_frequencies(plant, places, theta, held)
        assert modes.hz == pytest.approx([np.sqrt(K / inertia) / (2 * np.pi)], rel=1e-12)
    assert natural_frequencies(plant, places, theta, (0, 1)).hz.size == 0


def test_modes_come_lowest_first_and_equal_ones_by_themselves():
    """Two equal masses on equal springs, joined or not."""
    places = tuple((("stiffness",), i) for i in range(3))
    for k in ([300.0, 200.0, 300.0], [300.0, 0.0, 300.0]):
        plant = PLANTS["chain"]([2.0, 2.0], [1.0, 1.0], k)
        modes = natural_frequencies(plant, places, np.array(k))
        w = np.sqrt([150.0, 150.0 + k[1]])
        np.testing.assert_allclose(modes.hz, w / (2 * np.pi), rtol=1e-12)
        np.testing.assert_allclose(modes.slopes.sum(axis=0)[::2], np.sum(0.125 / w) / np.pi / 2, rtol=1e-9)


def test_nothing_swings_without_a_spring():
    plant = PLANTS["axis"](J1, effects=(EFFECTS["viscous_friction"](10.0),))
    assert natural_frequencies(plant, ((("inertia",), None),), np.array([J1])).hz.size == 0
    plant = PLANTS["chain"]([1.0, 2.0], [0.0, 0.0], [0.0, 0.0, 0.0])
    assert natural_frequencies(plant, ((("mass",), 0),), np.array([1.0])).hz.size == 0


def test_no_deviation_where_an_unknown_in_it_has_none():
    modes = Modes(np.array([3.0]), np.array([[2.0, 0.0]]))
    assert modes.std(np.diag([0.25, np.nan])) == pytest.approx([1.0])
    assert np.isnan(modes.std(np.diag([np.nan, 1.0]))).all()
