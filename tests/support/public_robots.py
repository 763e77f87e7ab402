"""Ten public robots: their files, and mass matrix, bias and weight by Pinocchio and by MuJoCo."""

import sysconfig
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

# Where the package example-robot-data keeps its files.
SHARE = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix" / "share" / "example-robot-data" / "robots"

# Robots and their URDFs; legged ones hang from their trunks.
ROBOTS = {
    "panda": "panda_description/urdf/panda.urdf",
    "tiago": "tiago_description/robots/tiago.urdf",
    "go2": "go2_description/urdf/go2.urdf",
    "anymal": "anymal_c_simple_description/urdf/anymal.urdf",
    "so101": "so_arm_description/urdf/so101.urdf",
    "talos arm": "talos_data/robots/talos_left_arm.urdf",
    "pr2": "pr2_description/urdf/pr2.urdf",
    "tiago pro": "tiago_pro_description/robots/tiago_pro.urdf",
}
# Robots of which mujoco-menagerie has an MJCF, and no package a URDF: their names there, and the entries.
MENAGERIE = {"ur10e": ("universal_robots_ur10e", "ur10e"), "iiwa": ("kuka_iiwa_14", "iiwa14")}


def urdf_of(name: str) -> Path:
    """The robot's file; the test is skipped if the package is not installed."""
    path = SHARE / ROBOTS[name]
    if not path.is_file():
        pytest.skip("example-robot-data is not installed: pip install 'jaxid[robots]'")
    return path


def mjcf_of(name: str, folder: Path) -> Path:
    """Write the robot's MJCF without its shapes, whose meshes neither its inertias nor its joints need.

    The test is skipped if the file is not there: the package downloads it, or takes it from MENAGERIE_ROOT.
    """
    menagerie = pytest.importorskip("mujoco_menagerie")
    robot, entry = MENAGERIE[name]
    try:
        tree = ElementTree.parse(menagerie.get(robot).xml(entry))
    except menagerie.MenagerieError as error:
        pytest.skip(f"mujoco-menagerie has no file of {robot} here: {error}")
    for part in [tree.getroot(), *tree.getroot().iter("body")]:
        for absent in (x for tag in ("geom", "asset", "contact", "keyframe") for x in part.findall(tag)):
            part.remove(absent)
    written = folder / f"{entry}.xml"
    tree.write(written)
    return written


@dataclass
class Mimics:
    """Motion of all joints of a file from that of the free ones: ratios @ q + offsets.

    Read from the XML alone, for joints in the order of `names`.
    """

    free: list[str]
    ratios: np.ndarray
    offsets: np.ndarray

    @classmethod
    def of(cls, path: Path, names: list[str]) -> "Mimics":
        follows = {}
        for joint in ElementTree.parse(path).getroot().findall("joint"):
            mimic = joint.find("mimic")
            if mimic is not None and joint.get("name") in names:
                values = (mimic.get("joint"), mimic.get("multiplier", 1.0), mimic.get("offset", 0.0))
                follows[joint.get("name")] = values
        free = [name for name in names if name not in follows]
        ratios, offsets = np.zeros((len(names), len(free))), np.zeros(len(names))
        for k, name in enumerate(names):
            leader, ratio, offset = follows.get(name, (name, 1.0, 0.0))
            ratios[k, free.index(leader)], offsets[k] = float(ratio), float(offset)
        return cls(free, ratios, offsets)


@dataclass
class Dynamics:
    """Mass matrices, bias forces and weights at some states, by free joint, in the order of `names`."""

    names: list[str]
    mass: np.ndarray
    bias: np.ndarray
    weight: np.ndarray


def states(count: int, joints: int) -> np.ndarray:
    """Random positions and velocities, (2, count, joints)."""
    return np.random.default_rng(11).uniform(-2, 2, (2, count, joints))


def by_pinocchio(path: Path, count: int) -> Dynamics:
    """The robot as Pinocchio reads it from a URDF or an MJCF, projected on its free joints."""
    pinocchio = pytest.importorskip("pinocchio")
    read = pinocchio.buildModelFromUrdf if path.suffix == ".urdf" else pinocchio.buildModelFromMJCF
    model = read(str(path))
    data = model.createData()
    mimics = Mimics.of(path, list(model.names)[1:])

    def whole(q: np.ndarray) -> np.ndarray:
        # Joints without end have the cosine and the sine of their angle as coordinates.
        parts = [
            [np.cos(x), np.sin(x)] if joint.nq == 2 else [x]
            for joint, x in zip(list(model.joints)[1:], q, strict=True)
        ]
        return np.concatenate(parts)

    def one(q: np.ndarray, qd: np.ndarray) -> tuple:
        at, v = whole(mimics.ratios @ q + mimics.offsets), mimics.ratios @ qd
        mass = np.triu(pinocchio.crba(model, data, at))
        bias = np.array(pinocchio.nonLinearEffects(model, data, at, v))
        weight = np.array(pinocchio.computeGeneralizedGravity(model, data, at))
        return mass + np.triu(mass, 1).T, bias, weight

    return _projected(mimics, one, count)


def by_mujoco(path: Path, model, count: int) -> Dynamics:
    """The robot as MuJoCo compiled it from its file, projected on its free joints."""
    import mujoco

    data = mujoco.MjData(model)
    mimics = Mimics.of(path, [model.joint(k).name for k in range(model.njnt)])

    def one(q: np.ndarray, qd: np.ndarray) -> tuple:
        data.qpos[:], data.qvel[:] = mimics.ratios @ q + mimics.offsets, 0.0
        mujoco.mj_forward(model, data)
        mass, weight = np.zeros((model.nv, model.nv)), data.qfrc_bias.copy()
        mujoco.mj_fullM(model, data, mass)
        data.qvel[:] = mimics.ratios @ qd
        mujoco.mj_forward(model, data)
        return mass, data.qfrc_bias.copy(), weight

    return _projected(mimics, one, count)


def _projected(mimics: Mimics, one, count: int) -> Dynamics:
    """Values of the free joints: those of all joints, between the ratios."""
    of_all = [np.array(x) for x in zip(*map(one, *states(count, len(mimics.free))), strict=True)]
    g = mimics.ratios
    return Dynamics(mimics.free, g.T @ of_all[0] @ g, of_all[1] @ g, of_all[2] @ g)
