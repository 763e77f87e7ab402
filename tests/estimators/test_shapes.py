"""An effect whose shape a log does not show."""

import dataclasses

import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.estimators.common.scoring import maximise_likelihood
from jaxid.estimators.common.shapes import within_a_turn, without_unseen_shapes
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.numerics.precision import Precision
from jaxid.session import open_session
from truth.axis.cases import case_text, recorded
from truth.axis.machines import Setup, emps_like, multisine
from truth.axis.stepper import Loop, Sensor

FRICTION = [("viscous_friction", {"coefficient": 203.5}), ("coulomb_friction", {"level": 20.4})]


SHAPED = [*FRICTION, ("stribeck_friction", {"level": 5.0, "velocity": 0.02})]


@pytest.fixture(scope="module")
def estimate(tmp_path_factory):
    """A fit whose effect with a shape counts as identifiable or not as a test says."""
    path, t = tmp_path_factory.mktemp("shape") / "case.toml", np.arange(1500) / 1000.0
    machine = emps_like().machine
    for kind, values in SHAPED:
        machine = machine.with_effect(kind, **values)
    loop = Loop(kind="open_loop", input=multisine(t, [0.8, 1.9, 3.7], 3.0, 1))
    setup = Setup(machine, loop, Sensor(1e-6, 7e-7, 0.05), rate=1000.0, duration=1.5, seed=1)
    log = recorded(setup)
    path.write_text(case_text(setup, SHAPED, closed=False))
    session = open_session(path, {"t": log["time"], "q": log["position"], "u": log["force"]})
    return inverse_dynamics(session.machine, session.fit.data)


def blind(estimate, *names):
    seen = np.array([name not in names for name in estimate.names])
    covariance = np.where(np.outer(seen, seen), 1e-4 * np.eye(len(seen)) + 1e-5, np.nan)
    precision = dataclasses.replace(
        estimate.precision, covariance=covariance, identifiable=seen, unidentifiable=[{n: 1.0} for n in names]
    )
    return dataclasses.replace(estimate, precision=precision)


def test_the_strength_is_not_identifiable_without_the_shape(estimate):
    found = without_unseen_shapes(blind(estimate, "stribeck_friction.velocity"))
    seen = dict(zip(found.names, found.identifiable, strict=True))
    assert seen == {name: not name.startswith("stribeck") for name in found.names}
    assert np.array_equal(np.isfinite(found.std), found.identifiable)
    assert {"stribeck_friction.level": 1.0} in found.precision.unidentifiable
    assert found.notes[-1].startswith("stribeck_friction.level: not identifiable without the shape")


@pytest.mark.parametrize(("ratio", "seen"), [(0.8, True), (1.2, False)])
def test_the_strength_needs_a_shape_larger_than_its_deviation(estimate, ratio, seen):
    names = list(estimate.names)
    velocity = names.index("stribeck_friction.velocity")
    std = np.full(len(names), 1e-3)
    std[velocity] = ratio * estimate.theta[velocity]
    precision = dataclasses.replace(blind(estimate).precision, covariance=np.diag(std**2))
    found = without_unseen_shapes(dataclasses.replace(estimate, precision=precision))
    assert dict(zip(names, found.identifiable, strict=True)) == {
        name: seen or not name.startswith("stribeck") for name in names
    }


def test_a_lag_needs_no_strength():
    case = {
        "plant": {"kind": "axis", "parameters": {"inertia": {"guess": 2.0}}},
        "effects": [{"kind": "actuator_lag", "time_constant": {"guess": 0.01}}],
    }
    machine = build_machine(load_case(case))
    values = np.array([2.0, 0.01])
    before = Estimate(
        method="inverse_dynamics",
        machine=machine.with_estimate(values),
        theta=values,
        precision=Precision(np.diag([1e-4, 0.02**2]), np.ones(2, bool), [], np.ones(2)),
        converged=True,
        message="converged",
        residual=np.zeros((5, 1)),
        samples=5,
    )
    assert without_unseen_shapes(before) is before


@pytest.mark.parametrize("names", [(), ("inertia",), ("stribeck_friction.level",)])
def test_whatever_has_no_unseen_shape_stays(estimate, names):
    before = blind(estimate, *names)
    assert without_unseen_shapes(before) is before


def test_scoring_stays_where_the_likelihood_has_slopes():
    import jax
    import jax.numpy as jnp

    @jax.custom_jvp
    def steep(x):
        return x

    @steep.defjvp
    def _(primals, tangents):
        (x,), (dx,) = primals, tangents
        return x, jnp.where(x > 2.0, jnp.nan, 0.3) * dx

    def outputs(x):
        e = jnp.full((50, 1), 5.0) - steep(x[0])
        return e, jnp.ones_like(e)

    limits = (np.array([-10.0]), np.array([10.0]))
    fit = maximise_likelihood(outputs, np.ones((50, 1), bool), np.array([0.5]), *limits, 40)
    assert np.isfinite(fit.mean).all()
    assert 1.5 < float(fit.x[0]) <= 2.0


def test_whole_turns_are_taken_off_a_phase():
    """A step of a fit went 1e8 turns off, and 7e8 +- 0.03 rad was printed."""
    case = {
        "plant": {"kind": "axis", "parameters": {"inertia": {"guess": 2.0}}},
        "effects": [{"kind": "cogging", "amplitude": 1.0, "period": 0.1, "phase": {"guess": 0.5}}],
    }
    machine = build_machine(load_case(case))
    far = np.array([7.0, 0.7 + 2 * np.pi * 1e6])
    estimate = Estimate(
        method="inverse_dynamics",
        machine=machine.with_estimate(far),
        theta=far,
        precision=Precision(np.eye(2), np.ones(2, bool), [], np.ones(2)),
        converged=True,
        message="converged",
        residual=np.zeros((5, 1)),
        samples=5,
    )
    found = within_a_turn(estimate, machine.parameters.guess)
    # Of 1e6 turns some rounding stays.
    np.testing.assert_allclose(found.theta, [7.0, 0.7], atol=1e-8)
    assert float(found.machine.plant.effects[0].phase) == found.theta[1]
    assert within_a_turn(found, machine.parameters.guess) is found
