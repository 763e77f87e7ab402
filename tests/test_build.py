"""From a case to arrays: names, leaves, true values, and the disturbance's ticks."""

from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxid.build import _loop_period, build_machine
from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.model.parameter import parameter
from jaxid.model.plant import Plant
from jaxid.plants import PLANTS
from jaxid.settings import Disturbance
from jaxid.simulation.disturbance import disturbance_at

CASE = """
[plant]
kind = "axis"
orientation = "vertical"
gravity = 9.7
[plant.parameters]
inertia = { guess = 80.0, min = 10.0, max = 200.0, true = 95.0 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 100.0 }
[[effects]]
kind = "cogging"
amplitude = { guess = 1.0, true = 2.0 }
period = 0.1
phase = 0
[[effects]]
kind = "cogging"
amplitude = 1.0
period = { guess = 0.2 }
phase = { guess = 0.5, min = 0.0, max = 3.2 }
[actuator]
gain = -35.15
[log]
time = "t"
position = "q"
force = "u"
hold = "linear"
[controller]
kind = "pid"
kp = 160.18
ki = 3
kd = 243.45
period = 0.001
velocity_average = 2
limit = 10.0
anti_windup = true
disturbance = { level = 5.07, on = 0.5, off = 0.5, start = 0.343 }
[sensor]
position_resolution = 1.0e-6
[simulation]
sharpness = 1e-4
"""
PULSES = Disturbance(level=5.07, on=0.5, off=0.5, start=0.343)


def machine(folder: Path, text: str = CASE, **options):
    path = folder / "case.toml"
    path.write_text(text)
    return build_machine(load_case(path), **options)


def test_names_units_and_places(tmp_path):
    free = machine(tmp_path).parameters.free
    assert [f.name for f in free] == [
        "inertia",
        "viscous_friction.coefficient",
        "cogging.amplitude",
        "cogging#2.period",
        "cogging#2.phase",
    ]
    assert [f.unit for f in free] == ["kg", "N s/m", "N", "m", "rad"]
    assert free[0].lower == 10.0
    assert free[0].true == 95.0


def test_guesses_and_known_values_stand_in_the_plant(tmp_path):
    built = machine(tmp_path)
    plant = built.plant
    assert float(plant.inertia) == 80.0
    assert plant.vertical
    assert float(plant.gravity) == 9.7
    assert float(plant.smoothing.sharpness) == 1e-4
    assert float(plant.effects[1].period) == 0.1
    np.testing.assert_array_equal(built.parameters.extract(plant), built.parameters.guess)
    np.testing.assert_array_equal(built.gain, [-35.15])
    assert built.hold == "linear"
    assert built.disturbance == PULSES


def test_true_values_take_the_place_of_guesses_only_where_asked(tmp_path):
    guess = machine(tmp_path)
    true = machine(tmp_path, at_truth=True)
    assert float(true.plant.inertia) == 95.0
    assert float(true.plant.effects[1].amplitude) == 2.0
    # without a truth the guess is the truth
    assert float(true.plant.effects[0].coefficient) == float(guess.plant.effects[0].coefficient)
    np.testing.assert_array_equal(true.parameters.guess, true.parameters.extract(true.plant))


def test_leaves_are_strong_float64(tmp_path):
    built = machine(tmp_path)
    leaves = jax.tree.leaves((built.plant, built.controller, built.sensor))
    # a Python float, or a weak type, would compile anew once a fit puts arrays in its place
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    assert {(str(leaf.dtype), leaf.weak_type) for leaf in leaves} == {("float64", False)}


def test_insert_changes_no_type(tmp_path):
    built = machine(tmp_path)
    moved = built.with_estimate(1.1 * built.parameters.guess)
    assert float(moved.plant.inertia) == pytest.approx(88.0)
    assert moved.parameters.free[0].guess == pytest.approx(88.0)
    kind = lambda leaf: (lambda x: (x.shape, x.dtype, x.weak_type))(jnp.asarray(leaf))
    before = jax.tree.map(kind, built.plant)
    assert jax.tree.structure(before) == jax.tree.structure(jax.tree.map(kind, moved.plant))
    assert jax.tree.leaves(before) == jax.tree.leaves(jax.tree.map(kind, moved.plant))


