"""The arm through the case file: identified from other physics, simulated, and refused where it is wrong."""

import dataclasses

import numpy as np
import pytest

from jaxid.arms.base_parameters import base_parameters
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.discovery.at_rest.break_away import break_away
from jaxid.errors import InputError
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.session import open_session
from tests.support.case_faults import message
from tests.support.cli_setup import run
from tests.support.written_logs import write_csv
from truth.arm.two_links import TwoLinks, followed

FRICTION = """
[[effects]]
kind = "viscous_friction"
coefficient = {viscous}
[[effects]]
kind = "coulomb_friction"
level = {coulomb}
"""
LOG = '[log]\ntime = "t"\nposition = ["q1", "q2"]\nforce = ["u1", "u2"]\n'
UNKNOWN = "[{ guess = 0.1 }, { guess = 0.1 }]"
# A guess of nothing where something is, and tenfold too little where something must be.
BASE = (("0.0", "[{ guess = 0.0 }, { guess = 0.0 }, 0.0]", "[0.0, 0.0, 0.0, 0.0, 0.0, { guess = 0.1 }]"),) * 2
WHOLE = (
    (
        "{ guess = 1.0 }",
        "[{ guess = 0.0 }, { guess = 0.0 }, { guess = 0.0 }]",
        "{ guess = [0.1, 0.0, 0.0, 0.1, 0.0, 0.1] }",
    ),
) * 2


def text(links=BASE, viscous=UNKNOWN, coulomb=UNKNOWN, rest=LOG) -> str:
    tables = [
        f'[[plant.links]]\njoint = "revolute"\nalpha_deg = 0.0\na = {a}\n'
        f"mass = {mass}\nfirst_moment = {first}\ninertia = {inertia}\n"
        for a, (mass, first, inertia) in zip((0.0, 0.5), links, strict=True)
    ]
    plant = '[plant]\nkind = "serial_arm"\ngravity_vector = [0.0, -9.81, 0.0]\n'
    friction = FRICTION.format(viscous=viscous, coulomb=coulomb) if viscous else ""
    return plant + "".join(tables) + friction + rest


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_csv(tmp_path_factory.mktemp("log") / "log.csv", followed(TwoLinks()))


@pytest.fixture(scope="module")
def estimates(log, tmp_path_factory):
    """Fits of the base parameters alone, and of all twenty inertial parameters."""
    out = {}
    for name, links in (("base", BASE), ("whole", WHOLE)):
        path = tmp_path_factory.mktemp(name) / "case.toml"
        path.write_text(text(links))
        session = open_session(path, log)
        out[name] = inverse_dynamics(session.machine, session.fit.data)
    return out


def truth():
    arm = TwoLinks()
    friction = {"viscous_friction": "coefficient", "coulomb_friction": "level"}
    values = dict(zip(friction, (arm.viscous, arm.coulomb), strict=True))
    return arm.base | {
        f"{kind}[{k + 1}].{key}": values[kind][k] for kind, key in friction.items() for k in range(2)
    }


def test_base_parameters_of_two_links_come_back(estimates):
    estimate = estimates["base"]
    assert estimate.converged
    assert set(estimate.names) == set(truth())
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std, strict=True):
        assert abs(value - truth()[name]) < 3 * std, name
        assert std < 0.01 * max(abs(truth()[name]), 1.0), name
    # and the start is off by far more than that
    off = np.abs(estimate.precision.std[:6]) * 10
    assert np.all(np.abs([truth()[n] - 0.1 for n in estimate.names[:6]]) > off)


