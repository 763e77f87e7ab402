"""Bias by noise of readings, on exact logs of a flexible joint whose loop is faster than its log."""

import numpy as np

import jaxid
from jaxid.estimators import METHODS
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.numerics.lanes import run_alone
from jaxid.session import open_session
from truth.chain.flexible_joints import FlexibleJoint, case, flexible_joint

# Its resonance lies at 23 Hz, and least squares finds 2/3 of the stiffness, 3 deviations off; that of the
# other one at 37 Hz, whose elongation the encoders do not show at 200 Hz.
SOFT, STIFF = 2, 4


def deviations(estimate, true: dict[str, float]) -> np.ndarray:
    """Return the errors of all values in standard deviations; NaN where one is not identifiable."""
    return np.array(
        [(estimate.value(n) - true[n]) / s for n, s in zip(estimate.names, estimate.std, strict=True)]
    )


def test_the_bias_of_an_elongation_between_two_encoders_is_removed():
    joint = flexible_joint(SOFT)
    session = open_session(case(), joint.log(200.0))
    plain = inverse_dynamics(session.machine, session.fit.data)
    assert np.nanmax(np.abs(deviations(plain, joint.true))) > 3.0
    fit = jaxid.identify(case(), joint.log(200.0))
    z = deviations(fit.estimate, joint.true)
    assert fit.estimate.method == "inverse_dynamics"
    assert np.all(np.abs(z) < 2.0), z
    # Not by intervals that hold everything.
    assert fit.estimate.std[fit.estimate.names.index("stiffness")] < 0.07 * joint.true["stiffness"]
    assert 0.05 < fit.estimate.details["reading_noise"]["share"] < 0.2
    assert any("bias by the noise" in note for note in fit.estimate.notes)


def test_what_noise_hides_is_not_identifiable():
    """Least squares alone finds no load at all: 30 and 300 deviations off."""
    joint = flexible_joint(STIFF)
    fit = jaxid.identify(case(), joint.log(200.0))
    seen = dict(zip(fit.estimate.names, fit.estimate.identifiable, strict=True))
    assert not any(
        seen[n] for n in ("motor_inertia", "load_inertia", "stiffness", "coulomb_friction[2].level")
    )
    assert {"load_inertia", "stiffness"} <= {n for c in fit.estimate.precision.unidentifiable for n in c}
    assert fit.estimate.details["reading_noise"]["share"] > 0.8
    assert {"load_inertia", "stiffness"} <= {*fit.estimate.details["reading_noise"]["hidden"]}
    assert fit.findings[1].startswith("Noise of the readings hides motor_inertia, load_inertia, stiffness")
    assert "instrumental_variable" in fit.findings[1]


def test_two_logs_are_corrected_together():
    joint = flexible_joint(SOFT)
    log = joint.log(200.0)
    half = len(log["t"]) // 2
    parts = [{n: x[:half] for n, x in log.items()}, {n: x[half:] for n, x in log.items()}]
    session = open_session(case(), parts)
    fit = run_alone(METHODS["inverse_dynamics"](session))
    z = deviations(fit, joint.true)
    assert fit.details["reading_noise"]["share"] > 0.05
    assert np.all(np.abs(z) < 2.5), z


def test_exact_readings_are_left_alone():
    """A log whose encoders are stated as exact has no such bias."""
    joint = flexible_joint(SOFT)
    tables = case() | {"sensor": {"position_noise": 1e-12}}
    session = open_session(tables, joint.log(200.0))
    plain = inverse_dynamics(session.machine, session.fit.data)
    fit = run_alone(METHODS["inverse_dynamics"](session))
    assert "reading_noise" not in fit.details
    np.testing.assert_array_equal(fit.theta, plain.theta)


def with_a_second_friction(seed: int):
    """Fit a joint of which two unknowns cannot be told apart by any log."""
    tables = case()
    twice = {"kind": "viscous_friction", "joint": 1, "coefficient": {"guess": 0.1}}
    tables["effects"] = [*tables["effects"], twice]
    session = open_session(tables, flexible_joint(seed).log(200.0))
    return run_alone(METHODS["inverse_dynamics"](session))


def test_unknowns_that_no_log_tells_apart_are_not_hidden_by_noise():
    fit = with_a_second_friction(SOFT)
    assert fit.details["reading_noise"]["share"] < 0.5
    assert [len(c) for c in fit.precision.unidentifiable] == [2]
    assert fit.details["reading_noise"]["hidden"] == []


def test_what_noise_hides_stands_beside_what_no_log_tells_apart():
    fit = with_a_second_friction(STIFF)
    assert len(fit.precision.unidentifiable) == 2
    assert {"load_inertia", "stiffness"} <= {*fit.precision.unidentifiable[-1]}


def test_a_value_at_its_bound_stays_there_while_others_are_corrected():
    """A load without dry friction, whose level is at zero: the stiffness loses its bias all the same."""
    joint = flexible_joint(SOFT)
    bare = FlexibleJoint(SOFT, joint.true | {"coulomb_friction[2].level": 1e-6})
    session = open_session(case(), bare.log(200.0))
    fit = run_alone(METHODS["inverse_dynamics"](session))
    z = (fit.value("stiffness") - bare.true["stiffness"]) / fit.std[fit.names.index("stiffness")]
    assert fit.details["reading_noise"]["share"] > 0.05
    assert abs(z) < 2.5
