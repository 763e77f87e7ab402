"""Stacked inertias of single joints: sums of link parameters from configurations, against other physics."""

import equinox as eqx
import numpy as np
import pytest

from jaxid.arms.base_parameters import base_parameters, standard_parameters
from jaxid.arms.dominant_inertia import from_dominant_inertias, inertia_regressor, of_swing
from jaxid.errors import InputError
from jaxid.plants import Axis
from tests.arms.test_base_parameters import pa10_arm
from tests.plants.test_serial_arm import ROWS, arm
from truth.arm import oracle as arm_oracle

# Symmetric links of known masses and centres of mass leave these.
KNOWN = (
    "mass",
    "first_moment_x",
    "first_moment_y",
    "first_moment_z",
    "inertia_xy",
    "inertia_xz",
    "inertia_yz",
)
ARM, BODIES = pa10_arm()
ANGLES = np.random.default_rng(4).uniform(-2.0, 2.0, (40, 7))


def true_inertias(name, bodies, q):
    return np.array([np.diag(arm_oracle.mass_matrix(ROWS[name], bodies, x)) for x in q])


INERTIAS = true_inertias("pa10", BODIES, ANGLES)


def test_period_of_a_pendulum_is_its_inertia():
    # 2 kg m^2 on 800 N m/rad: 20 rad/s
    assert of_swing(800.0, 2 * np.pi / 20.0) == pytest.approx(2.0, rel=1e-14)


@pytest.mark.parametrize("name", ROWS)
def test_columns_add_up_to_the_inertia(name):
    rng = np.random.default_rng(3)
    bodies = arm_oracle.bodies(len(ROWS[name]), rng)
    plant, q = arm(ROWS[name], bodies), rng.uniform(-2, 2, (10, len(ROWS[name])))
    true, values = true_inertias(name, bodies, q), standard_parameters(plant)[1]
    for k in range(len(bodies)):
        # inertias of some kg m^2: rounding
        np.testing.assert_allclose(inertia_regressor(plant, k + 1, q) @ values, true[:, k], atol=1e-12)


@pytest.mark.parametrize(("known", "sums"), [((), (36, 27, 19, 15, 7, 3, 1)), (KNOWN, (7, 6, 5, 4, 3, 2, 1))])
def test_configurations_give_the_sums(known, sums):
    for k, count in enumerate(sums, start=1):
        found = from_dominant_inertias(ARM, k, ANGLES, INERTIAS[:, k - 1], known)
        assert found.unidentifiable == []
        # condition at most 100: rounding of inertias of some kg m^2
        np.testing.assert_allclose(found.theta, found.base.of(ARM), atol=1e-12)
        assert np.abs(found.residual).max() < 1e-12
        if known:
            assert len(found.names) == count


def test_what_is_known_is_subtracted_and_the_rest_does_not_matter():
    other = eqx.tree_at(lambda p: (p.inertia_xx, p.inertia_yy, p.inertia_zz), ARM, replace_fn=lambda x: 7 * x)
    found = from_dominant_inertias(other, 3, ANGLES, INERTIAS[:, 2], KNOWN)
    np.testing.assert_allclose(found.theta, found.base.of(ARM), atol=1e-12)
    wrong = eqx.tree_at(lambda p: p.mass, ARM, ARM.mass.at[5].mul(1.2))
    found = from_dominant_inertias(wrong, 3, ANGLES, INERTIAS[:, 2], KNOWN)
    assert np.abs(found.theta - found.base.of(ARM)).max() > 1e-2


# Unknowns that remain at each joint once those of the joints after it are known.
COUNTS = {7: 1, 6: 2, 5: 2, 4: 2, 3: 2, 2: 2, 1: 2}


def test_joints_from_the_last_to_the_first_tell_all_thirteen():
    base = base_parameters(ARM, known=KNOWN)
    assert len(base.chosen) == 13
    plant, told = ARM, {}
    for name in base.names:
        plant = with_value(plant, name, 0.0)
    given = (*KNOWN, *(n for n in base.names if n not in base.chosen_names))
    for k in range(7, 0, -1):
        found = from_dominant_inertias(plant, k, ANGLES[:4], INERTIAS[:4, k - 1], (*given, *told))
        assert len(found.names) == COUNTS[k]
        told |= dict(zip(found.names, found.theta, strict=True))
        for name, value in told.items():
            plant = with_value(plant, name, value)
    assert set(told) == set(base.chosen_names)
    # each step passes its rounding on to the next
    np.testing.assert_allclose([told[n] for n in base.chosen_names], base.of(ARM), atol=1e-11)


