"""An experiment that tells a case's unknowns, found through the simulation."""

import numpy as np
import pytest

import jaxid
from jaxid.cli import main
from jaxid.experiment_design.in_loop import LoopDesign
from jaxid.logs.log import Log
from truth.axis.stepper import Loop, Machine, Sensor, simulate

CASE = """
[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 90.0 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 150.0 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 25.0 }
[log]
time = "t"
position = "q"
force = "u"
reference = "ref"
[controller]
kind = "cascade_pd"
kp = 60.0
kv = 3000.0
period = 0.002
limit = 400.0
[sensor]
position_noise = 1e-5
[output_error]
prior = 0.5
[limits]
stroke = [-0.1, 0.15]
speed = 0.4
[simulation]
duration = 2.0
sample_rate = 500.0
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    path = tmp_path_factory.mktemp("design") / "case.toml"
    path.write_text(CASE)
    return path, jaxid.design(path)


def test_it_tells_more_than_a_tour_and_keeps_within_its_limits(found):
    design = found[1]
    assert design.nats[0] > design.nats[1] > 1.0
    assert np.all(design.std < 0.2)
    assert np.prod(design.std) < np.prod(design.plain)
    assert -0.1 <= design.peaks.low <= design.values.min() + 0.05
    assert design.peaks.high <= 0.15
    assert 0.1 < design.peaks.speed <= 0.4
    assert 100.0 < design.peaks.force < 400.0
    assert "inertia" in str(design)


def test_what_it_expects_is_what_a_fit_of_such_a_log_says(found):
    """An exact machine follows it; sigma as expected to a factor of two, the truth within four of them."""
    path, design = found
    machine = Machine(95.0, {"viscous_friction": {"coefficient": 203.0}, "coulomb_friction": {"level": 20.0}})
    reference = design.values[:, 0]
    loop = Loop("cascade_pd", reference=reference, kp=60.0, kv=3000.0, limit=400.0)
    made = simulate(
        machine,
        loop,
        Sensor(position_noise=1e-7),
        rate=500.0,
        duration=len(reference) / 500.0,
        initial_position=reference[0],
    )
    noise = np.random.default_rng(0).normal(0.0, 1e-5, len(reference))
    log = Log(
        time=made["t"],
        position=(made["position"] + noise)[:, None],
        force=made["force"][:, None],
        reference=reference[:, None],
        source="designed",
    )
    estimate = jaxid.identify(path, log).estimate
    truth = np.array([95.0, 203.0, 20.0])
    assert np.all(np.abs(estimate.theta - truth) < 4 * estimate.std)
    ratio = estimate.std / estimate.theta / design.std
    assert np.all((ratio > 0.5) & (ratio < 2.0)), ratio


COUNT = 5e-5


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """The same on the command, where a coarse encoder closes the loop."""
    path = tmp_path_factory.mktemp("coarse") / "case.toml"
    rounded = f"position_resolution = {COUNT}\nforce_noise = 2.0"
    text = CASE.replace("position_noise = 1e-5", rounded).replace("prior = 0.5", 'prior = 0.5\non = "force"')
    path.write_text(text)
    return path, jaxid.design(path)


@pytest.mark.slow
def test_what_rounding_takes_is_expected_too(coarse):
    """Of an exact machine's logs sigma is as expected; and more is told than of the tour."""
    path, design = coarse
    machine = Machine(90.0, {"viscous_friction": {"coefficient": 150.0}, "coulomb_friction": {"level": 25.0}})
    reference = design.values[:, 0]
    loop = Loop("cascade_pd", reference=reference, kp=60.0, kv=3000.0, limit=400.0)
    ratios, off = [], []
    for seed in range(4):
        start = (np.round(reference[0] / COUNT) + np.random.default_rng(seed).uniform(-0.5, 0.5)) * COUNT
        made = simulate(
            machine,
            loop,
            Sensor(position_resolution=COUNT, force_noise=2.0),
            rate=500.0,
            duration=len(reference) / 500.0,
            initial_position=start,
            seed=seed,
        )
        log = Log(
            time=made["t"],
            position=made["position"][:, None],
            force=made["force"][:, None],
            reference=reference[:, None],
            source="designed",
        )
        estimate = jaxid.identify(path, log).estimate
        ratios.append(estimate.std / np.array([90.0, 150.0, 25.0]) / design.std)
        off.append((estimate.theta - np.array([90.0, 150.0, 25.0])) / estimate.std)
    assert np.all(np.isfinite(ratios))
    assert np.all((np.median(ratios, axis=0) > 0.7) & (np.median(ratios, axis=0) < 1.4))
    assert np.max(np.abs(off)) < 3
    assert design.nats[0] > design.nats[1] + 1.0


def test_of_a_loop_that_rounding_tosses_about_nothing_is_expected(coarse):
    path, design = coarse
    told = {}
    for count in (COUNT, 200 * COUNT):
        case = path.with_name("tossed.toml")
        case.write_text(path.read_text().replace(f"resolution = {COUNT}", f"resolution = {count}"))
        told[count] = LoopDesign.of(jaxid.load_case(case)).expected(design.values)
    assert np.all(np.diag(told[COUNT]) < 0.2)
    np.testing.assert_array_equal(told[200 * COUNT], np.eye(3))


def test_the_signal_is_a_reference_to_simulate(found, tmp_path):
    design = found[1]
    design.save(tmp_path / "ref.csv")
    text = CASE + '[reference]\nkind = "csv"\nfile = "ref.csv"\ntime = "t"\ncolumn = "reference"\n'
    (tmp_path / "case.toml").write_text(text)
    log = jaxid.simulate(tmp_path / "case.toml").log
    np.testing.assert_allclose(log.reference, design.values[: log.samples], atol=1e-12)


WRONG = {
    "limits": ("stroke = [-0.1, 0.15]\n", "", "[limits] has no stroke"),
    "duration": ("duration = 2.0\n", "", "[simulation] has no duration"),
    "noise": ("position_noise = 1e-5\n", "", "the noise of the position is not known"),
    "known": ("{ guess", "{ gues", "gues"),
    "force": ("prior = 0.5", 'prior = 0.5\non = "force"', "the noise of the force is not known"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_missing_is_said(name, tmp_path, capsys):
    old, new, words = WRONG[name]
    (tmp_path / "case.toml").write_text(CASE.replace(old, new))
    assert main(["design", str(tmp_path / "case.toml"), "-o", str(tmp_path / "r.csv")]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "r.csv").exists()
