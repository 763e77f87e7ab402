"""Intervals of an estimator, on logs of an exact simulator with fresh noise in each."""

from dataclasses import replace

import numpy as np
import scipy.stats

from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.session import open_another, open_session
from tests.support.axis_log import log_of
from tests.support.cli_setup import TRUTH
from truth.axis.cases import case_text, write_case
from truth.axis.machines import emps_like

RUNS = 60


def test_intervals_of_inverse_dynamics_hold_the_truth(tmp_path):
    """In its loop, with friction that sticks and noise of force and position: 95 %, by 60 runs."""
    setup = emps_like(0, noise=10.0, duration=4.0)
    path = write_case(tmp_path, case_text(setup, [*setup.machine.effects.items()]))
    session = open_session(path, log_of(setup), align_hold=True)
    truth = np.array([TRUTH[name] for name in session.machine.parameters.names])
    z = []
    for seed in range(RUNS):
        data = open_another(session, log_of(replace(setup, seed=1000 + seed))).data
        estimate = inverse_dynamics(session.machine, data)
        z.append((estimate.theta - truth) / estimate.std)
    z = np.array(z)
    inside = np.sum(np.abs(z) < 1.96, axis=0)
    low, high = scipy.stats.binom.ppf([5e-4, 1 - 5e-4], RUNS, 0.95)
    assert np.all((inside >= low) & (inside <= high)), inside / RUNS
    # Two-sided: a sigma twice too large is seen in the scatter.
    few, many = np.sqrt(scipy.stats.chi2.ppf([5e-4, 1 - 5e-4], RUNS - 1) / (RUNS - 1))
    assert np.all((z.std(axis=0, ddof=1) > few) & (z.std(axis=0, ddof=1) < many)), z.std(axis=0)
