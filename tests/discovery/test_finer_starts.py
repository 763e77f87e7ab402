"""Starts that a search tries where nothing else explains a log, on logs of an independent simulator."""

import numpy as np
import pytest

import jaxid
from jaxid.discovery.superset import build_candidate_model
from jaxid.session import open_session
from tests.support.axis_log import log_of
from tests.support.hidden_effect import search_hidden
from truth.axis import machines
from truth.axis.cases import case_text, write_case


def test_finer_starts_follow_the_others(tmp_path):
    setup = machines.servo(0, 1.0, 1.5)
    session = open_session(write_case(tmp_path, case_text(setup, [], motion="rotary")), log_of(setup))
    superset = build_candidate_model(session.machine, session.fit.data)
    coarse = next(c for c in superset.candidates if c.kind == "cogging")
    fine = coarse.finer()

    periods = fine.starts[:, 1]
    stroke = np.ptp(log_of(setup).position)
    assert len(fine.starts) > 5 * len(coarse.starts)
    assert np.array_equal(fine.starts[: len(coarse.starts)], coarse.starts)
    # Neighbouring periods differ by half a turn over the stroke everywhere.
    assert np.diff(np.unique(np.round(stroke / periods, 6))) == pytest.approx(0.5, rel=0.05)
    assert stroke / periods.min() > 390
    assert fine.finer() is fine


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "motion", "turns"), [("servo", "rotary", 100), ("emps_like", "linear", 300)]
)
def test_a_fine_ripple_is_named_with_its_period(preset, motion, turns, tmp_path):
    setup = getattr(machines, preset)(3, 1.0, 6.0)
    period = np.ptp(log_of(setup).position) / turns
    level = setup.machine.effects["coulomb_friction"]["level"]
    hidden = setup.with_effect("cogging", amplitude=0.3 * level, period=period, phase=0.4)
    case = write_case(tmp_path, case_text(setup, [*setup.machine.effects.items()], motion=motion))

    found = jaxid.discover(case, log_of(hidden), refit=False)
    assert [e.kind for e in found.effects] == ["cogging"]
    # A shift of a quarter of a turn over the stroke would be another ripple.
    assert found.parameters["cogging.period"].value == pytest.approx(period, rel=0.25 / turns)


@pytest.mark.slow
def test_a_limit_that_holds_for_much_of_a_log_is_named_with_its_value(tmp_path):
    """Of the first starts those beside this limit leave a larger residual than no limit."""
    found, truth = search_hidden(tmp_path, "saturation", "heavy_slide", 0.3, 18159)
    assert found.kinds == ["saturation"]
    limit = found.parameters["saturation.limit"]
    assert abs(limit.value - truth["saturation.limit"]) < 3 * limit.std
    assert limit.std < 1e-3 * limit.value