def test_starts_of_an_arm_are_no_place_to_look_for_break_away_friction(estimates, log, tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(text())
    found = break_away(estimates["base"], open_session(path, log).runs, (0, 1, 2))
    assert ["forces between the joints exceed" in why for why in found] == [True, True, True]


def test_rows_count_over_the_noise_of_their_joint(monkeypatch, tmp_path):
    """One torque sensor is a hundred times worse than the other."""
    rows, rng = dict(followed(TwoLinks())), np.random.default_rng(3)
    for name, noise in (("u1", 13.0), ("u2", 0.13)):
        rows[name] = rows[name] + noise * rng.standard_normal(len(rows["t"]))
    path = tmp_path / "case.toml"
    path.write_text(text())
    session = open_session(path, write_csv(tmp_path / "log.csv", rows))
    weighted = inverse_dynamics(session.machine, session.fit.data)
    monkeypatch.setattr("jaxid.estimators.inverse_dynamics.joint_weights", lambda *_: None)
    plain = inverse_dynamics(session.machine, session.fit.data)

    names = ["first_moment_x[2]", "first_moment_y[2]", "viscous_friction[2].coefficient"]
    std = dict(zip(weighted.names, weighted.std, strict=True))
    assert weighted.converged
    for name in names:
        off = abs(weighted.value(name) - truth()[name])
        assert off < 4 * std[name]
        assert off < 0.2 * abs(plain.value(name) - truth()[name])
    left = np.nanstd(weighted.residual, axis=0)
    assert left[0] / left[1] == pytest.approx(100, rel=0.2), "the residual is the force, without weights"


def test_a_weighted_fit_that_fails_leaves_the_first_one(log, monkeypatch, tmp_path):
    (tmp_path / "case.toml").write_text(text())
    session = open_session(tmp_path / "case.toml", log)
    fit = lambda: inverse_dynamics(session.machine, session.fit.data)
    monkeypatch.setattr("jaxid.estimators.inverse_dynamics.joint_weights", lambda *_: None)
    plain = fit()
    monkeypatch.setattr("jaxid.estimators.inverse_dynamics.joint_weights", lambda *_: np.array([np.nan, 1.0]))
    kept = fit()
    np.testing.assert_array_equal(kept.theta, plain.theta)
    np.testing.assert_array_equal(kept.std, plain.std)
    assert kept.converged


RATIO = np.array([[20.0, 0.0], [30.0, -30.0]])


def test_a_log_of_the_motors_says_the_same(estimates, tmp_path):
    """The second motor turns with both joints; commands are amperes."""
    rows = followed(TwoLinks())
    motor = np.stack([rows["q1"], rows["q2"]]).T @ RATIO.T
    command = np.stack([rows["u1"], rows["u2"]]).T @ np.linalg.inv(RATIO) / np.array([0.5, 2.0])
    log = {"t": rows["t"], **dict(zip(("q1", "q2", "u1", "u2"), [*motor.T, *command.T], strict=True))}
    path = tmp_path / "case.toml"
    gears = f"[actuator]\ngain = [0.5, 2.0]\ntransmission = {RATIO.tolist()}\n"
    path.write_text(text(rest=gears + LOG))
    session = open_session(path, write_csv(tmp_path / "log.csv", log))
    estimate = inverse_dynamics(session.machine, session.fit.data)
    np.testing.assert_allclose(estimate.theta, estimates["base"].theta, rtol=1e-5, atol=1e-8)
    path.write_text(path.read_text() + '[controller]\nkind = "pd"\nkp = [1.0, 1.0]\nkd = [1.0, 1.0]\n')
    with pytest.raises(InputError, match="does not go with a loop"):
        load_case(path)


def test_what_a_log_cannot_tell_is_named_and_has_no_sigma(estimates):
    estimate, told = estimates["whole"], estimates["base"]
    assert estimate.converged
    std = dict(zip(estimate.names, estimate.std, strict=True))
    blind = {n for n in estimate.names if np.isnan(std[n])}
    # 20 unknowns, 6 combinations; of those that no torque depends on none is told
    assert blind >= {
        "mass[1]",
        "inertia_xx[1]",
        "inertia_yy[2]",
        "inertia_yz[2]",
        "first_moment_z[2]",
        "mass[2]",
    }
    # what stands in no sum with another is told
    for name in ("first_moment_x[2]", "first_moment_y[2]", "inertia_zz[2]"):
        assert std[name] > 0
    # link 2's mass beside the first link's first moment and inertia: untold together
    named = [set(c) for c in estimate.precision.unidentifiable]
    assert len(named) == 20 - 6
    assert any({"first_moment_x[1]", "inertia_zz[1]", "mass[2]"} & n for n in named)
    found = base_parameters(estimate.machine.plant)
    values = dict(zip(found.chosen_names, found.of(estimate.machine.plant), strict=True))
    assert set(values) == set(TwoLinks().base)
    for name, value, sigma in zip(told.names, told.theta, told.std, strict=True):
        if name in values:
            assert abs(values[name] - truth()[name]) < 3 * sigma, name
            assert abs(values[name] - value) < 0.1 * sigma, name


def true_values(arm: TwoLinks) -> tuple:
    """The links with their own values, in full."""

    def link(m, x, y, inertia):
        own = f"[0.01, {-m * x * y}, 0.0, 0.01, 0.0, {inertia + m * (x**2 + y**2)}]"
        return str(m), f"[{m * x}, {m * y}, 0.0]", own

    return link(arm.m1, arm.x1, 0.0, arm.i1), link(arm.m2, arm.x2, arm.y2, arm.i2)


SHAFT = "[[plant.shafts]]\njoints = [1, 2]\n"


def on_shaft(inertia: str, viscous: str, coulomb: str) -> str:
    values = (
        ("added_mass", "mass", inertia),
        ("viscous_friction", "coefficient", viscous),
        ("coulomb_friction", "level", coulomb),
    )
    return "".join(f'[[effects]]\nkind = "{k}"\nshaft = 1\n{name} = {v}\n' for k, name, v in values)


@pytest.mark.slow
def test_friction_of_a_shaft_is_told_from_that_of_its_joints(tmp_path):
    arm = dataclasses.replace(TwoLinks(), shaft=(0.7, 1.6, 0.1))
    log = write_csv(tmp_path / "log.csv", followed(arm))
    rest = SHAFT + on_shaft("0.1", "{ guess = 0.1 }", "{ guess = 0.1 }") + LOG
    path = tmp_path / "case.toml"
    path.write_text(
        text().replace(
            FRICTION.format(viscous=UNKNOWN, coulomb=UNKNOWN) + LOG,
            rest + FRICTION.format(viscous=UNKNOWN, coulomb=UNKNOWN),
        )
    )
    session = open_session(path, log)
    estimate = inverse_dynamics(session.machine, session.fit.data)
    assert estimate.converged
    wanted = truth() | {"viscous_friction[shaft 1].coefficient": 0.7, "coulomb_friction[shaft 1].level": 1.6}
    assert set(estimate.names) == set(wanted)
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std, strict=True):
        assert abs(value - wanted[name]) < 3 * std, name
        assert std < 0.02 * max(abs(wanted[name]), 1.0), name
    # without it, what it does is left over
    path.write_text(text())
    session = open_session(path, log)
    without = inverse_dynamics(session.machine, session.fit.data)
    assert np.nanstd(without.residual) > 10 * np.nanstd(estimate.residual)