def with_value(plant, name, value):
    field, _, k = name.rstrip("]").partition("[")
    return eqx.tree_at(lambda p: getattr(p, field), plant, getattr(plant, field).at[int(k) - 1].set(value))


def test_configurations_that_do_not_tell_are_named():
    """With an elbow straight but for rounding, all that follows turns about one axis."""
    few = ANGLES.copy()
    few[:, 3] = np.pi
    inertia = true_inertias("pa10", BODIES, few)[:, 2]
    found = from_dominant_inertias(ARM, 3, few, inertia, KNOWN)
    lost = ["inertia_xx[4]", "inertia_xx[5]"]
    assert found.unidentifiable == [{name: pytest.approx(1.0)} for name in lost]
    rest = [k for k, name in enumerate(found.names) if name not in lost]
    assert np.isnan(np.delete(found.theta, rest)).all()
    assert np.isnan(np.delete(found.std, rest)).all()
    np.testing.assert_allclose(found.theta[rest], found.base.of(ARM)[rest], atol=1e-12)
    assert np.abs(found.residual).max() < 1e-12


def test_fewer_configurations_than_unknowns_tell_combinations_at_most():
    found = from_dominant_inertias(ARM, 3, ANGLES[:3], INERTIAS[:3, 2], KNOWN)
    assert len(found.unidentifiable) == len(found.names) - 3
    assert np.isnan(found.std).all()
    found = from_dominant_inertias(ARM, 3, ANGLES[:5], INERTIAS[:5, 2], KNOWN)
    np.testing.assert_allclose(found.theta, found.base.of(ARM), atol=1e-12)
    assert np.isnan(found.std).all()  # nothing is left to judge by


@pytest.mark.slow
def test_deviations_are_those_of_repeated_measurements():
    rng = np.random.default_rng(8)
    noisy = INERTIAS[:, 2] + 0.01 * rng.standard_normal((400, len(ANGLES)))
    fits = [from_dominant_inertias(ARM, 3, ANGLES, x, KNOWN) for x in noisy]
    theta, std = (np.array([getattr(f, n) for f in fits]) for n in ("theta", "std"))
    # 400 draws tell a deviation to 3.5 %; four of these
    np.testing.assert_allclose(np.sqrt(np.mean(std**2, axis=0)), theta.std(axis=0), rtol=0.14)
    off = theta.mean(axis=0) - fits[0].base.of(ARM)
    np.testing.assert_array_less(np.abs(off), 4 * theta.std(axis=0) / np.sqrt(len(noisy)))


FAULTS = {
    "no such joint": (dict(joint=8), r"joint is 8; the plant has joints 1 to 7"),
    "angles": (dict(configurations=ANGLES[:, :6]), r"shape \(40, 6\); give a row of 7 positions"),
    "lengths": (dict(measured=INERTIAS[:3, 2]), "3 inertias for 40 configurations; give one inertia"),
    "stuck": (dict(measured=np.r_[1.0, np.nan, INERTIAS[2:, 2]]), "configuration 2 is nan .*sticks"),
    "negative": (dict(measured=-INERTIAS[:, 2]), "configuration 1 is -"),
    "a name": (dict(known=("mass[9]",)), r"mass\[9\] is not a parameter of the plant; .*mass\[1\]"),
    "all known": (
        dict(known=(*KNOWN, "inertia_xx", "inertia_yy", "inertia_zz")),
        "does not depend on an unknown parameter",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_said_in_one_line(name):
    changes, message = FAULTS[name]
    good = dict(joint=3, configurations=ANGLES, measured=INERTIAS[:, 2], known=KNOWN)
    with pytest.raises(InputError, match=message):
        from_dominant_inertias(ARM, **(good | changes))


def test_an_axis_tells_its_inertia():
    found = from_dominant_inertias(Axis(3.0), 1, np.zeros((2, 1)), np.array([2.0, 2.2]))
    assert found.names == ("inertia",)
    assert found.theta == pytest.approx([2.1])
    assert found.std == pytest.approx([0.1])
