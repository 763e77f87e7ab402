"""Noise of the force, estimated: exact where the log is exact, and within a few percent of the truth."""

import dataclasses
import tomllib

import numpy as np
import pytest

import jaxid
from jaxid.consistency.balance_fit import balance_fits
from jaxid.gap import noise_floor
from jaxid.session import Session, open_session
from truth.axis.cases import case_text
from truth.axis.machines import Setup, moves
from truth.axis.stepper import Loop, Machine, Sensor
from truth.chain.flexible_joints import GUESS, flexible_joint
from truth.chain.flexible_joints import case as flexible_case

# A ball screw as in a trace of a drive: 180 kg, 226.19 N/A, 1 um, 1 kHz, 30 mA of noise on the current.
SECONDS, RATE, NOISE = 8.0, 1000.0, 0.03
TIME = np.arange(round(RATE * SECONDS)) / RATE
EFFECTS = {"viscous_friction": {"coefficient": 400.0}, "coulomb_friction": {"level": 60.0}}
MACHINE = Machine(inertia=180.0, actuator_gain=226.19, effects=EFFECTS)
REFERENCE = moves(TIME, [0.0, 0.1, 0.02, 0.3, 0.2], [0.1, 0.3, 0.2, 0.4, 0.05], 2.0, rest=0.15)
LOOPS = {
    "cascade_pd": Loop(
        kind="cascade_pd", kp=40.0, kv=60.0, velocity_average=2, limit=20.0, reference=REFERENCE
    ),
    "pid": Loop(
        kind="pid", kp=600.0, ki=800.0, kd=40.0, derivative_filter=2e-3, limit=20.0, reference=REFERENCE
    ),
}


def setup(loop: str = "cascade_pd", noise: float = NOISE) -> Setup:
    sensor = Sensor(position_resolution=1e-6, force_noise=noise)
    return Setup(MACHINE, LOOPS[loop], sensor, RATE, SECONDS, 1)


def opened(of: Setup, *, closed: bool = False, sensor: str = "", every: int = 1, **changes) -> Session:
    run = of.run()
    names = {"t": "t", "q": "position", "u": "force", "ref": "reference"}
    log = {column: run[name][::every] for column, name in names.items()}
    text = case_text(of, tuple(EFFECTS.items()), sensor=False, closed=closed)
    text = text.replace("[log]", '[log]\nhold = "zero_order"')
    return open_session(tomllib.loads(text + sensor), {**log, **changes})


def floor(session: Session, force_noise: float | None = None) -> float:
    """The noise floor as it is printed, or with the true noise of the force."""
    machine = session.machine
    if force_noise is not None:
        sensor = dataclasses.replace(machine.sensor, force_noise=np.asarray(force_noise))
        machine = dataclasses.replace(machine, sensor=sensor)
    return float(noise_floor(machine, session.fit.log, session.fit.data)[0])


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("loop", LOOPS)
def test_floor_of_a_noisy_current_is_near_the_truth(loop, closed):
    session = opened(setup(loop), closed=closed)
    assert floor(session) == pytest.approx(floor(session, NOISE), rel=0.05)
    assert floor(session) > 5 * floor(session, 0.0), "the noise of the force dominates this floor"


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("loop", LOOPS)
def test_a_rough_command_that_is_logged_exactly_has_no_noise(loop, closed):
    session = opened(setup(loop, 0.0), closed=closed)
    assert floor(session) == pytest.approx(floor(session, 0.0), rel=0.02)


def test_one_sample_in_ten_of_the_loop_is_enough():
    session = opened(setup(), every=10)
    assert floor(session) == pytest.approx(floor(session, NOISE), rel=0.2)


@pytest.mark.parametrize("seed", [1, 5])
def test_guesses_far_off_hide_no_noise(seed):
    """At guesses of inertia and stiffness the readings alone seemed to make more noise than there is."""
    joint = flexible_joint(seed)
    assert GUESS["load_inertia"] > 1.2 * joint.true["load_inertia"]
    session = open_session(flexible_case(), joint.log(1000.0, 6.0))
    assert session.fit.data.force_noise == pytest.approx([0.01], rel=0.1)


