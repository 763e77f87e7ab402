"""The guide to adding a plant: its files are those that it shows, are right, and find what they simulate."""

import importlib.util
import shutil
from pathlib import Path
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.build import build_machine
from jaxid.dynamics.rhs import State, acceleration, derivative
from jaxid.results.as_json import identification_json
from jaxid.results.as_text import identification_table
from tests.support.cli_setup import run

DOCS = Path(__file__).parents[2] / "docs"
GUIDE = (DOCS / "adding_a_plant.md").read_text("utf-8")
EXAMPLES = DOCS / "examples"
NAMES = ("cart_pole", "dc_motor_pendulum")


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


@pytest.fixture(scope="module")
def identified(tmp_path_factory) -> dict:
    """Results of both examples, each from its case's guesses on a log that the case simulates.

    They are fitted by the quick method here; by the chosen one in slow tests.
    """
    folder, found = tmp_path_factory.mktemp("guide"), {}
    for path in EXAMPLES.glob("*.*"):
        shutil.copy(path, folder)
    for name in NAMES:
        log = jaxid.simulate(folder / f"{name}.toml", seed=1)
        log.save(folder / f"{name}.csv")
        files = folder / f"{name}.toml", folder / f"{name}.csv"
        found[name] = jaxid.identify(*files, method="inverse_dynamics")
    return found


@pytest.mark.parametrize("file", ["cart_pole.py", "dc_motor_pendulum.py"])
def test_the_guide_shows_the_file_that_runs(file):
    written = (EXAMPLES / file).read_text("utf-8")
    assert f"```python\n{written}```" in GUIDE
    assert len(written.splitlines()) < 45


def test_the_case_of_the_guide_is_that_of_the_example():
    shown = GUIDE.split("```toml\n")[1].split("```")[0]
    assert shown in (EXAMPLES / "cart_pole.toml").read_text("utf-8")


def test_the_cart_pole_against_a_right_hand_side_of_its_own():
    big, small, length, g = 1.2, 0.3, 0.4, 9.81
    plant = module("cart_pole").CartPole(big, small, length)
    random = np.random.default_rng(0)
    for _ in range(20):
        (x, a), (v, w), force = random.normal(size=2), 3 * random.normal(size=2), random.normal()
        # From textbooks, with the angle from hanging down: solved for both accelerations by hand.
        sine, cosine = np.sin(a), np.cos(a)
        expected = (force + small * sine * (length * w**2 + g * cosine)) / (big + small * sine**2)
        both = [expected, -(expected * cosine + g * sine) / length]
        state = State(jnp.asarray([x, a]), jnp.asarray([v, w]), ())
        ours = acceleration(plant, state, jnp.asarray([force]), jnp.zeros(()))
        np.testing.assert_allclose(ours, both, rtol=1e-12)


def test_the_pendulum_against_the_equations_of_its_circuit():
    example, g = module("dc_motor_pendulum"), 9.81
    resistance, inductance, constant, inertia, moment = 1.2, 18e-3, 0.9, 0.03, 0.1
    plant = example.Pendulum(inertia, moment).with_effect(
        example.Armature(inductance / resistance, constant**2 / resistance)
    )
    random = np.random.default_rng(1)
    for _ in range(20):
        q, v, current, voltage = random.normal(size=4)
        slope = (voltage - resistance * current - constant * v) / inductance
        expected = (constant * current - moment * g * np.sin(q)) / inertia
        state = State(jnp.asarray([q]), jnp.asarray([v]), (jnp.asarray(constant * current),))
        declared = jnp.asarray([constant / resistance * voltage])
        ours = derivative(plant, state, declared, jnp.zeros(()))
        np.testing.assert_allclose(ours.qd, [expected], rtol=1e-12)
        np.testing.assert_allclose(ours.own[0], constant * slope, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "chosen"),
    [
        ("dc_motor_pendulum", False),
        # The Coulomb friction of the cart-pole by inverse dynamics is several standard deviations off.
        *(pytest.param(name, True, marks=pytest.mark.slow) for name in NAMES),
    ],
)
def test_the_values_are_those_simulated_within_their_precision(identified, name, chosen):
    found = identified[name]
    if chosen:
        path = Path(found.session.case.path)
        found = jaxid.identify(path, path.with_suffix(".csv"))
    assert found.converged
    free = build_machine(jaxid.load_case(EXAMPLES / f"{name}.toml")).parameters.free
    truth, guess = (np.asarray([getattr(f, key) for f in free]) for key in ("true", "guess"))
    assert np.all(np.abs(np.log(guess / truth)) > np.log(1.5))
    off = np.abs(found.estimate.theta - truth)
    assert np.all(off < 3 * found.estimate.std), off / found.estimate.std
    assert np.all(found.estimate.std < 0.05 * truth)


def test_units_are_those_of_the_joint(identified):
    content = identification_json(identified["cart_pole"])
    units = {name: p["unit"] for name, p in content["parameters"].items()}
    assert units == {
        "cart_mass": "kg",
        "pole_mass": "kg",
        "pole_length": "m",
        "coulomb_friction[1].level": "N",
        "viscous_friction[1].coefficient": "N s/m",
        "viscous_friction[2].coefficient": "N m s/rad",
    }
    assert content["gap"]["unit"] == ["N", "N m"]
    assert content["gap"]["simulation"]["unit"] == ["m", "rad"]
    table = identification_table(identified["cart_pole"])
    assert "N, N m" in table
    assert "m, rad" in table
    one = identification_json(identified["dc_motor_pendulum"])
    assert (one["gap"]["unit"], one["gap"]["simulation"]["unit"]) == ("N m", "rad")
    assert one["parameters"]["first_moment"]["unit"] == "kg m"


def test_the_report_labels_each_joint(identified, tmp_path):
    identified["cart_pole"].save(tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "N·m" in page or "N m" in page


def test_each_joint_has_its_typical_velocity(identified):
    smoothing = identified["cart_pole"].session.machine.plant.smoothing
    data = identified["cart_pole"].session.fit.data
    np.testing.assert_allclose(smoothing.velocity_scale, np.sqrt(np.mean(data.qd**2, axis=0)))
    assert np.shape(identified["dc_motor_pendulum"].session.machine.plant.smoothing.velocity_scale) == ()


@pytest.mark.slow
def test_the_other_commands_take_the_plant(tmp_path, capsys):
    for path in EXAMPLES.glob("*.*"):
        shutil.copy(path, tmp_path)
    case, log = tmp_path / "cart_pole.toml", tmp_path / "log.csv"
    text = case.read_text("utf-8")
    assert run(capsys, "simulate", case, folder=log).status == 0
    checked = run(capsys, "check", case, log)
    assert checked.status == 0
    assert "m, rad" in checked.out
    case.write_text(text + '\n[study]\nestimators = ["output_error"]\nruns = 2\n')
    assert run(capsys, "study", case, folder=tmp_path / "study").status == 0
    found = run(capsys, "discover", case, log, folder=tmp_path / "found")
    assert found.status == 0
    assert found.json("discovery.json")["verdict"] == "nothing_missing"
