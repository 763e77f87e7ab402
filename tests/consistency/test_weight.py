"""A pendulum with a declared weight: an inertia below that of its mass is said by check, and first of all."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxid

# 0.5 kg at 0.5 m, and its rod: least inertia 0.125 kg m^2.
INERTIA, MOMENT, VISCOUS = 0.133, 0.25, 0.02
CASE = """
[plant]
kind = "serial_arm"
gravity_vector = [9.81, 0.0, 0.0]
[[plant.links]]
joint = "revolute"
alpha_deg = 0.0
a = 0.0
mass = {mass}
first_moment = [0.25, 0.0, 0.0]
inertia = [0.0, 0.0, 0.0, 0.0, 0.0, {{ guess = 0.2 }}]
[[effects]]
kind = "viscous_friction"
coefficient = {{ guess = 0.05 }}
[log]
time = "t"
position = ["q"]
force = ["u"]
hold = "linear"
"""


@pytest.fixture(scope="module")
def log() -> dict[str, np.ndarray]:
    """A pendulum under two sines of torque, by an integrator of scipy, read with 10 urad of noise."""
    time = np.arange(0.0, 8.0, 2e-3)

    def torque(t):
        return 1.5 * np.sin(9.0 * t) + 1.2 * np.sin(17.0 * t + 1.0)

    def slope(t, x):
        return [x[1], (torque(t) - VISCOUS * x[1] - 9.81 * MOMENT * np.sin(x[0])) / INERTIA]

    run = solve_ivp(slope, (0.0, 8.0), [0.0, 0.0], t_eval=time, rtol=1e-10, atol=1e-12)
    noise = 1e-5 * np.random.default_rng(0).standard_normal(time.size)
    return {"t": time, "q": run.y[0] + noise, "u": torque(time)}


def fitted(folder, log, mass: float):
    path = folder / "case.toml"
    path.write_text(CASE.format(mass=mass))
    return jaxid.check(path, log), jaxid.identify(path, log, method="inverse_dynamics")


def test_a_weight_that_the_inertia_can_have_is_not_questioned(tmp_path, log):
    checked, found = fitted(tmp_path, log, 0.5)
    assert found.estimate.theta[0] == pytest.approx(INERTIA, rel=2e-3)
    assert not [line for line in (*checked.warnings, *found.findings) if "below" in line]


def test_an_inertia_below_that_of_the_declared_weight_is_said_first(tmp_path, log):
    """A weight such as that of 0.4 kg at 0.625 m has at least 0.156 kg m^2."""
    checked, found = fitted(tmp_path, log, 0.4)
    (line,) = [line for line in checked.warnings if "below" in line]
    assert "least squares gives inertia_zz[1] = 0.133" in line
    assert "below 0.156" in line
    first = found.findings[0]
    assert first.startswith("The fit contradicts the case: inertia_zz[1] = 0.133")
    assert "is below 0.156" in first
    assert "declared mass at its centre of mass" in first
    assert found.model_complete
