"""Trajectories that an arm follows: within their limits, and as telling as they are said to be."""

import numpy as np
import pytest

import jaxid
from jaxid.cli import main
from jaxid.experiment_design.along_reference import _Series
from tests.case.test_serial_arm_case import text
from truth.arm import oracle as arm_oracle

ROWS = [("revolute", 0.0, 0.0, 0.0, 0.0), ("revolute", 0.0, 0.5, 0.0, 0.0)]
STROKE, SPEED, ACCELERATION, NOISE = ((-1.0, 2.0), (-2.0, 2.0)), (2.0, 3.0), (8.0, 20.0), (0.5, 0.1)
DESIGN = f"""
[sensor]
force_noise = {list(NOISE)}
[limits]
stroke = {[list(s) for s in STROKE]}
speed = {list(SPEED)}
[simulation]
duration = 6.0
sample_rate = 100.0
[design]
acceleration = {list(ACCELERATION)}
"""
CASE = text() + DESIGN


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    path = tmp_path_factory.mktemp("excitation") / "case.toml"
    out = {}
    for criterion in ("determinant", "condition"):
        path.write_text(CASE + f'criterion = "{criterion}"\n')
        out[criterion] = jaxid.design(path)
    return out


@pytest.mark.parametrize("criterion", ["determinant", "condition"])
def test_it_keeps_within_its_limits_and_begins_and_ends_at_rest(found, criterion):
    run = found[criterion]
    used = []
    for k in range(2):
        assert STROKE[k][0] <= run.position[:, k].min()
        assert run.position[:, k].max() <= STROKE[k][1]
        peaks = [np.abs(x[:, k]).max() for x in (run.velocity, run.acceleration)]
        room = np.array([SPEED[k], ACCELERATION[k]])
        assert np.all(peaks <= room)
        used.append(max(*(peaks / room), np.ptp(run.position[:, k]) / np.ptp(STROKE[k])))
    assert np.all(np.array(used) > 0.5)
    np.testing.assert_allclose(run.velocity[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(run.acceleration[0], 0.0, atol=1e-10)
    # what is said to be velocity and acceleration is that of the positions, which are periodic
    step = run.time[1]
    whole = lambda x: np.concatenate([x[-1:], x, x[:1]])
    np.testing.assert_allclose(
        (whole(run.position)[2:] - whole(run.position)[:-2]) / (2 * step), run.velocity, atol=2e-2
    )
    np.testing.assert_allclose(
        (whole(run.velocity)[2:] - whole(run.velocity)[:-2]) / (2 * step), run.acceleration, atol=2e-1
    )


def columns(run) -> np.ndarray:
    """By other physics: torques of unit parameters, viscous friction, and signs smoothed as sharply."""
    names = arm_oracle.NAMES
    out = []
    for name in run.identified:
        kind, _, rest = name.partition("[")
        k = int(rest[0]) - 1
        unit = np.zeros((2, 10))
        if kind in names:
            unit[k, names.index(kind)] = 1.0
            gravity = np.array([0.0, -9.81, 0.0])
            motion = zip(run.position, run.velocity, run.acceleration, strict=True)
            out.append([arm_oracle.inverse_dynamics(ROWS, unit, *x, gravity) for x in motion])
        else:
            v = run.velocity[:, k]
            side = v if kind == "viscous_friction" else np.tanh(v / (0.03 * max(SPEED)))
            out.append(np.eye(2)[k] * side[:, None])
    return np.stack(out, axis=-1)


def test_its_condition_number_and_deviations_are_those_of_the_regressor(found):
    run = found["condition"]
    weighted = (columns(run) / np.array(NOISE)[:, None]).reshape(-1, len(run.identified))
    assert len(run.identified) == 10
    np.testing.assert_allclose(
        run.condition[1], np.linalg.cond(weighted / np.linalg.norm(weighted, axis=0)), rtol=1e-6
    )
    std = np.sqrt(np.diag(np.linalg.inv(weighted.T @ weighted)))
    np.testing.assert_allclose(run.std, std, rtol=1e-6)


def test_each_criterion_is_best_at_its_own(found):
    most, least = found["determinant"], found["condition"]
    assert most.nats > 0.5
    assert least.condition[1] < 0.9 * least.condition[0]
    assert least.condition[1] < most.condition[1]
    assert np.sum(np.log(most.std)) < np.sum(np.log(least.std))


@pytest.mark.slow
def test_what_no_motion_tells_apart_is_left_out(tmp_path, found):
    """All twenty inertial parameters unknown: as telling as with the six that stand for sums."""
    links = (
        (
            "{ guess = 1.0 }",
            "[{ guess = 0.0 }, { guess = 0.0 }, { guess = 0.0 }]",
            "{ guess = [0.1, 0.0, 0.0, 0.1, 0.0, 0.1] }",
        ),
    ) * 2
    path = tmp_path / "case.toml"
    path.write_text(text(links) + DESIGN)
    run = jaxid.design(path)
    assert len(run.identified) == 10
    assert len(run.machine.parameters.names) == 24


def test_any_machine_with_a_table_design_is_designed_so(tmp_path, capsys):
    axis = """[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 2.0 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 3.0 }
[limits]
stroke = [0.0, 1.0]
speed = 0.5
force = 6.0
[simulation]
duration = 4.0
sample_rate = 100.0
[design]
harmonics = 3
"""
    path = tmp_path / "case.toml"
    path.write_text(axis)
    assert main(["design", str(path), "-o", str(tmp_path / "r.csv")]) == 0
    assert "condition number" in capsys.readouterr().out
    rows = np.loadtxt(tmp_path / "r.csv", delimiter=",", skiprows=1)
    assert rows.shape == (400, 2)
    assert rows[:, 1].min() >= 0.0
    assert rows[:, 1].max() <= 1.0
    path.write_text(axis.replace("force = 6.0", "force = 1e-3"))
    assert main(["design", str(path), "-o", str(tmp_path / "s.csv")]) == 2
    assert "more than the force of drive 1" in capsys.readouterr().err
    assert not (tmp_path / "s.csv").exists()


AXIS = """[plant]
kind = "axis"
[plant.parameters]
inertia = INERTIA
[[effects]]
kind = "viscous_friction"
coefficient = { guess = GUESS }
[limits]
stroke = [0.0, 1.0]
speed = 0.5
[simulation]
duration = 1.0
sample_rate = 20.0
[design]
harmonics = 2
"""


@pytest.mark.parametrize(("inertia", "guess"), [("2.0", "3.0"), ("1e-300", "0.0")])
def test_a_force_noise_of_zero_is_none_that_is_known(tmp_path, inertia, guess):
    """No row has infinite weight, nor has one of a joint that needs no force at the guesses."""
    path = tmp_path / "case.toml"
    text = AXIS.replace("INERTIA", inertia).replace("GUESS", guess)
    path.write_text(text + "[sensor]\nforce_noise = 0.0\n")
    run = jaxid.design(path)
    assert run.std is None
    assert run.identified == ("viscous_friction.coefficient",)
    assert np.isfinite(run.nats)


@pytest.mark.parametrize("rate", [2.0, 4.0, 1000.0])
def test_a_trajectory_is_the_same_at_any_rate(rate):
    """And keeps to its limits between the samples of a slow log."""
    bounds = tuple(np.array([x]) for x in (-1.0, 1.0, 2.0, 8.0))
    times = np.arange(round(6 * rate)) / rate, np.arange(30000) / 5000
    slow, dense = (_Series.within(time, 1 / 6, 5, bounds) for time in times)
    for seed in range(5):
        p = np.random.default_rng(seed).normal(size=slow.size)
        few, many = slow(p), dense(p)
        for x, y in zip(few, many, strict=True):
            np.testing.assert_allclose(x, y[:: round(5000 / rate)], rtol=0, atol=1e-9)
        assert [np.abs(y).max() <= most for y, most in zip(many, (1.0, 2.0, 8.0), strict=True)] == [True] * 3
        assert max(np.abs(many[1]).max() / 2.0, np.abs(many[2]).max() / 8.0, np.abs(many[0]).max()) > 0.9


FIVE_BAR = """[plant]
kind = "five_bar"
[plant.parameters]
length = [0.18, 0.25, 0.25, 0.25, 0.25]
center = [[0.12, 0.0], [0.12, 0.0]]
mass = [2.0, 2.0]
inertia = [0.3, 0.3, 0.03, 0.03]
tip_mass = { guess = 2.7 }
[limits]
stroke = [[2.6, 3.1], [0.0, 0.5]]
speed = 3.0
[simulation]
duration = 1.0
sample_rate = 20.0
[design]
harmonics = 2
"""


def test_a_stroke_that_the_plant_cannot_be_in_is_refused(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(FIVE_BAR)
    with pytest.raises(jaxid.InputError, match=r"\[limits\]: .*cannot reach; narrow stroke"):
        jaxid.design(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[design]\n", '[design]\ncriterion = "trace"\n', ["criterion", "trace", "determinant, condition"]),
        ("[design]\n", "[design]\nbase_frequency_hz = 0.1\n", ["has no whole period", "duration to 10.01 s"]),
        ("[design]\n", "[design]\nharmonics = 400\n", ["harmonic 400 is beyond half the sample_rate"]),
        ("speed = [2.0, 3.0]", "", ["[limits] has no speed"]),
        (
            text(),
            text(
                (
                    ("{ guess = 1.0 }", "[0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0, 0.0, 0.1]"),
                    ("0.0", "[0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0, 0.0, 0.1]"),
                ),
                viscous="",
            ),
            ["no force depends on an unknown"],
        ),
        ("[8.0, 20.0]", "[8.0]", ["acceleration", "1 entry"]),
    ],
)
def test_faults_are_told_in_one_line(tmp_path, capsys, old, new, words):
    assert old in CASE
    (tmp_path / "case.toml").write_text(CASE.replace(old, new))
    assert main(["design", str(tmp_path / "case.toml"), "-o", str(tmp_path / "r.csv")]) == 2
    error = capsys.readouterr().err
    assert len(error.strip().splitlines()) == 1
    assert not [word for word in words if word not in error], error
