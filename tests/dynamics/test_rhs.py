"""What is read from the balance, against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.residuals import _recurrence, integrate_internal_states, residual_along
from jaxid.dynamics.rhs import State, small_solve, step
from jaxid.effects import EFFECTS
from jaxid.estimators.algebraic.windows import iterated_integral, weak_motion
from jaxid.model.smoothing import Smoothing
from jaxid.model.unknowns import scatter
from jaxid.plants import Axis
from jaxid.simulation.loops import Drive, open_loop
from truth.axis.stepper import Sensor
from truth.chain import flexible_axes as axes

MASS, DAMPING, STIFFNESS = 2.0, 3.0, 800.0
OSCILLATOR = (
    EFFECTS["viscous_friction"](coefficient=DAMPING),
    EFFECTS["linear_stiffness"](coefficient=STIFFNESS),
)


@eqx.filter_jit
def run(plant, period, force, start, substeps=1, set_valued=False, hold="zero_order"):
    """Open loop under a command a sample, from position and velocity `start`."""
    drive = Drive(jnp.ones(1), period, hold, substeps, set_valued)
    return open_loop(plant, drive, force[:, None], start[0][None], start[1][None])


def coast(plant, samples: int, period: float, velocity: float, **options):
    start = (jnp.zeros(()), jnp.asarray(velocity))
    out = run(plant, period, jnp.zeros(samples), start, **options)
    return np.asarray(out.position)[:, 0], np.asarray(out.velocity)[:, 0]


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_small_solve_is_numpys(size):
    random = np.random.default_rng(size)
    root, b = random.standard_normal((size, size)), random.standard_normal(size)
    a = root @ root.T + 0.1 * np.eye(size)
    x = np.asarray(jax.jit(small_solve)(jnp.asarray(a), jnp.asarray(b)))
    # condition below 1e3 here: three digits of sixteen
    np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=1e-12)


def oscillation(t: np.ndarray, position: float, velocity: float) -> np.ndarray:
    decay = DAMPING / (2 * MASS)
    omega = np.sqrt(STIFFNESS / MASS - decay**2)
    sine = (velocity + decay * position) / omega
    return np.exp(-decay * t) * (position * np.cos(omega * t) + sine * np.sin(omega * t))


def test_damped_oscillator_follows_its_closed_form_to_fourth_order():
    plant, errors = Axis(MASS, effects=OSCILLATOR), []
    for period in (4e-3, 2e-3, 1e-3):
        samples = round(0.8 / period)
        start = (jnp.asarray(0.1), jnp.asarray(0.5))
        q = np.asarray(run(plant, period, jnp.zeros(samples), start).position)[:, 0]
        errors.append(np.abs(q - oscillation(period * np.arange(samples), 0.1, 0.5)).max())
    # (w h)^5 / 120 a step at w h = 0.02, 16 radians long, of 0.1 m: 2e-9
    assert errors[-1] < 5e-9
    # 2^4 = 16; the next order is 2 % at w h = 0.08
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 16.0, rtol=0.05)


def test_order_is_four_with_memory_too():
    """The exponential form: a lag and a presliding spring, both as slow as the motion."""
    effects = (
        *OSCILLATOR,
        EFFECTS["actuator_lag"](time_constant=0.05),
        EFFECTS["hysteresis"](stiffness=300.0, level=4.0),
    )
    plant, runs = Axis(MASS, effects=effects, smoothing=Smoothing(0.3)), []
    start = (jnp.asarray(0.05), jnp.asarray(0.5))
    for period in (8e-3, 4e-3, 2.5e-4):
        command = 20.0 * period * jnp.arange(round(0.8 / period))
        out = run(plant, period, command, start, hold="linear")
        runs.append(np.asarray(out.velocity)[:: round(8e-3 / period), 0])
    errors = [np.abs(v - runs[-1]).max() for v in runs[:-1]]
    # the next order is 3 % at these steps; third order would give 8
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 16.0, rtol=0.05)


def test_lag_far_shorter_than_the_step_is_exact_and_stable():
    """A held force through a lag of a hundredth of the step: its state follows in one step."""
    lag, h = 1e-5, 1e-3
    plant = Axis(MASS, effects=(EFFECTS["actuator_lag"](time_constant=lag),))
    x = State(jnp.zeros(1), jnp.zeros(1), (jnp.asarray(-3.0),))
    force, zero = jnp.asarray([6.0]), jnp.zeros(())
    for one in (step, lambda *now: set_valued_step(*now)[0]):
        new = jax.jit(lambda x, one=one: one(plant, x, lambda s: force, zero, jnp.asarray(h)))(x)
        assert float(new.own[0]) == pytest.approx(6.0 - 9.0 * np.exp(-h / lag), rel=1e-13)


@pytest.mark.parametrize("ratio", [0.01, 0.1, 0.5, 2.0])
def test_impulse_through_a_lag(ratio):
    """Velocity after one step: exact too, though a short lag is over before the step's middle."""
    h = 1e-3
    lag = ratio * h
    plant = Axis(MASS, effects=(EFFECTS["actuator_lag"](time_constant=lag),))
    x = State(jnp.zeros(1), jnp.zeros(1), (jnp.asarray(-3.0),))
    force = jnp.asarray([6.0])
    new = jax.jit(lambda x: step(plant, x, lambda s: force, jnp.zeros(()), jnp.asarray(h)))(x)
    exact = (6.0 * h + 9.0 * lag * np.expm1(-h / lag)) / MASS
    assert float(new.qd[0]) == pytest.approx(exact, rel=1e-12)


