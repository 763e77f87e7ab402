"""The plant with all candidates: what is evaluated of it, and what a search does with what is found."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.commands import discover as discovery
from jaxid.discovery import candidates as cand
from jaxid.discovery.superset import build_candidate_model
from jaxid.effects import EFFECTS
from jaxid.numerics.affine import Dependence
from jaxid.session import open_session
from jaxid.simulation.force_balance import force_and_columns
from tests.case.test_five_bar_case import FRICTION, LOG, NOISE, UNKNOWN
from tests.support.axis_log import log_of
from tests.support.written_logs import write_csv
from truth.axis import machines
from truth.axis.cases import case_text, write_case
from truth.axis.hidden_effects import COULOMB, VISCOUS
from truth.five_bar.oracle import PLANT, Robot
from truth.five_bar.stepper import followed


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    setup = machines.emps_like(5, 1.0, 6.0)
    case = write_case(tmp_path_factory.mktemp("union"), case_text(setup, (VISCOUS, COULOMB)))
    return open_session(case, log_of(setup), align_hold=True)


def test_a_large_union_is_differentiated_in_parts_alike(session, monkeypatch):
    """By the same columns as all at once; of those not asked for nothing is said."""
    union = build_candidate_model(session.machine, session.fit.data)
    samples = cand.CandidateSamples(session.fit.data)
    theta = union.neutral.copy()
    for c in union.candidates:
        theta[c.index] = c.probe(0)
    with monkeypatch.context() as at_once:
        at_once.setattr(cand, "_COLUMNS", len(theta))
        e, whole = cand.evaluate_on(union, samples.arrays, theta)
    assert whole.shape[-1] > 5 * cand._COLUMNS
    same, parts = cand.evaluate_on(union, samples.arrays, theta)
    np.testing.assert_allclose(same, e, rtol=1e-12)
    size = np.abs(whole).max(axis=(0, 1))
    assert np.all(np.abs(parts - whole).max(axis=(0, 1)) <= 1e-9 * size)
    wanted = [0, 9, 17]
    same, some = cand.evaluate_on(union, samples.arrays, theta, wanted)
    np.testing.assert_allclose(same, e, rtol=1e-12)
    np.testing.assert_array_equal(some[..., wanted], parts[..., wanted])
    assert not np.any(np.delete(some, wanted, axis=-1))
    same, none = cand.evaluate_on(union, samples.arrays, theta, ())
    np.testing.assert_allclose(same, e, rtol=1e-12)
    assert not np.any(none)


def test_a_point_that_is_asked_for_again_is_not_computed_again(session, monkeypatch):
    union = build_candidate_model(session.machine, session.fit.data)
    samples, calls = cand.CandidateSamples(session.fit.data), []
    rows = cand._rows
    monkeypatch.setattr(cand, "_rows", lambda *args: calls.append(1) or rows(*args))
    theta = union.neutral.copy()
    e, jacobian = cand.evaluate(union, samples, theta, [0, 9])
    for fewer in ([9], ()):
        same, again = cand.evaluate(union, samples, theta.copy(), fewer)
        assert same is e
        np.testing.assert_array_equal(again[..., list(fewer)], jacobian[..., list(fewer)])
    assert len(calls) == 1
    more = cand.evaluate(union, samples, theta, [17])[1]
    moved = cand.evaluate(union, samples, theta + 1e-3, [0, 9])[0]
    assert len(calls) == 3
    assert np.any(more[..., 17] != jacobian[..., 17])
    assert np.any(moved != e)


COUPLED = {
    "only the inertial forces": ("tip_mass = 2.72", "tip_mass = { guess = 2.5 }", Dependence.AFFINE),
    "the closure": ("[0.18, 0.25,", "[0.18, { guess = 0.26 },", None),
    "no unknown": ("", "", Dependence.CONSTANT),
}


@pytest.mark.slow
@pytest.mark.parametrize("unknown", COUPLED)
def test_a_coupled_machine_is_known_apart_from_its_effects(tmp_path, unknown):
    """Columns, with what the robot itself does computed once, are those of the whole balance."""
    old, new, enter = COUPLED[unknown]
    log = write_csv(tmp_path / "log.csv", followed(Robot(friction=FRICTION), duration=1.0, **NOISE))
    path = tmp_path / "case.toml"
    path.write_text(PLANT.replace(old, new, 1) + UNKNOWN + LOG)
    session = open_session(path, log, align_hold=True)
    kinds = ("actuator_lag", "hysteresis", "quadratic_drag", "added_mass", "cogging")
    union = build_candidate_model(session.machine, session.fit.data, [EFFECTS[kind] for kind in kinds])
    samples = cand.CandidateSamples(session.fit.data)
    assert union.own_enter is enter
    for at in (union.neutral, 1.01 * union.neutral):
        theta = at.copy()
        for c in union.candidates:
            theta[c.index] = c.probe(0)
        e, columns = cand.evaluate_on(union, samples.arrays, theta)
        plant, places = union.machine.plant, union.machine.parameters.places
        [part] = samples.arrays
        wanted = force_and_columns(plant, places, part.data, jnp.asarray(theta))
        size = np.abs(wanted[1]).max(axis=(0, 1))
        np.testing.assert_allclose(e, wanted[0], rtol=0, atol=1e-11 * np.abs(wanted[0]).max())
        assert np.all(np.abs(columns - wanted[1]).max(axis=(0, 1)) <= 1e-9 * size)


@pytest.mark.parametrize("experiments", [True, False])
def test_experiments_are_left_out_where_they_are_not_wanted(session, monkeypatch, experiments):
    asked = []
    monkeypatch.setattr(discovery, "proposals", lambda *args: asked.append(args) or ())
    discovery.explore(session, max_effects=0, refit=False, experiments=experiments)
    assert bool(asked) == experiments
