"""MJCF files of small robots, as text; the logs that tests take from them are MuJoCo's."""

import numpy as np

# Defaults and classes, a reference pose, two joints on one body, an anchor beside the origin, a slide on a
# branch, a body whose inertia is that of its shape, a joint that follows another one, springs and drives.
BRANCHED = """
<mujoco model="branched">
  <compiler angle="radian"/>
  <option gravity="0.3 -0.4 -9.7" timestep="0.001"/>
  <default>
    <joint damping="0.4" armature="0.02"/>
    <default class="geared"><joint damping="0.1" armature="0.3"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="trunk" pos="0.1 0 0.3" quat="0.9 0.1 0.3 -0.2">
      <inertial pos="0.02 0.01 0.1" mass="3" fullinertia="0.05 0.04 0.03 0.001 -0.002 0.003"/>
      <joint name="yaw" axis="0 0.2 1" pos="0.03 0.01 0" class="geared" range="-2 2"/>
      <joint name="pitch" axis="1 0 0" ref="0.4" stiffness="2 0.3 0.5" springref="0.2"/>
      <body name="left" pos="0 0.2 0.1">
        <joint name="lift" type="slide" axis="0.3 0 1" damping="3 0.6 0.2" range="-0.3 0.5"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0.1" density="900"/>
        <body name="hand" pos="0.2 0 0.1">
          <joint name="grip" axis="0 1 0"/>
          <inertial pos="0.05 0 0" mass="0.4" diaginertia="0.001 0.002 0.002"/>
        </body>
        <body name="thumb" pos="0.2 0 -0.1" euler="0.3 0 0">
          <joint name="copy" axis="0 1 0" stiffness="0.7" springref="0.1"/>
          <inertial pos="-0.04 0 0.01" mass="0.3" diaginertia="0.001 0.002 0.0015"/>
        </body>
      </body>
      <body name="right" pos="0 -0.2 0.1">
        <joint name="swing" axis="0 0 1"/>
        <inertial pos="0.1 0 0.05" mass="1.2" diaginertia="0.02 0.03 0.02"/>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="copy" joint2="grip" polycoef="0.05 -1.5 0 0 0"/></equality>
  <actuator>
    <motor name="m" joint="yaw" gear="20" armature="0.001" damping="0.002"/>
    <velocity name="v" joint="pitch" kv="3" gear="2"/>
    <dcmotor name="d" joint="lift" gear="30" motorconst="0.05" resistance="2"/>
    <general name="g" joint="grip" gainprm="4"/>
    <motor name="s" joint="swing" gear="-1"/>
  </actuator>
</mujoco>
"""

# A cart on a rail that carries two arms of its own: one turns about y, the other about y further out and
# slides; weight acts across the rail.
CART = """
<mujoco model="cart">
  <compiler angle="radian"/>
  <option gravity="0 0 -9.81" timestep="0.0002" integrator="RK4"/>
  <default><joint solreffriction="0.001 1"/></default>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" damping="4" frictionloss="{rail}"/>
      <inertial pos="0 0 0" mass="3" diaginertia="0.01 0.01 0.01"/>
      <body name="pole" pos="0.1 0 0">
        <joint name="pole" axis="0 1 0" damping="0.1" armature="0.02" frictionloss="{pole}"/>
        <inertial pos="0.02 0 -0.25" mass="0.8" diaginertia="0.02 0.02 0.003"/>
      </body>
      <body name="boom" pos="-0.1 0 0">
        <joint name="boom" axis="0 -1 0" damping="0.2"/>
        <inertial pos="-0.2 0 0.03" mass="1.1" diaginertia="0.004 0.015 0.015"/>
        <body name="plunger" pos="-0.4 0 0">
          <joint name="plunger" type="slide" axis="0 0 1" damping="3"/>
          <inertial pos="0.01 0 -0.1" mass="0.5" diaginertia="0.003 0.003 0.001"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="rail"/><motor joint="pole"/><motor joint="boom"/><motor joint="plunger"/>
  </actuator>
</mujoco>
"""
CART_JOINTS = ("rail", "pole", "boom", "plunger")


