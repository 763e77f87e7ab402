"""Ten public robots against Pinocchio and MuJoCo: by URDF and what MuJoCo makes of it, or by MJCF."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.case.mjcf import robot_of_spec
from jaxid.case.robot import Robot
from jaxid.case.urdf import read_urdf_tree
from jaxid.plants import LinkTree
from tests.support.public_robots import (
    MENAGERIE,
    ROBOTS,
    Dynamics,
    by_mujoco,
    by_pinocchio,
    mjcf_of,
    states,
    urdf_of,
)

COUNT = 1000
GRAVITY = (0.0, 0.0, -9.81)
# Robots of few joints compile quickly.
QUICK = ("panda", "so101")
each_robot = pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in ROBOTS]
)


def by_jaxid(robot: Robot, order: list[str]) -> Dynamics:
    """The robot as jaxid computes it, at the states of joints in this order."""
    plant = LinkTree(
        *robot.bodies.T,
        geometry=robot.geometry,
        parents=robot.parents,
        copies=robot.copies,
        leading=robot.leading,
        gravity_vector=jnp.asarray(GRAVITY),
    )
    # A URDF states no rotors.
    rotors = np.array([joint.armature for joint in robot.free])
    if rotors.any():
        plant = replace(plant, rotor_inertia=rotors)
    free = [joint.name for joint in robot.free]
    assert sorted(free) == sorted(order)
    ours, theirs = [order.index(name) for name in free], [free.index(name) for name in order]
    zero = jnp.zeros(plant.joints)

    @jax.jit
    @jax.vmap
    def all_of(q, qd):
        bias, weight = plant.inertial(q, qd, zero), plant.inertial(q, zero, zero)
        return jax.jacfwd(lambda a: plant.inertial(q, qd, a))(zero), bias, weight

    q, qd = states(COUNT, len(free))
    mass, bias, weight = (np.array(x) for x in all_of(q[:, ours], qd[:, ours]))
    return Dynamics(order, mass[:, theirs][:, :, theirs], bias[:, theirs], weight[:, theirs])


def agree(ours: Dynamics, other: Dynamics) -> None:
    """Mass matrix, bias and weight at each state, relative to the largest entry there."""
    for name in ("mass", "bias", "weight"):
        a, b = getattr(ours, name), getattr(other, name)
        assert a.shape == b.shape
        assert a.shape[0] == COUNT
        axes = tuple(range(1, b.ndim))
        off = np.abs(a - b).max(axis=axes) / np.abs(b).max(axis=axes)
        assert off.max() < 1e-10, (name, off.argmax(), off.max())


@each_robot
def test_dynamics_are_those_that_pinocchio_reads(name):
    path = urdf_of(name)
    theirs = by_pinocchio(path, COUNT)
    agree(by_jaxid(read_urdf_tree(path), theirs.names), theirs)


def possible(path: Path, folder: Path) -> Path:
    """Write the file with a ball in place of each inertia that no body has, which MuJoCo refuses."""
    tree = ElementTree.parse(path)
    for inertial in tree.getroot().iter("inertial"):
        mass, tensor = inertial.find("mass"), inertial.find("inertia")
        if float(mass.get("value")) == 0:
            continue
        xx, xy, xz, yy, yz, zz = (float(tensor.get(f"i{k}")) for k in ("xx", "xy", "xz", "yy", "yz", "zz"))
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if moments[0] <= 1e-12 or moments[0] + moments[1] < moments[2]:
            ball = max(abs(xx + yy + zz) / 3, 1e-6)
            for k in ("xx", "yy", "zz"):
                tensor.set(f"i{k}", repr(ball))
            for k in ("xy", "xz", "yz"):
                tensor.set(f"i{k}", "0")
    written = folder / "robot.urdf"
    tree.write(written)
    return written


@each_robot
def test_dynamics_are_those_of_mujoco_from_either_file(name, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    path = possible(urdf_of(name), tmp_path)
    spec = mujoco.MjSpec.from_file(str(path))
    robot, model = robot_of_spec(spec, str(path))
    theirs = by_mujoco(path, model, COUNT)
    agree(by_jaxid(robot, theirs.names), theirs)
    agree(by_jaxid(read_urdf_tree(path), theirs.names), theirs)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(MENAGERIE))
def test_dynamics_of_an_mjcf_are_those_of_both(name, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    path = mjcf_of(name, tmp_path)
    robot, model = robot_of_spec(mujoco.MjSpec.from_file(str(path)), str(path))
    theirs = by_mujoco(path, model, COUNT)
    ours = by_jaxid(robot, theirs.names)
    assert len(theirs.names) >= 6
    agree(ours, theirs)
    agree(ours, by_pinocchio(path, COUNT))
