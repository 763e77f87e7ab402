"""Gains and transport delay of a loop, identified from logs of the exact stepper."""

import tomllib

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.errors import InputError
from jaxid.numerics.delays import shifted
from truth.axis.machines import Setup, moves, multisine
from truth.axis.stepper import Loop, Machine, Sensor

RATE, SECONDS = 1000.0, 6.0
TIME = np.arange(round(RATE * SECONDS)) / RATE
TRUE = {"controller.kp": 2.0, "controller.kd": 0.05, "coulomb_friction.level": 0.03}
CASE = """
[plant]
kind = "axis"
motion = "rotary"
[plant.parameters]
inertia = 2e-3
[[effects]]
kind = "viscous_friction"
coefficient = 4e-3
[[effects]]
kind = "coulomb_friction"
level = { guess = 0.01 }
[controller]
kind = "pd"
kp = { guess = 6.0 }
kd = { guess = 0.02 }
delay = { guess = 0.008 }
period = 0.001
[log]
time = "t"
position = "q"
force = "u"
reference = "r"
"""


def log(delay: float = 0.02, seed: int = 0) -> dict[str, np.ndarray]:
    """A servo of 4096 counts whose reference reaches its loop so much later [s]."""
    asked = moves(TIME, [0.0, 0.6, -0.4, 0.9], [2.0, 4.0, 1.0, 3.0], 40.0, rest=0.2)
    asked += multisine(TIME, [0.7, 1.9, 3.1], 0.15, seed)
    ticks = round(delay * RATE)
    reached = np.concatenate([np.full(ticks, asked[0]), asked])[: TIME.size]
    friction = {"viscous_friction": {"coefficient": 4e-3}, "coulomb_friction": {"level": 0.03}}
    loop = Loop(kind="pd", kp=2.0, kd=0.05, limit=np.inf, reference=reached)
    sensor = Sensor(position_resolution=2 * np.pi / 4096, position_noise=2e-4)
    run = Setup(Machine(inertia=2e-3, effects=friction), loop, sensor, RATE, SECONDS, seed).run()
    return {"t": run["t"], "q": run["position"], "u": run["force"], "r": asked}


def test_gains_and_delay_are_found_from_guesses_three_times_off():
    result = jaxid.identify(tomllib.loads(CASE), log())
    assert result.estimate.converged
    assert result.estimate.method == "output_error"
    for name, true in {**TRUE, "controller.delay": 0.02}.items():
        found = result.parameters[name]
        assert abs(found.value - true) < 4 * found.std, name
        assert found.std < 0.01 * true, name


def test_a_fit_passes_its_gains_on_to_the_case():
    found = jaxid.identify(tomllib.loads(CASE), log()).case()
    assert found.controller is not None
    assert found.controller.unknown["kp"].guess == pytest.approx(2.0, rel=0.01)
    assert found.controller.law["delay"] == pytest.approx(0.02, rel=0.02)


def test_a_delay_between_two_ticks_is_a_line_between_them():
    signal = jnp.asarray([[0.0], [1.0], [4.0], [9.0]])
    assert shifted(signal, jnp.asarray(1.25))[:, 0].tolist() == [0.0, 0.0, 0.75, 3.25]
    assert shifted(signal, jnp.asarray(0.0)).tolist() == signal.tolist()


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("kp = { guess = 6.0 }", "kp = { guess = -6.0 }", "kp"),
        ("delay = { guess = 0.008 }", "delay = -0.01", "delay"),
        ("period = 0.001", "period = { guess = 0.001 }", "period"),
        ('kind = "pd"', 'kind = "adaptive"', "kp"),
    ],
)
def test_unsound_unknowns_are_refused(old, new, what):
    with pytest.raises(InputError, match=what):
        jaxid.load_case(tomllib.loads(CASE.replace(old, new)))


FED = {"coulomb": 0.02, "viscous": 2e-3, "inertia": 1.5e-3}
# What the law adds for viscous friction is known, as are inertia and viscous friction of the machine.
GUESSED = {"coulomb": {"guess": 0.05}, "viscous": FED["viscous"], "inertia": {"guess": 5e-4}}


