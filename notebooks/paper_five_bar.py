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
# # Paper: a five-bar robot that learns its friction
#
# Righettini et al. identify friction and drive gains while the robot moves, and feed them
# forward. Here the robot is an exact-friction simulator of `truth/`; the controller is
# `jaxid.Live` at 4 kHz. It starts with drive gains of one and no friction.

# %%
# %matplotlib inline
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, "..")  # the checkout: experiments/ and truth/ are not installed

import jaxid
from experiments.five_bar_robot import GAINS, LOOK, PERIOD, case_text, driven, robot

# %% [markdown]
# ## The case
#
# Masses and lengths are known. The gains of the two drives and four terms of friction at each joint
# are to be identified; this is their part of the case, with the control law.

# %%
folder = Path(tempfile.mkdtemp())
SECONDS = 2.0


def run(name, law):
    """Run the exact robot under a law that starts with the guesses."""
    path = folder / f"{name}.toml"
    path.write_text(case_text(law, seed=9, duration=SECONDS))
    return driven(jaxid.Live(path), robot(), seed=9)


adaptive = run("adaptive", 'kind = "adaptive"\ngate_velocity = 0.05\nhalf_life = 600.0')
text = (folder / "adaptive.toml").read_text()
print("\n".join(filter(None, text[text.index("[[effects]]") : text.index("[log]")].splitlines())))

# %% [markdown]
# ## Tracking error
#
# At first the law feeds forward the model at its guesses, which has no friction. When all unknowns
# are precise enough, here after about one second, it uses the estimates. The error then falls from
# milliradians to a few hundredths of one.

# %%
JOINTS = ("joint 1", "joint 2")
plt.figure(figsize=(9, 3), layout="constrained")
plt.plot(adaptive.time, 1e3 * adaptive.error, label=JOINTS)
plt.xlabel("time [s]")
plt.ylabel("error [mrad]")
plt.legend()
plt.show()
rms = {}
for label, start, end in (("first second", 0.0, 1.0), ("last second", SECONDS - 1.0, SECONDS)):
    part = adaptive.error[round(start / PERIOD) : round(end / PERIOD)]
    rms[label] = 1e3 * np.sqrt(np.mean(part**2, axis=0))
    print(f"{label}: {rms[label][0]:.3f} and {rms[label][1]:.3f} mrad RMS")

# %% [markdown]
# ## The gains of the drives
#
# Grey lines are the true gains.

# %%
gains = adaptive.estimates[:, :2]
plt.figure(figsize=(9, 3), layout="constrained")
plt.plot(LOOK * np.arange(len(gains)), gains, label=JOINTS)
for true in GAINS:
    plt.axhline(true, color="0.6", lw=0.8)
plt.xlabel("time [s]")
plt.ylabel("actual over declared torque")
plt.legend()
plt.show()
for joint, found, true in zip(JOINTS, gains[-1], GAINS, strict=True):
    print(f"{joint}: {found:.4f}, true {true}")

# %% [markdown]
# The page [five-bar robot](../docs/evidence/five_bar.md) compares the paper's three laws over 40
# s, with friction that fluctuates.