def test_ratios_go_with_the_joints_that_are_named(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(text(rest=SHAFT.replace("[1, 2]", "[2, 1]\nratios = [3.0, -0.5]") + SHAFT + LOG))
    plant = build_machine(load_case(path)).plant
    q = np.array([0.2, 0.7])
    np.testing.assert_allclose(plant.ports(q), [0.2, 0.7, 3.0 * 0.7 - 0.5 * 0.2, 0.9], rtol=1e-15)
    assert [plant.place(k) for k in range(4)] == [("joint", 1), ("joint", 2), ("shaft", 1), ("shaft", 2)]


@pytest.mark.parametrize("shaft", [(0.0, 0.0, 0.0), (0.7, 0.0, 0.1)])
def test_open_loop_simulation_is_the_closed_form(tmp_path, capsys, shaft):
    arm = dataclasses.replace(TwoLinks(), coulomb=(0.0, 0.0), shaft=shaft)
    rest = LOG + (
        '[input]\nkind = "multisine"\nband_hz = [0.5, 3.0]\namplitude = [4.0, 2.0]\noffset = [14.0, 4.0]\n'
        "[simulation]\nduration = 1.0\nsample_rate = 500.0\ninitial_position = [0.3, -0.8]\n"
    )
    values = text(true_values(arm), viscous="[1.5, 0.8]", coulomb="[0.0, 0.0]", rest=rest)
    if any(shaft):
        with_shaft = SHAFT + on_shaft(str(shaft[2]), str(shaft[0]), "0.0") + "[log]"
        values = values.replace("[log]", with_shaft, 1)
    path = tmp_path / "case.toml"
    path.write_text(values)
    ran = run(capsys, "simulate", path, "-o", tmp_path / "log.csv")
    assert (ran.status, ran.err) == (0, "")
    rows = np.genfromtxt(tmp_path / "log.csv", delimiter=",", names=True)
    x, q = (0.3, -0.8, 0.0, 0.0), []
    for u in zip(rows["u1"], rows["u2"], strict=True):
        q.append(x[:2])
        x = arm.advance(x, u, 0.2e-3, 10)
    swing = np.ptp(q, axis=0)
    assert np.all(swing > 0.1)
    # a fourth-order step of 0.5 ms
    np.testing.assert_allclose(np.stack([rows["q1"], rows["q2"]], axis=-1), q, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_command_line_goes_from_simulated_loop_to_result(tmp_path, capsys):
    rest = LOG.replace('"u2"]', '"u2"]\nreference = ["r1", "r2"]') + (
        '[controller]\nkind = "pd"\nkp = [300.0, 150.0]\nkd = [30.0, 10.0]\nperiod = 0.002\n'
        "[sensor]\nposition_noise = 1e-5\n"
        '[reference]\nkind = "multisine"\nband_hz = [0.2, 2.0]\namplitude = [1.0, 1.5]\n'
        "[simulation]\nduration = 6.0\nsample_rate = 500.0\n"
    )
    links = [
        (
            mass,
            f"[{{ guess = 0.0, true = {first} }}, 0.0, 0.0]",
            f"[0.0, 0.0, 0.0, 0.0, 0.0, {{ guess = 0.1, true = {second} }}]",
        )
        for mass, first, second in ((0.0, 1.6, 0.7), (1.0, 0.5, 0.2))
    ]
    levels = "[{ guess = 0.1, true = 2.0 }, { guess = 0.1, true = 1.0 }]"
    path, made = tmp_path / "case.toml", tmp_path / "log.csv"
    path.write_text(text(links, viscous="[{ guess = 0.1, true = 1.5 }, 0.8]", coulomb=levels, rest=rest))
    assert run(capsys, "simulate", path, "-o", made, "--seed", 1).status == 0
    argv = ("identify", path, made, "--method", "inverse_dynamics")
    ran = run(capsys, *argv, folder=tmp_path / "out")
    assert (ran.status, ran.err) == (0, "")
    found = ran.json("result.json")["parameters"]
    assert found["inertia_zz"]["unit"] == "kg m^2"
    assert found["first_moment_x"]["unit"] == "kg m"
    for name, values in (("inertia_zz", (0.7, 0.2)), ("first_moment_x", (1.6, 0.5))):
        for value, std, true in zip(found[name]["value"], found[name]["std"], values, strict=True):
            assert abs(value - true) < 4 * std, name


GOOD = text()
LINK = "[[plant.links]]"
FAULTS = {
    "joint": (
        ('joint = "revolute"', 'joint = "helical"'),
        ["links]] 1", "joint", "helical", "revolute, prismatic"],
    ),
    "missing row": (("a = 0.5\n", ""), ["[[plant.links]] 2", "'a' is missing", "[m]"]),
    "missing angle": (("alpha_deg = 0.0\n", ""), ["links]] 1", "'alpha' is missing", "alpha_deg"]),
    "angle twice": (("alpha_deg = 0.0", "alpha_deg = 0.0\nalpha = 0.0"), ["both alpha and alpha_deg"]),
    "missing mass": (("mass = 0.0\n", ""), ["links]] 1", "'mass' is missing", "{ guess = ... }"]),
    "negative mass": (("mass = 0.0", "mass = -1.0"), ["mass = -1.0 is negative"]),
    "columns": (
        ("[0.0, 0.0, 0.0, 0.0, 0.0, {", "[0.0, 0.0, 0.0, 0.0, {"),
        ["inertia", "5 entries", "6 in a list"],
    ),
    "no list": (
        ("first_moment = [{ guess = 0.0 }, { guess = 0.0 }, 0.0]", "first_moment = 0.0"),
        ["first_moment = 0.0 is not a list; give 3 entries: x, y, z"],
    ),
    "unknown key": (("mass = 0.0", "mas = 0.0"), ["links]] 1", "'mas'", "'mass'"]),
    "gravity": (("= [0.0, -9.81, 0.0]", "= [0.0, -9.81]"), ["gravity_vector", "3"]),
    "scalar gravity": (
        ("gravity_vector = [0.0, -9.81, 0.0]", "gravity = 9.81"),
        ["'gravity'", "gravity_vector"],
    ),
    "guessed length": (("a = 0.5", "a = { guess = 0.5 }"), ["a", "must be a known number"]),
    "shafts": (
        ("[log]", "[[plant.shafts]]\njoints = [2, 3]\n[log]"),
        ["shafts]] 1", "[2, 3]", "from 1 to 2"],
    ),
    "one joint": (("[log]", "[[plant.shafts]]\njoints = [2]\n[log]"), ["shafts]] 1", "joints", "2"]),
    "ratios": (
        ("[log]", "[[plant.shafts]]\njoints = [1, 2]\nratios = [1.0]\n[log]"),
        ["ratios = [1.0] does not go with 2 joints; give a ratio other than zero for each"],
    ),
    "sliding shaft": (
        ('joint = "revolute"', 'joint = "prismatic"'),
        ["joints that turn and joints that slide"],
    ),
    "no shaft": (
        ('kind = "viscous_friction"', 'kind = "viscous_friction"\nshaft = 1'),
        ["shaft = 1 does not exist on kind = 'serial_arm'; add [[plant.shafts]]"],
    ),
    "second shaft": (
        ("[log]", SHAFT + '[[effects]]\nkind = "coulomb_friction"\nshaft = 2\nlevel = 1.0\n[log]'),
        ["shaft = 2 is out of range: the plant has 1 shaft; name shaft 1"],
    ),
    "parameters": (("[log]", "[plant.parameters]\nmass = 1.0\n[log]"), ["'parameters'", "there is: kind"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_told_in_one_line(tmp_path, fault):
    (old, new), words = FAULTS[fault]
    good = GOOD.replace("[log]", SHAFT + "[log]") if fault == "sliding shaft" else GOOD
    assert old in good
    told = message(tmp_path, good.replace(old, new, 1))
    assert not [word for word in words if word not in told], told


@pytest.mark.parametrize(
    ("plant", "words"),
    [
        ('kind = "serial_arm"', "'links' is missing; add a table [[plant.links]] for each"),
        ('kind = "serial_arm"\nlinks = []', "links has 0 entries; an arm has 1 to 50"),
        ('kind = "serial_arm"\nlinks = 3', "links is not a list of tables; write [[plant.links]]"),
    ],
)
def test_links_must_be_there(tmp_path, plant, words):
    assert words in message(tmp_path, f"[plant]\n{plant}\n")


def test_massless_arm_is_not_simulated(tmp_path, capsys):
    none = ("0.0", "[0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]")
    rest = LOG + '[input]\nkind = "fourier"\nbase_frequency_hz = 1.0\nsine = [1.0]\n'
    rest += "[simulation]\nduration = 1.0\nsample_rate = 100.0\n"
    path = tmp_path / "case.toml"
    path.write_text(text((BASE[0], none), rest=rest))
    ran = run(capsys, "simulate", path, "-o", tmp_path / "log.csv")
    assert ran.status == 2
    assert "mass matrix at initial_position is not positive definite (least about joint 2)" in ran.err
    assert ran.err.count("\n") == 1


def test_rotors_and_units_by_joint(tmp_path):
    slide = GOOD.replace(
        'joint = "revolute"\nalpha_deg = 0.0\na = 0.5',
        ('joint = "prismatic"\nalpha_deg = 90.0\na = 0.5\nrotor_inertia = { guess = 3.0 }'),
    )
    path = tmp_path / "case.toml"
    path.write_text(slide)
    built = build_machine(load_case(path))
    assert built.plant.geometry.joints == ("revolute", "prismatic")
    assert float(built.plant.geometry.alpha[1]) == np.pi / 2
    np.testing.assert_array_equal(built.plant.rotor_inertia, [0.0, 3.0])
    units = {f.name: f.unit for f in built.parameters.free}
    assert units["rotor_inertia[2]"] == "kg"
    assert units["inertia_zz[2]"] == "kg m^2"
    assert units["viscous_friction[1].coefficient"] == "N m s/rad"
    assert units["viscous_friction[2].coefficient"] == "N s/m"
