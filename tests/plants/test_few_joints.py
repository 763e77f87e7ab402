"""Polynomials of a chain of few joints: forces and their derivatives are those of Pinocchio."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio
import pytest

from jaxid.plants.few_joints import MOST_JOINTS, FewJoints
from jaxid.plants.geometry import JointFrames
from jaxid.plants.rigid_tree import Tree
from jaxid.plants.serial_arm import SerialArm
from tests.plants.test_rigid_tree import GRAVITY, close, moments, pinocchios
from truth.arm import oracle as arm_oracle

STATES = 20


def drawn(revolute, seed=0):
    """Return tree, geometry, parameters of the bodies (n, 10), and random motion (3, states, n)."""
    rng, n = np.random.default_rng(seed), len(revolute)
    axes = np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(n)])
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    joints = ["revolute" if turns else "prismatic" for turns in revolute]
    geometry = JointFrames(joints, axes, rng.uniform(-0.5, 0.5, (n, 3)))
    tree = Tree(tuple(range(-1, n - 1)), tuple(revolute))
    return tree, geometry, arm_oracle.bodies(n, rng), rng.uniform(-2, 2, (3, STATES, n))


@pytest.mark.parametrize("revolute", [(True, True), (True, False, True), (False, True)])
def test_forces_and_their_slopes_are_pinocchios(revolute):
    tree, geometry, parameters, motion = drawn(revolute)
    model, data = pinocchios(tree, geometry, parameters)

    @jax.jit
    def ours(q, qd, qdd):
        few = FewJoints.of(tree, geometry, jnp.asarray(-GRAVITY), moments(parameters))
        return jax.vmap(lambda *x: (few(*x), *jax.jacfwd(few, argnums=(0, 1, 2))(*x)))(q, qd, qdd)

    def theirs(q, qd, qdd):
        pinocchio.computeRNEADerivatives(model, data, q, qd, qdd)
        mass = np.triu(data.M)
        return (
            np.array(data.tau),
            np.array(data.dtau_dq),
            np.array(data.dtau_dv),
            mass + np.triu(mass, 1).T,
        )

    expected = [np.stack(x) for x in zip(*map(theirs, *motion), strict=True)]
    for a, b in zip(ours(*motion), expected, strict=True):
        close(a, b)


def test_a_long_chain_and_links_that_follow_keep_the_recursion():
    def prepared(n, **more):
        _, geometry, parameters, _ = drawn((True,) * n)
        arm = SerialArm(*parameters.T, geometry=geometry, **more)
        # Shapes tell: no operation is compiled.
        return eqx.filter_eval_shape(lambda arm: arm.prepared(), arm)

    assert prepared(MOST_JOINTS).polynomials is not None
    assert prepared(MOST_JOINTS + 1).polynomials is None
    follows = {"copies": ((0, 1.0), (0, 0.5)), "leading": (0,)}
    assert prepared(2, **follows).polynomials is None
