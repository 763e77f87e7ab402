"""Delays of a sampled loop beside its ticks, in logs without a force."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.unforced import covered, of
from benchmarks.unforced_machines import Servo
from jaxid.commands.identify import identify
from jaxid.estimators.several.parts import parts_of
from jaxid.estimators.ticks import at_ticks, best_ticks
from jaxid.numerics.lanes import run_alone
from jaxid.session import open_session

# A servo of 1 kHz whose command is held over ten ticks. Its true delay is 30 ms.
SERVO = of("coverage", 41)
PERIOD = 1e-3


@pytest.fixture(scope="module")
def session():
    return open_session(SERVO.case(), SERVO.columns())


def test_only_delays_go_to_the_ticks(session):
    machine = session.machine
    delay = machine.parameters.names.index("controller.delay")
    theta = np.full(len(machine.parameters.names), 0.0307)
    near = at_ticks(machine, theta)
    assert near[delay] == pytest.approx(31 * PERIOD, rel=1e-12)
    assert np.array_equal(np.delete(near, delay), np.delete(theta, delay))
    assert at_ticks(machine, theta, -1)[delay] == pytest.approx(30 * PERIOD, rel=1e-12)


def test_no_delay_becomes_negative(session):
    theta = np.zeros(len(session.machine.parameters.names))
    assert np.array_equal(at_ticks(session.machine, theta, -1), theta)


def test_a_known_delay_has_no_ticks_beside_it(session):
    known = replace(session.machine.parameters, free=())
    machine = replace(session.machine, parameters=known)
    assert run_alone(best_ticks(machine, parts_of(session), np.zeros(0))) == []


def slow_motion(seed: int, swing: float = 0.4, hertz: float = 0.5) -> Servo:
    """A servo of 250 Hz that swings slowly, by 8 counts a row, with a command every fifth tick."""
    t = np.arange(200) * 0.02
    command = swing * np.sin(2 * np.pi * hertz * t) * np.minimum(t, 1.0)
    effects = {
        "viscous_friction": {"coefficient": 5e-3},
        "coulomb_friction": {"level": 0.03},
        "command_delay": {"delay": 0.02},
    }
    return Servo(seed, 250.0, 5, 2e-3, 1.5, 0.06, effects, command)


def deviations(servo: Servo, *logs: dict) -> list[float]:
    """Fit logs of a servo, and return the deviations from its values over their standard deviations."""
    found, truth = identify(servo.case(), logs[0] if len(logs) == 1 else list(logs)).parameters, servo.truth()
    assert found["controller.delay"].value == pytest.approx(
        truth["controller.delay"], abs=servo.every / servo.rate
    )
    return [(found[name].value - truth[name]) / found[name].std for name in truth if name in found]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_a_slow_motion_gives_the_tick_of_the_delay(seed):
    """Each tick has a minimum of its own: one fit ended up to 13 sigma from the truth, called complete."""
    servo = slow_motion(seed)
    z = deviations(servo, servo.columns())
    assert len(z) == 5
    assert max(map(abs, z)) < 3.0, z


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_two_slow_motions_give_it_together(seed):
    """Without the mean readings of both loops the fit ended up to 36 sigma from the truth."""
    servo, other = slow_motion(seed), slow_motion(seed + 100, 0.3, 0.65)
    z = deviations(servo, servo.columns(), other.columns())
    assert len(z) == 5
    assert max(map(abs, z)) < 3.0, z


@pytest.mark.slow
def test_mean_readings_decide_between_neighbouring_ticks():
    """Without noise in the loop 31 ms fit better, and gains and friction are 5 % off: 8 sigma."""
    fit = covered(SERVO)
    assert fit["converged"]
    assert max(map(abs, fit["z"].values())) < 4.0
    assert max(map(abs, fit["error"].values())) < 0.05


@pytest.mark.slow
def test_a_delay_has_the_error_of_a_tick_where_the_period_is_stated():
    case, columns = SERVO.case(), SERVO.columns()
    estimate = identify(case, columns).estimate
    std = estimate.std[estimate.names.index("controller.delay")]
    assert std >= 0.999 * PERIOD / np.sqrt(12)
