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
# # Paper: the PA-10's joint that swings without friction
#
# A traineeship report compensates the friction of a joint, adds a spring by the controller, lets
# the joint swing, and reads the inertia off the period. Here the joint is the exact axis of
# `truth/`. Its true inertia is 2 kg m². Change the spring and the compensation, and see what the
# period says.

# %%
# %matplotlib inline
import sys

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, "..")  # the checkout: experiments/ and truth/ are not installed

import jaxid
from experiments.pa10_joint import COULOMB, INERTIA, NOISE, VISCOUS, settled, swinging

# %% [markdown]
# ## A limit cycle
#
# Coulomb friction is overcompensated and viscous friction undercompensated: after some time the joint
# swings at a constant amplitude.

# %%
log = swinging(200.0, 0.3, duration=20.0)
plt.figure(figsize=(9, 2.8), layout="constrained")
plt.plot(log["t"], log["position"])
plt.xlabel("time [s]")
plt.ylabel("angle [rad]")
plt.show()

# %% [markdown]
# ## Inertia by the period
#
# A spring K_p and an inertia I swing with the period T, so that I = K_p T² / 4 π².

# %%
by_period = {}
for kp in (100.0, 200.0, 400.0):
    amplitude, period = settled(swinging(kp, 0.3, duration=30.0))
    by_period[kp] = kp * period**2 / (4 * np.pi**2)
    print(f"K_p {kp:4.0f} N m/rad: amplitude {amplitude:.3f} rad, inertia {by_period[kp]:.3f} kg m^2")

# %% [markdown]
# ## Inertia and friction by identification
#
# The same swing, with noise of the sensors, and no use of the period. The spring is part of the
# command, so the log alone says everything.

# %%
measured = swinging(200.0, 0.3, duration=20.0, sensor=NOISE)
case = {
    "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": {"guess": 1.0}}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": 2.0}},
        {"kind": "coulomb_friction", "level": {"guess": 5.0}},
    ],
    "log": {"time": "t", "position": "q", "force": "u"},
    "sensor": {"position_noise": 1e-5, "force_noise": 0.2},
}
result = jaxid.identify(
    case,
    {"t": measured["t"], "q": np.ravel(measured["position"]), "u": np.ravel(measured["force"])},
    method="inverse_dynamics",
)
result

# %%
true = {
    "inertia": INERTIA,
    "viscous_friction.coefficient": VISCOUS,
    "coulomb_friction.level": COULOMB,
}
off = {n: (result.value(n) - v) / result.parameters[n].std for n, v in true.items()}
for name, sigmas in off.items():
    print(f"{name:30s} {result.value(name):.4f}, true {true[name]}: {sigmas:+.1f} std")
result.plot("scatter", against="velocity")
plt.show()

# %% [markdown]
# The period gives the inertia of one joint in one configuration, here 1 to 2 % too large.
# Identification gives friction too, and from one log. The page [PA-10](../docs/evidence/pa10.md) goes
# on to the whole arm, its drive and the method's failure.
