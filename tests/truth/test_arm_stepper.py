"""Seven joints that stick and slide in a loop: a stepper of other physics, and the replay beside it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.controllers.linear import PD
from jaxid.dynamics.rhs import State, acceleration
from jaxid.effects import EFFECTS
from jaxid.plants import SerialArm, pa10
from jaxid.simulation.loops import Drive, closed_loop
from truth.arm.oracle import NAMES, bodies
from truth.arm.stepper import Arm, followed

RATE = 200.0
KP = np.array([3000.0, 3000.0, 800.0, 800.0, 150.0, 80.0, 30.0])
KD = np.array([150.0, 150.0, 40.0, 40.0, 4.0, 2.5, 1.0])
AXES, ORIGINS = (np.asarray(x) for x in pa10().frames(np.zeros(7)))
ARM = Arm(
    AXES,
    ORIGINS,
    bodies(7, np.random.default_rng(0)) * np.linspace(1.0, 0.2, 7)[:, None],
    np.array([4.0, 5.6, 1.7, 2.7, 1.6, 0.8, 0.25]),
    np.array([9.6, 16.0, 3.7, 5.9, 3.7, 2.0, 1.0]),
)


def unknown_reference() -> np.ndarray:
    """Two seconds of sines from rest, each joint turning at a time of its own."""
    t = np.arange(0, 2.0, 1 / RATE)[:, None]
    hz = np.linspace(0.5, 1.1, 7)
    return 0.4 * (1 - np.cos(2 * np.pi * hz * t)) + 0.2 * np.arange(7)


@pytest.fixture(scope="module")
def truth():
    return followed(ARM, unknown_reference(), rate=RATE, kp=KP, kd=KD, step=2e-4)


def plant() -> SerialArm:
    viscous, coulomb = EFFECTS["viscous_friction"], EFFECTS["coulomb_friction"]
    effects = [viscous(c, port=k) for k, c in enumerate(ARM.viscous)]
    effects += [coulomb(c, port=k) for k, c in enumerate(ARM.coulomb)]
    parts = dict(zip(NAMES, ARM.bodies.T, strict=True))
    return SerialArm(**parts, geometry=pa10(), effects=tuple(effects))


def replayed(arm: SerialArm, substeps: int = 1) -> np.ndarray:
    """Positions of the same loop by the package's step."""
    drive = Drive(jnp.ones(7), 1 / RATE, substeps=substeps, set_valued=True)
    law = PD(KP, KD, period=1 / RATE)
    reference = jnp.asarray(unknown_reference())
    start = (reference[0], jnp.zeros(7))
    return closed_loop(arm, drive, law, reference, jnp.zeros_like(reference), *start).position


def test_the_stepper_settles_as_its_steps_shrink(truth):
    coarse, middle = (
        followed(ARM, unknown_reference(), rate=RATE, kp=KP, kd=KD, step=h)["q"] for h in (1e-3, 5e-4)
    )
    off = [np.abs(q - truth["q"]).max() for q in (coarse, middle)]
    assert off[1] < 0.5 * off[0]
    assert off[1] < 5e-6
    # joints do stand, one at a time, while others move
    still = np.abs(truth["qd"]) < 1e-12
    assert np.all(still.sum(axis=0) > 3)


def test_joints_that_stand_pull_at_the_others_as_they_should(truth):
    """At one step of 5 ms a sample; a standing joint's force without its damping was off by 3e-4 rad."""
    run = eqx.filter_jit(replayed)
    off = [np.sqrt(np.mean((run(plant(), n) - truth["q"]) ** 2, axis=0)).max() for n in (1, 2)]
    assert off[0] < 1e-5
    assert off[1] < 0.5 * off[0]


def test_accelerations_have_first_and_second_derivatives():
    """They are those of a root, not of the elimination that finds it."""
    arm, u = plant(), jnp.linspace(-5.0, 5.0, 7)
    motion = jnp.linspace(-1.0, 1.0, 7), jnp.linspace(1.0, -2.0, 7)
    x = jnp.concatenate([*motion, jnp.asarray(ARM.bodies[:, 9])])

    def at(x):
        now = State(x[:7], x[7:14], arm.initial_states(u))
        moved = dataclasses.replace(arm, inertia_zz=x[14:])
        return acceleration(moved, now, u, jnp.zeros(()), jnp.ones(7))

    way, h = jnp.asarray(np.random.default_rng(1).standard_normal(x.size)) * x, 1e-5
    along = lambda f: lambda x: jax.jvp(f, (x,), (way,))[1]
    for f in (at, along(at)):
        exact, f = jax.jit(along(f))(x), jax.jit(f)
        by_steps = (f(x + h * way) - f(x - h * way)) / (2 * h)
        np.testing.assert_allclose(exact, by_steps, rtol=1e-6, atol=1e-6 * np.abs(by_steps).max())


@pytest.mark.slow
def test_a_run_that_sticks_has_the_slope_of_its_differences():
    """In a link's moment and a level, through steps in which some joints stand."""
    arm = plant()

    def run(theta):
        moved = eqx.tree_at(lambda p: p.effects[11].level, arm, theta[1])
        moments = jnp.asarray(arm.inertia_zz).at[6].set(theta[0])
        return replayed(dataclasses.replace(moved, inertia_zz=moments))

    theta, h = jnp.asarray([ARM.bodies[6, 9], ARM.coulomb[4]]), 1e-6
    slope = eqx.filter_jit(jax.jacfwd(run))(theta)
    run = eqx.filter_jit(run)
    for k in range(2):
        step = h * jnp.eye(2)[k]
        differences = (run(theta + step) - run(theta - step)) / (2 * h)
        size = np.sqrt(np.mean(np.square(differences)))
        assert np.sqrt(np.mean((slope[..., k] - differences) ** 2)) < 1e-3 * size
