"""A drive at its limit for much of a log: what a model without it leaves passes for coloured noise."""

import numpy as np
import pytest

import jaxid
from truth.axis.machines import moves
from truth.axis.stepper import Loop, Machine, Sensor, simulate

FRICTION = {"viscous_friction": {"coefficient": 300.0}, "coulomb_friction": {"level": 40.0}}


def limited(limit: float) -> dict[str, np.ndarray]:
    """Return the log of a slide of 100 kg in a fast loop, its command logged, its drive at a limit [N]."""
    t = np.arange(8000) / 1000.0
    reference = moves(t, [0.0, 0.4, -0.3, 0.5], [0.5, 0.6, 0.35, 0.5], 4.0, 0.1)
    loop = Loop("pd", reference=reference, kp=2e5, kd=4e3)
    machine = Machine(100.0, {**FRICTION, "saturation": {"limit": limit}})
    run = simulate(machine, loop, Sensor(1e-7, 1e-7, 1.0), rate=1000.0, duration=8.0, seed=1)
    return {"t": run["t"], "q": run["position"], "u": run["force"]}


CASE = {
    "plant": {"kind": "axis", "motion": "linear", "parameters": {"inertia": {"guess": 140.0}}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": 200.0}},
        {"kind": "coulomb_friction", "level": {"guess": 60.0}},
    ],
    "log": {"time": "t", "position": "q", "force": "u"},
}


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "part"), [(450.0, 0.16), (320.0, 0.45), (240.0, 0.87)])
def test_a_limit_that_holds_for_much_of_a_fast_loop_is_named(limit, part):
    """All were unexplained: the colour of the noise was that of the limit, and no start near it gained.

    At 240 N the inertia without the limit is 38 times the true one: beside it the true one is not lost.
    """
    log = limited(limit)
    assert np.mean(np.abs(log["u"]) > limit) == pytest.approx(part, abs=0.01)
    found = jaxid.discover(CASE, log, refit=False)
    assert found.kinds == ["saturation"]
    assert found.parameters["saturation.limit"].value == pytest.approx(limit, rel=1e-3)
    assert found.parameters["inertia"].value == pytest.approx(100.0, rel=1e-3)
    assert not any(e.alternatives for e in found.effects)
