"""Inverse dynamics of a tree of links and its derivatives against Pinocchio and against plain autodiff."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio
import pytest

from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.rhs import State, acceleration, hold_polynomial, inverse
from jaxid.effects import EFFECTS
from jaxid.plants.geometry import JointFrames
from jaxid.plants.rigid_tree import Tree, inverse_dynamics, pseudo_inertia
from jaxid.plants.serial_arm import SerialArm
from truth.arm import oracle as arm_oracle

GRAVITY = np.array([1.5, -2.0, -9.2])
STATES = 300
# Parents and kinds of joints: an arm, and a trunk with two arms and a finger, some joints of which slide.
TREES = {
    "arm": Tree((-1, 0, 1, 2, 3), (True, True, False, True, True)),
    "branched": Tree((-1, 0, 1, 0, 3, 3, 5), (True, False, True, True, True, False, True)),
}


def made(name, seed=0):
    """Return tree, geometry, parameters of the bodies (n, 10), and random motion (3, states, n)."""
    rng, tree = np.random.default_rng(seed), TREES[name]
    n = len(tree.parents)
    axes = np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(n)])
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    joints = ["revolute" if turns else "prismatic" for turns in tree.revolute]
    geometry = JointFrames(joints, axes, rng.uniform(-0.5, 0.5, (n, 3)))
    return tree, geometry, arm_oracle.bodies(n, rng), rng.uniform(-2, 2, (3, STATES, n))


def moments(parameters):
    m, x, y, z, xx, xy, xz, yy, yz, zz = jnp.asarray(parameters).T
    rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    tensor = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return pseudo_inertia(m, jnp.stack([x, y, z], axis=-1), tensor)


def pinocchios(tree, geometry, parameters):
    model = pinocchio.Model()
    for k, (parent, turns) in enumerate(zip(tree.parents, tree.revolute, strict=True)):
        kind = pinocchio.JointModelRZ() if turns else pinocchio.JointModelPZ()
        place = pinocchio.SE3(np.asarray(geometry.axes[k]), np.asarray(geometry.origins[k]))
        joint = model.addJoint(parent + 1, kind, place, f"joint{k}")
        # mass, first moments, then xx xy yy xz yz zz about the joint's origin
        body = pinocchio.Inertia.FromDynamicParameters(parameters[k][[0, 1, 2, 3, 4, 5, 7, 6, 8, 9]])
        model.appendBodyToJoint(joint, body, pinocchio.SE3.Identity())
    model.gravity.linear = GRAVITY
    return model, model.createData()


def close(a, b, part=1e-10):
    axes = tuple(range(1, np.ndim(b)))
    off = np.abs(np.asarray(a) - b).max(axis=axes) / np.abs(b).max(axis=axes)
    assert off.max() < part, (off.argmax(), off.max())


@pytest.mark.parametrize("name", TREES)
def test_forces_and_all_their_derivatives_are_pinocchios(name):
    tree, geometry, parameters, motion = made(name)
    model, data = pinocchios(tree, geometry, parameters)

    def force(parameters, *motion):
        return inverse_dynamics(tree, geometry, -GRAVITY, moments(parameters), *motion)

    def theirs(q, qd, qdd):
        pinocchio.computeRNEADerivatives(model, data, q, qd, qdd)
        by_q, by_qd, mass = np.array(data.dtau_dq), np.array(data.dtau_dv), np.triu(data.M)
        regressor = pinocchio.computeJointTorqueRegressor(model, data, q, qd, qdd).reshape(q.size, -1, 10)
        # To the order xx xy xz yy yz zz.
        regressor = regressor[:, :, [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]]
        return np.array(data.tau), by_q, by_qd, mass + np.triu(mass, 1).T, regressor

    @jax.jit
    @jax.vmap
    def ours(q, qd, qdd):
        jacobian = jax.jacfwd(force, argnums=(0, 1, 2, 3))(jnp.asarray(parameters), q, qd, qdd)
        return force(jnp.asarray(parameters), q, qd, qdd), *jacobian[1:], jacobian[0]

    expected = [np.stack(x) for x in zip(*map(theirs, *motion), strict=True)]
    for a, b in zip(ours(*motion), expected, strict=True):
        close(a, b)


def test_derivatives_of_accelerations_are_pinocchios():
    """Of the arm as a plant, through the solve of its mass matrix."""
    tree, geometry, parameters, (q, qd, u) = made("arm")
    model, data = pinocchios(tree, geometry, parameters)
    columns = dict(zip(arm_oracle.NAMES, jnp.asarray(parameters).T, strict=True))
    plant = SerialArm(**columns, geometry=geometry, gravity_vector=GRAVITY)

    def accelerate(q, qd, u):
        return acceleration(plant, State(q, qd, ()), u, jnp.zeros(()), jnp.zeros(q.size))

    ours = jax.jit(jax.vmap(jax.jacfwd(accelerate, argnums=(0, 1, 2))))(q, qd, u)
    reverse = jax.jit(jax.vmap(jax.jacrev(accelerate, argnums=(0, 1, 2))))(q, qd, u)

    def theirs(q, qd, u):
        pinocchio.computeABADerivatives(model, data, q, qd, u)
        inverse = np.triu(data.Minv)
        return np.array(data.ddq_dq), np.array(data.ddq_dv), inverse + np.triu(inverse, 1).T

    expected = [np.stack(x) for x in zip(*map(theirs, q, qd, u), strict=True)]
    for a, b, c in zip(ours, reverse, expected, strict=True):
        close(a, c, 1e-9)
        close(b, c, 1e-9)


@pytest.mark.parametrize("name", ["arm", pytest.param("branched", marks=pytest.mark.slow)])
def test_derivatives_of_any_order_are_those_of_the_recursion(name):
    """First and second derivatives by every argument, forward and reverse, geometry and gravity included."""
    tree, geometry, parameters, motion = made(name)
    args = (geometry.axes, geometry.origins, -GRAVITY, parameters, *motion[:, 0])
    weight = np.arange(1.0, len(tree.parents) + 1)

    def weighted(function, axes, origins, rise, parameters, *motion):
        frames = JointFrames(geometry.joints, axes, origins)
        return weight @ function(tree, frames, rise, moments(parameters), *motion)

    ours, plain = (lambda *a, f=f: weighted(f, *a) for f in (inverse_dynamics, inverse_dynamics.fun))
    places = tuple(range(len(args)))
    for derive in (
        lambda f: jax.jacfwd(f, places),
        lambda f: jax.grad(f, places),
        lambda f: jax.jacfwd(jax.grad(f, places), (3, 4, 5, 6)),
        lambda f: jax.jacrev(jax.jacfwd(f, (3, 4, 5)), (4, 5, 6)),
    ):
        a, b = (jax.tree.leaves(jax.jit(derive(f))(*args)) for f in (ours, plain))
        for x, y in zip(a, b, strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-10 * max(np.abs(y).max(), 1.0))


def test_directions_of_a_derivative_share_the_recursion():
    tree, geometry, parameters, motion = made("arm")
    force = lambda q: inverse_dynamics(tree, geometry, -GRAVITY, moments(parameters), q, *motion[1:, 0])
    sines = [e for e in jax.make_jaxpr(jax.jacfwd(force))(motion[0, 0]).eqns if e.primitive.name == "sin"]
    assert [e.outvars[0].aval.shape for e in sines] == [(len(tree.parents), 1)]


@pytest.mark.parametrize("size", [1, 2, 7])
def test_inverse_and_its_derivative(size):
    rng = np.random.default_rng(size)
    a, d = rng.normal(size=(2, size, size))
    a = a @ a.T + np.eye(size)
    out, slope = jax.jvp(inverse, (a,), (d,))
    np.testing.assert_allclose(out @ a, np.eye(size), atol=1e-12)
    np.testing.assert_allclose(slope, -np.linalg.inv(a) @ d @ np.linalg.inv(a), atol=1e-12)


@pytest.mark.slow
def test_a_batch_of_steps_is_each_step_alone():
    """Sliding, at rest and near a reversal: a lane does not depend on whether others leave the usual case."""
    tree, geometry, parameters, (q, qd, u) = made("arm")
    columns = dict(zip(arm_oracle.NAMES, jnp.asarray(parameters).T, strict=True))
    friction = tuple(EFFECTS["coulomb_friction"](level=0.4 + 0.1 * k, port=k) for k in range(5))
    plant = SerialArm(**columns, geometry=geometry, gravity_vector=GRAVITY, effects=friction)
    qd = qd * np.array([1.0, 1e-2, 0.0, 1e-3, 1.0])[np.arange(STATES) % 5][:, None]

    def step(q, qd, u):
        x = State(q, qd, (None,) * 5)
        new, reaction = set_valued_step(plant, x, hold_polynomial((u,)), jnp.zeros(()), jnp.asarray(1e-3))
        return new.q, new.qd, reaction

    count = 20
    batch = jax.jit(jax.vmap(step))
    together = [np.asarray(x) for x in batch(q[:count], qd[:count], u[:count])]
    for k in range(count):
        beside = np.where(np.arange(count) == k, k, 0)  # a sliding step in all other lanes
        for a, b in zip(together, batch(q[beside], qd[beside], u[beside]), strict=True):
            np.testing.assert_array_equal(a[k], b[k])

    alone = [np.stack(x) for x in zip(*map(jax.jit(step), q[:count], qd[:count], u[:count]), strict=True)]
    first = batch(q[:1], qd[:1], u[:1])
    mass = jax.vmap(lambda q: jax.jacfwd(lambda a: plant.inertial(q, 0 * q, a))(0 * q))(q[:count])
    # The compiler orders sums of a batch otherwise: a few last digits of the largest entry, which solving for
    # the forces that hold a joint enlarges by the condition of the mass matrix.
    enlarged = 1.0, 1.0, np.max(np.linalg.cond(np.asarray(mass)))
    for one, several, b, factor in zip(first, together, alone, enlarged, strict=True):
        atol = 1e-14 * np.max(np.abs(b)) * factor
        np.testing.assert_allclose(one, b[:1], rtol=0, atol=atol)
        np.testing.assert_allclose(several, b, rtol=0, atol=atol)
    stuck = (alone[1] == 0).any(axis=1)
    assert 0 < stuck.sum() < count
