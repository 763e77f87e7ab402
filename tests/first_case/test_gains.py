"""Logs of arms in ampere, of which one is not the same torque at each joint."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

import jaxid
from jaxid.consistency.balance_fit import balance_fits, rough_gains, with_rough_gains
from jaxid.results.verdict.robot_file import contradicted_file
from truth.arm.two_links import TwoLinks, run_sampled
from truth.axis.machines import multisine

CONSTANTS = np.array([5.0, 8.0])  # N m/A
LINKS = {"m1": 3.0, "m2": 2.0, "x1": 0.2, "x2": 0.25, "y2": 0.03, "i1": 0.06, "i2": 0.05}
ARM = """<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="2.5"/>
    <inertia ixx="0.01" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0.2 0 0"/><mass value="1.5"/>
    <inertia ixx="0.01" iyy="0.04" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 -1 0"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.5 0 0"/><axis xyz="0 -1 0"/></joint>
</robot>
"""
GANTRY = """<robot name="gantry">
  <link name="base"/>
  <link name="bridge"><inertial><mass value="12"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool"><inertial><mass value="4"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="x" type="prismatic"><parent link="base"/><child link="bridge"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="9" velocity="5"/></joint>
  <joint name="y" type="prismatic"><parent link="bridge"/><child link="tool"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="9" velocity="5"/></joint>
</robot>
"""


def drawn(seed: int) -> tuple[TwoLinks, np.ndarray]:
    """Draw an arm and the torque constants of its drives."""
    rng = np.random.default_rng([9, seed])
    size = lambda value: value * rng.uniform(0.8, 1.2)
    links = TwoLinks(
        **{name: size(value) for name, value in LINKS.items()},
        viscous=(size(1.5), size(0.8)),
        coulomb=(size(2.0), size(1.2)),
    )
    return links, np.array([size(5.0), size(8.0)])


def recorded(
    links: TwoLinks,
    constants: np.ndarray,
    seed: int,
    rate: int = 1000,
    seconds: float = 6.0,
    noisy: bool = True,
):
    """Return the log of an arm of two links, by its closed-form equations, in a loop of 1 kHz."""
    t = np.arange(round(1000 * seconds)) / 1000
    wanted = np.stack([multisine(t, [0.2, 0.5, 0.9, 1.7], 1.2, 2 * seed + k) for k in range(2)], axis=1)
    count = 2 * np.pi / 2**17
    law = {"kp": (300.0, 150.0), "kd": (30.0, 10.0), "force_noise": 0.05 * noisy, "seed": seed}
    read = {"resolution": count, "noise": 0.5 * count} if noisy else {}
    run = run_sampled(links, rate=1000.0, start=wanted[0], reference=wanted, **read, **law)
    torque = np.stack([run["u1"], run["u2"]], axis=1)
    log = {"t": t} | {f"actual_q_{k}": run[f"q{k + 1}"] for k in range(2)}
    log |= {f"actual_current_{k}": torque[:, k] / constants[k] for k in range(2)}
    # The controller's model of the arm has no friction.
    log |= {f"target_moment_{k}": 0.8 * torque[:, k] for k in range(2)}
    return {name: column[:: 1000 // rate] for name, column in log.items()}


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """Return the first case and the log of an arm."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.urdf").write_text(ARM)
    log = recorded(TwoLinks(), CONSTANTS, 0)
    return jaxid.init(log, urdf=folder / "arm.urdf", folder=folder), log


def test_currents_come_before_torques_that_a_controller_wants(arm):
    first, _ = arm
    assert list(first.tables["log"]["force"].values()) == ["actual_current_0", "actual_current_1"]
    assert any("'target_moment_0', 'target_moment_1' could be these as well" in a for a in first.assumed)


def test_the_ratio_of_torque_constants_is_an_unknown_that_the_log_shows(arm):
    first, log = arm
    [effect] = [e for e in first.tables["effects"] if e["kind"] == "actuator_gain"]
    assert effect["joint"] == 2
    assert effect["gain"]["guess"] == pytest.approx(CONSTANTS[1] / CONSTANTS[0], rel=0.05)
    assert any("one A need not be the same torque" in line for line in first.assumed)

    fit = jaxid.identify(first.case(), log, method="inverse_dynamics").estimate
    values = dict(zip(fit.names, zip(fit.theta, fit.std, strict=True), strict=True))
    true = {"actuator_gain[2].gain": CONSTANTS[1] / CONSTANTS[0]}
    true |= {"coulomb_friction[1].level": 2.0 / CONSTANTS[0], "coulomb_friction[2].level": 1.2 / CONSTANTS[0]}
    for name, value in true.items():
        found, std = values[name]
        assert abs(found - value) < min(4 * std, 0.02 * value), name


