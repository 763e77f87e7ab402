"""Fits of a chunk as compiled programs: the same numbers as one estimator after the other."""

import numpy as np
import pytest

import jaxid
from jaxid.studies.loop_fits import LoopFits
from jaxid.studies.plan import Plan
from jaxid.studies.runs import Runner
from truth.axis.cases import write_case

LOOP = """
[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 60.0, true = 95.1 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 100.0, true = 203.5 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 30.0, true = 20.4 }
[actuator]
gain = 35.15065
[controller]
kind = "cascade_pd"
kp = 160.18
kv = 243.45
period = 0.001
[sensor]
position_noise = 1e-6
force_noise = 0.02
[reference]
kind = "trapezoid"
start = 0.0
targets = [0.1, 0.02, 0.12, 0.0]
speed = 0.2
acceleration = 2.0
[simulation]
duration = 3.0
sample_rate = 1000.0
substeps = 1
[study]
estimators = ["output_error"]
runs = 11
start_spread = 0.2
draw = 0.1
"""


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return jaxid.load_case(write_case(tmp_path_factory.mktemp("loop"), LOOP))


@pytest.fixture(scope="module")
def together(case):
    return jaxid.study(case, seed=2).table


def test_runs_together_are_what_each_estimator_finds(case, together, monkeypatch):
    plan = Plan.of(case)
    assert Runner(plan).ways(0).together is not None
    monkeypatch.setattr(LoopFits, "of", lambda *args: None)
    apart = jaxid.study(case, seed=2).table
    for name in ("estimate", "std", "tracking_rms", "tracking_peak"):
        if name in apart:
            np.testing.assert_allclose(together[name], apart[name], rtol=1e-9)
    for name in ("steps", "converged", "identifiable"):
        np.testing.assert_array_equal(together[name], apart[name])
    assert np.all(together["converged"])


def test_a_run_together_does_not_depend_on_those_beside_it(case, together):
    few = jaxid.study(case, runs=3, seed=2).table
    # Another number of runs is another chunk, whose last bits differ.
    np.testing.assert_allclose(few["estimate"], together["estimate"].isel(run=slice(3)), rtol=1e-12)


def test_a_run_that_decides_otherwise_is_left_to_its_estimator(case, together, monkeypatch):
    asked = []
    fitted, run = LoopFits.fitted, Runner._run
    second = Plan.of(case, seed=2).drawn(1)[1]

    def without_the_second(self, drawn):
        done, columns = fitted(self, drawn)
        # Numbers that may not be used.
        left = np.array([np.array_equal(start, second) for _, start, _ in drawn])
        columns["estimate"][:, left] = np.nan
        return done & ~left, columns

    def counted(self, level, number, ways):
        asked.append(number)
        return run(self, level, number, ways)

    monkeypatch.setattr(LoopFits, "fitted", without_the_second)
    monkeypatch.setattr(Runner, "_run", counted)
    mixed = jaxid.study(case, seed=2).table
    assert asked == [1]
    np.testing.assert_allclose(mixed["estimate"], together["estimate"], rtol=1e-9)


@pytest.mark.parametrize(
    "other",
    [
        ('estimators = ["output_error"]', 'estimators = ["output_error", "inverse_dynamics"]'),
        ("duration = 3.0", "duration = 1.5"),
        ("[study]", "[preprocess]\ncutoff_hz = 40.0\n[study]"),
    ],
)
def test_what_the_programs_do_not_decide_is_left_to_the_estimators(other, tmp_path):
    case = jaxid.load_case(write_case(tmp_path, LOOP.replace(*other)))
    assert Runner(Plan.of(case)).ways(0).together is None
