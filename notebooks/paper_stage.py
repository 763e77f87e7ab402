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
# # Paper: a stage, a hundred samples of its current
#
# Bogdan and Abba publish twelve parameters of a micropositioning stage, to 1 to 7 %, from a
# hundred samples of a current. Here the stage is the exact chain of `truth/` with their values.
# What does such a log determine?

# %%
# %matplotlib inline
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

sys.path.insert(0, "..")  # the checkout: truth/ is not installed

import jaxid
from truth.chain import stages

reference = stages.move(0.5, **stages.MOVES[1])
noise = 5e-3  # A
log = stages.record(stages.machine(1, rigid=True), reference, noise=noise, seed=3, start=0.2 * stages.COUNT)
plt.figure(figsize=(9, 2.8), layout="constrained")
plt.plot(log["t"], log["i"], ".-")
plt.xlabel("time [s]")
plt.ylabel("current [A]")
plt.show()

# %% [markdown]
# ## Guesses up to 50 % off, and a prior that says so

# %%
guesses = stages.drawn(1)
prior = '[within_prior]\non = "force"\nprior = 0.5\n'
path = Path(tempfile.mkdtemp()) / "stage.toml"
path.write_text(stages.text(1, guess=guesses, more=prior))
columns = {name: log[name] for name in ("t", "q", "i", "ref")}
result = jaxid.identify(path, columns)
print(result)

# %% [markdown]
# ## Two or three combinations, not twelve parameters
#
# These are the combinations that the log determines, with what is left of the prior.

# %%
directions = result.estimate.details["directions"]
for direction in directions:
    parts = ", ".join(f"{v:+.2f} {n}" for n, v in direction["combination"].items() if abs(v) > 0.2)
    print(f"{direction['std']:.3f} of the prior: {parts}")

# %% [markdown]
# The friction of motor and table acts as one sum at the motor. These are the true, the guessed and the
# fitted sum, and the inertia:

# %%
theta = dict(zip(result.estimate.names, result.estimate.theta, strict=True))
sums = {
    "true": stages.combined(stages.TRUTH[1]),
    "guess": stages.combined(guesses),
    "found": stages.combined(theta),
}
for name, entry in sums.items():
    print(f"{name:6s} inertia {entry['inertia']:.3g} kg m^2, dry friction {1e3 * entry['dry']:.2f} mN m")

# %% [markdown]
# The page [stage](../docs/evidence/stage.md) counts a thousand such logs, and designs the
# experiment that would tell more.
