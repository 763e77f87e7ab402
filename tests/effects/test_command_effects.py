"""Effects on the command and on the error of a controller, and friction by load, by other integrations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import jaxid
from jaxid.controllers import CONTROLLERS, with_effects
from jaxid.controllers.base import Tick
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.numerics.delays import accelerated, slewed
from jaxid.numerics.smooth import outside
from jaxid.plants import Axis
from truth.axis.stepper import Loop, Machine, Sensor, profile, reached, simulate

PERIOD = 1e-3
AS_EFFECT = {"command_delay": ("delay", 0.0123), "dead_band": ("width", 0.02)}
AS_KEY = {"command_delay": "delay", "dead_band": "dead_band"}


def servo(effects=(), **controller) -> dict:
    return {
        "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": 2e-3}},
        "effects": [{"kind": "coulomb_friction", "level": 0.03}, *effects],
        "controller": {"kind": "pd", "kp": 2.0, "kd": 0.05, "period": PERIOD, **controller},
        "reference": {"kind": "trapezoid", "targets": [0.6, -0.4], "speed": 3.0, "acceleration": 40.0},
        "simulation": {"duration": 1.0, "sample_rate": 1000.0},
    }


@pytest.mark.parametrize("kind", AS_EFFECT)
def test_an_effect_is_the_key_of_the_controller(kind):
    name, value = AS_EFFECT[kind]
    effect = jaxid.simulate(servo([{"kind": kind, name: value}])).log.position
    key = jaxid.simulate(servo(**{AS_KEY[kind]: value})).log.position
    without = jaxid.simulate(servo()).log.position
    np.testing.assert_array_equal(effect, key)
    assert np.abs(effect - without).max() > 1e-3


@pytest.mark.parametrize("kind", AS_EFFECT)
def test_both_at_once_are_refused(kind):
    name, value = AS_EFFECT[kind]
    with pytest.raises(InputError, match=f"{kind} and .controller. {AS_KEY[kind]} are both given"):
        jaxid.load_case(servo([{"kind": kind, name: value}], **{AS_KEY[kind]: value}))


def test_no_controller_and_no_error_are_refused():
    lag = [{"kind": "command_lag", "time_constant": 0.01}]
    alone = {name: t for name, t in servo(lag).items() if name not in ("controller", "reference")}
    with pytest.raises(
        InputError, match="command_lag acts on the command of a controller, and there is none"
    ):
        jaxid.load_case(alone)
    twice = [{"kind": "dead_band", "width": 0.01}] * 2
    with pytest.raises(InputError, match="dead_band is given twice"):
        jaxid.load_case(servo(twice))
    flat = servo([{"kind": "dead_band", "width": 0.01}])
    flat["controller"] = {"kind": "flatness", "poles": [-10.0, -10.0], "epsilon": 0.01, "period": PERIOD}
    with pytest.raises(InputError, match="which has no error"):
        jaxid.load_case(flat)


def test_the_lag_is_that_of_a_continuous_filter():
    """They agree for a smooth reference, to a part of a tick over the time constant."""
    constant, t = 0.03, PERIOD * np.arange(2000)
    reference = np.sin(7 * t) + 0.3 * np.sin(23 * t)
    law = CONTROLLERS["pd"](kp=jnp.asarray([1.0]), kd=jnp.asarray([0.0]), period=PERIOD)
    law = with_effects(
        law, Axis(1.0, effects=(EFFECTS["command_lag"](time_constant=jnp.asarray(constant)),)), 1
    )
    got = np.asarray(law.path(jnp.asarray(reference)[:, None]).reference)[:, 0]
    exact = scipy.integrate.solve_ivp(
        lambda s, y: (np.sin(7 * s) + 0.3 * np.sin(23 * s) - y) / constant,
        (0.0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-9,
    ).y[0]  # fmt: skip
    assert np.abs(reference - exact).max() > 0.3
    # Backward Euler is late by at most half a tick: the slope of the result is below 7.
    assert np.abs(got - exact).max() < 0.5 * PERIOD * 7


def test_a_lag_from_zero_has_a_slope():
    """A search begins there."""
    reference = jnp.asarray(np.sin(7 * PERIOD * np.arange(100)))[:, None]
    law = CONTROLLERS["pd"](kp=jnp.asarray([1.0]), kd=jnp.asarray([0.0]), period=PERIOD)

    def passed(constant):
        plant = Axis(1.0, effects=(EFFECTS["command_lag"](time_constant=constant),))
        return with_effects(law, plant, 1).path(reference).reference[:, 0]

    at_zero, slope = jax.jvp(passed, (jnp.zeros(()),), (jnp.ones(()),))
    np.testing.assert_array_equal(at_zero, reference[:, 0])
    np.testing.assert_allclose(slope[1:], -np.diff(reference[:, 0]) / PERIOD, rtol=1e-12)


def targets(steps: int = 1500) -> dict[str, np.ndarray]:
    """A step, steps while the profile moves, and a sine that asks for more than the limit."""
    t = PERIOD * np.arange(steps)
    return {
        "step": 0.24 * (t > 0.01),
        "steps": 0.24 * (t > 0.01) - 0.3 * (t > 0.08) + 0.1 * (t > 0.4),
        "sine": 0.15 * np.sin(2 * np.pi * 3.0 * t),
    }


def test_a_step_is_followed_by_a_triangle_of_velocities():
    target = targets()["step"]
    got = np.asarray(accelerated(jnp.asarray(target)[:, None], jnp.asarray(40.0), PERIOD))[:, 0]
    half = np.sqrt(0.24 / 40.0)
    # The first step is taken at the tick of the command, and each moves by the velocity at its end.
    t = PERIOD * (np.arange(target.size) - np.argmax(target > 0) + 1.5)
    up, down = 20.0 * t**2, 0.24 - 20.0 * (2 * half - t) ** 2
    exact = np.where(t < 0, 0.0, np.where(t < half, up, np.where(t < 2 * half, down, 0.24)))
    np.testing.assert_allclose(got, exact, atol=1e-4)
    assert np.abs(np.diff(got, 2)).max() < 40.0 * PERIOD**2 * (1 + 1e-9)
    assert got[-1] == 0.24


@pytest.mark.parametrize("name", ["steps", "sine"])
def test_a_profile_of_new_targets_is_the_time_optimal_one(name):
    """By bang-bang steps a fiftieth as long; the profile of ticks is ahead by one and a half of them."""
    target = targets()[name]
    got = np.asarray(accelerated(jnp.asarray(target)[:, None], jnp.asarray(40.0), PERIOD))[:, 0]
    exact = profile(target, 40.0, 1 / PERIOD)
    ticks = np.arange(target.size)
    ahead = np.interp(ticks + 1.5, ticks, exact)
    assert np.abs(target - exact).max() > 0.1
    # The two see a moving target at instants up to half a tick apart.
    assert np.abs(got - ahead)[:-2].max() < 0.5 * PERIOD * np.abs(np.gradient(exact, PERIOD)).max()


@pytest.mark.parametrize("name", ["step", "steps", "sine"])
def test_the_slope_by_a_limit_of_the_acceleration_is_exact(name):
    target = jnp.asarray(targets()[name])[:, None]

    def run(limit):
        return accelerated(target, limit, PERIOD)[:, 0]

    # At some limits a piece ends at a tick, and the two sides have slopes of their own; not at this one.
    slope = jax.jvp(run, (jnp.asarray(39.3),), (jnp.ones(()),))[1]
    apart = (run(39.3 + 1e-6) - run(39.3 - 1e-6)) / 2e-6
    assert np.abs(slope).max() > 1e-3
    np.testing.assert_allclose(slope, apart, atol=1e-8)


@pytest.mark.parametrize("name", ["step", "steps", "sine"])
def test_a_limited_velocity_is_the_independent_steppers(name):
    target = targets()[name]
    law = CONTROLLERS["pd"](kp=jnp.asarray([1.0]), kd=jnp.asarray([0.0]), period=PERIOD)
    law = with_effects(law, Axis(1.0, effects=(EFFECTS["velocity_limit"](limit=jnp.asarray(1.7)),)), 1)
    got = np.asarray(law.path(jnp.asarray(target)[:, None]).reference)[:, 0]
    exact = reached(target, Machine(1.0, {"velocity_limit": {"limit": 1.7}}), 1 / PERIOD)
    np.testing.assert_allclose(got, exact, rtol=0, atol=1e-12)
    assert np.abs(target - got).max() > 0.05
    assert np.abs(np.diff(got)).max() < 1.7 * PERIOD * (1 + 1e-9)


@pytest.mark.parametrize("name", ["step", "steps", "sine"])
def test_the_slope_by_a_limit_of_the_velocity_is_exact(name):
    target = jnp.asarray(targets()[name])[:, None]

    def run(limit):
        return slewed(target, limit, PERIOD)[:, 0]

    slope = jax.jvp(run, (jnp.asarray(1.717),), (jnp.ones(()),))[1]
    apart = (run(1.717 + 1e-6) - run(1.717 - 1e-6)) / 2e-6
    assert np.abs(slope).max() > 1e-3
    np.testing.assert_allclose(slope, apart, atol=1e-8)


@pytest.mark.parametrize("kind", ["velocity_limit", "acceleration_limit"])
def test_a_limit_where_a_search_begins_changes_nothing(kind):
    target = jnp.asarray(targets()["steps"])[:, None]
    law = CONTROLLERS["pd"](kp=jnp.asarray([1.0]), kd=jnp.asarray([0.0]), period=PERIOD)
    effect = EFFECTS[kind](limit=jnp.asarray(EFFECTS[kind].elsewhere))
    got = with_effects(law, Axis(1.0, effects=(effect,)), 1).path(target).reference
    np.testing.assert_allclose(got, target, rtol=0, atol=1e-15)


def test_an_error_in_the_dead_band_counts_as_none():
    law = CONTROLLERS["pd"](
        kp=jnp.asarray([5.0]), kd=jnp.asarray([0.0]), period=PERIOD, dead_band=jnp.asarray(0.1)
    )

    def command(error):
        path = law.path(jnp.full((2, 1), error))
        tick = Tick(jnp.zeros(1), jax.tree.map(lambda x: x[0], path), (0,))
        return float(law.command(tick, law.start(tick, jnp.zeros(1)), jnp.zeros(1))[0][0])

    assert [command(e) for e in (0.099, -0.099)] == [0.0, 0.0]
    assert [command(e) for e in (0.101, -0.3)] == pytest.approx([0.505, -1.5])


def test_the_slope_of_a_dead_band_is_that_of_the_instant_of_its_edge():
    """Integrated over a passage; the value itself jumps."""
    t = 1e-5 * np.arange(40_000)
    error = jnp.asarray(0.5 * t - 0.1)

    def area(band):
        return jnp.sum(outside(error, band)) * 1e-5

    # |error| passes the edge at two instants; each moves by 2 s per unit of the band.
    slope = float(jax.jvp(area, (jnp.asarray(0.06),), (jnp.ones(()),))[1])
    one_sided = float(
        jax.jvp(
            lambda b: jnp.sum(outside(error, b) * (error > 0)) * 1e-5, (jnp.asarray(0.06),), (jnp.ones(()),)
        )[1]
    )
    assert slope == pytest.approx(0.0, abs=1e-9)
    assert one_sided == pytest.approx(-0.06 * 2.0, rel=2e-3)


def test_load_friction_of_the_stepper_is_a_force_over_a_mass():
    """Driven by 4 N it loses a tenth; braked by it, four tenths."""
    machine = Machine(2.0, {"load_friction": {"coefficient": 0.1, "back": 0.4}})
    given = np.where(np.arange(2000) < 1000, 4.0, -4.0)
    log = simulate(machine, Loop(input=given), Sensor(), rate=1000.0, duration=2.0)
    forth, brake = 4.0 * 0.9 / 2.0, 4.0 * 1.4 / 2.0
    stop = 1.0 + forth / brake
    t = log["t"]
    expected = np.where(
        t < 1.0, forth * t, np.maximum(forth - brake * (t - 1.0), -4.0 * 0.9 / 2.0 * (t - stop))
    )
    np.testing.assert_allclose(log["true_velocity"], expected, atol=1e-4)


def test_the_dead_band_of_the_stepper_is_the_packages():
    """Both jump: a tick at the edge that falls otherwise moves the motion a little."""
    effects = {"coulomb_friction": {"level": 0.03}, "dead_band": {"width": 0.02}}
    run = jaxid.simulate(servo([{"kind": "dead_band", "width": 0.02}]))
    loop = Loop(kind="pd", kp=2.0, kd=0.05, reference=run.log.reference[:, 0])
    exact = simulate(Machine(2e-3, effects), loop, Sensor(), rate=1000.0, duration=1.0)
    assert np.abs(run.log.position[:, 0] - exact["true_position"]).max() < 1e-5
