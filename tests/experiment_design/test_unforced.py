"""Experiments for a servo whose log holds command and encoder alone, held against an exact machine."""

import dataclasses
import tomllib

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_machines import COUNT, NOISE, Servo
from jaxid.cli import main
from jaxid.errors import InputError
from tests.support.written_logs import write_csv

RATE, EVERY, SECONDS = 250.0, 5, 4.0
TRUE = {
    "inertia": 2e-3,
    "viscous_friction.coefficient": 5e-3,
    "coulomb_friction.level": 0.03,
    "controller.kd": 0.06,
    "controller.delay": 0.02,
}
KP = 1.5
CASE = f"""
[plant]
kind = "axis"
motion = "rotary"
[plant.parameters]
inertia = {{ guess = 2e-3 }}
[[effects]]
kind = "viscous_friction"
coefficient = {{ guess = 5e-3 }}
[[effects]]
kind = "coulomb_friction"
level = {{ guess = 0.03 }}
[controller]
kind = "pd"
kp = {KP}
kd = {{ guess = 0.06 }}
delay = {{ guess = 0.02 }}
period = {1 / RATE}
[log]
time = "t"
position = "q"
reference = "r"
reference_hold = "zero_order"
[sensor]
position_resolution = {COUNT}
position_noise = {NOISE}
[limits]
stroke = [-1.0, 1.0]
speed = 4.0
[design]
acceleration = 40.0
[simulation]
duration = {SECONDS}
sample_rate = {RATE / EVERY}
"""
FREE = CASE.replace(f"kp = {KP}", f"kp = {{ guess = {KP} }}")


def servo(command: np.ndarray, seed: int = 0, payload: float = 0.0) -> Servo:
    """The machine of the case on the exact stepper, under a command a row."""
    effects = {
        "viscous_friction": {"coefficient": TRUE["viscous_friction.coefficient"]},
        "coulomb_friction": {"level": TRUE["coulomb_friction.level"]},
        "command_delay": {"delay": TRUE["controller.delay"]},
    }
    inertia = TRUE["inertia"] + payload
    return Servo(seed, RATE, EVERY, inertia, KP, TRUE["controller.kd"], effects, command)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    path = tmp_path_factory.mktemp("unforced") / "case.toml"
    path.write_text(CASE)
    return jaxid.design(path)


@pytest.mark.slow
def test_it_tells_more_than_a_tour_and_keeps_within_its_limits(found):
    assert found.base is None
    assert found.before is None
    assert np.all(found.std < 0.2 * found.machine.parameters.guess)
    assert np.prod(found.std) < 0.7 * np.prod(found.plain)
    rate = RATE / EVERY
    reference = found.values[:, 0]
    assert len(reference) == round(SECONDS * rate)
    assert np.abs(reference).max() <= 1.0
    assert np.abs(np.diff(reference)).max() * rate <= 4.0
    assert 4.0 < np.abs(np.diff(reference, n=2)).max() * rate**2 <= 40.0
    exact = servo(reference).run(exact=True)
    assert np.abs(exact["position"]).max() <= 1.01
    assert np.abs(np.diff(exact["position"])).max() * rate <= 4.0


@pytest.mark.slow
def test_estimates_of_exact_logs_scatter_as_expected(found):
    """Of 8 logs and 5 unknowns, squared errors over the expected variances average about one."""
    case = tomllib.loads(CASE)
    squares = []
    for seed in range(8):
        estimate = jaxid.identify(case, servo(found.values[:, 0], seed).columns()).estimate
        assert estimate.converged
        squares.append(((estimate.theta - np.array(list(TRUE.values()))) / found.std) ** 2)
    by_unknown = np.sqrt(np.mean(squares, axis=0))
    assert 0.6 < np.sqrt(np.mean(squares)) < 1.6, by_unknown
    assert np.all(by_unknown < 2.5), by_unknown


