"""Tick of a loop that is faster than its log, on exact logs of every tick, and of every second or third."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

import jaxid
from jaxid.consistency import tick
from jaxid.consistency.balance_fit import balance_fits
from jaxid.consistency.noise import loop_is_faster
from jaxid.estimators import METHODS, steps_of
from jaxid.estimators.uncertain_hold import with_uncertain_hold
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session, open_another, open_session
from truth.axis.cases import case_text
from truth.axis.machines import Setup, moves
from truth.axis.slow_logs import HIDDEN, RATE, robot_joint, with_hidden
from truth.axis.stepper import Loop, Machine, Sensor

SETUP = robot_joint(0)[0]
EFFECTS = SETUP.machine.effects


def opened(every: int, of: Setup = SETUP, more: str = "") -> Session:
    run = of.run()
    log = {"t": run["t"], "q": run["position"], "u": run["force"]}
    text = case_text(of, tuple(EFFECTS.items()), motion="rotary", sensor=False, closed=False)
    text = text.replace("[log]\n", f"[log]\n{more}")
    return open_session(tomllib.loads(text), {name: x[::every] for name, x in log.items()})


@pytest.mark.parametrize("every", [2, 3, 10])
def test_a_log_of_some_ticks_shows_that_its_loop_is_faster(every):
    session = opened(every)
    assert session.fit.data.hold == pytest.approx(1 / RATE, rel=0.5 if every < 10 else 2.0)
    assert session.fit.data.faster_loop
    assert session.settings["tick"]["value"].endswith(" s")
    assert not session.chooses_hold, "a search keeps it"
    assert any("the loop is faster than the log" in f.what for f in session.findings)


def test_further_logs_of_the_same_rate_follow():
    run = SETUP.run()
    text = case_text(SETUP, tuple(EFFECTS.items()), motion="rotary", sensor=False, closed=False)
    log = {name: run[key][::2] for name, key in (("t", "t"), ("q", "position"), ("u", "force"))}
    half = len(log["t"]) // 2
    logs = [{name: x[part] for name, x in log.items()} for part in (slice(0, half), slice(half, None))]
    session = open_session(tomllib.loads(text), logs)
    holds = [part.data.hold for part in (session.fit, *session.more)]
    assert holds == [pytest.approx(1 / RATE, rel=0.5)] * 2


NOISY = replace(
    SETUP,
    loop=replace(SETUP.loop, velocity_average=1),
    sensor=replace(SETUP.sensor, force_noise=0.08),
)


@pytest.mark.parametrize("of", [SETUP, NOISY])
def test_a_log_of_every_tick_has_none(of):
    """Near half the rate of a log the difference of two readings is hardly more than one of them."""
    session = opened(1, of)
    assert session.fit.data.hold == pytest.approx(1 / RATE)
    assert not session.fit.data.faster_loop
    assert "tick" not in session.settings


def test_a_declared_loop_has_its_own_period():
    run = SETUP.run()
    text = case_text(SETUP, tuple(EFFECTS.items()), motion="rotary", sensor=False, closed=True)
    names = (("t", "t"), ("q", "position"), ("u", "force"), ("ref", "reference"))
    log = {name: run[key][::5] for name, key in names}
    session = open_session(tomllib.loads(text.replace("[controller]", "[controller]\nperiod = 0.001")), log)
    assert not session.fit.data.faster_loop
    assert "tick" not in session.settings


def test_a_stated_hold_is_kept():
    session = opened(2, more='hold = "zero_order"\n')
    assert session.fit.data.hold == pytest.approx(2 / RATE)
    assert "tick" not in session.settings


def test_a_log_that_is_opened_later_follows_too():
    session, run = opened(2), SETUP.run()
    log = {name: run[key][::2] for name, key in (("t", "t"), ("q", "position"), ("u", "force"))}
    later = open_another(session, log)
    assert later.data.hold == session.fit.data.hold
    assert later.data.faster_loop


@pytest.mark.parametrize("kind", HIDDEN)
def test_what_is_missing_is_no_tick(kind):
    assert "tick" not in opened(1, with_hidden(SETUP, kind)).settings


@pytest.mark.parametrize("every", [2, 5])
def test_values_of_a_faster_loop_hold_and_nothing_is_missing(every):
    run = SETUP.run()
    text = case_text(SETUP, tuple(EFFECTS.items()), motion="rotary", sensor=False, closed=False)
    log = {"t": run["t"], "q": run["position"], "u": run["force"]}
    case = tomllib.loads(text)
    found = jaxid.identify(case, {name: x[::every] for name, x in log.items()})
    assert found.model_complete is True
    assert found.estimate.method == "inverse_dynamics"
    assert any("faster than the log" in note for note in found.estimate.notes)
    fit = found.estimate
    assert tuple(fit.names) == ("inertia", "viscous_friction.coefficient", "coulomb_friction.level")
    frictions = (EFFECTS["viscous_friction"]["coefficient"], EFFECTS["coulomb_friction"]["level"])
    assert np.all(np.abs(fit.theta - [SETUP.machine.inertia, *frictions]) < 3 * fit.std)


def test_the_uncertainty_of_the_tick_is_an_error_of_the_values():
    """Half the tick shifts the force in time, as a viscous friction beside the inertia does."""
    session = opened(5)
    data = session.fit.data
    assert 0.2 / RATE < data.hold_std < 2 / RATE
    fit = run_alone(steps_of("inverse_dynamics", session))
    longer = replace(session, fit=replace(session.fit, data=replace(data, hold=data.hold + data.hold_std)))
    known, other = (run_alone(METHODS["inverse_dynamics"](of)) for of in (session, longer))
    change = other.theta - known.theta
    np.testing.assert_array_equal(fit.theta, known.theta)
    added = fit.precision.covariance - known.precision.covariance
    np.testing.assert_allclose(added, np.outer(change, change), rtol=0.05)
    np.testing.assert_allclose(fit.std_misspecified**2 - known.std_misspecified**2, change**2, rtol=0.05)
    assert np.max(fit.std / known.std) > 1.005


def test_a_known_time_is_not_fitted_twice():
    session, calls = opened(1), []

    def steps(of: Session):
        calls.append(of.fit.data.hold)
        return METHODS["inverse_dynamics"](of)

    run_alone(with_uncertain_hold(steps, session))
    assert calls == [1 / RATE]
    known = replace(session.fit.data, hold_std=1e-5 / RATE)
    run_alone(with_uncertain_hold(steps, replace(session, fit=replace(session.fit, data=known))))
    assert len(calls) == 2


def test_a_second_fit_that_fails_is_said():
    session = opened(5)

    def steps(of: Session):
        fit = yield from METHODS["inverse_dynamics"](of)
        return replace(fit, converged=of is session)

    fit = run_alone(with_uncertain_hold(steps, session))
    assert any("standard deviations are too small" in note for note in fit.notes)


def test_lines_that_explain_far_more_leave_a_finite_tick(monkeypatch):
    """The likelihood of lines over that of the best tick is then no number of double precision."""
    session = opened(2)
    machine, log, data = session.machine, session.fit.log, session.fit.data
    left = tick.residual_held
    monkeypatch.setattr(tick, "residual_held", lambda *args: left(*args) * (1e-4 if args[-1] == 0 else 1.0))
    found = tick.faster_tick(machine, log, data, balance_fits(machine, data)[0], fast=True)
    assert found is not None
    assert (found.period, found.std) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_a_filtered_derivative_at_the_rate_of_the_log_is_no_faster_loop():
    """In the high band it answers to the reading of its row nearly alone, but its force acts for a row."""
    t = np.arange(6000) / 1000.0
    reference = moves(t, [0.0, 0.1, 0.3, 0.05], [0.1, 0.25, 0.05, 0.2], 2.0, 0.2)
    loop = Loop("pid", reference=reference, kp=2e4, kd=180.0, ki=2e4, derivative_filter=0.002)
    effects = {"viscous_friction": {"coefficient": 350.0}, "coulomb_friction": {"level": 45.0}}
    machine = Machine(60.0, effects, actuator_gain=120.0)
    setup = Setup(machine, loop, Sensor(1e-6, 3e-7, 0.01), rate=1000.0, duration=6.0, seed=1)
    run = setup.run()
    text = case_text(setup, tuple(effects.items()), sensor=False, closed=False)
    session = open_session(tomllib.loads(text), {"t": run["t"], "q": run["position"], "u": run["force"]})
    assert loop_is_faster(session.machine, session.fit.log), "by its noise alone it counts as faster"
    assert "tick" not in session.settings
    assert session.fit.data.hold == pytest.approx(1e-3)
    assert not session.fit.data.faster_loop
