"""Base parameters of arms: the PA-10's 43 by published rules, others by counting; torques by them alone."""

import dataclasses
from pathlib import Path

import arm_oracle
import numpy as np
import pytest
from test_serial_arm import ROWS, arm

from jaxid.arms.base_by_rules import base_parameters_by_rules
from jaxid.arms.base_parameters import base_parameters, inertial_regressor, standard_parameters
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.plants import Axis, pa10

# (2.16) of the PA-10 report: no torque depends on them.
WITHOUT_EFFECT = {
    "inertia_xx[1]",
    "inertia_xy[1]",
    "inertia_xz[1]",
    "inertia_yy[1]",
    "inertia_yz[1]",
    "first_moment_x[1]",
    "first_moment_y[1]",
    "first_moment_z[1]",
    "mass[1]",
    "first_moment_z[2]",
    "mass[2]",
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
    torque = [
        arm_oracle.inverse_dynamics(rows, _bodies(plant), *x, plant.gravity_vector)
        for x in states.transpose(1, 0, 2)
    ]
    torque = np.array(torque) + np.asarray(plant.rotor_inertia) * states[2]
    told, near = columns[..., list(found.chosen)] @ found.of(plant), 1e-9 * np.abs(torque).max()
    np.testing.assert_allclose(told, torque, rtol=0, atol=near)
    np.testing.assert_allclose(columns @ standard_parameters(plant)[1], torque, rtol=0, atol=near)


def _bodies(plant):
    return np.stack([np.asarray(getattr(plant, n)) for n in arm_oracle.NAMES], axis=-1)


def test_scara_in_the_plane_has_five():
    rows = [
        ("revolute", 0.0, 0.0, 0.2, 0.0),
        ("revolute", 0.0, 0.4, 0.0, 0.0),
        ("prismatic", 0.0, 0.3, 0.0, 0.0),
    ]
    plant = arm(rows, np.ones((3, 10)), (0.0, 0.0, -9.81))
    found = base_parameters(plant)
    # both arms' inertia, the outer one's centre of mass, and what the slide lifts
    assert found.chosen_names == (
        "inertia_zz[1]",
        "first_moment_x[2]",
        "first_moment_y[2]",
        "inertia_zz[2]",
        "mass[3]",
    )


def test_chosen_ones_may_be_asked_for():
    plant, _ = pa10_arm()
    found = base_parameters(plant, keep=("inertia_yy[7]", "mass[7]"))
    assert {"inertia_yy[7]", "mass[7]"} < set(found.chosen_names)
    assert len(found.chosen) == 43
    with pytest.raises(ValueError, match=r"mass\[8\] is not a parameter"):
        base_parameters(plant, keep=("mass[8]",))
    for known in ("mass[7]", "mass"):
        with pytest.raises(ValueError, match=r"mass\[7\] is in keep and in known"):
            base_parameters(plant, keep=("mass[7]",), known=(known,))


def test_an_axis_has_its_inertia():
    found = base_parameters(Axis(2.0, vertical=True))
    assert found.chosen_names == ("inertia",)
    np.testing.assert_allclose(found.of(Axis(3.0)), [3.0])


def random_rows(rng, joints):
    """Axes in general position, and many that are parallel, at right angles, or meet."""
    pick = lambda *values: float(rng.choice(values))
    right = np.pi / 2
    return [
        (
            str(rng.choice(["revolute", "revolute", "prismatic"])),
            pick(0, 0, right, -right, np.pi, 0.7),
            pick(0, 0, 0.3, -0.2),
            pick(0, 0.25),
            pick(0, 0.4, right),
        )
        for _ in range(joints)
    ]


def agree(plant):
    """By rank and by rules: the same choice, and every coefficient to 1e-9."""
    rank, rules = base_parameters(plant), base_parameters_by_rules(plant)
    assert rules.chosen_names == rank.chosen_names
    np.testing.assert_allclose(rules.mapping, rank.mapping, rtol=0, atol=1e-9)
    return rules


@pytest.mark.parametrize("rotors", [False, True])
def test_closed_rules_give_the_numerical_mapping_of_the_pa10(rotors):
    found = agree(pa10_arm(**({"rotor_inertia": np.ones(7)} if rotors else {}))[0])
    # of the rotors, the first two are seen as parts of their links
    assert len(found.chosen) == 43 + 5 * rotors
    assert "inertia_xx[6] -1 inertia_yy[6] +0.16 first_moment_z[7] +0.0064 mass[7] + inertia_yy[7]" in (
        found.text()
    )


def test_closed_rules_give_the_numerical_mapping_of_the_tx40():
    case = Path(__file__).parent.parent / "experiments" / "cases" / "tx40.toml"
    machine = build_machine(dataclasses.replace(load_case(case), transmission=None))
    # the case lets those be unknown
    assert set(agree(machine.plant).chosen_names) == {n for n in machine.parameters.names if "." not in n}


WEIGHTS = [(0.0, 0.0, -9.81), (0.0, -9.81, 0.0), (1.5, -2.0, -9.2)]


@pytest.mark.parametrize("seed", range(12))
def test_closed_rules_give_the_numerical_mapping_of_random_chains(seed):
    rng = np.random.default_rng(seed)
    n = 1 + seed % 4
    rotors = {"rotor_inertia": np.ones(n)} if seed % 2 else {}
    agree(arm(random_rows(rng, n), arm_oracle.bodies(n, rng), WEIGHTS[seed % 3], **rotors))


# What takes a rule of its own: a slide before, along, across and askew of the only direction of rotation, two
# joints on one axis, and slides at right angles with rotors and without weight.
SPECIAL = [
    "PP",
    "PRP",
    "RPaR",
    "RPxP",
    "RPoR",
    "RR0",
    "RR0P",
    "RPaR0",
    "PxP",
    "RPaP",
]
_ROWS = {
    "P": ("prismatic", 0.3, 0.1, 0.2, 0.1),
    "R": ("revolute", 0.0, 0.0, 0.2, 0.3),
    "0": None,
    "a": ("prismatic", 0.0, 0.3, 0.1, 0.2),
    "x": ("prismatic", np.pi / 2, 0.2, 0.0, 0.0),
    "o": ("prismatic", 0.6, 0.2, 0.1, 0.4),
}


@pytest.mark.parametrize("name", SPECIAL)
@pytest.mark.parametrize("weight", WEIGHTS[::2])
def test_closed_rules_give_the_numerical_mapping_of_special_chains(name, weight):
    letters = name.replace("Pa", "a").replace("Px", "x").replace("Po", "o").replace("0", "")
    rows = [_ROWS[letter] for letter in letters]
    n = len(rows)
    rng = np.random.default_rng(n)
    agree(arm(rows, arm_oracle.bodies(n, rng), weight, rotor_inertia=np.ones(n)))


def test_closed_rules_ask_for_weight():
    with pytest.raises(ValueError, match="need weight"):
        base_parameters_by_rules(arm(ROWS["scara"], np.ones((3, 10)), (0.0, 0.0, 0.0)))


def test_angles_of_five_digits_are_right_angles_where_asked():
    rows = [(j, np.round(alpha, 4), *rest) for j, alpha, *rest in ROWS["pa10"]]
    plant = arm(rows, np.ones((7, 10)), (0.0, 0.0, -9.81))
    assert (
        base_parameters_by_rules(plant, 1e-4).chosen_names
        == base_parameters_by_rules(pa10_arm()[0]).chosen_names
    )


KNOWN = (
    "mass",
    "first_moment_x",
    "first_moment_y",
    "first_moment_z",
    "inertia_xy",
    "inertia_xz",
    "inertia_yz",
)


def test_symmetric_links_of_known_mass_leave_thirteen():
    """Section 4.2 of the report: centres of mass are known, and products of inertia follow from them."""
    plant, _ = pa10_arm()
    found = base_parameters(plant, known=KNOWN)
    assert found.chosen_names == (
        "inertia_zz[1]",
        *(f"inertia_{axes}[{k}]" for k in range(2, 8) for axes in ("xx", "zz")),
    )
    assert len(found.names) == 21
    states = np.random.default_rng(0).uniform(-2, 2, (3, 10, 7))
    names, values = standard_parameters(plant)
    known = np.array([not set(found.names) & {name} for name in names])
    columns = np.asarray(inertial_regressor(plant, *states))
    rest = columns[..., ~known] @ values[~known]
    stand = [names.index(n) for n in found.chosen_names]
    np.testing.assert_allclose(columns[..., stand] @ found.of(plant), rest, atol=1e-10 * np.abs(rest).max())
