"""Base parameters of arms: the PA-10's 43 by published rules, others by counting; torques by them alone."""

import arm_oracle
import numpy as np
import pytest
from test_serial_arm import ROWS, arm

from jaxid.base_parameters import base_parameters, inertial_regressor, standard_parameters
from jaxid.plants import Axis, pa10

# (2.16) of the PA-10 report: no torque depends on them.
WITHOUT_EFFECT = {
    "inertia_xx[1]", "inertia_xy[1]", "inertia_xz[1]", "inertia_yy[1]", "inertia_yz[1]", "first_moment_x[1]",
    "first_moment_y[1]", "first_moment_z[1]", "mass[1]", "first_moment_z[2]", "mass[2]",
}


def pa10_arm(seed=0, **more):
    parameters = arm_oracle.bodies(7, np.random.default_rng(seed))
    return arm(ROWS["pa10"], parameters, (0.0, 0.0, -9.81), **more), parameters


@pytest.fixture(scope="module")
def base():
    return base_parameters(pa10_arm()[0])


def by_rules(parameters) -> dict[str, float]:
    """(2.16) and Appendix A of the report, corrected: plus 2 d_7 mZ_7 in (A.1), every mass carried on."""
    keys = ("m", "x", "y", "z", "xx", "xy", "xz", "yy", "yz", "zz")
    links = {k: dict(zip(keys, p, strict=True)) for k, p in enumerate(parameters, start=1)}
    offsets = dict(enumerate(np.asarray(pa10().d), start=1))
    signs = {7: -1.0, 6: 1.0, 5: -1.0, 4: 1.0, 3: -1.0, 2: 1.0}
    for k in range(7, 1, -1):
        link, before, d = links[k], links[k - 1], offsets[k]
        moved = link["yy"] + 2 * d * link["z"] + d**2 * link["m"]
        before["xx"] += moved
        before["zz"] += moved
        before["y"] += signs[k] * (link["z"] + d * link["m"])
        before["m"] += link["m"]
        link["xx"] -= link["yy"]
    names = {"x": "first_moment_x", "y": "first_moment_y"}
    names |= {k: f"inertia_{k}" for k in ("xx", "xy", "xz", "yz", "zz")}
    kept = {f"{name}[{k}]": links[k][key] for k in range(2, 8) for key, name in names.items()}
    return {"inertia_zz[1]": links[1]["zz"], **kept}


def test_pa10_has_43_base_parameters(base):
    assert len(base.names) == 70
    assert len(base.chosen) == 43
    assert set(base.without_effect) == WITHOUT_EFFECT
    # a gap of fourteen decades says that 43 is a rank and no threshold
    assert base.singular_values[42] > 0.1
    assert base.singular_values[43] < 1e-13


@pytest.mark.parametrize("seed", range(2))
def test_pa10s_base_parameters_are_those_of_the_closed_rules(base, seed):
    plant, parameters = pa10_arm(seed)
    rules = by_rules(parameters)
    assert set(base.chosen_names) == set(rules)
    found = dict(zip(base.chosen_names, base.of(plant), strict=True))
    for name, value in rules.items():
        assert found[name] == pytest.approx(value, rel=1e-10, abs=1e-11), name


def test_text_names_the_sums(base):
    lines = base.text()
    assert len(lines) == 43
    assert "inertia_zz[1] + inertia_yy[2]" in lines
    assert "first_moment_y[6] -1 first_moment_z[7] -0.08 mass[7]" in lines


@pytest.mark.parametrize("name", ROWS)
def test_base_parameters_give_all_torques(name):
    rng = np.random.default_rng(3)
    rows = ROWS[name]
    plant = arm(rows, arm_oracle.bodies(len(rows), rng), rotor_inertia=rng.uniform(0.1, 1, len(rows)))
    found = base_parameters(plant, seed=1)
    states = rng.uniform(-2, 2, (3, 10, len(rows)))
    columns = np.asarray(inertial_regressor(plant, *states))
    torque = [arm_oracle.inverse_dynamics(rows, _bodies(plant), *x, plant.gravity_vector)
              for x in states.transpose(1, 0, 2)]
    torque = np.array(torque) + np.asarray(plant.rotor_inertia) * states[2]
    told, near = columns[..., list(found.chosen)] @ found.of(plant), 1e-9 * np.abs(torque).max()
    np.testing.assert_allclose(told, torque, rtol=0, atol=near)
    np.testing.assert_allclose(columns @ standard_parameters(plant)[1], torque, rtol=0, atol=near)


def _bodies(plant):
    return np.stack([np.asarray(getattr(plant, n)) for n in arm_oracle.NAMES], axis=-1)


def test_scara_in_the_plane_has_five():
    rows = [
        ("revolute", 0.0, 0.0, 0.2, 0.0), ("revolute", 0.0, 0.4, 0.0, 0.0), ("prismatic", 0.0, 0.3, 0.0, 0.0),
    ]
    plant = arm(rows, np.ones((3, 10)), (0.0, 0.0, -9.81))
    found = base_parameters(plant)
    # both arms' inertia, the outer one's centre of mass, and what the slide lifts
    assert found.chosen_names == (
        "inertia_zz[1]", "first_moment_x[2]", "first_moment_y[2]", "inertia_zz[2]", "mass[3]",
    )


def test_chosen_ones_may_be_asked_for():
    plant, _ = pa10_arm()
    found = base_parameters(plant, keep=("inertia_yy[7]", "mass[7]"))
    assert {"inertia_yy[7]", "mass[7]"} < set(found.chosen_names)
    assert len(found.chosen) == 43
    with pytest.raises(ValueError, match=r"mass\[8\] is none"):
        base_parameters(plant, keep=("mass[8]",))


def test_an_axis_has_its_inertia():
    found = base_parameters(Axis(2.0, vertical=True))
    assert found.chosen_names == ("inertia",)
    np.testing.assert_allclose(found.of(Axis(3.0)), [3.0])
