# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A Monte-Carlo study
#
# A standard deviation is a promise: of many logs, 95 % of the intervals hold the truth. A study
# tests the promise before you measure. It simulates the log that a case describes many times,
# fits each, and counts.
#
# Each unknown has a `guess`, at which fits start, and a `true` value, with which logs are made.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt

import jaxid

case = {
    "plant": {"kind": "axis", "parameters": {"inertia": {"guess": 70.0, "true": 95.0}}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": 150.0, "true": 200.0}},
        {"kind": "coulomb_friction", "level": {"guess": 30.0, "true": 20.0}},
    ],
    "actuator": {"gain": 35.0},
    "controller": {"kind": "cascade_pd", "kp": 160.0, "kv": 243.0, "velocity_average": 2, "limit": 10.0},
    "sensor": {"position_resolution": 1e-6, "position_noise": 1e-6, "force_noise": 0.02},
    "reference": {
        "kind": "trapezoid",
        "targets": [0.02, 0.08, 0.2, 0.01, 0.0],
        "speed": 0.12,
        "acceleration": 0.8,
    },
    "simulation": {"duration": 3.0, "sample_rate": 500.0},
    "study": {"estimators": ["inverse_dynamics", "algebraic"], "runs": 60},
}

# %% [markdown]
# ## Run it
#
# Sixty logs, two methods. The logs are made with other integration steps than the fits use, so
# that an error of integration would show as a bias.

# %%
study = jaxid.study(case)
print(study)

# %% [markdown]
# `spread` is the scatter of the estimates, `std` the mean of the standard deviations that the fits
# reported; they should agree. `coverage_95` is the share of 95 % intervals that hold the truth.

# %%
rows = study.to_pandas()
rows[["estimator", "parameter", "unit", "true", "bias", "spread", "std", "coverage_95"]].round(3)

# %%
study.plot("coverage", parameter="inertia")
plt.show()

# %% [markdown]
# ## Count by hand
#
# All runs are in an xarray Dataset, `study.table`. An interval of 1.96 standard deviations holds the
# truth, or not.

# %%
table = study.table
off = abs(table.estimate - table.truth) / table["std"]
held = (off < 1.96).mean("run").squeeze()
print(held.to_dataframe("held").held.unstack().to_string())

# %% [markdown]
# `inverse_dynamics` is within the range that sixty runs of a sound method have, 86.7 to 100 %, at its
# lower end. For the inertia `std` is smaller than `spread`, so more runs may say that its intervals are a
# little too narrow. `algebraic` integrates over short windows, whose friction at halts is not known. Its
# intervals allow for that and hold the truth at 95 %, but the study says that they are not right at every
# level: they are wider than the scatter. This is the use of a study: to know before the fit which method to
# trust on such a log.
