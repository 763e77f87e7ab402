"""Experiments for an arm whose log holds commands and encoders alone, held against an exact arm."""

import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_arms import NOISE, Arm, arm
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.cli import main
from jaxid.errors import InputError
from jaxid.experiment_design.by_trials import Trial, Trials
from jaxid.experiment_design.next_case import _added
from jaxid.experiment_design.present import _follows
from jaxid.experiment_design.second_logs import _loaded_link
from jaxid.experiment_design.shapes import Shapes
from jaxid.experiment_design.unforced import _sampling
from jaxid.experiment_design.unforced_design import UnforcedDesign
from jaxid.first_case.section import toml
from jaxid.logs.log import Log

SECONDS, RATE, EVERY = 6.0, 500.0, 10
STROKE, SPEED, ACCELERATION = 0.8, 4.0, 40.0
# Counts a turn of a fine encoder.
FINE = 65536


def exact(command: np.ndarray, seed: int = 0, counts: int = 4096) -> Arm:
    """Return an arm of two servos on the exact stepper, under commands a row."""
    drawn = arm(4)
    servos = tuple(replace(s, effects={**s.effects}) for s in drawn.servos)
    for servo, delay in zip(servos, (0.02, 0.03), strict=True):
        servo.effects["command_delay"] = {"delay": delay}
    count = 2 * np.pi / counts
    return replace(drawn, seed=seed, rate=RATE, every=EVERY, count=count, servos=servos, command=command)


def case(factor: float = 1.0, counts: int = 4096) -> dict:
    """Return the case of that arm, its guesses at the truth times a factor, with limits for an experiment."""
    made = exact(np.zeros((10, 2)), counts=counts)
    tables, true = made.case(), made.truth()
    for k, link in enumerate(tables["plant"]["links"], start=1):
        link["rotor_inertia"] = {"guess": factor * true[f"rotor_inertia[{k}]"]}
    for entry in tables["effects"]:
        (name,) = set(entry) - {"kind", "joint"}
        entry[name] = {"guess": factor * true[f"{entry['kind']}[{entry['joint']}].{name}"]}
    for name in ("kp", "kd", "delay"):
        tables["controller"][name] = [{"guess": factor * true[f"controller.{name}[{k}]"]} for k in (1, 2)]
    return tables | {
        "sensor": {"position_resolution": made.count, "position_noise": NOISE},
        "limits": {"stroke": [-STROKE, STROKE], "speed": SPEED},
        "design": {"acceleration": ACCELERATION},
        "simulation": {"duration": SECONDS, "sample_rate": RATE / EVERY},
    }


@pytest.fixture(scope="module")
def found():
    return jaxid.design(case(counts=FINE))


@pytest.mark.slow
def test_it_tells_more_than_a_tour_and_keeps_within_its_limits(found):
    assert found.base is None
    assert found.before is None
    # Both tell the delays within a tick, and no motion tells more.
    by_motion = ["delay" not in name for name in found.machine.parameters.names]
    ratio = (found.std / found.plain)[by_motion]
    assert np.prod(ratio) ** (1 / len(ratio)) < 0.85
    rate, command = RATE / EVERY, found.values
    assert command.shape == (round(SECONDS * rate), 2)
    assert np.abs(command).max() <= STROKE
    assert np.abs(np.diff(command, axis=0)).max() * rate <= SPEED
    assert np.abs(np.diff(command, n=2, axis=0)).max() * rate**2 <= ACCELERATION
    motion = exact(command).run(exact=True)["position"]
    assert np.abs(motion).max() <= 1.02 * STROKE
    assert np.abs(np.diff(motion, axis=0)).max() * RATE <= SPEED
    printed = str(found)
    assert "collisions are not checked" in printed
    assert "joint 2  " in printed


@pytest.mark.slow
def test_estimates_of_exact_logs_scatter_as_their_fits_say_and_not_less_than_expected(found):
    """The fits' deviations have the noise that goes round the loop, the expected ones have not."""
    true = exact(found.values).truth()
    errors, ratios = [], []
    for seed in range(4):
        log = exact(found.values, seed, FINE).columns()
        estimate = jaxid.identify(case(counts=FINE), log).estimate
        assert estimate.converged
        errors.append((estimate.theta - np.array([true[name] for name in estimate.names])) / estimate.std)
        ratios.append(estimate.std / found.std)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5, errors
    assert np.abs(errors).max() < 3.5, errors
    ratio = np.mean(ratios, axis=0)
    assert np.all((ratio > 0.9) & (ratio < 4.0)), ratio