def fed_forward(seed: int = 0) -> dict[str, np.ndarray]:
    """Return a log without a force of a servo that feeds inertia and friction forward."""
    asked = moves(TIME, [0.0, 0.6, -0.4, 0.9], [2.0, 4.0, 1.0, 3.0], 40.0, rest=0.2)
    asked += multisine(TIME, [0.7, 1.9, 3.1], 0.15, seed)
    reached = np.concatenate([np.full(20, asked[0]), asked])[: TIME.size]
    friction = {"viscous_friction": {"coefficient": 4e-3}, "coulomb_friction": {"level": 0.03}}
    gains = {"kp": 2.0, "kd": 0.05, "velocity_average": 8}
    loop = Loop(kind="friction_compensation", limit=np.inf, reference=reached, **gains, **FED)
    sensor = Sensor(position_resolution=2 * np.pi / 4096, position_noise=2e-4)
    run = Setup(Machine(inertia=2e-3, effects=friction), loop, sensor, RATE, SECONDS, seed).run()
    return {"t": run["t"], "q": run["position"], "r": asked}


@pytest.mark.parametrize(
    ("kind", "fed", "unknown"),
    [
        ("friction_compensation", GUESSED, {"kp", "kd", "delay", "coulomb", "inertia"}),
        ("computed_torque", {}, {"kp", "kd", "delay"}),
    ],
)
def test_laws_that_feed_a_model_forward_may_have_unknown_gains(kind, fed, unknown):
    case = tomllib.loads(CASE)
    case["controller"] |= {"kind": kind, **fed}
    controller = jaxid.load_case(case).controller
    assert controller is not None
    assert controller.unknown.keys() == unknown


@pytest.mark.slow
def test_values_that_a_law_feeds_forward_are_found_without_a_force():
    case = tomllib.loads(CASE)
    del case["log"]["force"]
    case["controller"] |= {"kind": "friction_compensation", "velocity_average": 8, **GUESSED}
    result = jaxid.identify(case, fed_forward())
    assert result.estimate.converged
    true = TRUE | {"controller.delay": 0.02, "controller.coulomb": 0.02, "controller.inertia": 1.5e-3}
    assert set(result.parameters) == set(true)
    for name, value in true.items():
        found = result.parameters[name]
        assert abs(found.value - value) < 4 * found.std, name
        assert found.std < 0.03 * value, name


def computed_torque(known_inertia: float) -> dict[str, np.ndarray]:
    """Return a log without a force of a servo that feeds forward the force for an inertia.

    The force is a PD law of a reference with more added to it, so that the stepper needs no such law.
    """
    asked = moves(TIME, [0.0, 0.6, -0.4, 0.9], [2.0, 4.0, 1.0, 3.0], 40.0, rest=0.2)
    asked += multisine(TIME, [0.7, 1.9, 3.1], 0.15, 0)
    curvature = np.diff(np.pad(asked, 1, mode="reflect", reflect_type="odd"), 2) * RATE**2
    kp, slope = 2.0, 0.05 * RATE
    added = np.zeros_like(asked)
    for k in range(asked.size):
        added[k] = (known_inertia * curvature[k] + slope * added[k - 1]) / (kp + slope)
    friction = {"viscous_friction": {"coefficient": 4e-3}, "coulomb_friction": {"level": 0.03}}
    loop = Loop(kind="pd", kp=kp, kd=0.05, limit=np.inf, reference=asked + added)
    sensor = Sensor(position_resolution=2 * np.pi / 4096, position_noise=2e-4)
    run = Setup(Machine(inertia=2e-3, effects=friction), loop, sensor, RATE, SECONDS, 0).run()
    return {"t": run["t"], "q": run["position"], "r": asked}


@pytest.mark.slow
def test_a_force_that_the_law_computes_gives_the_scale():
    case = tomllib.loads(CASE)
    del case["log"]["force"], case["controller"]["delay"]
    # The law knows this guess; the true inertia is 2e-3.
    case["plant"]["parameters"]["inertia"] = {"guess": 1.5e-3}
    case["controller"]["kind"] = "computed_torque"
    result = jaxid.identify(case, computed_torque(1.5e-3))
    assert result.estimate.converged
    assert any("the law computes forces with the guesses" in note for note in result.estimate.notes)
    for name, value in (TRUE | {"inertia": 2e-3}).items():
        found = result.parameters[name]
        assert abs(found.value - value) < 4 * found.std, name
        assert found.std < 0.01 * value, name


def test_a_method_that_does_not_simulate_refuses_unknown_gains():
    with pytest.raises(InputError, match=r"controller\.kp, controller\.kd, controller\.delay are unknown"):
        jaxid.identify(tomllib.loads(CASE), log(), method="inverse_dynamics")
