"""The five-bar robot through the case file: identified from an exact stepper's logs, simulated, refused."""

import dataclasses

import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.estimators.choice import choose_method
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.estimators.recursive.estimate import recursive_steps
from jaxid.experiment_design.in_loop import LoopDesign
from jaxid.numerics.lanes import run_alone
from jaxid.session import open_session
from jaxid.settings import Recursive
from tests.support.case_faults import message
from tests.support.cli_setup import run
from tests.support.written_logs import write_csv
from truth.five_bar.oracle import PLANT, Robot
from truth.five_bar.stepper import followed

NAMES = {"actuator_gain": "gain", "coulomb_friction": "level", "viscous_friction": "coefficient"}
LOG = """[log]
time = "t"
position = ["q1", "q2"]
force = ["u1", "u2"]
reference = ["r1", "r2"]
[controller]
kind = "pd"
kp = [150.0, 150.0]
kd = [4.0, 4.0]
period = 0.001
[sensor]
position_noise = 2e-6
force_noise = 0.02
"""
FRICTION = {"coulomb_friction": [6.0, 5.0, 0.4, 0.5, 0.3], "viscous_friction": [4.0, 3.0, 0.3, 0.2, 0.25]}
GAINS = (1.06, 0.93)
NOISE = {"noise": 2e-6, "force_noise": 0.02}


def effect(kind: str, values, where: str = "") -> str:
    return f'[[effects]]\nkind = "{kind}"\n{where}\n{NAMES[kind]} = {values}\n'


def unknown(guess: float, count: int) -> str:
    return f"[{', '.join([f'{{ guess = {guess} }}'] * count)}]"


UNKNOWN = effect("actuator_gain", unknown(1.0, 2)) + "".join(
    effect(kind, unknown(1.0, 2)) + effect(kind, unknown(0.05, 3), "passive = [1, 2, 3]") for kind in FRICTION
)
TRUTH = {f"actuator_gain[{k + 1}].gain": g for k, g in enumerate(GAINS)} | {
    f"{kind}[{(k + 1) if k < 2 else f'passive {k - 1}'}].{NAMES[kind]}": value
    for kind, values in FRICTION.items()
    for k, value in enumerate(values)
}


@pytest.fixture(scope="module")
def robot():
    return Robot(friction=FRICTION)


@pytest.fixture(scope="module")
def log(robot, tmp_path_factory):
    rows = followed(robot, gains=GAINS, **NOISE)
    return write_csv(tmp_path_factory.mktemp("log") / "log.csv", rows)


def opened(folder, text, log):
    path = folder / "case.toml"
    path.write_text(text)
    return open_session(path, log)


@pytest.fixture(scope="module")
def session(log, tmp_path_factory):
    return opened(tmp_path_factory.mktemp("case"), PLANT + UNKNOWN + LOG, log)


def test_no_filter_is_chosen_for_a_loop_that_is_closed_at_every_step(session):
    choice = choose_method(session)
    assert choice.method == "inverse_dynamics"
    assert "filter" in choice.reason


def recursive(machine, data):
    return run_alone(recursive_steps(machine, data, Recursive()))


@pytest.mark.parametrize("method", [inverse_dynamics, recursive])
def test_friction_of_every_hinge_and_drive_gains_come_back(session, method):
    """Logged torques count at the motors; what the drives give differs by their gains."""
    estimate = method(session.machine, session.fit.data)
    assert estimate.converged
    assert set(estimate.names) == set(TRUTH)
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std, strict=True):
        assert abs(value - TRUTH[name]) < 3 * std, name
        assert std < 0.05 * max(TRUTH[name], 0.3), name


@pytest.mark.slow
def test_payload_is_told_by_the_tip_or_by_an_effect_on_the_tool(robot, tmp_path):
    """With the gains known: they and the masses together are any multiple of both."""
    log = write_csv(tmp_path / "log.csv", followed(dataclasses.replace(robot, tip_mass=3.4), **NOISE))
    friction = UNKNOWN.replace(effect("actuator_gain", unknown(1.0, 2)), "")
    tip = PLANT.replace("tip_mass = 2.72", "tip_mass = { guess = 2.0 }")
    tool = '[[effects]]\nkind = "added_mass"\ntool = 1\nmass = { guess = 0.0 }\n'
    found = {}
    for text, name, true in (
        (tip + friction, "tip_mass", 3.4),
        (PLANT + friction + tool, "added_mass[tool 1].mass", 3.4 - 2.72),
    ):
        session = opened(tmp_path, text + LOG, log)
        assert {f.name: f.unit for f in session.machine.parameters.free}[name] == "kg"
        estimate = inverse_dynamics(session.machine, session.fit.data)
        k = estimate.names.index(name)
        assert abs(estimate.theta[k] - true) < 3 * estimate.std[k]
        assert estimate.std[k] < 0.01 * (3.4 - 2.72)
        found[name] = estimate.theta[k] - true
    np.testing.assert_allclose(*found.values(), atol=1e-6)


