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
# # An arm from its MJCF, and back
#
# A robot's file has guesses of masses, armature and friction. MuJoCo simulates the real arm here:
# jaxid gets only its log and a file with wrong values. At the end the corrected file is run in
# MuJoCo again. The last cells do the same with a URDF.
#
# Needs `pip install 'jaxid[mujoco]'`.

# %%
# %matplotlib inline
import subprocess
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np

import jaxid

folder = Path(tempfile.mkdtemp())

# %% [markdown]
# ## The true arm, which jaxid does not see

# %%
MODEL = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option gravity="0 0 -9.81" timestep="0.0005" integrator="implicitfast"/>
  <default><joint solreffriction="0.002 1"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" armature="{a1}" damping="{d1}" frictionloss="{f1}"/>
      <inertial pos="0.2 0 0" mass="2" diaginertia="0.01 {i1} 0.03"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="elbow" axis="0 1 0" armature="{a2}" damping="{d2}" frictionloss="{f2}"/>
        <inertial pos="0.15 0 0" mass="{m2}" diaginertia="0.005 0.015 0.015"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
</mujoco>
"""
TRUE = dict(a1=0.08, d1=0.9, f1=1.6, i1=0.03, a2=0.03, d2=0.5, f2=0.7, m2=1.2)
GUESS = dict(a1=0.02, d1=0.3, f1=0.5, i1=0.03, a2=0.01, d2=0.2, f2=0.2, m2=0.8)
(folder / "robot.xml").write_text(MODEL.format(**GUESS))


def moved(text, seconds=6.0, seed=0):
    """Run a model under a PD controller at 500 Hz; return time, positions, torques and references."""
    model = mujoco.MjModel.from_xml_string(text)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    kp, kd, rows = np.array([300.0, 120.0]), np.array([30.0, 10.0]), []
    for k in range(round(500 * seconds)):
        t = k / 500.0
        wanted = np.array([0.8 * np.sin(1.7 * t) + 0.3 * np.sin(4.1 * t), 0.9 * np.cos(2.3 * t) - 0.9])
        q = data.qpos + 1e-5 * rng.standard_normal(2)
        data.ctrl[:] = kp * (wanted - q) - kd * data.qvel
        rows.append([t, *q, *data.ctrl, *wanted])
        for _ in range(4):
            mujoco.mj_step(model, data)
    return np.array(rows)


rows = moved(MODEL.format(**TRUE))
log = dict(zip(("t", "q1", "q2", "u1", "u2"), rows[:, :5].T, strict=True))
plt.figure(figsize=(9, 2.5), layout="constrained")
plt.plot(log["t"], log["q1"], label="shoulder")
plt.plot(log["t"], log["q2"], label="elbow")
plt.xlabel("time [s]")
plt.ylabel("position [rad]")
plt.legend()
plt.show()

# %% [markdown]
# ## Identify
#
# `unknown` says which values of the file are to be identified: sums of the link parameters, and
# everything that CAD does not have.

# %%
case = {
    "plant": {
        "kind": "tree",
        "mjcf": str(folder / "robot.xml"),
        "unknown": ["base", "armature", "damping", "frictionloss"],
    },
    "log": {"time": "t", "position": ["q1", "q2"], "force": ["u1", "u2"]},
}
result = jaxid.identify(case, log, method="inverse_dynamics")
print(result)

# %% [markdown]
# The residual over velocity has no pattern: nothing is missing. Without `"armature"` in the list the
# model would be incomplete, because the file's value of the elbow is wrong. The armature of the
# shoulder acts like the inertia of its link, so that the log shows their sum only.

# %%
figure, axes = plt.subplots(1, 2, figsize=(12, 3.2), layout="constrained")
for joint in (1, 2):
    result.plot("scatter", axes[joint - 1], against="velocity", joint=joint)
plt.show()

# %% [markdown]
# ## Back into the file
#
# The command is `jaxid export`. Bodies with the identified sums are written into the robot's own
# file.

# %%
result.save(folder / "out")
words = "jaxid export out/result.json --to mjcf --model robot.xml -o found.xml".split()
status = subprocess.run(words, cwd=folder).returncode

# %% [markdown]
# MuJoCo runs the true arm, the file as it was, and the file as found, under the same controller.
# The torque that each needs for this motion is compared.

# %%
runs = {
    "file": moved((folder / "robot.xml").read_text(), seed=1),
    "found": moved((folder / "found.xml").read_text(), seed=1),
}
true = moved(MODEL.format(**TRUE), seed=1)
torque_off = {name: np.sqrt(np.mean((run[:, 3:5] - true[:, 3:5]) ** 2, axis=0)) for name, run in runs.items()}
for name, off in torque_off.items():
    print(f"torque of the {name}: {off[0]:.3f} and {off[1]:.3f} N m RMS from the true arm's")
friction_names = [n for n in result.parameters if "friction" in n]
true_friction = [TRUE[k] for k in ("d1", "d2", "f1", "f2")]
for name, value in zip(friction_names, true_friction, strict=True):
    print(f"{name:34s} {result.value(name):.4f}, true {value}")

# %% [markdown]
# ## The same from a URDF
#
# A URDF has no armature, so the fit starts from zero. The friction comes out the same.

# %%
URDF = """
<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0.15 0 0"/><mass value="0.8"/>
    <inertia ixx="0.005" ixy="0" ixz="0" iyy="0.015" iyz="0" izz="0.015"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><dynamics damping="0.3" friction="0.5"/>
    <limit lower="-2" upper="2" effort="90" velocity="9"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.4 0 0"/><axis xyz="0 1 0"/><dynamics damping="0.2" friction="0.2"/>
    <limit lower="-3" upper="3" effort="90" velocity="9"/></joint>
</robot>
"""
(folder / "robot.urdf").write_text(URDF)
case["plant"] = {
    "kind": "tree",
    "urdf": str(folder / "robot.urdf"),
    "unknown": ["base", "armature", "damping", "frictionloss"],
}
by_urdf = jaxid.identify(case, log, method="inverse_dynamics")
for name in friction_names:
    print(f"{name:34s} by MJCF {result.value(name):.4f}, by URDF {by_urdf.value(name):.4f}")
