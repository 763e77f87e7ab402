"""A branched mechanism with two slides, logged by MuJoCo: what its fits and searches give back."""

import json
import tomllib

import pytest

import jaxid
from jaxid.build import build_machine
from jaxid.case.case import load_case
from tests.support.cli_setup import run
from tests.support.mjcf_robots import CART_JOINTS, cart, cart_log
from tests.support.written_logs import write_csv

CASE = """
[plant]
kind = "tree"
mjcf = "robot.xml"
unknown = ["base", "armature", "damping"]
[log]
time = "t"
hold = "zero_order"
position = { rail = "q_rail", pole = "q_pole", boom = "q_boom", plunger = "q_plunger" }
force = { plunger = "u_plunger", rail = "u_rail", pole = "u_pole", boom = "u_boom" }
[sensor]
position_noise = 1e-6
"""
# The file that the fits start from: masses and damping are off.
WRONG = (('mass="0.8"', 'mass="0.5"'), ('mass="1.1"', 'mass="1.5"'), ('damping="4"', 'damping="2"'))


def wrong(text: str) -> str:
    for old, new in WRONG:
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "case.toml").write_text(CASE)
    (tmp_path / "robot.xml").write_text(cart())
    return tmp_path


def true_values(folder) -> dict[str, float]:
    """The unknowns by the file that made the log."""
    unknowns = build_machine(load_case(folder / "case.toml")).parameters
    return dict(zip(unknowns.names, unknowns.guess, strict=True))


def check(estimate, true, sigmas=4.0):
    assert set(estimate.names) == set(true)
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std, strict=True):
        assert 0 < std < 1e-3, name
        assert abs(value - true[name]) < sigmas * std, (name, value, true[name], std)


@pytest.mark.parametrize("method", ["inverse_dynamics", pytest.param("output_error", marks=pytest.mark.slow)])
def test_base_parameters_rotors_and_damping_come_back(folder, method):
    true = true_values(folder)
    # Of four bodies, ten parameters each, and four rotors 11 sums remain.
    assert len(true) == 11 + len(CART_JOINTS)
    (folder / "robot.xml").write_text(wrong(cart()))
    assert abs(true_values(folder)["first_moment_x[3]"] - true["first_moment_x[3]"]) > 0.05
    log = write_csv(folder / "log.csv", cart_log(cart(), seconds=6.0, rate=250))
    check(jaxid.identify(folder / "case.toml", log, method=method).estimate, true)


@pytest.mark.slow
def test_a_hidden_friction_is_found_with_the_name_of_its_joint(folder, capsys):
    """The log's pole rubs with 0.15 N m, of which the file says nothing; the corrected case says it."""
    log = write_csv(folder / "log.csv", cart_log(cart(pole=0.15), seconds=6.0, rate=250))
    ran = run(capsys, "discover", folder / "case.toml", log, folder=folder / "out")
    assert ran.status == 0
    assert "coulomb_friction[2] at joint 'pole'" in ran.out
    found = json.loads((folder / "out" / "discovery.json").read_text())
    assert [(e["kind"], e["joint"], e["joint_name"]) for e in found["effects"]] == [
        ("coulomb_friction", 2, "pole")
    ]
    assert found["effects"][0]["parameters"]["level"]["value"] == pytest.approx(0.15, rel=2e-3)


def test_a_corrected_case_holds_links_and_effects_of_the_file_by_joint(folder):
    (folder / "robot.xml").write_text(wrong(cart()))
    log = write_csv(folder / "log.csv", cart_log(cart(), seconds=6.0, rate=250))
    result = jaxid.identify(folder / "case.toml", log, method="inverse_dynamics")
    result.save_case(folder / "found.toml")
    tables = tomllib.loads((folder / "found.toml").read_text())
    assert tables["plant"]["parameters"]["mass"].keys() == {"plunger"}
    assert [e["joint"] for e in tables["effects"]] == list(CART_JOINTS)
    machine = build_machine(load_case(folder / "found.toml"))
    value = dict(zip(machine.parameters.names, machine.parameters.guess, strict=True))
    again = dict(zip(result.estimate.names, result.estimate.theta, strict=True))
    assert value == pytest.approx(again, rel=1e-8, abs=1e-12)
