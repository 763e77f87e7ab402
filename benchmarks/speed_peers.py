"""The axis of the speed benchmarks by other tools for identification, as far as they are installed.

MuJoCo's sysid closes the loop by an affine servo, continuous where the controller is sampled, and fits a
simulated log of this servo, so that its model can be right. jax-sysid fits the sampled loop, one explicit
step a sample; figaroh builds the regressor of a motion by Pinocchio, sample by sample.
"""

from collections.abc import Callable
from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np

from benchmarks import axis
from benchmarks.speed_rows import Row, compare
from jaxid.numerics.filters import Decimator
from jaxid.simulation.force_balance import ForceData, force_and_columns

KP, KV, WIDTH = 160.18, 243.45, 1e-3

XML = """
<mujoco>
  <option integrator="implicitfast" timestep="{period}" gravity="0 0 0"><flag contact="disable"/></option>
  <worldbody><body name="slide">
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
    <joint name="x" type="slide" axis="1 0 0"/>
  </body></worldbody>
  <actuator>
    <general name="servo" joint="x" gainprm="{kp}" biastype="affine" biasprm="0 -{kp} -{kv}"/>
    <motor name="offset" joint="x"/>
  </actuator>
  <sensor><jointpos name="position" joint="x"/></sensor>
</mujoco>
"""
URDF = """<robot name="axis"><link name="base"/><link name="slide"><inertial><mass value="95"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="x" type="prismatic"><parent link="base"/><child link="slide"/><axis xyz="1 0 0"/>
<limit lower="-9" upper="9" effort="999" velocity="9"/></joint></robot>"""


def installed(name: str) -> bool:
    return find_spec(name) is not None


class MuJoCo:
    """Rollout and fit by mujoco.sysid."""

    def __init__(self, reference: np.ndarray):
        import mujoco
        from mujoco import sysid

        kp, kv = axis.GAIN * KP * KV, axis.GAIN * KV
        spec = mujoco.MjSpec.from_string(XML.format(period=axis.PERIOD, kp=kp, kv=kv))
        model = spec.compile()
        times = axis.PERIOD * np.arange(len(reference))
        control = np.stack([reference, np.ones_like(reference)], axis=1)[:-1]
        data = mujoco.MjData(model)
        start = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
        self.sysid = sysid

        def make(measured: np.ndarray) -> Callable:
            seen = sysid.TimeSeries.from_names(times, measured[:, None], model)
            log = sysid.ModelSequences(
                "axis", spec, "log", start, sysid.TimeSeries(times[:-1], control), seen
            )
            return sysid.build_residual_fn(models_sequences=[log])

        # Its log is its own, so that its model can be right.
        noise = axis.NOISE * np.random.default_rng(0).standard_normal(len(reference))
        self.residual = make(reference)
        run = self.rollout()  # the first sample and the last are left out
        self.residual = make(np.concatenate([run[:1], run, run[-1:]]) + noise)

    def parameters(self, values: np.ndarray):
        out = self.sysid.ParameterDict()
        joint = lambda spec: spec.joint("x")
        changes = {
            "mass": lambda s, p: setattr(s.body("slide"), "mass", p.value[0]),
            "damping": lambda s, p: setattr(joint(s), "damping", [p.value[0], 0, 0]),
            "friction": lambda s, p: setattr(joint(s), "frictionloss", p.value[0]),
            "offset": lambda s, p: setattr(s.actuator("offset"), "gear", [p.value[0], 0, 0, 0, 0, 0]),
        }
        for (name, change), value in zip(changes.items(), values, strict=True):
            low, high = sorted((0.1 * value, 5.0 * value))
            out.add(self.sysid.Parameter(name, nominal=value, min_value=low, max_value=high, modifier=change))
            out[name].value[:] = value
        return out

    def rollout(self) -> np.ndarray:
        own = self.parameters(axis.TRUTH)
        predicted = self.residual(own.as_vector(), own, return_pred_all=True)[1]
        return np.ravel(predicted[0][0].data)

    def fit(self) -> np.ndarray:
        # Of order one the residual is so small that its solver is content at once.
        def scaled(*args, **more):
            residual, *rest = self.residual(*args, **more)
            return ([1e6 * r for r in residual], *rest)

        found, _ = self.sysid.optimize(
            initial_params=self.parameters(axis.START),
            residual_fn=scaled,
            optimizer="mujoco",
            verbose=False,
            x_scale="jac",
        )
        return found.as_vector()


