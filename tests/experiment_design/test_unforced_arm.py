"""Experiments for an arm whose log holds commands and encoders alone, held against an exact arm."""

import dataclasses
import tomllib

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_arms import NOISE, Arm, arm
from jaxid.cli import main
from jaxid.first_case.section import toml

SECONDS, RATE, EVERY = 6.0, 500.0, 10
STROKE, SPEED, ACCELERATION = 0.8, 4.0, 40.0


def exact(command: np.ndarray, seed: int = 0) -> Arm:
    """An arm of two servos on the exact stepper, under commands a row."""
    drawn = arm(4)
    servos = tuple(dataclasses.replace(s, effects={**s.effects}) for s in drawn.servos)
    for servo, delay in zip(servos, (0.02, 0.03), strict=True):
        servo.effects["command_delay"] = {"delay": delay}
    return dataclasses.replace(drawn, seed=seed, rate=RATE, every=EVERY, servos=servos, command=command)


def case(factor: float = 1.0) -> dict:
    """The case of that arm, its guesses at the truth times a factor, with limits for an experiment."""
    made = exact(np.zeros((10, 2)))
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
    return jaxid.design(case())


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
    assert np.abs(np.diff(motion[::EVERY], axis=0)).max() * rate <= SPEED
    printed = str(found)
    assert "collisions are not checked" in printed
    assert "joint2  " in printed


@pytest.mark.slow
def test_estimates_of_exact_logs_scatter_as_expected(found):
    """Of 4 logs and 12 unknowns, squared errors over the expected variances average about one."""
    true = exact(found.values).truth()
    squares = []
    for seed in range(4):
        estimate = jaxid.identify(case(), exact(found.values, seed).columns()).estimate
        assert estimate.converged
        off = estimate.theta - np.array([true[name] for name in estimate.names])
        squares.append((off / found.std) ** 2)
    by_unknown = dict(zip(estimate.names, np.sqrt(np.mean(squares, axis=0)), strict=True))
    assert 0.5 < np.sqrt(np.mean(squares)) < 1.6, by_unknown
    assert max(by_unknown.values()) < 3.0, by_unknown


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