def test_controller_and_sensor(tmp_path):
    built = machine(tmp_path)
    controller = built.controller
    assert controller.period == 0.001
    assert controller.velocity_average == 2
    assert controller.anti_windup is True
    assert float(controller.limit) == 10.0
    assert float(controller.derivative_filter) == 0.0
    assert float(built.sensor.position_resolution) == 1e-6
    assert built.sensor.position_noise is None


def test_bare_case(tmp_path):
    built = machine(tmp_path, '[plant]\nkind = "axis"\nparameters = { inertia = 2 }')
    assert built.parameters.names == []
    assert built.controller is None
    assert built.disturbance is None
    assert built.hold == "zero_order"
    np.testing.assert_array_equal(built.gain, [1.0])
    assert float(built.plant.gravity) == 9.81


def test_period_of_a_controller_without_its_own(tmp_path):
    text = CASE.replace("period = 0.001\n", "")
    with pytest.raises(InputError, match=r"\[controller\]: .*period is not known; add period"):
        machine(tmp_path, text)
    assert machine(tmp_path, text, period=0.002).controller.period == 0.002
    sampled = text.replace('time = "t"', "sample_rate = 250.0")
    assert machine(tmp_path, sampled).controller.period == 0.004
    simulated = text + "sample_rate = 500.0\n"
    assert machine(tmp_path, simulated).controller.period == 0.002


class Pair(Plant):
    """Two masses that do not touch."""

    kind = "pair"
    joints: ClassVar[int] = 2
    mass: Array = parameter("inertia", "positive", "masses")

    def inertial(self, q, qd, qdd):
        return self.mass * qdd


def pair(parameters: str, effects: str = "", rest: str = "") -> str:
    return f'[plant]\nkind = "pair"\n[plant.parameters]\n{parameters}\n{effects}\n{rest}'


@pytest.fixture
def _pair(monkeypatch):
    monkeypatch.setitem(PLANTS, "pair", Pair)


@pytest.mark.usefixtures("_pair")
def test_names_on_several_joints(tmp_path):
    effects = """[[effects]]
kind = "coulomb_friction"
level = { guess = 3.0 }
[[effects]]
kind = "viscous_friction"
coefficient = [1.0, { guess = 2.0 }]
[[effects]]
kind = "viscous_friction"
joint = 2
coefficient = { guess = 4.0 }
"""
    built = machine(tmp_path, pair("mass = [2.0, { guess = 2.5 }]", effects))
    assert built.parameters.names == [
        "mass[2]",
        "coulomb_friction[1].level",
        "coulomb_friction[2].level",
        "viscous_friction[2].coefficient",
        "viscous_friction[2]#2.coefficient",
    ]
    assert [e.port for e in built.plant.effects] == [0, 1, 0, 1, 1]
    moved = built.parameters.insert(built.plant, jnp.asarray([9.0, 5.0, 6.0, 7.0, 8.0]))
    np.testing.assert_array_equal(moved.mass, [2.0, 9.0])
    assert float(moved.effects[1].level) == 6.0


@pytest.mark.usefixtures("_pair")
def test_gains_by_joint(tmp_path):
    built = machine(tmp_path, pair("mass = [1, 2]", rest="[actuator]\ngain = [3.0, -4.0]"))
    np.testing.assert_array_equal(built.gain, [3.0, -4.0])
    one = machine(tmp_path, pair("mass = [1, 2]", rest="[actuator]\ngain = 3.0"))
    np.testing.assert_array_equal(one.gain, [3.0, 3.0])


@pytest.mark.usefixtures("_pair")
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("gain = [1.0]", r"gain .*1 entry; give 2 values"),
        ("gain = [1.0, 0.0]", r"gain\[2\] = 0.0 is zero"),
        ("transmission = [[1.0, 0.0], [2.0, 0.0]]", "invertible"),
        ("transmission = [[1.0, 0.0], [0.0, 1.0]]", "goes with a measured log"),
    ],
)
def test_actuators_of_several_joints(tmp_path, line, words):
    with pytest.raises(InputError, match=words):
        machine(tmp_path, pair("mass = [1, 2]", rest=f"[actuator]\n{line}"))


