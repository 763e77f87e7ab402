"""A delay of many ticks in a loop: as long as the case needs it, or refused, and never cut."""

import dataclasses
import tomllib

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.estimators.output_error import output_error
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.gap import simulated
from jaxid.results.verdict.absurd import remarks_on
from jaxid.session import Session, open_session
from jaxid.simulation.replay import exact_numerics, make_replay, remembered_ticks
from truth.axis.cases import case_text
from truth.axis.machines import Setup, moves
from truth.axis.stepper import Loop, Machine, Sensor

DELAY, RATE, SECONDS = 0.0305, 1000.0, 2.0
TIME = np.arange(round(RATE * SECONDS)) / RATE
FRICTION = {"viscous_friction": {"coefficient": 400.0}, "coulomb_friction": {"level": 60.0}}
DELAYED = {**FRICTION, "input_delay": {"delay": DELAY}}
LOOP = Loop(
    kind="pd", kp=20.0, kd=4.0, limit=40.0, reference=moves(TIME, [0.0, 0.1, 0.02], [0.1, 0.3, 0.2], 2.0)
)


def opened(delay: float | dict) -> Session:
    machine = Machine(inertia=180.0, actuator_gain=226.19, effects=DELAYED)
    of = Setup(machine, LOOP, Sensor(position_resolution=1e-7), RATE, SECONDS, 0)
    run = of.run()
    log = {c: run[n] for c, n in {"t": "t", "q": "position", "u": "force", "ref": "reference"}.items()}
    case = tomllib.loads(case_text(of, tuple(DELAYED.items()), off=1.0))
    case["effects"][-1]["delay"] = delay
    return open_session(case, log)


def test_a_delay_of_thirty_ticks_is_simulated_whole():
    session = opened({"guess": DELAY})
    gap = simulated(session.machine, session.fit.log)
    # The stroke is 0.1 m; a delay that is cut at 12 ticks is off by millimetres.
    assert gap is not None
    assert gap.rms[0] < 2e-5
    short = dataclasses.replace(opened({"guess": 0.012}).machine)
    assert simulated(short, session.fit.log).rms[0] > 1e-3


@pytest.mark.parametrize(
    ("delay", "ticks"), [(0.002, 12), (DELAY, 96), ({"guess": 0.004, "max": 0.04}, 48), (0.0, 12)]
)
def test_the_memory_is_as_long_as_guess_and_max_need(delay, ticks):
    delay = delay if isinstance(delay, dict) else {"guess": delay}
    session = opened(delay)
    assert remembered_ticks(session.machine, session.fit.log) == ticks


def test_a_loop_without_a_memory_simulates_a_plant_with_a_delay_of_zero():
    """A search simulates candidates for a delay so, in a loop that keeps no command."""
    session = opened(0.0)
    machine, log = session.machine, session.fit.log
    runs = []
    for ticks in (0, 2):
        numerics = dataclasses.replace(exact_numerics(machine, log), longest_delay=ticks)
        runs.append(np.asarray(make_replay(machine, log, numerics)(machine.plant).position))
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-9)


def test_a_delay_that_no_loop_can_keep_is_refused():
    session = opened({"guess": 1.0})
    with pytest.raises(InputError, match=r"a delay of 1 s.*2000 ticks.*at most 1536"):
        remembered_ticks(session.machine, session.fit.log)


@pytest.fixture(scope="module")
def guessed_short() -> Session:
    """A case whose guess of the delay, 1 ms, makes a loop keep 12 ticks of the 30.5 that it needs."""
    return opened({"guess": 0.001})


def test_a_fit_that_reaches_the_end_of_the_memory_goes_on_with_more(guessed_short):
    session = guessed_short
    fit = output_error(session.machine, session.fit.log)
    assert fit.converged
    assert fit.details["longest_delay"] == pytest.approx(0.048)
    assert fit.value("input_delay.delay") == pytest.approx(DELAY, abs=1e-5)
    assert not [r for r in remarks_on(session, fit) if "delay" in r.name]


def test_a_delay_at_the_end_of_the_memory_is_a_value_at_a_bound(guessed_short):
    """Twelve ticks, stated: the log seems not to determine a delay that is longer."""
    session = guessed_short
    numerics = dataclasses.replace(choose_numerics(session.machine, session.fit.log), longest_delay=12)
    fit = output_error(session.machine, session.fit.log, numerics=numerics)
    assert fit.value("input_delay.delay") > 0.011
    (remark,) = [r for r in remarks_on(session, fit) if "delay" in r.name]
    assert remark.text == (
        "input_delay.delay is at the longest delay that this fit could simulate, 0.0120 s (12 ticks of the "
        "controller): give it a larger guess or max"
    )