def cart(rail: float = 0.0, pole: float = 0.0) -> str:
    """The cart with dry friction on two of its joints."""
    return CART.format(rail=rail, pole=pole)


def cart_log(text: str, seconds: float = 10.0, rate: int = 500, seed: int = 0) -> dict[str, np.ndarray]:
    """Columns of a log by MuJoCo: the cart under PD control along sums of sines, with encoder noise.

    The force is held between the samples, as a drive would.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(text)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    inner = round(1 / rate / model.opt.timestep)
    count, n = round(seconds * rate), model.nv
    frequency, phase = rng.uniform(0.15, 1.1, (5, n)), rng.uniform(0, 2 * np.pi, (5, n))
    amplitude = np.array([0.12, 0.5, 0.4, 0.05]) / np.sqrt(5)
    kp, kd = np.array([3000.0, 60.0, 150.0, 2500.0]), np.array([120.0, 4.0, 10.0, 60.0])

    def wanted(t: float) -> np.ndarray:
        return amplitude * np.sin(2 * np.pi * frequency * t + phase).sum(axis=0)

    data.qpos[:] = wanted(0.0)
    q, u = np.zeros((count, n)), np.zeros((count, n))
    for k in range(count):
        u[k] = kp * (wanted(k / rate) - data.qpos) - kd * data.qvel
        q[k], data.ctrl[:] = data.qpos, u[k]
        for _ in range(inner):
            mujoco.mj_step(model, data)
    q = q + 1e-6 * rng.normal(size=q.shape)
    columns = {"t": np.arange(count) / rate}
    columns |= {f"q_{name}": q[:, k] for k, name in enumerate(CART_JOINTS)}
    return columns | {f"u_{name}": u[:, k] for k, name in enumerate(CART_JOINTS)}


# A cart that a motor drives, with a pendulum that nothing drives.
PENDULUM_ON_CART = """
<mujoco>
  <option gravity="0 0 -9.81" timestep="0.0001" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="slide" type="slide" axis="1 0 0" {slide}/>
      <inertial pos="0 0 0" mass="1.2" diaginertia="0.01 0.01 0.01"/>
      <body><joint name="swing" axis="0 1 0" {swing}/>
        <inertial pos="0 0 -0.25" mass="0.3" diaginertia="0.007 0.007 0.0001"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slide"/></actuator>
</mujoco>
"""


def pendulum_log(slide: str, swing: str, seconds: float = 20.0, rate: int = 500) -> dict[str, np.ndarray]:
    """Columns of a log by MuJoCo: the cart under PD control, with rounded readings and a noisy force.

    Args:
        slide, swing: Attributes of the joints in MJCF.
        seconds: Length of the log [s].
        rate: Sampling rate [Hz].
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(PENDULUM_ON_CART.format(slide=slide, swing=swing))
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    inner, count = round(1 / rate / model.opt.timestep), round(seconds * rate)
    steps = np.array([2e-5, 2 * np.pi / 8192])
    t = np.arange(count) / rate
    wanted = sum(a * np.sin(2 * np.pi * f * t) for a, f in ((0.25, 0.4), (0.1, 1.1), (0.05, 2.3)))
    q, u, before = np.zeros((count, 2)), np.zeros(count), 0.0
    for k in range(count):
        q[k] = np.round(data.qpos / steps) * steps
        u[k] = np.clip(120 * (wanted[k] - q[k, 0]) - 12 * (q[k, 0] - before) * rate, -30, 30)
        before, data.ctrl[0] = q[k, 0], u[k]
        for _ in range(inner):
            mujoco.mj_step(model, data)
    return {"t": t, "slide pos": q[:, 0], "swing pos": q[:, 1], "F [N]": u + 0.05 * rng.normal(size=count)}
