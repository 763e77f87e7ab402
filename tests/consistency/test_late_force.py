"""A force that was logged late or through a low-pass, held against effects that turn the phase of a force."""

import tomllib

import numpy as np
import pytest

import jaxid
from jaxid.consistency.late_force import LateForce, late_force
from jaxid.session import Session, open_session
from jaxid.session.preparing import under_hold
from truth.axis.cases import case_text
from truth.axis.machines import Setup, servo

PERIOD = 0.001
FRICTION = (("viscous_friction", {"coefficient": 2e-4}), ("coulomb_friction", {"level": 0.01}))
# What a search finds in place of a force that is 2 ms late, or behind a low-pass of 4 ms: a damper.
DAMPED = {2: (4e-5, 0.202, 2.02e-4), 4: (0.03, 0.0212, 8.57e-5)}


def low_passed(u: np.ndarray, lag: float) -> np.ndarray:
    out, part = np.zeros_like(u), 1.0 - np.exp(-PERIOD / lag)
    for k in range(1, u.size):
        out[k] = out[k - 1] + part * (u[k] - out[k - 1])
    return out


def late_by_two(u: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros(2), u[:-2]])


def logged(setup: Setup, how=lambda u: u) -> dict[str, np.ndarray]:
    """The log of a run whose force reaches the file in some way; the noise of its reading comes last."""
    run = setup.run()
    noise = run["force"] - run["true_command"]
    return {"t": run["t"], "q": run["position"], "u": how(run["true_command"]) + noise}


def opened(setup: Setup, log: dict[str, np.ndarray], *more: tuple[str, dict[str, float]]) -> Session:
    """The session of the rotary axis under its frictions, with more effects of known values."""
    case = tomllib.loads(case_text(setup, FRICTION, motion="rotary", closed=False))
    case["effects"] += [{"kind": kind, **values} for kind, values in more]
    return open_session(case, log, align_hold=True, method="discover")


def held(setup: Setup, log: dict[str, np.ndarray], kind: str, **values: float) -> LateForce | None:
    plain, whole = opened(setup, log), opened(setup, log, (kind, values))
    default = under_hold("zero_order", plain.fit, plain.machine).data
    return late_force(plain.machine, whole.machine, plain.fit.data, [kind], default)


def damped(milliseconds: int) -> dict[str, float]:
    return dict(zip(("stiffness", "damping", "load_inertia"), DAMPED[milliseconds], strict=True))


def test_a_force_that_was_logged_late_is_not_taken_for_a_spring():
    setup = servo(duration=5.0)
    late = held(setup, logged(setup, late_by_two), "joint_flexibility", **damped(2))
    assert late is not None
    assert late.lag == 0.0
    assert late.delay == pytest.approx(2 * PERIOD, rel=0.02)
    assert late.findings[0].startswith(
        "The force seems to be logged 2 ms late: that explains the log as well as joint_flexibility does"
    )
    assert "set delay = { force = 0.002 } in [log]" in late.findings[1]


def test_a_force_that_was_logged_through_a_low_pass_is_not_taken_for_a_spring():
    setup = servo(duration=5.0)
    log = logged(setup, lambda u: low_passed(u, 0.004))
    late = held(setup, log, "joint_flexibility", **damped(4))
    assert late is not None
    assert late.delay == 0.0
    assert late.lag == pytest.approx(0.004, rel=0.02)
    assert "set lag = { force = 0.004 } in [log]" in late.findings[1]


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("input_delay", {"delay": 0.0025}),
        ("actuator_lag", {"time_constant": 0.004}),
        ("saturation", {"limit": 0.05}),
        ("quadratic_drag", {"coefficient": 1e-5}),
    ],
)
def test_what_a_machine_does_is_no_late_force(kind, values):
    """A drive that acts late is the opposite of a reading that is late."""
    setup = servo(duration=5.0).with_effect(kind, **values)
    assert held(setup, logged(setup), kind, **values) is None


def test_a_complete_model_has_no_late_force():
    setup = servo(duration=5.0)
    assert held(setup, logged(setup), "joint_flexibility", **damped(2)) is None
    plain = opened(setup, logged(setup))
    assert late_force(plain.machine, plain.machine, plain.fit.data, []) is None


def searched(log: dict[str, np.ndarray], **of_log: dict[str, float]) -> jaxid.Discovery:
    case = tomllib.loads(case_text(servo(), FRICTION, motion="rotary", closed=False))
    case["log"] |= of_log
    return jaxid.discover(case, log, refit=False)


@pytest.mark.slow
def test_a_search_says_that_a_force_was_logged_late_and_how_to_take_it_back():
    log = logged(servo(), late_by_two)
    found = searched(log)
    # The spring that looks like it has a load heavier than the joint: it is turned down.
    assert found.verdict == "unexplained"
    assert found.force_reading is not None
    assert found.force_reading.delay == pytest.approx(2 * PERIOD, rel=0.02)
    assert found.findings[0].startswith("The force seems to be logged 2 ms late")
    assert found.model_complete is not True

    back = searched(log, delay={"force": 0.002})
    assert back.verdict == "nothing_missing"
    assert back.model_complete
    assert back.parameters["inertia"].value == pytest.approx(1e-4, abs=3 * back.parameters["inertia"].std)


@pytest.mark.slow
def test_a_search_says_that_a_force_passed_a_low_pass():
    log = logged(servo(), lambda u: low_passed(u, 0.004))
    found = searched(log)
    assert found.verdict == "found"
    assert found.force_reading is not None
    assert found.force_reading.lag == pytest.approx(0.004, rel=0.02)
    assert found.model_complete is not True

    back = searched(log, lag={"force": 0.004})
    assert back.verdict == "nothing_missing"
    assert back.parameters["inertia"].value == pytest.approx(1e-4, abs=3 * back.parameters["inertia"].std)
