"""The axis that the speed benchmarks run: EMPS-like, in its cascade loop, 25 000 samples at 1 kHz.

Its log comes from the independent stepper of `truth/`, with an encoder's rounding and noise.
"""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.controllers import CascadePD
from jaxid.effects import EFFECTS
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform
from jaxid.estimators.output_fit import fit_alone
from jaxid.model.smoothing import Smoothing
from jaxid.model.unknowns import scatter
from jaxid.plants import Axis
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import Drive
from jaxid.simulation.replay import Numerics, Replay
from truth.axis import machines

PERIOD, GAIN = 1e-3, 35.15065
NOISE = 1e-6  # of a reading [m]
TRUTH = np.array([95.1, 203.5, 20.39, -3.16])
START = 0.7 * TRUTH
# Fitted: inertia, viscous coefficient, Coulomb level, constant force.
PLACES = (
    (("inertia",), None),
    (("effects", 0, "coefficient"), None),
    (("effects", 1, "level"), None),
    (("effects", 2, "level"), None),
)
TRANSFORM = Transform(jnp.asarray([True, False, False, False]))
BOUNDS = (jnp.asarray([1e-9, 0.0, 0.0, -np.inf]), jnp.full(4, np.inf))


def log(samples: int = 25_000) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the log by the exact stepper; return reference and measured position [m], each (time,)."""
    setup = machines.emps_like(duration=25.0).with_effect("constant_force", level=TRUTH[3])
    return setup.loop.reference[:samples], np.asarray(setup.run()["position"])[:samples]


def plant(theta: np.ndarray, sharpness: float = 1e-3) -> Axis:
    """Build the axis at some values of its four parameters; see `PLACES` for their order."""
    effects = (
        EFFECTS["viscous_friction"](coefficient=1.0),
        EFFECTS["coulomb_friction"](level=1.0),
        EFFECTS["constant_force"](level=1.0),
    )
    return scatter(PLACES, Axis(1.0, effects=effects, smoothing=Smoothing(sharpness)), jnp.asarray(theta))


def replay(reference: np.ndarray, numerics: Numerics) -> Replay:
    """Set up the simulated run in the loop: from rest, by exact readings of the position.

    Args:
        reference: Reference position [m], (time,).
        numerics: Steps and friction.
    """
    law = CascadePD(
        kp=jnp.asarray(160.18),
        kv=jnp.asarray(243.45),
        limit=jnp.asarray(10.0),
        period=PERIOD,
        velocity_average=2,
    )
    drive = Drive(jnp.asarray([GAIN]), PERIOD, "zero_order", numerics.substeps, numerics.set_valued)
    zero = jnp.zeros((len(reference), 1))
    return Replay(
        drive=drive,
        controller=law,
        sensor=Sensor(),
        reference=jnp.asarray(reference)[:, None],
        disturbance=zero,
        command=None,
        position=jnp.zeros(1),
        velocity=jnp.zeros(1),
        restart=None,
        every=1,
        follow=jnp.eye(1),
    )


def simulated(run: Replay, base: Axis, theta: jax.Array) -> jax.Array:
    """Simulate the position [m], (time,), at some values of the parameters, (4,)."""
    return run(scatter(PLACES, base, theta)).position[:, 0]


def jacobian(run: Replay, base: Axis, theta: jax.Array) -> jax.Array:
    """Differentiate the position by the parameters in forward mode, (time, 4)."""
    return jax.jacfwd(lambda x: simulated(run, base, x))(theta)


def gauss_newton(run: Replay, base: Axis, theta: jax.Array, measured: jax.Array) -> tuple:
    """Return J'J (4, 4), J'e (4,) and half the sum of squares [m^2] of the residual in position."""

    def residual(x: jax.Array) -> tuple:
        e = measured - simulated(run, base, x)
        return e, e

    jac, e = jax.jacfwd(residual, has_aux=True)(theta)
    return jac.T @ jac, jac.T @ e, 0.5 * e @ e


def costs(run: Replay, base: Axis, thetas: jax.Array, measured: jax.Array) -> jax.Array:
    """Return half the sum of squares [m^2] of each parameter set, (sets,)."""

    def cost(x: jax.Array) -> jax.Array:
        e = measured - simulated(run, base, x)
        return 0.5 * e @ e

    return jax.vmap(cost)(thetas)


class Compiled:
    """A function of a run, a plant and arrays, compiled for calls that cost microseconds.

    `eqx.filter_jit` inspects all of the run at every call, which takes a third of a forward simulation.
    """

    def __init__(self, function: Callable, run: Replay, base: Axis):
        self._arrays, static = eqx.partition((run, base), eqx.is_array)

        def on_arrays(arrays: tuple, *args: jax.Array) -> Any:
            return function(*eqx.combine(arrays, static), *args)

        self._function = jax.jit(on_arrays)

    def __call__(self, *args: jax.Array) -> Any:
        return jax.block_until_ready(self._function(self._arrays, *args))

    def compile(self, *args: jax.Array) -> tuple[float, float, str]:
        """Trace and compile; return the processor time of either [s], and the compiled text."""
        begin = time.process_time()
        lowered = self._function.lower(self._arrays, *args)
        traced = time.process_time()
        compiled = lowered.compile()
        return traced - begin, time.process_time() - traced, compiled.as_text()


def fit(run: Replay, base: Axis, theta: np.ndarray, measured: np.ndarray) -> Minimum:
    """Fit the position by jaxid's output-error method from some start, (4,)."""
    measured = jnp.asarray(measured)[:, None]
    weight, active = jnp.ones(measured.shape), np.ones(len(PLACES), bool)
    minimum = fit_alone(
        run,
        PLACES,
        base,
        measured,
        weight,
        jnp.asarray(theta),
        TRANSFORM,
        BOUNDS,
        "position",
        active,
        None,
    )
    return jax.block_until_ready(minimum)
