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
# # Your own log
#
# You have a trace of a drive, a CSV, and no model. This notebook goes from the raw file to a
# case, to parameters, and to the effect that the first model misses. Put your own file in place
# of `trace`, and the rest stays as it is.
#
# The trace here comes from a simulator that shares no code with jaxid: a slide of 180 kg on a
# ball screw. It is in `truth/` of the checkout, so run this notebook there.

# %%
# %matplotlib inline
import sys

import matplotlib.pyplot as plt
import pandas as pd

sys.path.insert(0, "..")  # the checkout: truth/ is not installed

import jaxid
from truth.axis import tutorial_logs

trace = pd.DataFrame(tutorial_logs.trace(seed=1))  # yours: pd.read_csv("trace.csv")
again = pd.DataFrame(tutorial_logs.trace(seed=2))
trace.head()

# %% [markdown]
# ## A first case
#
# `init` reads the columns by their names, the units by the header, and makes rough guesses. It
# prints what it assumed, and asks what only you know.

# %%
first = jaxid.init(trace)
print(first)

# %% [markdown]
# It asks for the drive. The data sheet says 0.72 N m/A, and the screw moves 20 mm in a turn. With
# these two numbers results are in kg and N.

# %%
case = {
    "plant": {"kind": "axis", "parameters": {"inertia": {"guess": 100.0}}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": 200.0}},
        {"kind": "coulomb_friction", "level": {"guess": 50.0}},
    ],
    "actuator": {"torque_constant": 0.72, "lead": 0.02},
    "log": {
        "time": "Time [ms]",
        "position": "Position [mm]",
        "force": "Current [A]",
        "units": {"time": "ms", "position": "mm", "force": "A"},
    },
}
print(jaxid.check(case, trace))

# %% [markdown]
# ## Fit what was declared
#
# Read the first sentence: it says whether the model is complete. If it is not, the standard
# deviations count noise only, and the values are those of the wrong model.

# %%
declared = jaxid.identify(case, trace, method="inverse_dynamics")
declared

# %% [markdown]
# The residual over velocity says where it fails: at low speed.

# %%
declared.plot("scatter", against="velocity")
plt.show()

# %% [markdown]
# ## Find what is missing
#
# The search uses the first trace, and the second one confirms.

# %%
found = jaxid.discover(case, trace, validate=[again], experiments=False)
print(found)

# %%
found.plot("candidates")
plt.show()

# %% [markdown]
# ## The corrected model
#
# `found.case()` is the case with the effect in it, `found.save_case("found.toml")` writes it. The values
# are those of the last refit.

# %%
found.parameters

# %% [markdown]
# The machine was made with 180 kg, 400 N s/m, 60 N, and a Stribeck friction of 35 N below 12 mm/s.
# Here is how far each value is off, in its standard deviations.

# %%
truth = {
    "inertia": 180.0,
    "viscous_friction.coefficient": 400.0,
    "coulomb_friction.level": 60.0,
    "stribeck_friction.level": 35.0,
    "stribeck_friction.velocity": 0.012,
}
off = {}
for name, true in truth.items():
    p = found.parameters[name]
    off[name] = (p.value - true) / p.std
    print(f"{name:30s} {p.value:9.4g} ± {p.std:.2g} {p.unit}, true {true:g}: {off[name]:+.1f} std")