@pytest.mark.slow
def test_it_adds_to_a_log_that_is_there_and_its_files_are_fitted_together(tmp_path):
    def write(name: str, columns: dict[str, np.ndarray]) -> None:
        table = np.stack(list(columns.values()), axis=1)
        np.savetxt(tmp_path / name, table, "%.10g", ",", header=",".join(columns), comments="")

    t = np.arange(round(SECONDS * RATE / EVERY)) * EVERY / RATE
    sines = (a * np.sin(2 * np.pi * f * t) for a, f in ((0.3, 0.4), (0.4, 0.5)))
    slow = np.stack([sine * np.minimum(t, 1.0) for sine in sines], axis=1)
    write("slow.csv", exact(slow).columns())
    tables = case(1.5)
    lines = (f"{name} = {toml(table)}\n" for name, table in tables.items())
    (tmp_path / "case.toml").write_text("".join(lines))
    command = ["design", str(tmp_path / "case.toml"), str(tmp_path / "slow.csv")]
    assert main([*command, "-o", str(tmp_path / "next.csv")]) == 0

    content = tomllib.loads((tmp_path / "next.toml").read_text())
    assert [entry["log"] for entry in content["fit"]] == ["slow.csv", "next_log.csv"]
    played = np.genfromtxt(tmp_path / "next.csv", delimiter=",", names=True)
    signal = np.stack([played["reference_1"], played["reference_2"]], axis=1)
    write("next_log.csv", exact(signal, 1).columns())
    before = jaxid.identify(tables, tmp_path / "slow.csv").estimate
    result = jaxid.identify(tmp_path / "next.toml").estimate
    true = np.array([exact(signal).truth()[name] for name in result.names])
    assert np.all(np.abs(result.theta - true) < 4 * result.std)
    assert np.prod(result.std / before.std) ** (1 / len(true)) < 0.6


TWO_LINKS = """<mujoco><option timestep="0.002"/><worldbody><body name="upper">
<joint name="shoulder" axis="0 1 0" damping="0.05" frictionloss="0.05" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/>
<body name="lower" pos="0.2 0 0"><joint name="elbow" axis="0 1 0" damping="0.03" armature="0.005"/>
<geom type="capsule" fromto="0 0 0 0.15 0 0" size="0.015" mass="0.1"/></body></body></worldbody>
<actuator><position name="s" joint="shoulder" kp="10" kv="0.5"/>
<position name="e" joint="elbow" kp="5" kv="0.2"/></actuator></mujoco>"""
OF_FILE = {
    "plant": {"kind": "tree", "mjcf": "two.xml", "unknown": ["kp"], "payload_at": {"lower": [0.15, 0, 0]}},
    "log": {
        "time": "t",
        "position": {"shoulder": "q1", "elbow": "q2"},
        "reference": {"shoulder": "r1", "elbow": "r2"},
        "reference_hold": "zero_order",
    },
    "sensor": {"position_noise": 5e-4},
    "limits": {"stroke": [-0.8, 0.8], "speed": 4.0},
    "simulation": {"duration": 1.0, "sample_rate": 49.9},
}


def written(folder: Path, **changes: object) -> Path:
    """Write the case of the file, with other tables in place of some."""
    (folder / "two.xml").write_text(TWO_LINKS)
    lines = (f"{name} = {toml(table)}\n" for name, table in (OF_FILE | changes).items())
    (folder / "case.toml").write_text("".join(lines))
    return folder / "case.toml"


def test_a_second_log_has_a_payload_where_the_case_has_a_place_for_it(tmp_path):
    case = load_case(written(tmp_path))
    changes = _loaded_link(case, build_machine(case, period=0.02))
    # Parts of the 0.4 kg of both links, the larger first.
    assert [values for _, values, _ in changes] == [{"payload[2]": 0.08}, {"payload[2]": 0.02}]
    assert changes[0][0] == "a payload of 0.08 kg that is known, at the link that elbow moves"
    for _, values, loaded in changes:
        np.testing.assert_allclose(loaded.plant.payload, [0.0, values["payload[2]"]])

    plant = {**OF_FILE["plant"], "parameters": {"payload": {"elbow": {"guess": 0.1}}}}
    unknown = load_case(written(tmp_path, plant=plant))
    assert _loaded_link(unknown, build_machine(unknown, period=0.02)) == []
    # Which link a point at an origin belongs to is not in the plant.
    at_origin = load_case(written(tmp_path, plant={**OF_FILE["plant"], "payload_at": {"upper": [0, 0, 0]}}))
    assert _loaded_link(at_origin, build_machine(at_origin, period=0.02)) == []


