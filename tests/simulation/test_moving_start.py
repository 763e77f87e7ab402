"""Exact logs of a loop that begin in the middle of a move: no method may take the start for rest."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from jaxid.commands.identify import identify_many
from jaxid.logs.log import Log
from truth.axis.cases import case_text
from truth.axis.machines import emps_like, servo

SETUPS = {
    "cascade": (emps_like(0, noise=10.0, duration=4.0), 1300, "linear"),
    # Its integral at the first row is that of all rows before it.
    "integral": (servo(0, duration=3.0), 1150, "rotary"),
}


# Each of the slow pairs takes up to a minute.
PAIRS = [
    ("cascade", "output_error"),
    pytest.param("integral", "prediction_error", marks=pytest.mark.slow),
    pytest.param("cascade", "prediction_error", marks=pytest.mark.slow),
    pytest.param("integral", "output_error", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "method"), PAIRS)
def test_a_log_that_begins_in_a_move(name, method):
    setup, first, motion = SETUPS[name]
    case = tomllib.loads(case_text(setup, [*setup.machine.effects.items()], motion=motion))
    truth = [setup.machine.inertia, *(v for e in setup.machine.effects.values() for v in e.values())]
    logs = []
    for seed in range(6):
        run = {k: v[first:] for k, v in replace(setup, seed=500 + seed).run().items()}
        assert abs(run["true_velocity"][0]) > 0.2 * np.abs(run["true_velocity"]).max()
        columns = {k: run[k] for k in ("position", "force", "reference")}
        logs.append(Log(time=run["t"] - run["t"][0], **columns))
    estimates = identify_many(case, logs, method=method)
    z = np.array([(e.theta - truth) / e.std for e in estimates])
    assert np.all(np.abs(z) < 4), z
    assert np.all(estimates[0].std / truth < 0.005)
