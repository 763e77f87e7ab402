"""Loads of an arm's joints from its simulated motion; logs by the exact stepper."""

import numpy as np
import pytest

from benchmarks.unforced import of
from benchmarks.unforced_machines import NOISE
from jaxid.discovery.in_loop.arm_search import ArmSearch
from jaxid.estimators.apart.joint import JointAlone, joints_alone
from jaxid.estimators.apart.loads import with_simulated_loads
from jaxid.estimators.apart.start import is_stable, starts_beside
from jaxid.estimators.several.parts import parts_of
from jaxid.gap import simulation_of_log
from jaxid.session import open_session


@pytest.fixture(scope="module")
def arm():
    """A complete arm whose commands are held over four ticks: it jerks between the rows of its log."""
    drawn = of("arm_nulls", 0)
    assert drawn.every == 4
    session = open_session(drawn.case(), drawn.columns())
    parts = parts_of(session)
    return drawn, session, parts, joints_alone(session.machine, parts)


def true_values(drawn, alone: JointAlone) -> np.ndarray:
    """The joint's own values, in the order of its unknowns."""
    servo, out = drawn.servos[alone.joint], []
    for f in alone.machine.parameters.free:
        if f.path == ("inertia",):
            out.append(alone.links + servo.rotor)
        elif f.path[-1] == "delay":
            out.append(servo.effects["command_delay"]["delay"])
        elif f.path[0] == "controller":
            out.append(getattr(servo, f.path[-1]))
        else:
            kind = alone.machine.plant.effects[f.path[1]].kind
            out.append(servo.effects[kind][f.path[-1]])
    return np.array(out)


def left(drawn, alone: JointAlone) -> float:
    """RMS of the position that the true values of a joint leave, over the noise of its encoder."""
    (part,) = alone.with_estimate(true_values(drawn, alone)).parts
    off = simulation_of_log(part.machine, part.log).position - part.log.filled
    return float(np.sqrt(np.mean(off**2) / (NOISE**2 + drawn.count**2 / 12)))


def of_number(number: int):
    drawn = of("arm_nulls", number)
    return drawn, open_session(drawn.case(), drawn.columns())


def test_starts_beside_a_delay_differ_in_it_and_are_stable():
    _, session = of_number(17)
    alone = joints_alone(session.machine, parts_of(session))[1]
    delay = list(alone.machine.parameters.names).index("controller.delay[2]")
    values = alone.machine.parameters.guess
    values[delay] = 0.0105
    starts = starts_beside(alone.with_estimate(values))
    assert sorted(round(start[delay], 3) for start in starts) == [0.0, 0.005, 0.01, 0.015, 0.02]
    assert all(is_stable(alone.machine.with_estimate(start)) for start in starts)


@pytest.mark.slow
def test_a_fit_returns_from_a_delay_that_is_a_third_of_a_row_early():
    """The other minimum leaves five times the noise: a drag of joint 2 was named on this complete arm."""
    drawn, session = of_number(17)
    noise = np.hypot(NOISE, drawn.count / np.sqrt(12))
    for fit in ArmSearch.of(session).declared.values():
        assert np.sqrt(np.mean(np.square(fit.residual))) < 1.4 * noise


@pytest.mark.slow
def test_true_values_leave_noise_with_the_loads_of_the_simulation(arm):
    drawn, session, parts, joints = arm
    theta = session.machine.parameters.guess
    for alone in joints:
        theta[alone.index] = alone.of_arm(true_values(drawn, alone))
    measured = [left(drawn, alone) for alone in joints]
    simulated = [left(drawn, alone) for alone in with_simulated_loads(joints, theta, parts)]
    assert min(measured) > 2.0
    assert max(simulated) < 1.3


@pytest.mark.slow
def test_fits_and_loads_come_together_from_guesses_up_to_three_times_off(arm):
    """Along the measured motion the fit of the second joint leaves five times the noise."""
    drawn, session, _, _ = arm
    found = ArmSearch.of(session).declared
    noise = np.hypot(NOISE, drawn.count / np.sqrt(12))
    for fit in found.values():
        assert np.sqrt(np.mean(np.square(fit.residual))) < 1.4 * noise