def test_rows_fall_on_ticks_of_a_loop_whose_rate_nobody_states(tmp_path):
    case = load_case(written(tmp_path))
    sampling = _sampling(case, build_machine(case, period=1 / 498.5))
    assert (sampling.rate, sampling.rows, sampling.every) == (pytest.approx(49.85, rel=1e-12), 50, 10)
    slow = load_case(written(tmp_path, simulation={"duration": 1.0, "sample_rate": 210.0}))
    with pytest.raises(InputError, match=r"a loop of 498\.5 Hz cannot be logged at sample_rate = 210"):
        _sampling(slow, build_machine(slow, period=1 / 498.5))


def test_the_case_is_not_written_over(tmp_path, capsys):
    path = written(tmp_path)
    before = path.read_text()
    assert main(["design", str(path), "-o", str(tmp_path / "case.csv"), "--force"]) == 2
    assert "the case of the experiment would be written over" in capsys.readouterr().err
    log = tmp_path / "log.csv"
    log.write_text("t,q1,q2,r1,r2\n")
    assert main(["design", str(path), str(log), "-o", str(log), "--force"]) == 2
    assert "the signal would be written over" in capsys.readouterr().err
    assert log.read_text() == "t,q1,q2,r1,r2\n"
    unsaved = SimpleNamespace(case=load_case(path))
    with pytest.raises(InputError, match="the case of the experiment would be written over"):
        UnforcedDesign.save_case(unsaved, tmp_path / "case.csv")
    assert path.read_text() == before


def test_a_mixed_command_takes_the_joints_that_tell_more():
    # The second of four joints has no drive.
    plant = SimpleNamespace(driven=lambda n: (0, 2, 3))
    shapes = Shapes(np.zeros((5, 2)), np.zeros(3), np.ones(3), np.ones(3))
    present = SimpleNamespace(machine=SimpleNamespace(plant=plant))
    trials = Trials(present, None, (), None, shapes, 50.0)
    best, other = (
        Trial(size * np.arange(1.0, 11.0), None, None, 0.0, np.array(told))
        for size, told in ((1.0, [3.0, 1.0, 1.0, 2.0]), (-1.0, [2.0, 0.0, 4.0, 5.0]))
    )
    # Two weights of each joint, the centres, the amplitude.
    np.testing.assert_array_equal(trials.mixed(best, other), [1, 2, -3, -4, -5, -6, 7, -8, -9, 10])
    assert trials.mixed(best, replace(other, by_joint=np.zeros(4))) is None


@pytest.mark.parametrize(
    ("left", "follows"), [([0.2, 1e-3], True), ([0.2, 0.1], False), ([0.4, 1e-3], False)]
)
def test_a_fit_follows_its_log_at_every_joint(left, follows):
    """The first joint moves by 1 rad, the second is at rest but for 0.5 mrad of noise."""
    rng = np.random.default_rng(0)
    readings = np.stack([np.sqrt(2) * np.sin(np.arange(200)), 5e-4 * rng.standard_normal(200)], axis=1)
    log = Log(np.arange(200) / 50, readings, np.zeros((200, 2)))
    session = SimpleNamespace(
        fits=[SimpleNamespace(log=log)],
        machine=SimpleNamespace(sensor=SimpleNamespace(position_std=5e-4)),
    )
    gaps = [SimpleNamespace(simulation=SimpleNamespace(rms=np.array(left)))]
    result = SimpleNamespace(session=session, gaps=gaps, estimate=SimpleNamespace(theta=np.ones(3)))
    assert _follows(result) == follows


def test_a_second_round_has_a_name_that_is_free(tmp_path):
    design = SimpleNamespace(result=None, base=None, second=())
    tables = {"fit": [{"name": "designed"}, {"name": "designed 2"}]}
    assert _added(design, tmp_path / "next.csv", tables) == {
        "fit": [{"name": "designed 3", "log": "next_log.csv"}]
    }
