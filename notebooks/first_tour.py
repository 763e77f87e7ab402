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
# # A first tour of jaxid
#
# A machine was logged. We have a model of it, and the model is missing something. In this tour
# jaxid fits the model to the log, measures what the model leaves unexplained, finds out where
# that lies, names the effect that is missing, and fits again with the effect in place.
#
# The log ships with jaxid: a slide of about 95 kg in a position loop. It was made by a program
# that shares no code with jaxid, with something in it that the model does not have.
#
# With `JAXID_FAST=1` in the environment the search takes a shorter way.

# %%
# %matplotlib inline
import os
import shutil
import tempfile
from dataclasses import replace
from importlib import resources
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxid

FAST = os.environ.get("JAXID_FAST") == "1"

# %% [markdown]
# ## The case and its log
#
# A case file says what machine a log came from, what is known of it, and what is not. An
# unknown has a guess: `{ guess = 60.0 }`. This one declares inertia, viscous and Coulomb
# friction.

# %%
folder = Path(tempfile.mkdtemp())
with resources.as_file(resources.files("jaxid.demo")) as shipped:
    for name in ("case.toml", "log.csv", "validation.csv"):
        shutil.copyfile(shipped / name, folder / name)
case_file, log_file = folder / "case.toml", folder / "log.csv"
print(case_file.read_text())

# %% [markdown]
# The log has one row a sample: time, position, the logged command, and the reference that the
# loop was to follow. The command in V times the actuator's gain in N/V is the force at the load.

# %%
case = jaxid.load_case(case_file)
log = jaxid.read_log(log_file, case.columns)

figure, (top, below) = plt.subplots(2, 1, sharex=True, figsize=(10, 4.5), layout="constrained")
top.plot(log.time, log.reference, color="0.7", lw=3, label="reference")
top.plot(log.time, log.position, lw=1, label="position")
top.set_ylabel("position [m]")
top.legend()
below.plot(log.time, case.actuator.gain * log.force, lw=0.6)
below.set_ylabel("force [N]")
below.set_xlabel("time [s]")
plt.show()

# %% [markdown]
# ## Before any fit
#
# `check` says whether the log is sound, and how well each unknown could be identified if noise
# alone separated model and log.

# %%
print(jaxid.check(case_file, log_file))

# %% [markdown]
# ## Fit the declared model
#
# `identify` fits the unknowns to the log and judges the fit on a second one, which the case names.
# Without `method` jaxid chooses one, and says why. The tour takes `inverse_dynamics`: it is the fastest,
# and it fits the force, which we look at below.

# %%
declared = jaxid.identify(case_file, log_file, method="inverse_dynamics")
declared

# %% [markdown]
# Each parameter has a value, a standard deviation and a unit. `declared.covariance` holds their
# covariance, and `declared.to_pandas()` makes a table of them.

# %%
inertia = declared.parameters["inertia"]
print(f"inertia: {inertia.value:.2f} ± {inertia.std:.2f} {inertia.unit}, from a guess of {inertia.guess}")

# %% [markdown]
# The fit converged, and still the force gap is far above the noise floor, the part that the
# sensors' noise alone would cause. The machine has something that the model does not have. We draw
# the residual, force measured minus force of the model, against velocity and against position.

# %%
figure, axes = plt.subplots(1, 2, sharey=True, figsize=(13, 3.6), layout="constrained")
declared.plot("scatter", axes[0], against="velocity")
declared.plot("scatter", axes[1], against="position")
plt.show()

# %% [markdown]
# Over velocity it is a cloud. Over position it is a wave: a force that repeats every 20 mm or so.
# We can see it; now let jaxid find it by itself.
#
# ## Find what is missing
#
# `discover` fits each effect that it knows to one part of the log and scores it on another,
# then asks the second log to confirm. It adds the best, and goes on until no effect is accepted.

# %%
quicker = {"refit": False, "max_effects": 1} if FAST else {}
found = jaxid.discover(case_file, log_file, **quicker)
print(found)

# %% [markdown]
# The verdict names the effect. Its evidence is the gain in log-likelihood on data held out, and
# this is how it stood against all others:

# %%
figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
found.plot("candidates", axes)
plt.show()

# %% [markdown]
# The same residual, before and after:

# %%
figure, axes = plt.subplots(1, 2, sharey=True, figsize=(13, 3.6), layout="constrained")
found.plot("scatter", axes[0], against="velocity")
found.plot("scatter", axes[1], against="position")
plt.show()

# %% [markdown]
# ## Make it part of the model
#
# `save_case` writes the case with the effect in it and the estimates as guesses; everything else
# of the case file stays, comments too. `found.case()` is the same case without a file.

# %%
extended_file = found.save_case(folder / "extended.toml")
print(extended_file.read_text())

extended = jaxid.identify(extended_file, log_file, method="inverse_dynamics")
extended

# %% [markdown]
# Now compare: the force that each model leaves unexplained (RMS), on the log that was fitted and
# on the one that was not.

# %%
print(f"{'log':12s} {'declared':>10s} {'extended':>10s} {'noise floor':>12s}")
for before, after in zip(declared.gaps, extended.gaps, strict=True):
    row = [before.force.rms[0], after.force.rms[0], extended.noise_floor[0]]
    print(f"{before.name:12s} {row[0]:8.3f} N {row[1]:8.3f} N {row[2]:10.3f} N")

# %% [markdown]
# The rest is close to noise, and inertia and friction are at their true values (95.1 kg,
# 203.5 N s/m, 20.39 N), known far better than before.
#
# ## Everything is differentiable
#
# A fitted machine is a function that JAX can differentiate: from parameters to the position over
# the whole log, controller, dry friction and all. `make_replay` holds the log's reference; call it
# with a plant and get the motion. (The encoder's rounding is left out: we are about to compare
# with finite differences, and rounding would turn these into steps.)

# %%
machine = replace(extended.estimate.machine, sensor=jaxid.Sensor())
replay = jaxid.make_replay(machine, extended.session.fit.log)


@jax.jit
def position(theta):
    """Simulated position [m] at every sample, (time,)."""
    return replay(machine.parameters.insert(machine.plant, theta)).position[:, 0]


theta = machine.parameters.guess
slope = np.asarray(jax.jacfwd(position)(theta))  # (time, parameter)
for k, name in enumerate(machine.parameters.names):
    nudge = np.zeros(theta.size)
    nudge[k] = 1e-5 * float(theta[k])
    difference = np.asarray(position(theta + nudge) - position(theta - nudge)) / (2 * nudge[k])
    off = np.linalg.norm(slope[:, k] - difference) / np.linalg.norm(difference)
    print(f"{name:30s} derivative and finite difference: {off:.0e} apart")

# %% [markdown]
# How far the simulated position moves if a parameter grows by one percent, which is what a fit in
# position depends on. It moves by micrometres, because the loop is stiff.

# %%
figure, axes = plt.subplots(figsize=(10, 3.6), layout="constrained")
moved = 1e6 * 0.01 * slope * np.asarray(theta)
for k, name in enumerate(machine.parameters.names):
    axes.plot(extended.session.fit.log.time, moved[:, k], lw=1, label=name)
axes.set_xlabel("time [s]")
axes.set_ylabel("change of position [µm] per 1 %")
axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
plt.show()

# %% [markdown]
# ## From here
#
# The same steps on the command line, with a report that stands alone:
#
# ```
# jaxid check    case.toml log.csv
# jaxid identify case.toml log.csv -o results
# jaxid discover case.toml log.csv -o results
# ```
#
# For your machine: write its case file, name the columns of its log, and run `check`.
