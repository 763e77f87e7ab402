"""A double pendulum that hangs, driven by a sine at its lower resonance, logged at 100 Hz.

Near a resonance the driving torque is a small difference of large ones, so that inverse dynamics hangs on
what its filter does to each of them.
"""

import numpy as np
import pytest

import jaxid
from truth.arm.two_links import TwoLinks, run_sampled
from truth.arm.two_links_case import plant_lines

RATE, SECONDS, NOISE = 100.0, 20.0, 1e-4
LINKS = TwoLinks(viscous=(0.05, 0.03), coulomb=(0.0, 0.0))
TRUE = {
    "first_moment_x[1]": LINKS.m1 * LINKS.x1,
    "first_moment_x[2]": LINKS.base["first_moment_x[2]"],
    "first_moment_y[2]": LINKS.base["first_moment_y[2]"],
    "inertia_zz[1]": LINKS.i1 + LINKS.m1 * LINKS.x1**2,
    "inertia_zz[2]": LINKS.base["inertia_zz[2]"],
    "viscous_friction[1].coefficient": LINKS.viscous[0],
    "viscous_friction[2].coefficient": LINKS.viscous[1],
}


def resonance() -> float:
    """Return the lower resonance of small motions about the hanging pendulum [Hz]."""
    base, couple = LINKS.base, LINKS.length * LINKS.base["first_moment_x[2]"]
    m12, m22 = base["inertia_zz[2]"] + couple, base["inertia_zz[2]"]
    mass = np.array([[base["inertia_zz[1]"] + m22 + 2 * couple, m12], [m12, m22]])
    outer = base["first_moment_x[2]"]
    weight = LINKS.gravity * np.array([[base["first_moment_x[1]"] + outer, outer], [outer, outer]])
    return float(np.sqrt(np.linalg.eigvals(np.linalg.solve(mass, weight)).min()) / (2 * np.pi))


@pytest.fixture(scope="module")
def log():
    t = np.arange(round(RATE * SECONDS)) / RATE
    torque = np.stack([2.0 * np.sin(2 * np.pi * resonance() * t), np.zeros_like(t)], axis=1)
    start = np.array([-np.pi / 2, 0.0])
    run = run_sampled(LINKS, start=start, command=torque, rate=RATE, noise=NOISE, force_noise=0.01, seed=1)
    assert np.ptp(run["q1"]) > 2.5, "it swings far"
    return run


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    entry = lambda name: f"{{ guess = {1.5 * TRUE[name]!r} }}"
    lines = plant_lines(LINKS, entry)
    friction = ", ".join(entry(f"viscous_friction[{k}].coefficient") for k in (1, 2))
    lines += ["[[effects]]", 'kind = "viscous_friction"', f"coefficient = [{friction}]"]
    lines += ["[log]", 'time = "t"', 'position = ["q1", "q2"]', 'force = ["u1", "u2"]']
    path = tmp_path_factory.mktemp("pendulum") / "case.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def deviations(fitted) -> np.ndarray:
    estimate = fitted.estimate
    true = np.array([TRUE[name] for name in estimate.names])
    return np.abs(estimate.theta - true) / estimate.std


@pytest.mark.slow
def test_intervals_of_the_chosen_method_hold(case, log):
    fitted = jaxid.identify(case, log)
    assert fitted.estimate.method == "prediction_error"
    assert fitted.model_complete is True
    assert deviations(fitted).max() < 3.0
    assert np.all(np.abs(fitted.estimate.std / fitted.estimate.theta) < 0.01)


@pytest.mark.slow
def test_what_the_filter_does_at_the_resonance_is_said(case, log):
    fitted = jaxid.identify(case, log, method="inverse_dynamics")
    assert deviations(fitted).max() > 3.0, "the filter moves the values"
    assert fitted.model_complete is False
    assert str(fitted).startswith("The model is incomplete")