def test_stopping_time_and_distance_tend_to_the_sharp_ones():
    """m v / F seconds and m v^2 / 2 F metres, as the sign sharpens."""
    level, speed, period = 3.0, 1.0, 2e-3
    exact, errors = MASS * speed**2 / (2 * level), []
    for sharpness in (0.1, 0.03, 0.01):
        friction = EFFECTS["coulomb_friction"](level=level)
        plant = Axis(MASS, effects=(friction,), smoothing=Smoothing(sharpness))
        q, _ = coast(plant, 600, period, speed)
        errors.append(q[-1] - exact)
    # slower by tanh: the distance past the sharp stop is (pi^2 / 12) m width^2 / F, up to the end
    widths = np.array([0.1, 0.03, 0.01])
    expected = np.pi**2 / 12 * MASS * widths**2 / level
    np.testing.assert_allclose(errors, expected, rtol=1e-3)  # RK4 at level h / (m width) = 0.3


def test_set_valued_step_stops_at_the_right_time_and_stays():
    level, speed, period = 3.0, 1.0, 1e-3
    plant = Axis(MASS, effects=(EFFECTS["coulomb_friction"](level=level),))
    q, v = coast(plant, 1000, period, speed, set_valued=True)
    t = period * np.arange(1000)
    np.testing.assert_allclose(v, np.maximum(speed - level / MASS * t, 0.0), atol=period)
    assert np.all(v[t > MASS * speed / level + period] == 0.0)
    # the last step to rest has a constant reaction that is up to the level too small: F h^2 / 2 m
    assert q[-1] == pytest.approx(MASS * speed**2 / (2 * level), abs=level * period**2 / MASS)


def test_sticks_exactly_under_any_force_below_the_level():
    plant = Axis(MASS, effects=(EFFECTS["coulomb_friction"](level=3.0),))
    force = 2.999 * np.sin(np.arange(500))
    start = (jnp.asarray(0.1), jnp.zeros(()))
    out = run(plant, 1e-3, jnp.asarray(force), start, set_valued=True)
    assert np.all(np.asarray(out.velocity) == 0.0)
    # the free step out and the reaction back cancel to rounding in the position
    np.testing.assert_allclose(np.asarray(out.position), 0.1, atol=1e-14)


@pytest.mark.parametrize("set_valued", [False, True])
def test_energy_is_what_the_drive_gave_less_what_friction_took(set_valued):
    level, samples, period = 3.0, 4000, 2.5e-4
    effects = (*OSCILLATOR, EFFECTS["coulomb_friction"](level=level))
    plant = Axis(MASS, effects=effects, smoothing=Smoothing(1e-3))
    t = period * np.arange(samples)
    force = 20.0 * np.sin(9.0 * t)  # far below the resonance at 20 rad/s
    out = run(
        plant,
        period,
        jnp.asarray(force),
        (jnp.zeros(()), jnp.asarray(0.3)),
        set_valued=set_valued,
        hold="linear",
    )
    q, v = np.asarray(out.position)[:, 0], np.asarray(out.velocity)[:, 0]
    energy = 0.5 * MASS * v**2 + 0.5 * STIFFNESS * q**2
    power = force * v - DAMPING * v**2 - level * np.abs(v)
    given = np.concatenate([[0.0], np.cumsum(0.5 * period * (power[1:] + power[:-1]))])
    took = level * np.abs(np.diff(q)).sum()
    assert took > 0.5 * np.ptp(energy)  # friction matters here
    # trapezoids of the power: (w h)^2 / 12 relative, and the width of the sign against 1 m/s
    np.testing.assert_allclose(energy - energy[0], given, atol=1e-3 * np.ptp(energy))