class JaxSysid:
    """A fit by jax-sysid: L-BFGS on the reverse-mode gradient, from the same start."""

    def __init__(self, reference: np.ndarray, measured: np.ndarray):
        from jax_sysid.models import Model

        scale, h = 1e3, axis.PERIOD  # the output in millimetres: its loss is of order one

        def state(x, u, params):
            q, v, last, past = x
            m, c, f, f0 = params[0] * axis.START
            wanted = KV * (KP * (u[0] - q) - (q - past) / (2 * h))
            force = axis.GAIN * jnp.clip(wanted, -10.0, 10.0)
            new = v + h / m * (force - c * v - f * jnp.tanh(v / WIDTH) + f0)
            return jnp.array([q + h * 0.5 * (v + new), new, q, last])

        self.model = Model(4, 1, 1, state_fcn=state, output_fcn=lambda x, u, params: scale * x[:1])
        self.model.loss(rho_x0=0.0, rho_th=0.0, train_x0=False)
        self.model.optimization(adam_epochs=0, lbfgs_epochs=500, iprint=-1, lbfgs_tol=1e-16)
        self.reference, self.measured = reference[:, None], scale * measured[:, None]

    def fit(self) -> np.ndarray:
        self.model.init(params=[np.ones(4)], x0=np.zeros(4))
        self.model.fit(self.measured, self.reference)
        return np.asarray(self.model.params[0]) * axis.START


class Figaroh:
    """Least squares on figaroh's regressor of a motion that is known."""

    def __init__(self, motion: tuple[np.ndarray, ...], force: np.ndarray):
        import pinocchio as pin
        from figaroh.backends.pinocchio import PinocchioBackend
        from figaroh.tools.regressor import RegressorBuilder, RegressorConfig

        class Robot:
            model = pin.buildModelFromXML(URDF)
            backend = PinocchioBackend.from_model(model)

        config = RegressorConfig(has_friction=True, has_joint_offset=True)
        self.builder = RegressorBuilder(Robot(), config)
        self.motion, self.force = motion, force

    def fit(self) -> np.ndarray:
        w = self.builder.build_basic_regressor(*(x[:, None] for x in self.motion), {"act_idxv": [0]})
        # Columns that this machine does not excite are zero; mass, viscous, dry, offset remain.
        w = w[:, np.linalg.norm(w, axis=0) > 0]
        # Its offset stands on the other side of the balance.
        return np.linalg.lstsq(w, self.force, rcond=None)[0] * [1.0, 1.0, 1.0, -1.0]


class Regressor:
    """Least squares on jaxid's regressor of a motion that is known."""

    def __init__(self, motion: tuple[np.ndarray, ...], force: np.ndarray):
        columns = [jnp.asarray(x)[:, None] for x in (*motion, force)]
        self.data = ForceData(
            *columns, jnp.ones((len(force), 1)), jnp.zeros(()), axis.PERIOD, 0.0, Decimator(1, 0)
        )
        # So sharp that its sign is figaroh's.
        self.plant = axis.plant(np.ones(4), sharpness=1e-9)

    def fit(self) -> np.ndarray:
        e, jacobian = force_and_columns(self.plant, axis.PLACES, self.data, jnp.zeros(4))
        return np.linalg.lstsq(np.asarray(jacobian)[:, 0], -np.asarray(e)[:, 0], rcond=None)[0]


def motion_of(run: np.ndarray, velocity: np.ndarray) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return position, velocity and acceleration of a run, and the force of the balance [N], each (time,)."""
    acceleration = np.gradient(velocity, axis.PERIOD)
    m, c, f, f0 = axis.TRUTH
    return (run, velocity, acceleration), m * acceleration + c * velocity + f * np.sign(velocity) - f0


def against_peers(sides: object, few: int) -> list[Row]:
    """Compare jaxid with the tools that are installed."""
    rows = []
    if installed("mujoco"):
        peer = MuJoCo(sides.reference)
        forward = sides.forward("ideal")
        # Different worlds: what is compared is a run, and what a fit finds.
        rows.append(
            compare(
                "forward, ideal step",
                forward,
                "mujoco.sysid, a rollout",
                lambda: np.append(peer.rollout(), [0.0, 0.0]),
                None,
                few,
                0.1,
            )
        )
        rows.append(
            compare("fit, warm, ideal", sides.fit("ideal"), "mujoco.sysid optimize", peer.fit, None, 2, 0.05)
        )
    if installed("jax_sysid"):
        peer = JaxSysid(sides.reference, sides.measured)
        rows.append(compare("fit, warm", sides.fit("smooth"), "jax-sysid, L-BFGS", peer.fit, None, 2, 0.05))
    if installed("figaroh"):
        run = sides.runs["ideal"](sides.base)
        known = motion_of(np.asarray(run.position)[:, 0], np.asarray(run.velocity)[:, 0])
        rows.append(
            compare(
                "regressor and least squares",
                Regressor(*known).fit,
                "figaroh, Pinocchio",
                Figaroh(*known).fit,
                None,
                few,
                0.05,
            )
        )
    return rows