def test_disturbance_starts_one_tick_late():
    t = np.round(np.arange(3000) * 1e-3, 3)
    d = disturbance_at(PULSES, t)
    assert d.shape == (3000, 1)
    # measured on a real log: start 0.343 s, 1 ms ticks, the first disturbed one is at 0.344 s
    edges = np.flatnonzero(np.diff(d[:, 0])) + 1
    np.testing.assert_array_equal(edges, [344, 844, 1344, 1844, 2344, 2844])
    assert set(d[:, 0]) == {0.0, 5.07}


@pytest.mark.parametrize("jitter", [-2e-8, 2e-8])
def test_jitter_of_time_stamps_moves_no_edge(jitter):
    t = np.arange(30000) * 1e-3
    np.testing.assert_array_equal(disturbance_at(PULSES, t + jitter), disturbance_at(PULSES, t))
    random = np.random.default_rng(0).uniform(-2e-8, 2e-8, t.size)
    np.testing.assert_array_equal(disturbance_at(PULSES, t + random), disturbance_at(PULSES, t))


def test_edges_do_not_drift_over_a_long_log():
    # 0.1 + 0.2 is not 0.3: the rounding of 1e4 cycles must not reach a tick
    wave = Disturbance(level=1.0, on=0.1, off=0.2)
    ticks = np.arange(300_000)
    on = disturbance_at(wave, ticks * 0.01)[:, 0]
    np.testing.assert_array_equal(on, ((ticks - 1) % 30 < 10) & (ticks > 0))


def test_disturbance_without_pause_is_a_step():
    d = disturbance_at(Disturbance(level=2.0, on=1.0, off=0.0, start=1.0), np.arange(5.0))
    np.testing.assert_array_equal(d[:, 0], [0.0, 0.0, 2.0, 2.0, 2.0])


def test_no_disturbance():
    np.testing.assert_array_equal(disturbance_at(None, np.arange(3.0)), np.zeros((3, 1)))


def test_disturbance_from_a_column_is_held(tmp_path):
    rows = "\n".join(f"{0.1 * k},{k}.0" for k in range(10))
    (tmp_path / "log.csv").write_text("t,d\n" + rows)
    t = 0.1 * np.arange(2, 10)
    log = Log(t, np.zeros(8), np.zeros(8), rows=(2, 10), source=str(tmp_path / "log.csv"))
    np.testing.assert_array_equal(disturbance_at("d", t, log)[:, 0], np.arange(2.0, 10.0))
    twice = 0.2 + 0.05 * np.arange(4)
    np.testing.assert_array_equal(disturbance_at("d", twice, log)[:, 0], [2.0, 2.0, 3.0, 3.0])
    with pytest.raises(InputError, match="needs a log"):
        disturbance_at("d", t)
    with pytest.raises(InputError, match="'e'"):
        disturbance_at("e", t, log)


@pytest.mark.parametrize(
    ("period", "bounds"),
    [
        ({"guess": 0.0873}, (0.0582, 0.13095)),
        ({"guess": 0.0873, "true": 0.4}, (0.0582, 0.6)),
        ({"guess": 0.0873, "max": 0.5}, (8.73e-11, 0.5)),
    ],
)
def test_a_period_stays_near_its_guess_unless_it_has_bounds(period, bounds):
    effect = {"kind": "cogging", "amplitude": {"guess": 1.0}, "period": period, "phase": {"guess": 0.0}}
    case = {"plant": {"kind": "axis", "parameters": {"inertia": 1.0}}, "effects": [effect]}
    parameters = build_machine(load_case(case)).parameters
    at = parameters.names.index("cogging.period")
    assert [b[at] for b in parameters.bounds] == pytest.approx(bounds)


@pytest.mark.parametrize(
    ("tables", "logged", "expected"),
    [
        ({}, 0.0200604, 0.00200604),  # ten steps of 2 ms, as a drive's own clock has them
        ({}, 0.02, 0.002),
        ({}, 0.0005, 0.0005),
        ({}, None, 0.002),
        ({"controller": {"period": 0.002}}, 0.0200604, 0.002),
    ],
)
def test_servos_of_a_file_run_in_step_with_the_log(tables, logged, expected):
    case = SimpleNamespace(controller=SimpleNamespace(period=0.002), tables=tables)
    assert _loop_period(case, logged) == pytest.approx(expected, rel=1e-12)
