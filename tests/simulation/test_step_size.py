"""A step too coarse for the smoothed sign is refined or refused, never endured."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.simulation.replay import make_replay

CASE = (Path(jaxid.__file__).parent / "demo" / "case.toml").read_text(encoding="utf-8")
BREAK_AWAY = '\n[[effects]]\nkind = "static_friction"\nlevel = { guess = 5.0 }\n\n[actuator]'
MOVE = """
[reference]
kind = "trapezoid"
start = 0.0
targets = [0.1]
speed = 0.1
acceleration = 1.0

[simulation]
duration = 1.0
sample_rate = 1000.0
"""


def test_smoothed_fits_take_the_steps_that_the_sign_asks_for(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(CASE.replace("\n[actuator]", BREAK_AWAY).split("[[validation]]")[0])
    session = jaxid.open_session(path, Path(jaxid.__file__).parent / "demo" / "log.csv")
    numerics = choose_numerics(session.machine, session.fit.log)
    assert not numerics.set_valued
    # 10 N over 60 kg and 1e-3 of a typical 0.08 m/s: 2 per ms, and break-away steepens it
    assert 2 <= numerics.substeps <= 16
    # The motion is that of eight times the steps to half of the encoder's noise; with one step it is not.
    motion = {n: _motion(session, numerics, n) for n in (1, numerics.substeps, 8 * numerics.substeps)}
    fine = motion[8 * numerics.substeps]
    error = {n: np.sqrt(np.mean((motion[n] - fine) ** 2)) for n in motion}
    allowed = 0.5 * session.machine.sensor.position_std
    assert error[numerics.substeps] < allowed < error[1], error


def _motion(session, numerics, substeps):
    replay = make_replay(session.machine, session.fit.log, replace(numerics, substeps=substeps))
    plant = session.machine.plant.smoothed(jnp.asarray(1e-3))
    return np.asarray(jax.jit(lambda: replay(plant).position)())


@pytest.mark.parametrize("substeps", [1])
def test_simulate_refuses_a_coarse_step(tmp_path, substeps):
    path = tmp_path / "case.toml"
    text = CASE.split("[[validation]]")[0] + MOVE + f"sharpness = 1e-5\nsubsteps = {substeps}\n"
    path.write_text(text)
    with pytest.raises(jaxid.InputError, match="too coarse.*set substeps = "):
        jaxid.simulate(path)
