"""A model that ran away, to next to no inertia: no command may simulate it for ever."""

import numpy as np
import pytest

from jaxid.discovery.at_rest.break_away import break_away
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.gap import gaps
from jaxid.session import open_session
from jaxid.simulation.step_size import TooStiffError, _rounded, needed_steps
from tests.support.axis_log import log_of
from tests.support.cli_setup import recorded, run, text
from tests.support.written_logs import write_csv
from truth.axis import machines
from truth.axis.cases import case_text, write_case


@pytest.fixture(scope="module")
def light(tmp_path_factory):
    """A session whose inertia is a billion billion times too small."""
    setup = machines.emps_like(3, 1.0, 2.0)
    written = case_text(setup, [*setup.machine.effects.items()])
    session = open_session(write_case(tmp_path_factory.mktemp("light"), written), log_of(setup))
    names = session.machine.parameters.names
    assert names[0] == "inertia"
    theta = np.asarray(session.machine.parameters.guess).copy()
    theta[0] = 1e-18
    return session.with_machine(session.machine.with_estimate(theta))


def test_it_is_refused(light):
    with pytest.raises(TooStiffError, match=r"integration steps every 0.001 s.*inertia") as caught:
        needed_steps(light.machine, light.fit.log)
    assert "stepper.csv" in str(caught.value)


def test_its_gap_is_in_the_force_only(light):
    (gap,) = gaps(light.machine, light.runs)
    assert gap.simulation is None
    assert np.all(np.isfinite(gap.force.rms))


def test_no_start_from_rest_is_run(light):
    estimate = inverse_dynamics(light.machine, light.fit.data)
    estimate = type(estimate)(**{**vars(estimate), "machine": light.machine})
    assert break_away(estimate, light.runs) == ["the resulting model is too stiff to be simulated"]


def test_identify_says_so_and_writes_nothing(capsys, tmp_path):
    known = text().replace("[plant.parameters]\ninertia = ", "[plant.parameters]\ninertia = 1e-18 #")
    case = write_case(tmp_path, known)
    log = write_csv(tmp_path / "log.csv", recorded())
    ran = run(capsys, "identify", case, log, folder=tmp_path / "out")
    assert ran.status == 2
    assert "integration steps every" in ran.err
    assert ran.err.count("\n") == 1
    assert not ran.folder.exists()


def test_numbers_of_steps_are_few_and_never_too_small():
    """Every other number compiles anew: guesses of one machine that differ must share theirs."""
    asked = np.arange(1, 2001)
    given = np.array([_rounded(int(k)) for k in asked])
    assert np.all(given >= asked)
    assert np.all(given <= np.ceil(1.2 * asked))
    assert len(set(given[asked > 8])) < 40
    np.testing.assert_array_equal(given[:8], asked[:8])
