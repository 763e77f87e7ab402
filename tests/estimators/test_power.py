"""Energy balances over windows, against exact steppers and an arm whose mass depends on where it is."""

import dataclasses
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxid.errors import InputError
from jaxid.estimators.power import power
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared, Recipe
from jaxid.machine import Machine
from jaxid.model.parameter import parameter
from jaxid.model.plant import Plant
from jaxid.model.units import Units
from jaxid.model.unknowns import Free, Parameters
from jaxid.session import open_session
from tests.support.axis_log import log_of
from truth.axis.cases import case_text, write_case
from truth.axis.machines import emps_like, moves
from truth.axis.stepper import Loop, Sensor
from truth.chain.stepper import ChainMachine, simulate_chain

VISCOUS = ("viscous_friction", {"coefficient": 203.5})
COULOMB = ("coulomb_friction", {"level": 20.39})
TRUTH = np.array([95.1, 203.5, 20.39])


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    setup = dataclasses.replace(
        emps_like(0, duration=8.0), sensor=Sensor(position_resolution=1e-7, position_noise=1e-6)
    )
    case = write_case(tmp_path_factory.mktemp("axis"), case_text(setup, [VISCOUS, COULOMB], off=3.0))
    return open_session(case, log_of(setup))


def test_an_axis_with_dry_friction(axis):
    """Quantised, noisy readings in the loop; starts a factor of three off."""
    estimate = power(axis.machine, axis.fit.data)
    assert estimate.converged
    np.testing.assert_allclose(estimate.theta, TRUTH, rtol=1.5e-3)
    assert np.all(np.abs(estimate.theta - TRUTH) < 4 * estimate.std)
    assert "windows of" in estimate.notes[0]


def test_accelerations_are_not_looked_at(axis):
    data = axis.fit.data
    without = replace(data, qdd=np.full_like(data.qdd, 1e3))
    one, other = (power(axis.machine, d).theta for d in (data, without))
    np.testing.assert_array_equal(one, other)


def test_a_log_too_short_for_its_windows(axis):
    short = axis.fit.data
    short = replace(short, q=short.q[:400], qd=short.qd[:400], qdd=short.qdd[:400], force=short.force[:400])
    with pytest.raises(InputError, match=r"windows of .* fit into the log; take a longer log"):
        power(axis.machine, short)


CHAIN = """
[plant]
kind = "chain"
[plant.parameters]
mass = [{ guess = 1.0 }, { guess = 3.0 }]
damping = [{ guess = 4.0 }, { guess = 4.0 }]
stiffness = [{ guess = 900.0 }, { guess = 2500.0 }, { guess = 900.0 }]
[[effects]]
kind = "coulomb_friction"
joint = 1
level = { guess = 1.0 }
[log]
time = "t"
position = ["q1", "q2"]
force = ["u1", "u2"]
"""


def test_a_chain_has_a_balance_a_mass(tmp_path):
    t = np.arange(6000) / 1000.0
    machine = ChainMachine([2.0, 1.5], [8.0, 8.0], [1500.0] * 3, {("coulomb_friction", 1): {"level": 4.0}})
    speeds = np.array([0.2, 0.3, 0.15])
    loops = [
        Loop("pd", reference=moves(t, tour, speeds, 4.0), kp=2000.0, kd=60.0)
        for tour in ([0.0, 0.03, -0.02], [0.0, -0.02, 0.03])
    ]
    sensor = Sensor(position_resolution=1e-7, position_noise=3e-7, force_noise=0.01)
    run = simulate_chain(machine, loops, sensor, rate=1000.0, duration=6.0, seed=1)
    log = Log(run["t"], run["position"], run["force"], source="chain.csv")
    session = open_session(write_case(tmp_path, CHAIN), log)
    estimate = power(session.machine, session.fit.data)
    assert estimate.converged
    assert estimate.residual.shape[1] == 2
    truth = [2.0, 1.5, 8.0, 8.0, 1500.0, 1500.0, 1500.0, 4.0]
    np.testing.assert_allclose(estimate.theta, truth, rtol=4e-3)