def simulated_motion() -> tuple[Axis, list[jax.Array], float]:
    """A smooth run, with the accelerations that its balance gave, at 1 kHz."""
    friction = EFFECTS["coulomb_friction"](level=3.0)
    effects = (*OSCILLATOR, friction, EFFECTS["cubic_friction"](coefficient=0.7))
    plant, period = Axis(MASS, effects=effects, smoothing=Smoothing(0.02)), 1e-3
    t = period * np.arange(800)
    u = 40.0 * np.sin(20.0 * t) + 15.0 * np.cos(57.0 * t)
    out = run(plant, period, jnp.asarray(u), (jnp.zeros(()), jnp.asarray(0.3)), hold="linear")
    q, v = np.asarray(out.position), np.asarray(out.velocity)
    table = u[:, None] - DAMPING * v - STIFFNESS * q - 3.0 * np.tanh(v / 0.02) - 0.7 * v**3
    return plant, [jnp.asarray(x) for x in (q, v, table / MASS, u[:, None])], period


PLACES = (
    (("inertia",), None),
    (("effects", 0, "coefficient"), None),
    (("effects", 1, "coefficient"), None),
    (("effects", 2, "level"), None),
    (("effects", 3, "coefficient"), None),
)
TRUTH = np.array([MASS, DAMPING, STIFFNESS, 3.0, 0.7])


def test_regressor_times_parameters_is_the_force():
    """Two routes, one answer: Y theta is the declared force along a simulated motion."""
    plant, motion, period = simulated_motion()

    def residual(theta):
        return residual_along(scatter(PLACES, plant, theta), *motion, period)[0][:, 0]

    e, regressor = jax.jit(lambda th: (residual(th), jax.jacfwd(residual)(th)))(TRUTH)
    u = np.asarray(motion[3])[:, 0]
    np.testing.assert_allclose(np.asarray(e), 0.0, atol=1e-12)  # rounding of 100 N
    np.testing.assert_allclose(np.asarray(regressor) @ TRUTH, u, atol=1e-12)
    # and least squares on it gives the truth back
    fit = np.linalg.lstsq(np.asarray(regressor), u, rcond=None)[0]
    np.testing.assert_allclose(fit, TRUTH, rtol=1e-10)


def test_simulated_velocities_agree_with_the_balance():
    """The residual with accelerations differenced from the simulation vanishes to second order."""
    plant, (q, v, _, u), period = simulated_motion()
    a = jnp.gradient(v[:, 0], period)[:, None]
    e = np.asarray(jax.jit(residual_along)(plant, q, v, a, u, period)[0])[1:-1, 0]
    calm = np.abs(np.asarray(v)[1:-1, 0]) > 0.1  # away from the corner of the sign
    # h^2 / 6 times the third derivative of v: 1e-6 / 6 * (60 / s)^3 * 1 m/s * 2 kg = 0.07 N
    assert np.abs(e[calm]).max() < 0.07
    assert np.abs(e[calm]).max() < 2e-3 * np.abs(np.asarray(u)).max()


def test_own_states_driven_along_a_motion_are_those_of_the_simulation():
    effects = (
        *OSCILLATOR,
        EFFECTS["actuator_lag"](time_constant=0.01),
        EFFECTS["hysteresis"](stiffness=2e3, level=5.0),
    )
    plant, errors = Axis(MASS, effects=effects, smoothing=Smoothing(1e-3)), []
    start = (jnp.zeros(()), jnp.asarray(0.3))
    for period in (1e-3, 5e-4):
        u = 40.0 * np.sin(20.0 * period * np.arange(round(0.6 / period)))
        out = run(plant, period, jnp.asarray(u), start, hold="linear")
        a = jnp.gradient(out.velocity[:, 0], period)[:, None]
        motion = (out.position, out.velocity, a, jnp.asarray(u)[:, None])
        e = jax.jit(residual_along)(plant, *motion, period)[0]
        errors.append(np.sqrt(np.mean(np.asarray(e)[2:-2, 0] ** 2)))
    # of a force of 40 N; second order, 4 a halving, less at the corners of the hysteresis
    assert errors[1] < 0.05
    assert errors[0] > 2.5 * errors[1]


