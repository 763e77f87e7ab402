"""An arm in MuJoCo of which the user's file lacks or misstates five things, and its log with torques."""

import mujoco
import numpy as np

# Yaw, shoulder and elbow; the last two turn about parallel axes.
ARM = """<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.0002" integrator="RK4"/>
  <default><joint solreffriction="0.001 1"/></default>
  <worldbody>
    <body name="base">
      <joint name="yaw" axis="0 0 1"{yaw}/>
      <inertial pos="0 0 0.1" mass="2" diaginertia="0.02 0.02 0.01"/>
      <body name="upper" pos="0 0 0.2">
        <joint name="shoulder" axis="0 1 0"{shoulder}/>
        <inertial pos="0.02 0.01 0.15" mass="1.5" diaginertia="0.015 0.015 0.003"/>
        <body name="forearm" pos="0 0 0.3">
          <joint name="elbow" axis="0 1 0"{elbow}/>
          <inertial pos="0.01 0 0.12" mass="{mass}" diaginertia="0.006 0.006 0.001"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="yaw"/><motor joint="shoulder"/><motor joint="elbow"/></actuator>
</mujoco>
"""
JOINTS = ("yaw", "shoulder", "elbow")
# What the machine has: by joint, attributes of MuJoCo.
HIDDEN = {
    "yaw": {"frictionloss": 0.4},
    "shoulder": {"damping": 0.6},
    "elbow": {"armature": 0.05, "stiffness": 4.0, "springref": 0.5},
}
MASS, STATED = 0.8, 0.5


def user_file() -> str:
    """The file that the user has: a wrong mass, and nothing at the joints."""
    return ARM.format(yaw="", shoulder="", elbow="", mass=STATED)


def true_file(hidden: dict[str, dict[str, float]] = HIDDEN) -> str:
    """The machine, with what its joints have."""
    shown = {joint: "".join(f' {n}="{v}"' for n, v in values.items()) for joint, values in hidden.items()}
    return ARM.format(mass=MASS, **shown)


def arm_log(
    seconds: float = 12.0,
    rate: int = 250,
    noise: float = 1e-5,
    seed: int = 0,
    hidden: dict[str, dict[str, float]] = HIDDEN,
) -> dict[str, np.ndarray]:
    """Columns of a log by MuJoCo: the arm under PD control along sums of sines; torques are held."""
    model = mujoco.MjModel.from_xml_string(true_file(hidden))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    inner, count = round(1 / rate / model.opt.timestep), round(seconds * rate)
    frequency, phase = rng.uniform(0.2, 1.4, (5, 3)), rng.uniform(0, 2 * np.pi, (5, 3))
    # Torques are held for a sample: more damping about yaw, whose inertia is small, would chatter.
    kp, kd = np.array([15.0, 120.0, 30.0]), np.array([0.8, 8.0, 2.0])

    def wanted(t: float) -> np.ndarray:
        return 0.8 / np.sqrt(5) * np.sin(2 * np.pi * frequency * t + phase).sum(axis=0)

    data.qpos[:] = wanted(0.0)
    q, u = np.zeros((count, 3)), np.zeros((count, 3))
    for k in range(count):
        u[k] = kp * (wanted(k / rate) - data.qpos) - kd * data.qvel
        q[k], data.ctrl[:] = data.qpos, u[k]
        mujoco.mj_step(model, data, inner)
    q = q + noise * rng.normal(size=q.shape)
    columns = {"t": np.arange(count) / rate}
    for k, name in enumerate(JOINTS):
        columns |= {f"q_{name}": q[:, k], f"torque_{name}": u[:, k]}
    return columns


def stated(file: str) -> dict[str, float]:
    """What a file states of the joints, by joint and attribute."""
    model, out = mujoco.MjModel.from_xml_string(file), {}
    for name in JOINTS:
        joint = model.joint(name)
        dof = joint.dofadr[0]
        out |= {
            f"{name} armature": model.dof_armature[dof],
            f"{name} damping": np.ravel(model.dof_damping[dof])[0],
            f"{name} frictionloss": model.dof_frictionloss[dof],
            f"{name} stiffness": np.ravel(model.jnt_stiffness[joint.id])[0],
            f"{name} springref": model.qpos_spring[joint.qposadr[0]],
        }
    return out


def inertial_forces(file: str, count: int = 50) -> np.ndarray:
    """Forces that move the bodies and rotors of a file in some random states, by MuJoCo: (count, 3) [N m]."""
    model = mujoco.MjModel.from_xml_string(file)
    data, full, out = mujoco.MjData(model), np.zeros((model.nv, model.nv)), []
    drawn = np.random.default_rng(0).uniform(-1, 1, (count, 3, len(JOINTS)))
    for data.qpos[:], data.qvel[:], acceleration in drawn * np.array([1.0, 3.0, 10.0])[:, None]:
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        out.append(full @ acceleration + data.qfrc_bias)
    return np.array(out)