class Arm(Plant):
    """Two links in a plane: the mass depends on the second angle, and is not diagonal."""

    kind = "arm"
    joints = 2

    a: Array = parameter("inertia", "positive", "of both links, about the first joint")
    b: Array = parameter("inertia", "positive", "coupling")
    d: Array = parameter("inertia", "positive", "of the second link")

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        c, s = self.b * jnp.cos(q[1]), self.b * jnp.sin(q[1])
        first = (self.a + 2 * c) * qdd[0] + (self.d + c) * qdd[1] - s * (2 * qd[0] + qd[1]) * qd[1]
        return jnp.stack([first, (self.d + c) * qdd[0] + self.d * qdd[1] + s * qd[0] ** 2])


def swing(t: np.ndarray, order: int) -> np.ndarray:
    """Angles, or their derivative of an order, (time, 2)."""
    rows = [[(0.7, 0.6, 0.0), (0.3, 1.7, 1.0)], [(1.1, 0.9, 0.5), (0.4, 2.3, 2.0)]]
    columns = []
    for sines in rows:
        waves = [
            size * (2 * np.pi * f) ** order * np.sin(2 * np.pi * f * t + phase + order * np.pi / 2)
            for size, f, phase in sines
        ]
        columns.append(sum(waves))
    return np.stack(columns, axis=1)


def torques(t: np.ndarray, a: float, b: float, d: float) -> np.ndarray:
    """d/dt dL/dq' - dL/dq of the arm by central differences of its Lagrangian's momenta, (time, 2)."""

    def momenta(t: np.ndarray) -> np.ndarray:
        q, v = swing(t, 0), swing(t, 1)
        c = b * np.cos(q[:, 1])
        first = (a + 2 * c) * v[:, 0] + (d + c) * v[:, 1]
        return np.stack([first, (d + c) * v[:, 0] + d * v[:, 1]], axis=1)

    q, v, h = swing(t, 0), swing(t, 1), 1e-4
    pull = -b * np.sin(q[:, 1]) * (v[:, 0] ** 2 + v[:, 0] * v[:, 1])
    return (momenta(t + h) - momenta(t - h)) / (2 * h) - np.stack([0 * pull, pull], axis=1)


MOMENTS = np.array([0.9, 0.3, 0.4])


def swung(samples: int = 4000, noise: np.ndarray | None = None) -> tuple[Machine, Prepared]:
    """The arm with nothing known, and a motion of it without accelerations: they are zero."""
    t = np.arange(samples) / 500.0
    free = Parameters(tuple(Free(n, (n,), "kg m^2", "positive", 1.0) for n in ("a", "b", "d")))
    machine = Machine(Arm(1.0, 1.0, 1.0), free, np.ones(2), Units("rotary"))
    recipe = Recipe(20.0, 4, 5, 2, (1e-3, 1e-3), False, "spectral")
    q, v, every = swing(t, 0), swing(t, 1), np.ones((len(t), 2), bool)
    force = torques(t, *MOMENTS) + (0.0 if noise is None else noise[:samples])
    data = Prepared(
        q, v, np.zeros_like(q), force, 0.002, 0.0, recipe, every[::5], every[::5], np.arange(len(t))[::5]
    )
    return machine, data


def test_a_mass_that_depends_on_where_it_is():
    """One balance for the machine; the mass's own rate is in it."""
    estimate = power(*swung())
    assert estimate.residual.shape[1] == 1
    np.testing.assert_allclose(estimate.theta, MOMENTS, rtol=1e-4)


def test_one_balance_of_all_joints_asks_for_as_many_windows_as_unknowns():
    """Not for that over the joints: a second joint adds no equation."""
    with pytest.raises(InputError, match=r"only [345] windows"):
        power(*swung(150))


def test_a_noisy_joint_counts_for_less_where_it_is_fast(monkeypatch):
    rng = np.random.default_rng(0)
    logs = [swung(noise=rng.standard_normal((4000, 2)) * np.array([1.0, 0.02])) for _ in range(12)]

    def off() -> float:
        return float(np.sqrt(np.mean([(power(*log).theta - MOMENTS) ** 2 for log in logs])))

    by_noise = off()
    monkeypatch.setattr("jaxid.estimators.power._noise_shares", lambda data: np.ones(2))
    assert by_noise < 0.8 * off()
