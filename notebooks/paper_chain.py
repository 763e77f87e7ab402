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
# # Paper: a chain of masses, identified in its first instants
#
# Wi, Ri, Ri and Ri identify six masses with Coulomb friction from the first tenth of a second, by
# iterated integrals: no derivatives, no initial conditions. Here the chain is an exact-friction
# simulator of `truth/`, and the controller is the paper's. Try another window, another rate, or
# noise.

# %%
# %matplotlib inline
import sys
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt

sys.path.insert(0, "..")  # the checkout: experiments/ and truth/ are not installed

import jaxid
from experiments.wi_loop import CASE, driven, errors, true_values

# %% [markdown]
# ## A tenth of a second
#
# `driven` calls the case's controller tick by tick on the exact chain. It starts from the paper's
# wrong values.

# %%
run = driven(CASE, 0.1)
plt.figure(figsize=(8, 3), layout="constrained")
plt.plot(run.log.time, 1e3 * run.log.position, label=[f"mass {k}" for k in range(1, 7)])
plt.xlabel("time [s]")
plt.ylabel("position [mm]")
plt.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
plt.show()

# %% [markdown]
# ## One window, 25 unknowns
#
# The log has no noise, as in the paper.

# %%
windowed = Path(mkdtemp()) / "window.toml"
windowed.write_text(CASE.read_text() + "\n[algebraic]\nwindow = [0.0, 0.1]\n")
found = jaxid.identify(windowed, run.log, method="algebraic").estimate
worst = errors(found.names, found.theta)

names, true = list(found.names), true_values()
plt.figure(figsize=(9, 3), layout="constrained")
plt.bar(range(len(names)), [100 * (v / true[n] - 1) for n, v in zip(names, found.theta, strict=True)])
plt.xticks(range(len(names)), names, rotation=90, fontsize=7)
plt.ylabel("error without noise [%]")
plt.show()

# %% [markdown]
# ## What noise does
#
# The same window with noise on the readings, which goes round the loop. The table has the largest error
# of each kind of parameter, in one run for each level of noise.

# %%
noisy = {0.0: worst}
for noise in (1e-8, 1e-7, 1e-6):
    log = driven(CASE, 0.1, noise=noise, seed=3).log
    estimate = jaxid.identify(windowed, log, method="algebraic").estimate
    noisy[noise] = errors(estimate.names, estimate.theta)

print(f"{'noise':>10s}" + "".join(f"{kind:>18s}" for kind in worst))
for noise, largest in noisy.items():
    print(f"{1e9 * noise:7.0f} nm" + "".join(f"{100 * error:16.3f} %" for error in largest.values()))

# %% [markdown]
# Errors grow with the noise. The page [a chain of masses](../docs/evidence/chain.md) has a thousand
# runs of each method and level.