@pytest.mark.parametrize("every", [4, 10])
def test_what_a_faster_loop_makes_of_its_readings_is_noise_in_its_log(every):
    """The rows show one tick of several; the floor is then what a complete model leaves."""
    encoder = Sensor(position_resolution=1e-5, position_noise=5e-6, force_noise=0.1 * NOISE)
    session = opened(dataclasses.replace(setup(), sensor=encoder), every=every)
    machine, data = session.machine, session.fit.data
    left = balance_fits(machine, data)[0].fit(bounded=False)[1][data.fitted]
    assert floor(session) == pytest.approx(np.std(left), rel=0.15)
    assert floor(session) > 1.2 * floor(session, 0.1 * NOISE)


def test_a_random_command_is_no_noise():
    rough = 3.0 * np.random.default_rng(0).standard_normal(TIME.size) + 2.0 * np.sin(5 * TIME)
    of = dataclasses.replace(setup(noise=0.0), loop=Loop(input=rough))
    session = opened(of, ref=np.zeros(TIME.size))
    assert session.fit.data.force_noise < 0.03 * 3.0


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_steps_of_a_command_are_no_noise(noise):
    """Their edges are in every band, and their level is right between them."""
    levels = np.random.default_rng(4).uniform(-1.5, 1.5, round(SECONDS / 0.25))
    steps = np.repeat(levels, round(0.25 * RATE))
    of = dataclasses.replace(setup(noise=noise), loop=Loop(kind="open_loop", input=steps))
    session = opened(of)
    assert floor(session) == pytest.approx(floor(session, noise), rel=0.1)


def test_a_quantised_command_has_the_noise_of_its_steps():
    of = setup(noise=0.0)
    exact = of.run()["force"]
    session = opened(of, u=0.05 * np.round(exact / 0.05))
    assert session.fit.data.force_noise == pytest.approx(0.05 / np.sqrt(12), rel=0.25)


def test_stated_noise_that_the_log_contradicts_is_named():
    def told(sensor: str) -> list[str]:
        return [f.what for f in opened(setup(), sensor=f"[sensor]\n{sensor}\n").findings]

    assert told(f"force_noise = {NOISE}\nposition_resolution = 1e-6") == []
    (more,) = told("force_noise = 0.005")
    assert more == "force_noise = 0.005 is stated, and the log has about 0.029"
    (less,) = told("force_noise = 0.3")
    assert less == "force_noise = 0.3 is stated, and the log has at most 0.029"
    (coarse,) = told("position_resolution = 1e-5")
    assert "readings lie on steps of 1e-06" in coarse
    (noisy,) = told("position_noise = 1e-5")
    assert noisy.startswith("position_noise = 1e-05 is stated")
    (fine,) = told("position_noise = 1e-8")
    assert fine.startswith("position_noise = 1e-08 is stated, and the readings lie on steps of 1e-06")
    # The bound for the force is that of the log, whatever is stated of the position.
    of_force, _ = told("force_noise = 0.3\nposition_noise = 1e-3")
    bound = float(of_force.removeprefix("force_noise = 0.3 is stated, and the log has at most "))
    assert NOISE < 1.1 * bound < 1.3 * NOISE


def test_a_wrong_noise_of_the_position_does_not_change_that_of_the_force():
    session = opened(setup(), sensor="[sensor]\nposition_noise = 1e-3\n")
    assert session.fit.data.force_noise == pytest.approx(NOISE, rel=0.1)


def test_check_gives_the_noise_with_its_source():
    of = setup()
    run = of.run()
    log = {"t": run["t"], "q": run["position"], "u": run["force"]}
    text = case_text(of, tuple(EFFECTS.items()), sensor=False, closed=False)
    found = jaxid.check(tomllib.loads(text + "[sensor]\nposition_resolution = 1e-6\n"), log)
    content = found.json()["log"]
    assert content["noise_from"] == {"position": "stated", "force": "estimated"}
    assert content["force_noise"] == pytest.approx(NOISE, rel=0.05)
    assert content["position_noise"] == pytest.approx(1e-6 / np.sqrt(12))
    assert "force 0.029" in str(found)
    assert "in units of the log (estimated)" in str(found)
