"""Logs at 50 Hz of exact servos whose loops tick 4 and 10 times a row: what the case leaves open is found."""

import numpy as np

import jaxid
from jaxid.consistency.law import law_of_rows
from jaxid.consistency.reference_hold import UNDECIDED
from jaxid.session import open_session
from truth.axis.held_loop import Servo, drawn, log_of

NOISE = 3e-5  # rad
LOG = {"time": "t", "position": "q", "force": "u", "reference": "ref"}


def case(servo: Servo, **tables) -> dict:
    """Return the case of a servo with its law, its guesses off by a factor of 1.4."""
    law = {"kind": "pd", "derivative": "velocity", "kp": servo.kp, "kd": servo.kd, "period": servo.period}
    return {
        "plant": {
            "kind": "axis",
            "motion": "rotary",
            "parameters": {"inertia": {"guess": 1.4 * servo.inertia}},
        },
        "effects": [
            {"kind": "viscous_friction", "coefficient": {"guess": servo.viscous / 1.4}},
            {"kind": "coulomb_friction", "level": {"guess": 1.4 * servo.coulomb}},
        ],
        "log": LOG,
        "controller": law,
        **tables,
    }


def fitted(seed: int, every: int, *, own_velocity: bool, noise: float = NOISE, **tables):
    """Identify a drawn servo; return the result, and its errors in standard deviations."""
    servo, target = drawn(seed, every, own_velocity=own_velocity)
    log = log_of(servo, target, every, noise=noise, seed=seed)
    result = jaxid.identify(case(servo, **tables), log)
    true = np.array([servo.inertia, servo.viscous, servo.coulomb])
    return result, (result.estimate.theta - true) / result.estimate.std


def test_the_course_of_the_target_is_found_by_fits_where_forces_do_not_decide_it():
    """With the default course inertia and viscous friction were off by 46 and 58 sigma."""
    result, z = fitted(24, 4, own_velocity=True, log={**LOG, "loop_velocity": "dq"})
    assert result.session.settings["reference_hold"]["reason"].startswith(UNDECIDED)
    assert result.settings["reference_hold"]["value"] == "zero_order"
    assert np.all(np.abs(z) < 3.5), z
    assert result.model_complete
    assert np.all(result.estimate.std / result.estimate.theta < 1e-3)


def test_a_velocity_that_the_drive_measures_is_found():
    """As a loop that differences positions the inertia was off by kd times half a tick."""
    result, z = fitted(24, 4, own_velocity=True)
    assert result.settings["loop_velocity"]["value"] == "measured"
    assert np.all(np.abs(z) < 3.5), z


def test_a_loop_that_differences_positions_is_found():
    result, z = fitted(20, 4, own_velocity=False)
    assert result.settings["loop_velocity"]["value"] == "differenced"
    assert np.all(np.abs(z) < 3.5), z


def test_what_a_log_does_not_decide_is_within_the_intervals():
    """Noise of the encoder, half a degree and differenced in the loop, hides target and velocity."""
    result, z = fitted(20, 4, own_velocity=True, noise=1e-2)
    for name in ("reference_hold", "loop_velocity"):
        assert "about equally well" in result.settings[name]["reason"]
    assert np.all(np.abs(z) < 1.96), z


def test_the_law_of_the_rows_is_named_where_no_loop_is_declared():
    servo, target = drawn(3, 4, own_velocity=True)
    log = log_of(servo, target, 4, noise=NOISE)
    made = case(servo, log={**LOG, "velocity": "dq"})
    del made["controller"]
    session = open_session(made, log)
    text = f"kind = 'pd' with derivative = 'velocity', kp = {servo.kp:.4g}, kd = {servo.kd:.4g}"
    assert law_of_rows(session.machine, session.fit.log) == text
