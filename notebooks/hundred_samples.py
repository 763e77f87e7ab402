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
# # A hundred noisy samples
#
# Half a second of an axis at 200 Hz, with a coarse encoder: what can such a log determine? The
# log comes from the exact axis of `truth/`, which shares no code with jaxid.

# %%
# %matplotlib inline
import json
import os
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, "..")  # the checkout: truth/ is not installed

import jaxid
from truth.axis.machines import single_move
from truth.axis.stepper import Loop, Machine, Sensor, simulate

# %%
TRUE = {
    "inertia": 95.0,
    "viscous_friction.coefficient": 200.0,
    "coulomb_friction.level": 20.0,
    "constant_force.level": 4.0,
}
machine = Machine(
    inertia=TRUE["inertia"],
    actuator_gain=35.0,
    effects={
        "viscous_friction": {"coefficient": 200.0},
        "coulomb_friction": {"level": 20.0},
        "constant_force": {"level": 4.0},
    },
)
time = np.arange(100) / 200.0
reference = single_move(time - 0.02, 0.03, 0.1, 1.0)
loop = Loop("cascade_pd", kp=60.0, kv=90.0, limit=10.0, reference=reference)
sensor = Sensor(position_resolution=2e-5, position_noise=1e-5, force_noise=0.05)


def log_of(seed):
    """A log of the exact axis, as a dict of columns."""
    made = simulate(machine, loop, sensor, rate=200.0, duration=0.5, seed=seed)
    return {"t": made["t"], "q": made["position"], "u": made["force"], "ref": made["reference"]}


log = log_of(1)
figure, axes = plt.subplots(1, 2, figsize=(10, 3), layout="constrained")
axes[0].plot(log["t"], log["q"], ".-")
axes[0].set_ylabel("position [m]")
axes[1].plot(log["t"], log["u"], ".-")
axes[1].set_ylabel("command [V]")
for ax in axes:
    ax.set_xlabel("time [s]")
plt.show()

# %% [markdown]
# ## State the precision of the guesses
#
# Guesses are up to 40 % off. `prior = 0.5` says how well they are known; `on = "force"` compares
# the command.

# %%
case = {
    "plant": {"kind": "axis", "parameters": {"inertia": {"guess": 75.0}}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": 280.0}},
        {"kind": "coulomb_friction", "level": {"guess": 26.0}},
        {"kind": "constant_force", "level": {"guess": 3.0}},
    ],
    "actuator": {"gain": 35.0},
    "controller": {"kind": "cascade_pd", "kp": 60.0, "kv": 90.0, "limit": 10.0},
    "sensor": {"position_resolution": 2e-5, "position_noise": 1e-5, "force_noise": 0.05},
    "log": {"time": "t", "position": "q", "force": "u", "reference": "ref"},
    "within_prior": {"prior": 0.5, "on": "force"},
}
result = jaxid.identify(case, log)
print(result)

# %% [markdown]
# ## What the log determines
#
# `directions` are the combinations of parameters that the log determines at least twice as well as
# the guesses do.

# %%
details = result.estimate.details
for direction in details["directions"]:
    parts = ", ".join(f"{v:+.2f} {n}" for n, v in direction["combination"].items() if abs(v) > 0.15)
    print(f"{direction['std']:.3f} of the prior is left of: {parts}")

# %% [markdown]
# The constant force is in none of them: this log moves in one direction only, so that a constant
# force and Coulomb friction act alike. The fit holds the constant force at its guess of 3 N. The true
# value is 4 N, so Coulomb friction comes out about 1 N too low. Its standard deviation includes that.
#
# ## Do the intervals hold?
#
# Fifty logs with other noise, fitted in one call. That takes a minute or two, so their values are read from
# `results/hundred_samples.json`. With `JAXID_LONG=1` in the environment they are fitted here;
# `python -m benchmarks.notebooks hundred_samples` does that and writes the file.

# %%
RUN_LONG = os.environ.get("JAXID_LONG") == "1"
SEEDS = range(2, 52)
if RUN_LONG:
    estimates = jaxid.identify_many(case, [log_of(seed) for seed in SEEDS])
    # NaN: not identifiable from this log.
    results = {"theta": [e.theta.tolist() for e in estimates], "std": [e.std.tolist() for e in estimates]}
else:
    results = json.loads(Path("results/hundred_samples.json").read_text())
    print(f"fitted by commit {results['commit']} on {results['date']}")

# %% [markdown]
# The figure shows how far each identifiable value is from the truth, in its standard deviations. 95 % should
# lie between the dashed lines.

# %%
true = np.array([TRUE[name] for name in result.estimate.names])
by_log = (np.array(results["theta"], float) - true) / np.array(results["std"], float)
off = by_log[np.isfinite(by_log)]
print(f"{off.size} values; {np.mean(abs(off) < 1.96):.0%} within 1.96 standard deviations")
for name, values in zip(result.estimate.names, by_log.T, strict=True):
    if np.isfinite(values).any():
        print(f"{name:30s} scatters by {np.nanstd(values):.2f} standard deviations")

plt.figure(figsize=(8, 3), layout="constrained")
for name, values in zip(result.estimate.names, by_log.T, strict=True):
    if np.isfinite(values).any():
        plt.plot(range(1, len(by_log) + 1), values, "o", label=name)
for line in (-1.96, 1.96):
    plt.axhline(line, color="0.6", ls="--", lw=0.8)
plt.xlabel("log")
plt.ylabel("value minus truth [std]")
plt.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
plt.show()

# %% [markdown]
# The values scatter by half of their standard deviations, so that for this log the intervals are wider than
# they need be. On the safe side, but not exact.
