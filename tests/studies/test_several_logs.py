"""A study whose runs have several logs each."""

import tomllib

import numpy as np

import jaxid

CASE = """
[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 80.0, true = 95.1 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 180.0, true = 203.5 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 18.0, true = 20.39 }
[[effects]]
kind = "added_mass"
mass = 0.0
[[effects]]
kind = "actuator_gain"
gain = { guess = 0.9, true = 1.0 }
[actuator]
gain = 35.15
[log]
time = "t"
position = "q"
force = "u"
reference = "ref"
[controller]
kind = "cascade_pd"
kp = 160.18
kv = 243.45
velocity_average = 2
[sensor]
position_noise = 1e-7
force_noise = 0.05
[reference]
kind = "trapezoid"
targets = [0.05, 0.02, 0.12]
speed = 0.1
acceleration = 1.0
[simulation]
duration = 2.0
sample_rate = 1000.0
[study]
estimators = ["inverse_dynamics"]
runs = 12
"""
FITS = """
[[fit]]
name = "empty"
[[fit]]
name = "loaded"
set = { added_mass.mass = 40.0 }
"""


def test_each_run_simulates_every_entry_with_what_is_set_there():
    alone, both = (jaxid.study(tomllib.loads(text)) for text in (CASE, CASE + FITS))

    def rows(study):
        return {r["parameter"]: r for r in study.summary}

    one, two = rows(alone), rows(both)
    # No noise is so small that one log determined the gain.
    assert all(np.isnan(r["bound"]) for r in one.values())
    assert all(r["identifiable"] == 1.0 for r in two.values())
    # The spread over the runs is what the fits state.
    for r in two.values():
        assert 0.5 < r["spread"] / r["std"] < 2.0
        assert np.isfinite(r["bound"])
        assert abs(r["bias"]) < 2 * r["spread"]
