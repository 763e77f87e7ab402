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
# # A plant of your own, in JAX
#
# A plant is one class: its parameters and its inertial forces. From it jaxid makes a right-hand
# side for ODE solvers, exact simulations with sticking friction, regressors and fits. Everything
# can be jitted, mapped and differentiated. This notebook writes a pendulum on a motor, and checks
# jaxid against SciPy.

# %%
# %matplotlib inline
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import jaxid

# %% [markdown]
# ## The class
#
# J a + m l g sin q = u + effects. The class says what stands on the left.


# %%
class Pendulum(jaxid.Plant):
    """J a + m l g sin q = u + effects; q = 0 hangs down."""

    kind = "pendulum"
    joints = 1
    motions = ("rotary",)

    inertia: jax.Array = jaxid.parameter("inertia", "positive", "J, about the axis", motion="rotary")
    weight: jax.Array = jaxid.parameter(
        "force", "positive", "m l g, torque of the weight at 90 degrees", motion="rotary"
    )

    def inertial(self, q, qd, qdd):
        return self.inertia * qdd + self.weight * jnp.sin(q)


viscous = jaxid.EFFECTS["viscous_friction"](coefficient=0.05)
plant = Pendulum(inertia=0.12, weight=2.4, effects=(viscous,))
jaxid.parameter_names(plant)

# %% [markdown]
# ## Right-hand side and diffrax
#
# `vector_field` has the form that diffrax wants. The torque of the motor is a function of time.


# %%
def torque(t):
    return 1.5 * jnp.sin(3.0 * t)[None]


times = jnp.linspace(0.0, 6.0, 601)
BACKWARD, FORWARD = diffrax.RecursiveCheckpointAdjoint(), diffrax.ForwardMode()


def motion(plant, adjoint=BACKWARD):
    """Angle [rad] at every sample, (time,)."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(jaxid.vector_field),
        diffrax.Tsit5(),
        t0=times[0],
        t1=times[-1],
        dt0=None,
        y0=jaxid.initial_state(plant, jnp.array([0.3]), force=torque(0.0)),
        args=(plant, torque),
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-11),
        adjoint=adjoint,
    )
    return solution.ys.q[:, 0]


angle = jax.jit(motion)(plant)

# %% [markdown]
# SciPy solves the equation as it stands on paper:


# %%
def on_paper(t, x, J=0.12, w=2.4, c=0.05):
    return [x[1], (1.5 * np.sin(3.0 * t) - c * x[1] - w * np.sin(x[0])) / J]


reference = solve_ivp(on_paper, (0.0, 6.0), [0.3, 0.0], t_eval=np.asarray(times), rtol=1e-10, atol=1e-12).y[0]
apart = float(np.abs(np.asarray(angle) - reference).max())
print(f"largest difference: {apart:.1e} rad")
plt.figure(figsize=(8, 3), layout="constrained")
plt.plot(times, angle, label="jaxid and diffrax")
plt.plot(times, reference, "--", label="SciPy")
plt.xlabel("time [s]")
plt.ylabel("angle [rad]")
plt.legend()
plt.show()

# %% [markdown]
# ## Many machines at once
#
# A function of a plant is a function of its leaves; `vmap` runs it for many. Here all three values
# change by up to 20 %. Black is the machine above.

# %%
leaves = lambda p: (p.inertia, p.weight, p.effects[0].coefficient)
theta = jnp.array([0.12, 2.4, 0.05])
angle_of = lambda theta, adjoint=BACKWARD: motion(eqx.tree_at(leaves, plant, tuple(theta)), adjoint)
many = theta * jnp.linspace(0.8, 1.2, 32)[:, None]
fan = jax.jit(jax.vmap(angle_of))(many)
plt.figure(figsize=(8, 3), layout="constrained")
plt.plot(times, fan.T, color="C0", lw=0.6)
plt.plot(times, angle, color="k")
plt.xlabel("time [s]")
plt.ylabel("angle [rad]")
plt.show()

# %% [markdown]
# ## Hessian
#
# The cost of a fit is a sum of squares. Its exact second derivative, forward over forward, gives
# the curvature at the optimum. A finite difference of the gradient agrees.


# %%
def cost(theta):
    difference = angle_of(theta, FORWARD) - jnp.asarray(reference)
    return jnp.sum(difference**2)


gradient = jax.jit(jax.jacfwd(cost))
hessian = jax.jit(jax.jacfwd(jax.jacfwd(cost)))(theta)
step = 1e-5 * theta
columns = [
    (gradient(theta.at[k].add(step[k])) - gradient(theta.at[k].add(-step[k]))) / (2 * step[k])
    for k in range(3)
]
hessian_apart = float(jnp.abs(jnp.stack(columns) - hessian).max() / jnp.abs(hessian).max())
print(np.array2string(np.asarray(hessian), precision=3))
print(f"finite differences of the gradient: {hessian_apart:.0e} apart")

# %% [markdown]
# ## A fit
#
# `jaxid.fit` is a pure function of arrays. The log is SciPy's motion with noise of 5 mrad; guesses are
# 10 % off. This pendulum turns over, so that guesses much farther off may end in another minimum.

# %%
command = np.asarray(torque(times)[0])[:, None]
noisy = reference[:, None] + 5e-3 * np.random.default_rng(0).standard_normal((times.size, 1))
free = ("inertia", "weight", "viscous_friction.coefficient")
period = float(times[1] - times[0])
# Between two samples the torque goes on: a line between them, in four steps each.
fitted = jax.jit(
    lambda y: jaxid.fit(plant, free, period, y, command, start=theta * 1.1, hold="linear", substeps=4)
)(jnp.asarray(noisy))
sigmas = np.asarray((fitted.theta - theta) / fitted.std)
for name, value, std, true in zip(free, fitted.theta, fitted.std, theta, strict=True):
    print(f"{name:30s} {value:.6f} ± {std:.6f}, true {true}")
