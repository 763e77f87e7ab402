"""Logs without a position, a force or time: what they give, and what they are refused for."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest

from jaxid.cli import main
from jaxid.commands.discover import discover
from jaxid.commands.identify import identify, identify_many
from jaxid.consistency.absent import known_forces
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.session import open_session
from truth.axis.machines import Loop, Machine, Sensor, Setup, multisine

MEASURED = os.environ.get("JAXID_DATA")
needs_files = pytest.mark.skipif(MEASURED is None, reason="JAXID_DATA names no folder")
FIELD = Path(MEASURED or ".") / "field"

FRICTION = [
    {"kind": "viscous_friction", "coefficient": {"guess": 0.05}},
    {"kind": "coulomb_friction", "level": {"guess": 0.1}},
]
SPEEDS = {"time": "t", "velocity": "v", "force": "u"}
TABLE = {"kind": "steady", "velocity": "v", "force": "f"}


def case_of(log, effects=FRICTION, **tables):
    plant = {"kind": "axis", "motion": "rotary", "parameters": {"inertia": {"guess": 0.05}}}
    return {"plant": plant, "effects": effects, "log": log, **tables}


def inside(estimate, truth, sigmas=3.0):
    off = np.abs((estimate.theta - np.array(truth)) / estimate.std)
    assert np.all(off < sigmas), off


# Velocity alone

MOTOR = {"viscous_friction": {"coefficient": 0.12}, "coulomb_friction": {"level": 0.25}}


def velocity_log(seed, seconds=6.0, noise=0.1):
    t = np.arange(round(200 * seconds)) / 200.0
    u = 6 * np.sin(2 * np.pi * 0.25 * t) + multisine(t, [0.7, 1.3, 2.9, 5.1], 3.0, 1)
    setup = Setup(Machine(0.02, MOTOR), Loop(input=u), Sensor(), 200.0, seconds, seed)
    run = setup.run()
    measured = run["true_velocity"] + noise * np.random.default_rng(seed).standard_normal(t.size)
    return Log(time=t, position=None, velocity=measured, force=run["force"])


@pytest.mark.parametrize(
    "method",
    [
        "inverse_dynamics",
        *(pytest.param(m, marks=pytest.mark.slow) for m in ("prediction_error", "output_error")),
    ],
)
def test_a_log_of_velocities_gives_the_parameters(method):
    estimates = identify_many(case_of(SPEEDS), [velocity_log(seed) for seed in range(6)], method=method)
    z = np.array([(e.theta - [0.02, 0.12, 0.25]) / e.std for e in estimates])
    assert np.all(np.abs(z) < 4), z
    assert np.all(np.abs(z.mean(axis=0)) < 1.6), z
    assert np.all(estimates[0].std / [0.02, 0.12, 0.25] < 0.02)


def test_a_velocity_is_integrated_from_zero():
    t = np.arange(100) / 10.0
    log = Log(time=t, position=None, velocity=np.cos(t), force=np.sin(t))
    assert log.integrated
    np.testing.assert_allclose(log.position[:, 0], np.sin(t), atol=2e-3)


@needs_files
def test_a_field_log_of_velocities():
    case = case_of({"time": "timestamp", "velocity": "velocity", "force": "voltage"})
    result = identify(case, FIELD / "velocity_only.csv")
    inside(result.estimate, [0.02, 0.12, 0.25])
    assert "position" in {a.setting for a in result.session.fit.log.assumed}


@pytest.mark.parametrize(
    ("effect", "named"),
    [
        ({"kind": "linear_stiffness", "coefficient": {"guess": 1.0}}, "linear_stiffness"),
        ({"kind": "cogging", "amplitude": {"guess": 0.1}, "period": 0.5, "phase": 0.0}, "cogging"),
    ],
)
def test_a_force_of_position_needs_a_position(effect, named):
    with pytest.raises(InputError, match=f"no position, and {named} acts by where the machine is"):
        identify(case_of(SPEEDS, [*FRICTION, effect]), velocity_log(0, 3.0))


def test_methods_that_read_positions_refuse_velocities():
    with pytest.raises(InputError, match="has no position, which algebraic needs"):
        identify(case_of(SPEEDS), velocity_log(0, 3.0), method="algebraic")


# A table of steady speeds


def table(seed, rows=16, spread=0.02):
    v = np.concatenate([-np.linspace(0.2, 3, rows // 2)[::-1], np.linspace(0.2, 3, rows // 2)])
    f = 0.5 * v + 0.6 * np.sign(v) + spread * np.random.default_rng(seed).standard_normal(v.size)
    return {"v": v, "f": f, "s": np.full(v.size, spread)}


@pytest.mark.parametrize("columns", [{}, {"scatter": "s"}])
def test_intervals_of_a_steady_table_hold_the_truth(columns):
    case = case_of({**TABLE, **columns})
    z = []
    for estimate in identify_many(case, [table(seed) for seed in range(200)]):
        assert estimate.identifiable.tolist() == [False, True, True]
        z.append(((estimate.theta - [np.nan, 0.5, 0.6]) / estimate.std)[1:])
    share = np.mean(np.abs(z) < 1.96, axis=0)
    # Two-sided, at one in a thousand: 200 tables.
    assert np.all((share > 0.895) & (share < 0.99)), share


@needs_files
def test_a_field_table_of_steady_speeds(tmp_path, capsys):
    result = identify(
        case_of({"kind": "steady", "velocity": "velocity", "force": "torque"}), FIELD / "velocity_table.csv"
    )
    assert result.estimate.precision.unidentifiable == [{"inertia": 1.0}]
    assert result.gaps[0].force.relative[0] < 0.02
    result.save(tmp_path / "out")
    assert (tmp_path / "out" / "result.json").read_text().count("NaN") == 0


@pytest.mark.parametrize("scatter", [pytest.param(False, marks=pytest.mark.slow), True])
def test_hidden_friction_of_a_steady_table_is_found(scatter):
    log = {**TABLE, "scatter": "s"} if scatter else TABLE
    columns = table(3, rows=24)
    columns["f"] = columns["f"] + 0.08 * columns["v"] * np.abs(columns["v"])
    found = discover(case_of(log), columns)
    assert found.verdict == "found"
    drag = found.effects[0]
    assert "quadratic_drag" in {drag.kind, *(s.candidate.kind for s in drag.alternatives)}
    assert drag.score.evidence > 10


def test_noise_of_a_steady_table_is_no_effect():
    assert [discover(case_of(TABLE), table(seed)).kinds for seed in range(12)] == [[]] * 12


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"velocity": None}, "'velocity' is missing"),
        ({"force": None}, "'force' is missing"),
        ({"position": "q"}, 'position does not go with kind = "steady"'),
        ({"time": "t"}, 'time does not go with kind = "steady"'),
        ({"kind": "time", "time": "t", "scatter": "s"}, 'scatter goes with kind = "steady" only'),
        ({"kind": "time", "time": "t", "velocity": None}, "'position' is missing"),
    ],
)
def test_wrong_columns_are_one_line(change, told):
    log = {name: value for name, value in {**TABLE, **change}.items() if value is not None}
    with pytest.raises(InputError, match=told):
        identify(case_of(log), table(0))


def test_a_steady_table_is_for_forces_of_speed():
    held = {"kind": "actuator_lag", "time_constant": {"guess": 0.01}}
    with pytest.raises(InputError, match="actuator_lag acts over time"):
        identify(case_of(TABLE, [*FRICTION, held]), table(0))
    with pytest.raises(InputError, match="output_error needs a log over time"):
        identify(case_of(TABLE), table(0), method="output_error")


# A free swing

SPRING = {"kind": "linear_stiffness", "coefficient": 200.0}
SWUNG = {"time": "t", "position": "q"}


def swing(seed, noise=1e-4, step=0.0, seconds=6.0):
    effects = {"viscous_friction": {"coefficient": 0.3}, "coulomb_friction": {"level": 0.4}}
    machine = Machine(0.5, {**effects, "linear_stiffness": {"coefficient": 200.0}})
    still = Loop(input=np.zeros(round(200 * seconds)))
    sensor = Sensor(position_noise=noise, position_resolution=step)
    run = Setup(machine, still, sensor, 200.0, seconds, seed).run(initial_position=0.1 + 1e-4 * seed)
    return {"t": run["t"], "q": run["position"]}


@pytest.mark.parametrize("sensor", [pytest.param({}, marks=pytest.mark.slow), {"noise": 0.0, "step": 2e-4}])
def test_a_free_swing_on_a_known_spring(sensor):
    case = case_of(SWUNG, [*FRICTION, SPRING])
    estimates = identify_many(case, [swing(seed, **sensor) for seed in range(8)])
    z = np.array([(e.theta - [0.5, 0.3, 0.4]) / e.std for e in estimates])
    assert np.all(np.abs(z) < 4), z
    assert np.all(estimates[0].std / [0.5, 0.3, 0.4] < 0.01)


def test_the_known_value_that_scales_a_swing_is_named():
    session = open_session(case_of(SWUNG, [*FRICTION, SPRING]), swing(0))
    assert known_forces(session.machine) == ["linear_stiffness.coefficient = 200 N m/rad"]


def test_a_swing_without_scale_is_refused():
    free = {"kind": "linear_stiffness", "coefficient": {"guess": 150.0}}
    with pytest.raises(InputError, match="'force' is missing, and nothing known acts: inertia, ") as told:
        identify(case_of(SWUNG, [*FRICTION, free]), swing(0))
    assert "known number" in str(told.value)


def test_a_swing_with_a_controller_is_refused():
    loop = {"kind": "pd", "kp": 1.0, "kd": 0.1}
    with pytest.raises(InputError, match=r"so is the reference that \[controller\] follows"):
        identify(case_of(SWUNG, controller=loop), swing(0))


@needs_files
@pytest.mark.parametrize("name", ["swing_zero_torque.csv", "swing_no_torque.csv"])
def test_field_swings_of_a_pendulum(name):
    case = tomllib.loads((FIELD / "swing.toml").read_text())
    if "no" in name:
        del case["log"]["force"]
    result = identify(case, FIELD / name)
    estimate = result.estimate
    assert "all values are in proportion to first_moment_x[1] = 0.00214 kg m" in result.findings[0]
    # The case rounds the moment of the weight: 0.00214 g is 0.9997 of the true 0.021 N m.
    inside(estimate, np.array([1.9e-4, 3e-5, 4e-4]) * 0.00214 * 9.81 / 0.021)


# A step of the voltage, and a drive's own velocity


@needs_files
@pytest.mark.parametrize("way", ["forward", "reverse"])
def test_a_voltage_step_with_known_friction(way):
    case = tomllib.loads((FIELD / "tests.toml").read_text())
    case["effects"][1]["level"] = 0.25
    inside(identify(case, FIELD / f"test_dynamic-{way}.csv").estimate, [0.02, 0.12])


@needs_files
def test_a_voltage_step_alone_leaves_a_combination_open():
    case = tomllib.loads((FIELD / "tests.toml").read_text())
    with pytest.raises(
        InputError, match=r"as after a step, of which coulomb_friction\.level may take any part"
    ):
        identify(case, FIELD / "test_dynamic-forward.csv")


@needs_files
def test_a_drive_that_measures_its_velocity():
    case = tomllib.loads((FIELD / "slow_log.toml").read_text())
    case["controller"]["derivative"] = "velocity"
    plain = identify(case, FIELD / "slow_log.csv")
    assert any("drive measures the velocity" in f.what for f in plain.session.findings)
    assert plain.settings["loop_velocity"]["value"] == "measured"
    assert abs(plain.estimate.theta[0] / 0.03 - 1) < 0.003, plain.estimate.theta
    case["log"]["loop_velocity"] = "dq"
    result = identify(case, FIELD / "slow_log.csv")
    assert abs(result.estimate.theta[0] / 0.03 - 1) < 0.003, result.estimate.theta
    assert not any("drive measures the velocity" in f.what for f in result.session.findings)
    assert "loop_velocity" not in result.settings


def test_a_wrong_log_is_status_two(tmp_path, capsys):
    case = tmp_path / "case.toml"
    case.write_text(
        '[plant]\nkind = "axis"\n[plant.parameters]\ninertia = 1.0\n[log]\nkind = "steady"\nforce = "f"\n'
    )
    assert main(["identify", str(case), str(tmp_path / "log.csv")]) == 2
    assert "'velocity' is missing" in capsys.readouterr().err
