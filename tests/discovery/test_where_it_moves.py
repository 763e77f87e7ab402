"""Searches whose log moves little and far from the origin, slowly, or from a jerk on."""

import dataclasses

import numpy as np
import pytest

import jaxid
from tests.support.axis_log import log_of
from truth.axis import machines
from truth.axis.cases import case_text, write_case
from truth.axis.hidden_effects import COULOMB, SEARCH_CASES, VISCOUS


def near(origin: float, t: np.ndarray) -> np.ndarray:
    """Return strokes of some centimetres."""
    return origin + 0.02 * np.sin(2 * np.pi * 0.7 * t) + 0.008 * np.sin(2 * np.pi * 2.1 * t)


def slow(_: float, t: np.ndarray) -> np.ndarray:
    """Return a sine of which friction and a spring hide the inertia."""
    return 0.1 * np.sin(2 * np.pi * 0.08 * t)


def searched(folder, motion, origin: float, hidden: str | None):
    """Search a log of an axis that starts from rest, on a reference that moves at once."""
    own = machines.emps_like(4, 1.0, 8.0)
    reference = motion(origin, np.arange(round(8.0 * own.rate)) / own.rate)
    effects = {kind: dict(values) for kind, values in (VISCOUS, COULOMB)}
    if hidden is not None:
        effects[hidden] = dict(SEARCH_CASES[hidden].values)
    machine = dataclasses.replace(own.machine, effects=effects)
    own = dataclasses.replace(own, machine=machine, loop=dataclasses.replace(own.loop, reference=reference))
    case = write_case(folder, case_text(own, (VISCOUS, COULOMB), off=1.4))
    log = log_of(own, initial_position=float(reference[0]))
    return jaxid.discover(case, log, refit=False, experiments=False)


@pytest.mark.parametrize("origin", [3.0, -40.0])
def test_a_complete_model_far_from_the_origin_lacks_nothing(origin, tmp_path):
    """The candidates' springs at their neutral values pushed with 0.3 N there, and one was found."""
    found = searched(tmp_path, near, origin, None)
    assert (found.verdict, found.kinds, found.model_complete) == ("nothing_missing", [], True)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", ["quadratic_drag", "asymmetric_viscous", "stribeck_friction", "cogging"])
def test_an_effect_far_from_the_origin_is_found_alone(hidden, tmp_path):
    """A cubic stiffness was named beside it; the ripple was taken out, because the log begins with a jerk."""
    found = searched(tmp_path, near, 3.0, hidden)
    assert (found.kinds, found.model_complete) == ([hidden], True)


@pytest.mark.slow
def test_an_inertia_that_a_missing_spring_made_vanish_returns(tmp_path):
    found = searched(tmp_path, slow, 0.0, "linear_stiffness")
    assert (found.kinds, found.model_complete) == (["linear_stiffness"], True)
    assert found.value("inertia") == pytest.approx(95.1, rel=0.01)
    assert found.value("linear_stiffness.coefficient") == pytest.approx(100.0, rel=0.01)
