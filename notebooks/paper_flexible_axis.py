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
# # Paper: an axis with a flexible coupling
#
# Janot, Gautier, Jubien and Vandanjon ask what can be identified of a motor, a spring and a load,
# depending on which of them carries a sensor. Here the axis is the exact chain of `truth/`, with
# the paper's values.

# %%
# %matplotlib inline
import dataclasses
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

sys.path.insert(0, "..")  # the checkout: truth/ is not installed

import jaxid
from truth.chain import flexible_axes as axes

folder = Path(tempfile.mkdtemp())
quiet = dataclasses.replace(axes.SENSOR, force_noise=0.08)
recorded = axes.record(duration=8.0, sensor=quiet)
columns = axes.columns(recorded)
plt.figure(figsize=(9, 3), layout="constrained")
plt.plot(columns["t"], 1e6 * (columns["q_load"] - columns["q"]), lw=0.5)
plt.xlabel("time [s]")
plt.ylabel("load minus motor [µm]")
plt.show()

# %% [markdown]
# ## Both encoders


# %%
def fitted(name, method, **sensors):
    """Fit the axis with some of its sensors."""
    path = folder / f"{name}.toml"
    path.write_text(axes.text(sensor=quiet, **sensors))
    return jaxid.identify(path, columns, method=method)


both = fitted("both", "inverse_dynamics", load=True)
both

# %% [markdown]
# ## The motor's encoder alone
#
# `minimal_model` eliminates the motion of the load, as the paper does. It can only give the two
# Coulomb frictions as a sum, and says so. It needs derivatives of fourth order, which amplify noise: the
# first line and the notes of the result say how much remains unexplained.

# %%
motor = fitted("motor", "minimal_model", load=False)
print(motor)

# %% [markdown]
# ## Beside the truth

# %%
off = {}
for label, result in (("both encoders", both), ("motor alone", motor)):
    for name, true in axes.TRUTH.items():
        p = result.parameters[name]
        if p.identifiable:
            off[label, name] = (p.value - true) / p.std
            print(f"{label:14s} {name:34s} {p.value:10.4g} ± {p.std:8.2g}, true {true:g}")
print(f"largest: {max(map(abs, off.values())):.1f} standard deviations")

# %% [markdown]
# The page [flexible axis](../docs/evidence/flexible_axis.md) has the paper's third model, its
# noise, and coarser encoders.
