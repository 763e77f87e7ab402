"""Delays of a sampled loop beside its ticks, in logs without a force."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.unforced import covered, of
from jaxid.commands.identify import identify
from jaxid.estimators.ticks import at_ticks, starts_beside
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
    before, after = starts_beside(machine, theta)
    assert before[delay] == pytest.approx(30 * PERIOD, rel=1e-12)
    assert after[delay] == pytest.approx(32 * PERIOD, rel=1e-12)


def test_no_delay_becomes_negative(session):
    theta = np.zeros(len(session.machine.parameters.names))
    assert np.array_equal(at_ticks(session.machine, theta, -1), theta)


def test_a_known_delay_has_no_neighbours(session):
    known = replace(session.machine.parameters, free=())
    machine = replace(session.machine, parameters=known)
    assert starts_beside(machine, np.zeros(0)) == []


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