def test_what_sits_behind_a_spring_is_driven_along_the_motion_of_the_joint():
    """Own state of two entries: the motor of an independent axis is the rigid one with the effect."""
    free_load = axes.machine(**{"viscous_friction[2].coefficient": 0.0, "coulomb_friction[2].level": 0.0})
    log = axes.record(free_load, duration=2.0, sensor=Sensor())
    q, v = log["true_position"][:, :1], log["true_velocity"][:, :1]
    # Of command and acceleration, which jump at every tick, the mean of both sides.
    a, u = np.gradient(v, 1 / axes.RATE, axis=0), axes.GAIN * log["force"]
    u[1:] = 0.5 * (u[1:] + u[:-1])
    moving = np.abs(v[:, 0]) > 1e-3
    true = axes.TRUTH
    inertia = true["motor_inertia"] + true["load_inertia"]
    behind = {name: true[name] for name in ("stiffness", "damping", "load_inertia")}
    friction = (
        EFFECTS["viscous_friction"](true["viscous_friction[1].coefficient"]),
        EFFECTS["coulomb_friction"](true["coulomb_friction[1].level"]),
    )

    def rms(*effects) -> float:
        plant = Axis(inertia, effects=(*friction, *effects), smoothing=Smoothing(1e-6))
        e = jax.jit(residual_along)(plant, *map(jnp.asarray, (q, v, a, u)), 1 / axes.RATE)[0]
        return float(np.sqrt(np.mean(np.square(np.asarray(e)[moving]))))

    flexible, rigid = rms(EFFECTS["joint_flexibility"](**behind)), rms()
    assert rigid > 0.1 * np.sqrt(np.mean(u[moving] ** 2))
    assert flexible < 0.01 * rigid


def test_iterated_integrals_are_exact_for_cubics():
    t = 1e-2 * np.arange(200)[:, None]
    cubic = 1.0 - 3.0 * t + 0.5 * t**2 + 2.0 * t**3
    double = t**2 / 2 - t**3 / 2 + t**4 / 24 + t**5 / 10
    once = np.asarray(iterated_integral(jnp.asarray(cubic), 1e-2, 1))
    np.testing.assert_allclose(once, t - 1.5 * t**2 + t**3 / 6 + t**4 / 2, atol=1e-13)
    # the second integrand has degree four: h^4 of its fourth derivative, 12, over 720 a second
    twice = np.asarray(iterated_integral(jnp.asarray(cubic), 1e-2, 2))
    np.testing.assert_allclose(twice, double, atol=12 * 1e-8 * 2.0 / 30)


def test_weak_motion_is_the_double_integral_of_the_derivatives():
    """Integrals of t^2 q'' and t^2 q' themselves must give the same, for q = sin w t."""
    period, w = 1e-3, 9.0
    t = period * np.arange(1000)[:, None]
    acceleration, velocity = weak_motion(jnp.asarray(np.sin(w * t)), period)
    for value, derivative in (
        (acceleration, -(w**2) * np.sin(w * t)),
        (velocity, w * np.cos(w * t)),
    ):
        direct = iterated_integral(jnp.asarray(t**2 * derivative), period, 2)[-1]
        # two quadratures of fourth order at w h = 0.01: 1e-8 / 30 each, of terms of order one
        np.testing.assert_allclose(np.asarray(value), np.asarray(direct), atol=1e-9)


def test_presliding_that_slips_stays_at_its_level_however_the_speed_changes():
    speed = jnp.linspace(1e-4, 0.3, 40)
    stiff = 5e5  # per metre: slips within 2 um, far less than a sample's stroke
    z = _recurrence(jnp.ones(()), -stiff * speed, stiff * speed, 1e-3)
    assert np.abs(np.asarray(z) - 1).max() < 1e-9


def test_a_lag_follows_a_sine_to_the_order_of_the_cubic():
    t, lag, omega = 1e-3 * jnp.arange(400), 4e-3, 2 * jnp.pi * 60.0
    z = _recurrence(jnp.zeros(()), jnp.full(400, -1 / lag), jnp.sin(omega * t) / lag, 1e-3)
    steady = (jnp.sin(omega * t) - lag * omega * jnp.cos(omega * t)) / (1 + (lag * omega) ** 2)
    exact = steady + jnp.exp(-t / lag) * lag * omega / (1 + (lag * omega) ** 2)
    assert np.abs(np.asarray(z - exact)).max() < 1e-3


def test_a_lag_behind_a_lag_gets_what_the_first_lets_through():
    lags, period = (0.02, 0.05), 1e-3
    effects = [EFFECTS["actuator_lag"](time_constant=lag) for lag in lags]
    plant = Axis(MASS, effects=(effects[0], EFFECTS["hysteresis"](stiffness=2e3, level=5.0), effects[1]))
    t = period * np.arange(600)
    u, still = np.sin(30.0 * t)[:, None], np.zeros((600, 1))
    own = jax.jit(integrate_internal_states)(plant, still, still, still, u, period)
    for k, states in ((1, own[0]), (2, own[2])):
        system = scipy.signal.lti([1.0], np.poly([-1 / lag for lag in lags[:k]]) * np.prod(lags[:k]))
        exact = scipy.signal.lsim(system, np.interp(fine := np.arange(0, 0.599, 1e-5), t, u[:, 0]), fine)[1]
        assert np.abs(np.asarray(states)[:-1] - exact[::100]).max() < 1e-4
    assert not np.any(own[1])