@pytest.mark.slow
def test_lengths_and_centres_may_be_unknown(robot, log, tmp_path):
    """They enter the closure, and not in proportion: bounds keep the start within reach."""
    text = PLANT.replace("[0.18, 0.25, 0.25, 0.25, 0.25]", "[0.18, 0.25, 0.25, { guess = 0.255 }, 0.25]")
    text = text.replace("[[0.1254, 0.0009]", "[[{ guess = 0.1 }, 0.0009]")
    session = opened(tmp_path, text + UNKNOWN + LOG, log)
    estimate = inverse_dynamics(session.machine, session.fit.data)
    wanted = TRUTH | {"length[4]": 0.25, "center[1, 1]": 0.1254}
    assert set(estimate.names) == set(wanted)
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std, strict=True):
        assert abs(value - wanted[name]) < 3 * std, name
        if name in ("length[4]", "center[1, 1]"):
            assert std < 0.02 * wanted[name]


def simulated(tmp_path, capsys, text, name="sim.csv"):
    path = tmp_path / "case.toml"
    path.write_text(text)
    return run(capsys, "simulate", path, "-o", tmp_path / name, "--force")


@pytest.mark.parametrize(
    ("friction", "apart"),
    [
        # without dry friction both are smooth: fourth order at 0.25 ms, the stepper's second at 10 us
        ({"viscous_friction": FRICTION["viscous_friction"]}, 2e-9),
        # dry friction in all hinges at once: the stepper's turns are of first order, 7e-7 rad at 10 us
        pytest.param(FRICTION, 2e-6, marks=pytest.mark.slow),
    ],
)
def test_simulation_is_the_steppers(tmp_path, capsys, friction, apart):
    rows = followed(Robot(friction=friction), duration=2.0, noise=0.0)
    reference = np.stack([rows["r1"], rows["r2"]], axis=1)
    write_csv(tmp_path / "reference.csv", {k: rows[k] for k in ("t", "r1", "r2")})
    effects = "".join(effect(k, v[:2]) + effect(k, v[2:], "passive = [1, 2, 3]") for k, v in friction.items())
    text = (
        PLANT
        + effects
        + LOG[: LOG.index("[sensor]")]
        + (
            '[reference]\nkind = "csv"\nfile = "reference.csv"\ntime = "t"\ncolumn = ["r1", "r2"]\n'
            "[simulation]\nduration = 2.0\nsample_rate = 1000.0\n"
            f"initial_position = {reference[0].tolist()}\n"
            f"initial_velocity = {((reference[1] - reference[0]) * 1000).tolist()}\n"
        )
    )
    ran = simulated(tmp_path, capsys, text)
    assert (ran.status, ran.err) == (0, "")
    ours = np.genfromtxt(tmp_path / "sim.csv", delimiter=",", names=True)
    for name in ("q1", "q2"):
        assert np.ptp(ours[name]) > 0.2
        np.testing.assert_allclose(ours[name], rows[name], rtol=0, atol=apart)
    # motors, not joints: a twentieth of the torque
    assert np.abs(ours["u1"] - rows["u1"]).max() < 1e5 * apart


INPUT = (
    '[input]\nkind = "fourier"\nbase_frequency_hz = 0.1\nsine = [[0.0], [0.0]]\noffset = [{0}, {1}]\n'
    "[simulation]\nduration = 2.0\nsample_rate = 500.0\ninitial_position = {2}\n"
)
OPEN = LOG[: LOG.index("reference")]


def test_motion_that_ends_in_a_singular_configuration_says_so(tmp_path, capsys):
    # the arms are driven apart until the distal links stand in one line
    ran = simulated(tmp_path, capsys, PLANT + OPEN + INPUT.format(0.1, -0.1, "[2.0, 1.14]"))
    assert ran.status == 2
    assert ran.err.count("\n") == 1
    assert "the motion ends at t = " in ran.err
    assert "singular configuration" in ran.err or "out of reach" in ran.err
    assert not (tmp_path / "sim.csv").exists()


