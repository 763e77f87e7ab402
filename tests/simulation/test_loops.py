"""Trajectories: the scan against diffrax, controllers against plain Python, delay and rounding."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.controllers.linear import CascadePD
from jaxid.effects import EFFECTS
from jaxid.model.smoothing import Smoothing
from jaxid.model.unknowns import scatter
from jaxid.numerics.delays import shifted_hold
from jaxid.plants import Axis
from jaxid.sensors.encoder import Sensor
from jaxid.session import open_session
from jaxid.simulation.loops import (
    Drive,
    closed_loop,
    interval_forces,
    needed_substeps,
    open_loop,
    with_diffrax,
)
from jaxid.simulation.replay import exact_numerics, make_replay
from tests.support.axis_log import log_of
from truth.axis.cases import case_text, write_case
from truth.axis.machines import Setup, emps_like, multisine
from truth.axis.stepper import Loop
from truth.axis.stepper import Sensor as TrueSensor

MASS, PERIOD, SAMPLES = 2.0, 1e-2, 60
TIMES = PERIOD * np.arange(SAMPLES)
COMMAND = 6.0 * np.sin(9.0 * TIMES) + 4.0 * np.cos(31.0 * TIMES)
START = (jnp.asarray([0.05]), jnp.asarray([-0.4]))

SMOOTH = {
    "springs": {
        "cubic_stiffness": {"coefficient": 3e3},
        "cogging": {"amplitude": 2.0, "period": 0.2, "phase": 0.3},
        "viscous_friction": {"coefficient": 3.0},
    },
    "memory": {
        "actuator_lag": {"time_constant": 0.03},
        "hysteresis": {"stiffness": 200.0, "level": 3.0},
    },
    "smoothed sign": {
        "coulomb_friction": {"level": 1.5},
        "stribeck_friction": {"level": 1.0, "velocity": 0.5},
    },
}


def smooth_plant(case: str) -> Axis:
    effects = tuple(EFFECTS[kind](**values) for kind, values in SMOOTH[case].items())
    return Axis(MASS, effects=effects, smoothing=Smoothing(0.3))


def forces(hold: str):
    """The command as a function of time, between its samples as the hold says."""
    times, command = jnp.asarray(TIMES), jnp.asarray(COMMAND)[:, None]
    if hold == "linear":
        return diffrax.LinearInterpolation(times, command).evaluate
    # side="right": at a sample its own command acts; diffrax looks just before a jump too
    return lambda t: command[jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0)]


@eqx.filter_jit
def by_scan(plant, substeps, hold):
    drive = Drive(jnp.ones(1), PERIOD, hold, substeps)
    out = open_loop(plant, drive, jnp.asarray(COMMAND)[:, None], *START)
    return out.position, out.velocity


@eqx.filter_jit
def by_diffrax(plant, hold, step_length=None):
    times = jnp.asarray(TIMES)
    adaptive = diffrax.ClipStepSizeController(
        diffrax.PIDController(rtol=1e-11, atol=1e-12), jump_ts=times[1:-1]
    )
    return with_diffrax(
        plant,
        forces(hold),
        times,
        *START,
        solver=diffrax.Dopri8(),
        controller=adaptive if step_length is None else None,
        step_length=step_length,
    )


@pytest.mark.parametrize(
    ("case", "hold"),
    [("springs", "zero_order"), ("memory", "linear"), ("smoothed sign", "zero_order")],
)
def test_scan_agrees_with_diffrax(case, hold):
    plant = smooth_plant(case)
    for ours, theirs in zip(by_scan(plant, 16, hold), by_diffrax(plant, hold), strict=True):
        # rates of 30 / s at steps of 0.6 ms: (w h)^4 / 120 = 1e-9 relative
        scale = np.abs(np.asarray(theirs)).max()
        np.testing.assert_allclose(np.asarray(ours), np.asarray(theirs), atol=1e-8 * scale)


def test_fixed_steps_of_diffrax_agree_with_adaptive_ones():
    plant = smooth_plant("memory")
    fixed, adaptive = by_diffrax(plant, "linear", PERIOD / 8), by_diffrax(plant, "linear")
    for a, b in zip(fixed, adaptive, strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=1e-8)


def test_a_continuous_hold_is_another_model():
    """What would go wrong if the hold were ignored: a thousand times the tolerance above."""
    plant = smooth_plant("springs")
    held, linear = by_scan(plant, 16, "zero_order")[0], by_scan(plant, 16, "linear")[0]
    assert np.abs(np.asarray(held - linear)).max() > 1e-5 * np.abs(np.asarray(held)).max()


DELAY = 2.3 * PERIOD


def delayed_forces(hold: str):
    plant = Axis(MASS, effects=(EFFECTS["input_delay"](delay=DELAY),))
    drive = Drive(jnp.asarray([3.0]), PERIOD, hold)
    both = interval_forces(plant, drive, jnp.asarray(COMMAND)[:, None])
    return [np.asarray(x)[4:, 0] for x in both]


def test_held_and_delayed_force_has_mean_and_moment_of_each_interval():
    """A mass then moves as under the two values that act in turn."""
    start, end = delayed_forces("zero_order")
    late = PERIOD * (np.arange(SAMPLES * 1000) + 0.5) / 1000 - DELAY
    held = COMMAND[np.clip(np.floor(late / PERIOD).astype(int), 0, None)]
    acting = 3.0 * held.reshape(SAMPLES, 1000)[4:]
    np.testing.assert_allclose(0.5 * (start + end), acting.mean(axis=1), atol=1e-12)
    moment = acting @ ((np.arange(1000) + 0.5) / 1000 - 0.5) / 1000
    # Of a line from start to end: a twelfth of its rise. The sum over a thousand parts is off by 1e-6 of it.
    np.testing.assert_allclose((end - start) / 12, moment, atol=1e-5 * np.abs(moment).max())


def test_a_delay_of_whole_samples_leaves_the_command_held():
    signal = jnp.asarray(COMMAND)[:, None]
    start, end = shifted_hold(signal, jnp.asarray(2.0))
    np.testing.assert_array_equal(np.asarray(start)[2:], COMMAND[:-2, None])
    np.testing.assert_array_equal(end, start)


def test_ramped_and_delayed_force_is_right_at_the_samples():
    start, end = delayed_forces("linear")
    np.testing.assert_allclose(start, 3 * np.interp(TIMES - DELAY, TIMES, COMMAND)[4:], atol=1e-12)
    np.testing.assert_allclose(end[:-1], start[1:], atol=1e-12)


@pytest.mark.parametrize("closed", [False, True])
def test_gradient_in_the_delay_is_there(closed):
    plant = Axis(MASS, effects=(EFFECTS["input_delay"](delay=0.0),))
    drive = Drive(jnp.ones(1), PERIOD, longest_delay=4)

    @jax.jit
    def end(delay):
        moved = scatter(((("effects", 0, "delay"), None),), plant, delay[None])
        if not closed:
            return open_loop(moved, drive, jnp.asarray(COMMAND)[:, None], *START).position[-1, 0]
        law = CascadePD(jnp.asarray([4.0]), jnp.asarray([10.0]), period=PERIOD)
        reference = jnp.asarray(0.01 * COMMAND)[:, None]
        zero = jnp.zeros((SAMPLES, 1))
        return closed_loop(moved, drive, law, reference, zero, *START).position[-1, 0]

    slope, step = jax.jit(jax.grad(end)), 1e-6
    for delay in (0.4 * PERIOD, 2.3 * PERIOD):
        difference = (end(delay + step) - end(delay - step)) / (2 * step)
        assert abs(difference) > 1e-3  # m/s: it acts
        assert float(slope(jnp.asarray(delay))) == pytest.approx(float(difference), rel=1e-6)


# F h / (m width) = 3 * 1e-2 / (2 * 1e-3) = 15: RK4 leaves its stability at 2.8.
STIFF = Axis(MASS, effects=(EFFECTS["coulomb_friction"](level=3.0),), smoothing=Smoothing(1e-3))


@pytest.mark.parametrize("seen", ["at rest", "passing through rest between samples"])
def test_needed_substeps_counts_the_smoothed_sign(seen):
    v = {"at rest": [0.3, 0.0], "passing through rest between samples": [0.3, -0.3]}[seen]
    zero = jnp.zeros((2, 1))
    drive = Drive(jnp.ones(1), PERIOD)
    assert needed_substeps(STIFF, drive, zero, jnp.asarray(v)[:, None], zero) == 15


def test_too_coarse_a_step_has_a_garbage_gradient_and_is_flagged():
    """The trajectory looks plausible; only the count of substeps tells."""
    sharp = STIFF.smoothed(jnp.asarray(2e-4))
    zero = jnp.zeros((1, 1))
    needed = needed_substeps(sharp, Drive(jnp.ones(1), PERIOD), zero, zero, zero)
    assert needed == 75
    command = jnp.asarray(8.0 * np.sin(9.0 * TIMES))[:, None]

    def position(level, substeps):
        moved = scatter(((("effects", 0, "level"), None),), sharp, level[None])
        drive = Drive(jnp.ones(1), PERIOD, substeps=substeps)
        return open_loop(moved, drive, command, *START).position[:, 0]

    def with_slope(substeps):
        one = jnp.ones(())
        return jax.jit(lambda x: jax.jvp(lambda x: position(x, substeps), (x,), (one,)))

    coarse, fine = with_slope(1), with_slope(needed)
    level = jnp.asarray(3.0)
    (rough, garbage), (q, slope) = coarse(level), fine(level)
    secant = (fine(level + 0.05)[0] - fine(level - 0.05)[0]) / 0.1
    size = np.linalg.norm(np.asarray(secant))
    assert np.abs(np.asarray(rough - q)).max() < 0.05 * np.ptp(np.asarray(q))
    # the secant over 3 % of the level is curved and smooth to a few percent
    assert np.linalg.norm(np.asarray(slope - secant)) < 0.05 * size
    assert np.linalg.norm(np.asarray(garbage - secant)) > 2 * size


def test_rounded_reading_has_the_gradient_of_the_position():
    sensor = Sensor(position_resolution=jnp.asarray(0.01))
    q = jnp.asarray([0.0123, -0.0449])
    np.testing.assert_allclose(np.asarray(sensor.read(q)), [0.01, -0.04], atol=1e-15)
    np.testing.assert_array_equal(np.asarray(jax.jacfwd(sensor.read)(q)), np.eye(2))


def test_restarts_put_the_run_back_on_the_given_motion():
    plant, drive = Axis(MASS), Drive(jnp.ones(1), PERIOD)
    flags = np.arange(SAMPLES) % 20 == 0
    q, v = np.full((SAMPLES, 1), 0.3), np.full((SAMPLES, 1), -1.0)
    reset = tuple(jnp.asarray(x) for x in (flags, q, v))
    out = open_loop(plant, drive, jnp.zeros((SAMPLES, 1)), *START, None, reset)
    expected = 0.3 - PERIOD * (np.arange(SAMPLES) % 20)
    np.testing.assert_allclose(np.asarray(out.position)[:, 0], expected, atol=1e-14)


def test_rounding_that_noise_dithers_is_read_as_its_mean():
    counts, q = jnp.asarray(1e-3), jnp.linspace(0.0, 0.01, 7)[:, None]
    loud = Sensor(position_resolution=counts, position_noise=0.5 * counts)
    quiet = Sensor(position_resolution=counts, position_noise=0.2 * counts)
    np.testing.assert_array_equal(loud.mean.read(q), q)
    np.testing.assert_array_equal(quiet.mean.read(q), quiet.read(q))
    assert Sensor(position_resolution=counts).mean.position_resolution is not None
    # What it leaves out is noise like any other: what half a count of noise and rounding leave on average.
    noise = np.random.default_rng(0).standard_normal((200_000, 1))
    for at in (0.0, 0.3e-3, 0.5e-3):
        readings = loud.read(jnp.full((200_000, 1), at), jnp.asarray(noise))
        assert float(jnp.mean(readings)) == pytest.approx(at, abs=1e-2 * 1e-3)
        assert float(jnp.std(readings)) == pytest.approx(float(loud.position_std), rel=0.03)


@pytest.mark.parametrize("delay", [0.0, 2.37e-3, 3e-3])
def test_friction_turns_where_a_delayed_command_does(delay):
    """A line with the mean and moment of the two values turned it elsewhere: 1.7e-6 m away in the end."""
    t = np.arange(600) / 1000.0
    force = multisine(t, [3.1, 7.9, 13.3], 4.0, 0)
    machine = emps_like().machine
    machine = dataclasses.replace(machine, effects={**machine.effects, "input_delay": {"delay": delay}})
    law = Loop(kind="open_loop", input=force)
    run = Setup(machine, law, TrueSensor(), rate=1000.0, duration=0.6, seed=0).run()

    effects = [EFFECTS[kind](**values) for kind, values in machine.effects.items()]
    plant = Axis(jnp.asarray(machine.inertia), effects=tuple(effects))
    drive = Drive(jnp.asarray([machine.actuator_gain]), 1e-3, set_valued=True)
    command = jnp.asarray(run["true_command"])[:, None]
    ours = open_loop(plant, drive, command, jnp.zeros(1), jnp.zeros(1))
    np.testing.assert_allclose(ours.position[:, 0], run["true_position"], atol=1e-8)
    assert np.ptp(run["true_position"]) > 1e-3


def test_friction_turns_where_a_delayed_command_does_in_a_loop(tmp_path):
    """A line for the two values of an interval left 2.4e-7 m, 500 times as much."""
    setup = emps_like(0, 0.0, 4.0)
    machine = setup.machine.with_effect("input_delay", delay=2.37e-3)
    setup = dataclasses.replace(setup, machine=machine, sensor=TrueSensor())
    text = case_text(setup, [*machine.effects.items()], off=1.0, sensor=False)
    session = open_session(write_case(tmp_path, text), log_of(setup))

    log, ours = session.fit.log, session.machine
    replay = make_replay(ours, log, exact_numerics(ours, log, 1))
    run = setup.run()
    np.testing.assert_allclose(replay(ours.plant).position[:, 0], run["true_position"], atol=2e-9)
    assert np.ptp(run["true_position"]) > 0.1
