"""The command `simulate`: the log that a case describes."""

from __future__ import annotations

import numpy as np

from jaxid.case.case import CaseLike, load_case
from jaxid.case.user_faults import named_faults
from jaxid.numerics.lanes import run_alone
from jaxid.scene import Scene, SimulatedLog


@named_faults()
def simulate(case: CaseLike, *, seed: int = 0) -> SimulatedLog:
    """Simulate the log of a case, at its `true` values if it states any.

    Args:
        case: The case, its file, or a dict with its tables; it needs [simulation] with duration and
            sample_rate, and [reference] (with a [controller]) or [input].
        seed: Seed of the sensors' noise.

    Raises:
        InputError: If the case does not state the simulation completely.
    """
    scene = Scene.of(load_case(case))
    return run_alone(scene.simulated_log(scene.machine, np.random.default_rng(seed)))