def test_positions_that_cannot_be_are_refused(tmp_path, capsys, log):
    ran = simulated(tmp_path, capsys, PLANT + OPEN + INPUT.format(0, 0, "[3.1, 0.1]"))
    assert ran.status == 2
    assert "initial_position: joints at [3.1, 0.1] rad are out of reach: elbows 0.6787 m apart" in ran.err
    loop = '[reference]\nkind = "multisine"\nband_hz = [0.2, 2.0]\namplitude = [1.5, 1.5]\n'
    loop += "offset = [2.0, 1.1]\n[simulation]\nduration = 4.0\nsample_rate = 1000.0\n"
    loop += "initial_position = [2.0, 1.1]\n"
    ran = simulated(tmp_path, capsys, PLANT + LOG + loop)
    assert ran.status == 2
    assert "[reference]: joints at [" in ran.err
    assert " at t = " in ran.err
    short = PLANT.replace("[0.18, 0.25, 0.25, 0.25, 0.25]", "[0.18, 0.25, 0.25, 0.15, 0.15]")
    with pytest.raises(InputError, match=r"row \d+: joints at .* out of reach.*check the lengths") as caught:
        opened(tmp_path, short + UNKNOWN + LOG, log)
    assert "\n" not in str(caught.value)


def test_columns_are_counted_where_a_case_names_none(tmp_path, capsys):
    text = PLANT + INPUT.format(0, 0, "[2.0, 1.1]").replace("duration = 2.0", "duration = 0.1")
    ran = simulated(tmp_path, capsys, text)
    assert (ran.status, ran.err) == (0, "")
    assert (tmp_path / "sim.csv").read_text().startswith("t,q1,q2,u1,u2\n")


@pytest.mark.slow
def test_an_experiment_is_designed_from_where_the_robot_starts(tmp_path):
    """Lengths with which both joints at zero is no position."""
    text = (
        PLANT.replace("[0.18,", "[0.6,")
        + effect("coulomb_friction", unknown(1.0, 2))
        + OPEN
        + (
            "[sensor]\nposition_noise = 1e-5\n[limits]\nstroke = [0.0, 3.0]\nspeed = 3.0\nforce = 0.5\n"
            "[simulation]\nduration = 0.2\nsample_rate = 250.0\n"
        )
    )
    path = tmp_path / "case.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"initial_position: joints at \[0, 0\] rad are out of reach"):
        LoopDesign.of(load_case(path))
    path.write_text(text + "initial_position = [1.1, 2.0]\n")
    bench = LoopDesign.of(load_case(path))
    peaks = bench.peaks(np.zeros((len(bench.shapes.signal(bench.starts[0])), 2)))
    np.testing.assert_allclose([peaks.low, peaks.high], [[1.1, 2.0]] * 2)


