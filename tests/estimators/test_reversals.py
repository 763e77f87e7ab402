"""Reversals under noise: the filter does not know the sign of a velocity that a reading has just shown."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from benchmarks.interval_machines import MACHINES
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.logs.log import Log
from jaxid.simulation.kalman import make_filter
from jaxid.simulation.replay import exact_numerics

PERIOD, NOISE = 1e-3, 5e-7
# [N], on a mass of 1 kg.
FORCE, FRICTION = 2.2, 2.0


def thrown_back(turn: int, samples: int) -> np.ndarray:
    """Return the positions of a mass that moves against a force until a sample, and then with it [m]."""
    t = PERIOD * (np.arange(samples) - turn)
    return 0.5 * np.where(t < 0, FORCE + FRICTION, FORCE - FRICTION) * t**2


def test_a_wrong_reading_after_a_reversal_is_soon_forgotten():
    """The first reading says that the mass still moves back, where friction would stop it.

    The filter took it for stopped, and its velocity for known: errors of 2.5, 2.2 and 2.0 followed.
    """
    turn, samples, after = 30, 80, 36
    position = thrown_back(turn, samples)
    position[after] -= 3 * NOISE
    log = Log(
        time=PERIOD * np.arange(samples),
        position=position[:, None],
        force=np.full((samples, 1), FORCE),
    )
    case = load_case(
        {
            "plant": {"kind": "axis", "parameters": {"inertia": 1.0}},
            "effects": [{"kind": "coulomb_friction", "level": FRICTION}],
            "sensor": {"position_noise": NOISE},
            "log": {"time": "t", "position": "q", "force": "u"},
        }
    )
    machine = build_machine(case, period=PERIOD)
    slow = np.zeros((samples, 1), bool)
    slow[turn - 4 : after] = True
    kalman = make_filter(machine, log, exact_numerics(machine, log, 1), slow)

    innovations, variances = kalman(machine.plant, jnp.array([1e-3]), jnp.array([NOISE]))
    z = np.asarray(innovations / jnp.sqrt(variances))[:, 0]
    assert z[after + 1] > 3
    assert np.max(np.abs(z[after + 2 :])) < 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6, 8])
def test_friction_with_memory_after_a_reversal_is_right_without_a_declared_loop(tmp_path, seed):
    """Its level backwards was 3.2 and 4.0 standard deviations too low: 39 and 13 % of the truth."""
    text, log, true = MACHINES["stage"](seed, "unknown", "not stated")
    path = tmp_path / "case.toml"
    path.write_text(text)
    [fit] = jaxid.identify_many([path], [log])
    assert fit.converged
    z = [(v - true[n]) / s for n, v, s in zip(fit.names, fit.theta, fit.std, strict=True)]
    assert np.max(np.abs(z)) < 2.5
    level = fit.names.index("velocity_hysteresis[2].level_negative")
    assert fit.theta[level] == pytest.approx(true["velocity_hysteresis[2].level_negative"], rel=0.4)
