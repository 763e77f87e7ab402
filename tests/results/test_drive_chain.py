"""The drive chain of a report: what the case has of each part, and what was found there."""

from dataclasses import replace

import numpy as np

from jaxid.results.drive_chain import drive_chain
from jaxid.session import open_session

CASE = {
    "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": 4e-3}},
    "effects": [{"kind": "viscous_friction", "coefficient": {"guess": 0.05}}],
    "controller": {"kind": "pd", "kp": {"guess": 3.0}, "kd": 0.1},
    "log": {"time": "t", "position": "q", "reference": "r"},
}


def test_the_rate_of_the_controller_is_that_of_the_loop_that_was_fitted():
    """The report showed the rate of the log, 50 Hz, where the fit had chosen 5 ms."""
    t = 0.02 * np.arange(200)
    session = open_session(CASE, {"t": t, "q": np.sin(t), "r": np.sin(t)})
    declared = session.machine
    fitted = replace(declared, controller=replace(declared.controller, period=0.005))
    lines = {
        rate: drive_chain(session, machine)[0].lines for rate, machine in ((50, declared), (200, fitted))
    }
    assert lines == {rate: ("pd", f"{rate} Hz") for rate in (50, 200)}