def test_reduction_counts_in_the_gain(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(PLANT + "[actuator]\ngain = [0.5, 2.0]\n" + OPEN)
    np.testing.assert_array_equal(build_machine(load_case(path)).gain, [10.0, 40.0])
    path.write_text(PLANT.replace("reduction = [20.0, 20.0]\n", "") + OPEN)
    np.testing.assert_array_equal(build_machine(load_case(path)).gain, [1.0, 1.0])


GOOD = PLANT + effect("viscous_friction", unknown(0.1, 3), "passive = [1, 2, 3]") + OPEN
FAULTS = {
    "length": (
        ("length = [0.18, ", "length = ["),
        ["[plant.parameters]: length has 4 entries; give 5 entries: l_f, l_p1, l_p2, l_d1, l_d2"],
    ),
    "no list": (("mass = [2.32, 2.78]", "mass = 2.32"), ["mass = 2.32 is not a list; give a list of 2"]),
    "negative": (("0.292, 0.292", "0.292, -0.292"), ["inertia[2] = -0.292 is negative"]),
    "centre": (("[0.1254, 0.0009]", "0.1254"), ["center[1] = 0.1254 is not a list; give 2 numbers"]),
    "four centres": (
        ("[[0.1254, 0.0009]", "[[0.1188, 0.0007], [0.1188, 0.0007], [0.1254, 0.0009]"),
        ["center has 4 entries; give 2 entries: of the distal links, [along, to the left] each"],
    ),
    "centre's width": (("[0.1254, 0.0009]", "[0.1254]"), ["center[1] = [0.1254] has 1 entry", "component"]),
    "missing": (("tip_mass = 2.72\n", ""), ["'tip_mass' is missing", "at the tool"]),
    "unknown key": (("tip_mass", "tool_mass"), ["unknown key 'tool_mass'", "tip_mass"]),
    "guessed ratio": (
        ("[20.0, 20.0]", "[{ guess = 20.0 }, 20.0]"),
        ["reduction[1]", "must be a known number", "actuator_gain"],
    ),
    "passive": (
        ("[1, 2, 3]", "9"),
        ["passive = 9 is out of range: the plant has 3 passive angles", "from 1 to 3"],
    ),
    "twice": (("[1, 2, 3]", "[1, 2, 2]"), ["passive = [1, 2, 2] names a passive angle twice"]),
    "spring": (("passive = [1, 2, 3]", "spring = 1"), ["spring = 1 does not exist on kind = 'five_bar'"]),
    "both": (("passive = [1, 2, 3]", "passive = 1\njoint = 1"), ["joint and passive exclude each other"]),
    "drive": (
        (
            '"viscous_friction"\npassive = [1, 2, 3]\ncoefficient',
            '"actuator_gain"\npassive = [1, 2, 3]\ngain',
        ),
        ["passive = [1, 2, 3] has no command for actuator_gain", "name the joint of the drive"],
    ),
    "tool": (
        ('"viscous_friction"\npassive = [1, 2, 3]\ncoefficient', '"coulomb_friction"\ntool = 1\nlevel'),
        ["tool = 1 does not go with coulomb_friction", "added_mass"],
    ),
    "second tool": (
        ("passive = [1, 2, 3]", "tool = 2"),
        ["tool = 2 is out of range: the plant has 1 tool; name tool 1"],
    ),
    "transmission": (
        ("[log]", "[actuator]\ntransmission = [[20.0, 0.0], [0.0, 20.0]]\n[log]"),
        ["[actuator]: transmission and reduction of [plant.parameters] are both given"],
    ),
    "orientation": (
        ('"five_bar"', '"five_bar"\norientation = "vertical"'),
        ["does not go with a rotary plant"],
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_told_in_one_line(tmp_path, fault):
    (old, new), words = FAULTS[fault]
    assert old in GOOD
    told = message(tmp_path, GOOD.replace(old, new, 1))
    assert not [word for word in words if word not in told], told


def test_passive_angles_belong_to_plants_that_have_them(tmp_path):
    text = '[plant]\nkind = "axis"\n[plant.parameters]\ninertia = 1.0\n' + effect(
        "viscous_friction", 1.0, "passive = 1"
    )
    assert "passive = 1 does not exist on kind = 'axis'; leave passive out" in message(tmp_path, text)


@pytest.mark.slow
def test_every_command_takes_a_five_bar_case(tmp_path, capsys, log):
    """Check and identify, with results by place; units are those of the parameter's own motion."""
    text = PLANT.replace("0.292, 0.292", "{ guess = 0.2 }, 0.292").replace("[[0.1254,", "[[{ guess = 0.12 },")
    friction = UNKNOWN.replace(effect("actuator_gain", unknown(1.0, 2)), effect("actuator_gain", [*GAINS]))
    path = tmp_path / "case.toml"
    path.write_text(text + friction + LOG)
    assert run(capsys, "check", path, log, folder=tmp_path / "check").status == 0
    ran = run(capsys, "identify", path, log, "--method", "inverse_dynamics", folder=tmp_path / "out")
    assert (ran.status, ran.err) == (0, "")
    found = ran.json("result.json")["parameters"]
    assert found["inertia"]["unit"] == "kg m^2"
    assert found["inertia"]["value"][1:] == [0.292, 0.030, 0.036]
    assert abs(found["inertia"]["value"][0] - 0.292) < 3 * found["inertia"]["std"][0]
    assert found["center"]["unit"] == "m"
    assert found["center"]["value"][1] == [0.1303, 0.0006]
    assert found["center"]["std"][0][1] is None
    assert abs(found["center"]["value"][0][0] - 0.1254) < 3 * found["center"]["std"][0][0]
    assert found["coulomb_friction[passive 2].level"]["unit"] == "N m"
    assert (tmp_path / "out" / "report.html").exists()