def test_the_tick_of_a_faster_loop_is_found_beside_an_unknown_gain(tmp_path):
    """With the gain 2 per cent off, half a row seems to be the tick, which moves the gain by as much."""
    (tmp_path / "arm.urdf").write_text(ARM)
    links, constants = drawn(29)
    log = recorded(links, constants, 29, 200, seconds=8.0, noisy=False)
    first = jaxid.init(log, urdf=tmp_path / "arm.urdf", folder=tmp_path)
    fit = jaxid.identify(first.case(), log, method="inverse_dynamics")
    assert fit.session.settings["tick"]["value"] == "0.001 s"
    gain = fit.estimate.value("actuator_gain[2].gain")
    assert gain == pytest.approx(constants[1] / constants[0], rel=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "rate",
    [500, pytest.param(200, marks=pytest.mark.xfail(strict=True, reason="18 of 24 hold"))],
)
def test_intervals_of_gains_hold_their_share(tmp_path, rate):
    (tmp_path / "arm.urdf").write_text(ARM)
    hold, runs = 0, 24
    for seed in range(runs):
        links, constants = drawn(seed)
        log = recorded(links, constants, seed, rate, seconds=8.0)
        first = jaxid.init(log, urdf=tmp_path / "arm.urdf", folder=tmp_path)
        fit = jaxid.identify(first.case(), log).estimate
        k = list(fit.names).index("actuator_gain[2].gain")
        hold += abs(fit.theta[k] - constants[1] / constants[0]) < 1.96 * fit.std[k]
    assert binom.cdf(hold, runs, 0.95) > 0.005


def test_values_in_ampere_are_not_compared_with_the_file(arm):
    first, log = arm
    found = jaxid.identify(first.case(), log, method="inverse_dynamics")
    assert not [line for line in contradicted_file(found.session, found.estimate)]
    in_file_units = replace(found.session.case, tables=without_units(found.session.case.tables))
    assert contradicted_file(replace(found.session, case=in_file_units), found.estimate)


def without_units(tables):
    plant = {key: value for key, value in tables["plant"].items() if key != "units"}
    return {**tables, "plant": plant}


def test_with_the_constant_of_one_joint_all_is_in_newton_metres(arm):
    first, log = arm
    tables = first.tables
    del tables["plant"]["units"]
    tables["plant"]["urdf"] = str(first.folder / "arm.urdf")
    tables["actuator"] = {"gain": CONSTANTS[0]}
    fit = jaxid.identify(tables, log, method="inverse_dynamics").estimate
    true = {"coulomb_friction[1].level": 2.0, "coulomb_friction[2].level": 1.2}
    true |= {"viscous_friction[1].coefficient": 1.5, "viscous_friction[2].coefficient": 0.8}
    for name, value in true.items():
        assert fit.value(name) == pytest.approx(value, rel=0.02), name


def test_checks_begin_at_the_rough_gains(arm):
    first, log = arm
    tables = first.tables
    tables["plant"]["urdf"] = str(first.folder / "arm.urdf")
    tables["effects"][-1]["gain"] = {"guess": 0.5}
    session = jaxid.open_session(tables, log)
    rough = rough_gains(session.machine, session.fit.data)
    ratio = CONSTANTS[1] / CONSTANTS[0]
    assert rough is not None
    assert rough.gains == pytest.approx([ratio], rel=0.05)
    assert rough.std < 0.01 * ratio
    machine = with_rough_gains(session.machine, session.fit.data)
    assert machine.parameters.guess[rough.places[0]] == rough.gains[0]
    # The noise of the force is that of a case with the right guess.
    tables["effects"][-1]["gain"] = {"guess": ratio}
    right = jaxid.open_session(tables, log)
    np.testing.assert_allclose(session.fit.data.force_noise, right.fit.data.force_noise, rtol=0.02)


def test_the_time_for_which_a_current_acts_is_found_beside_unknown_gains(arm):
    first, _ = arm
    session = jaxid.open_session(first.case(), recorded(TwoLinks(), CONSTANTS, 0, rate=200))
    assert "tick" in session.settings
    assert session.fit.data.faster_loop


def test_slides_that_do_not_push_each_other_show_no_ratio(tmp_path):
    t = np.arange(5000) / 500
    path = tmp_path / "gantry.urdf"
    path.write_text(GANTRY)
    log = {"t": t}
    for name, mass, constant, phase in (("x", 16.0, 20.0, 0.0), ("y", 4.0, 9.0, 1.0)):
        angle = 2 * np.pi * np.array([[0.3], [0.8]]) * t + phase
        size, rate = np.array([[0.1], [0.03]]), 2 * np.pi * np.array([[0.3], [0.8]])
        speed = np.sum(size * rate * np.cos(angle), axis=0)
        force = -mass * np.sum(size * rate**2 * np.sin(angle), axis=0) + 3.0 * np.sign(speed) + 5.0 * speed
        log[f"{name}_pos"] = np.round(np.sum(size * np.sin(angle), axis=0) / 1e-6) * 1e-6
        log[f"{name}_current"] = force / constant
    first = jaxid.init(log, urdf=path, folder=tmp_path)
    assert "effects" not in first.tables
    tables = first.tables | {"effects": [{"kind": "actuator_gain", "joint": 2, "gain": {"guess": 1.0}}]}
    tables["plant"]["urdf"] = str(path)
    session = jaxid.open_session(tables, log)
    rough = rough_gains(session.machine, session.fit.data)
    assert rough is not None
    assert not rough.std < 0.05 * rough.gains
    assert not rough.shown.any()
    # The force itself, as one more undeclared force, would explain its joint under every hold.
    assert balance_fits(session.machine, session.fit.data)[0].gains == ()
    assert "tick" not in session.settings
    assert first.tables["plant"]["units"] == {"force": "A"}


def test_torques_have_no_unknown_gain(arm):
    first, log = arm
    torques = {name: x for name, x in log.items() if "current" not in name}
    again = jaxid.init(torques, urdf=first.folder / "arm.urdf", folder=first.folder)
    assert list(again.tables["log"]["force"].values()) == ["target_moment_0", "target_moment_1"]
    assert "effects" not in again.tables