@pytest.mark.slow
def test_the_files_give_the_scale_that_no_motion_tells(tmp_path, capsys):
    (tmp_path / "case.toml").write_text(FREE)
    assert main(["design", str(tmp_path / "case.toml"), "-o", str(tmp_path / "next.csv")]) == 0
    printed = capsys.readouterr().out
    assert "no motion tells the scale: inertia, " in printed
    assert "if controller.kp is stated as a number: inertia " in printed
    assert "by a second log with a payload of 0.0005 kg m^2 that is known: inertia " in printed

    content = tomllib.loads((tmp_path / "next.toml").read_text())
    names = [entry["log"] for entry in content["fit"]]
    masses = [entry.get("set", {}).get("added_mass.mass", 0.0) for entry in content["fit"]]
    assert names == ["next_log.csv", "next_second_log.csv"]
    assert masses[0] == 0.0 < masses[1]
    table = np.genfromtxt(tmp_path / "next.csv", delimiter=",", names=True)
    for name, payload in zip(names, masses, strict=True):
        given = servo(table["reference"], payload=payload).columns()
        columns = np.stack(list(given.values()), axis=1)
        np.savetxt(tmp_path / name, columns, "%.10g", ",", header=",".join(given), comments="")
    result = jaxid.identify(tmp_path / "next.toml")
    for name, true in {**TRUE, "controller.kp": KP}.items():
        parameter = result.parameters[name]
        assert abs(parameter.value - true) < 4 * parameter.std, name
        assert parameter.std < 0.1 * true, name


@pytest.mark.slow
def test_second_logs_with_another_gain_scatter_as_expected(found, tmp_path):
    """Of 4 pairs of logs, the second with another gain."""
    gains = {log.values["controller.kp"]: log.std for log in found.second if "controller.kp" in log.values}
    assert gains
    assert set(gains) <= {KP / 2, 2 * KP}
    gain, expected = max(gains.items())
    # The same log a second time would leave 0.25.
    assert np.prod(expected / found.std) < 0.2
    case, squares = tomllib.loads(CASE), []
    for seed in range(4):
        entries = []
        for name, kp in ((f"{seed}_stated", KP), (f"{seed}_other", gain)):
            drawn = dataclasses.replace(servo(found.values[:, 0], seed=10 * seed + len(entries)), kp=kp)
            write_csv(tmp_path / f"{name}.csv", drawn.columns())
            entries.append({"name": name, "log": str(tmp_path / f"{name}.csv")})
        entries[1]["set"] = {"controller.kp": gain}
        estimate = jaxid.identify({**case, "fit": entries}).estimate
        assert estimate.converged
        squares.append(((estimate.theta - np.array(list(TRUE.values()))) / expected) ** 2)
    assert 0.5 < np.sqrt(np.mean(squares)) < 1.7, np.sqrt(np.mean(squares, axis=0))


@pytest.mark.slow
def test_it_adds_to_a_log_that_is_there():
    t = np.arange(round(SECONDS * RATE / EVERY)) * EVERY / RATE
    slow = servo(0.4 * np.sin(2 * np.pi * 0.5 * t) * np.minimum(t, 1.0)).columns()
    design = jaxid.design(tomllib.loads(CASE), slow)
    fitted = jaxid.identify(tomllib.loads(CASE), slow)
    ratio = design.before / fitted.estimate.std
    assert np.all((ratio > 0.5) & (ratio < 2.0)), ratio
    delay = list(TRUE).index("controller.delay")
    assert design.std[delay] == pytest.approx(1 / RATE / np.sqrt(12), rel=1e-9)
    # The same log a second time would leave the square root of a half.
    others = np.delete(design.std / design.before, delay)
    assert np.all(others < np.sqrt(0.5)), others
    assert np.prod(others) ** (1 / len(others)) < 0.6, others


def case(**changes: object) -> dict:
    """The case with tables in place of its own; None leaves one out."""
    return {k: v for k, v in {**tomllib.loads(CASE), **changes}.items() if v is not None}


WRONG = {
    "noise": (case(sensor=None), None, "noise of the position is not known"),
    "series": (case(design={"harmonics": 4}), None, "harmonics is of an experiment along a reference"),
    "each": (case(identification={"per_log": ["inertia"]}), None, "with a value in each log"),
    "rate": (
        case(simulation={"duration": 2.0, "sample_rate": 90.0}),
        None,
        "cannot be logged at sample_rate",
    ),
    "forced": (
        case(log={"time": "t", "position": "q", "reference": "r", "force": "u"}),
        {"t": np.arange(100) / 100},
        "for a case without a force",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_case_without_such_an_experiment_is_refused(name):
    given, log, words = WRONG[name]
    with pytest.raises(InputError, match=words):
        jaxid.design(given, log)
