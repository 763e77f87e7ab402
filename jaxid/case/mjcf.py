"""Robots from MJCF files, as MuJoCo itself reads them: defaults, includes and inertias of shapes resolved."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.case.robot import Follows, Robot, RobotDrive, RobotJoint, body_in, moved_by, spring, towards
from jaxid.errors import InputError

# Parts of a model that a tree does not hold: count in MuJoCo's model, singular, plural.
_ABSENT = (
    ("ntendon", "tendon", "tendons"),
    ("nflex", "flex", "flexes"),
    ("nplugin", "plugin", "plugins"),
)


def read_mjcf(path: str | Path) -> Robot:
    """Read a robot from an MJCF file by MuJoCo's parser.

    Shapes are needed only for bodies without <inertial>, and meshes only for these: missing ones of other
    bodies are no fault.

    Args:
        path: The file.

    Raises:
        InputError: If MuJoCo is not installed, or cannot read the file.
    """
    mujoco, path = need_mujoco(str(path)), Path(path)
    if not path.is_file():
        beside = ", ".join(sorted(p.name for p in path.parent.glob("*.xml"))[:8]) or "none"
        hint = f"check the path, which starts at the case; XML files in that folder: {beside}"
        raise InputError("no such file", where=str(path), hint=hint)
    try:
        return robot_of_spec(mujoco.MjSpec.from_file(str(path)), str(path))[0]
    except (ValueError, mujoco.FatalError) as error:
        text = " ".join(str(error).split())
        hint = "correct it until MuJoCo loads it: python -m mujoco.viewer --mjcf=FILE"
        raise InputError(f"MuJoCo cannot read it: {text}", where=str(path), hint=hint) from error


def robot_of_spec(spec: Any, file: str = "model") -> tuple[Robot, Any]:
    """Compile a specification of MuJoCo, and return its robot and the model.

    Args:
        spec: An MjSpec; shapes without which its bodies keep their inertia are deleted from it.
        file: Name of its file, for messages.
    """
    mujoco = need_mujoco(file)
    touching = any(geom.contype and geom.conaffinity for geom in spec.geoms)
    _without_shapes(mujoco, spec)
    model = spec.compile()
    robot = robot_of_model(model, file)
    if touching:
        robot = replace(robot, notes=(*robot.notes, "contacts between shapes are not simulated"))
    return robot, model


def need_mujoco(file: str, purpose: str = "reading an MJCF file") -> Any:
    """Import MuJoCo.

    Args:
        file: The file, for messages.
        purpose: Feature that needs it, for messages.

    Raises:
        InputError: If it is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        hint = "pip install 'jaxid[mujoco]'"
        if purpose.startswith("reading"):
            hint += ", or name the robot's URDF by urdf"
        raise InputError(f"{purpose} needs MuJoCo", where=file, hint=hint) from error
    return mujoco


def _without_shapes(mujoco: Any, spec: Any) -> None:
    """Delete all that a body with <inertial> does not need for its inertia, so that meshes may be absent."""
    compiler = spec.compiler
    every = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if every or compiler.settotalmass > 0:
        return
    for part in ("keys", "sensors", "pairs", "excludes", "skins", "lights", "cameras"):
        for element in list(getattr(spec, part)):
            spec.delete(element)
    for body in spec.bodies:
        if body.explicitinertial or body.name == "world":
            for geom in list(body.geoms):
                spec.delete(geom)
    used = set()
    for geom in spec.geoms:
        geom.material = ""
        used |= {geom.meshname, geom.hfieldname}
    for material in list(spec.materials):
        spec.delete(material)
    for texture in list(spec.textures):
        spec.delete(texture)
    for mesh in [m for m in spec.meshes if m.name not in used and Path(m.file).stem not in used]:
        spec.delete(mesh)


def robot_of_model(model: Any, file: str = "model") -> Robot:
    """Return the robot of a compiled model of MuJoCo.

    Args:
        model: An MjModel.
        file: Name of its file, for messages.
    """
    mujoco, notes = need_mujoco(file), list[str]()
    names = [model.joint(k).name or f"joint{k + 1}" for k in range(model.njnt)]
    joints, places = _joints(mujoco, model, names, notes)
    follows, held = _equalities(mujoco, model, names, notes)
    joints = [replace(joint, follows=follows.get(joint.name)) for joint in joints]
    joints = _with_motors(mujoco, model, joints, names, notes)
    drives = tuple(_drives(mujoco, model, names, notes))
    notes += _absent(mujoco, model)
    notes += [f"joint '{name}' is fixed by an equality: state its position in held" for name in held]
    weight = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    x, y, z = (float(g) for g in model.opt.gravity) if weight else (0.0, 0.0, 0.0)
    period = float(model.opt.timestep)
    return Robot(file, tuple(joints), (x, y, z), drives, period, tuple(notes), places)


def _joints(
    mujoco: Any, model: Any, names: list[str], notes: list[str]
) -> tuple[list[RobotJoint], dict[str, tuple[int, np.ndarray]]]:
    """Return hinges and slides with the bodies behind them, and the places of bodies.

    Free and ball joints are held.
    """
    kinds = mujoco.mjtJoint
    motions = {kinds.mjJNT_HINGE: "revolute", kinds.mjJNT_SLIDE: "prismatic"}
    out: list[RobotJoint] = []
    # Joint that carries each body, and the body's frame in that of the joint.
    carriers: list[tuple[int, np.ndarray]] = []
    for b in range(model.nbody):
        carrier, frame = carriers[model.body_parentid[b]] if b else (-1, np.eye(4))
        first, count = int(model.body_jntadr[b]), int(model.body_jntnum[b])
        free = count > 0 and is_one_of(model.jnt_type[first], kinds.mjJNT_FREE)
        # The pose of a body on a free joint is that of its start, as that of any other body.
        frame = frame @ _place(mujoco, model.body_pos[b], model.body_quat[b])
        if free:
            notes.append(f"free joint '{names[first]}' is held: the base is fixed")
        for k in range(first, first + (0 if free else count)):
            if is_one_of(model.jnt_type[k], kinds.mjJNT_BALL):
                notes.append(f"ball joint '{names[k]}' is held")
                continue
            anchor, turn = np.eye(4), np.eye(4)
            anchor[:3, 3], turn[:3, :3] = model.jnt_pos[k], towards(np.array(model.jnt_axis[k]))
            motion, at = motions[kinds(model.jnt_type[k])], int(model.jnt_qposadr[k])
            # The pose of the file is that at the reference coordinate.
            place = frame @ anchor @ turn @ moved_by(motion, -float(model.qpos0[at]))
            out.append(_joint(model, k, names[k], motion, carrier, place, notes))
            anchor[:3, 3] = -model.jnt_pos[k]
            carrier, frame = len(out) - 1, turn.T @ anchor
        carriers.append((carrier, frame))

        if carrier >= 0 and model.body_mass[b] > 0:
            inertial = frame @ _place(mujoco, model.body_ipos[b], model.body_iquat[b])
            xx, yy, zz = model.body_inertia[b]
            ten = np.array([model.body_mass[b], 0.0, 0.0, 0.0, xx, 0.0, 0.0, yy, 0.0, zz])
            out[carrier] = replace(out[carrier], body=out[carrier].body + body_in(ten, inertial))
    return out, {model.body(b).name: place for b, place in enumerate(carriers)}


def _joint(
    model: Any, k: int, name: str, motion: str, parent: int, place: np.ndarray, notes: list[str]
) -> RobotJoint:
    """Return one hinge or slide; its body is still empty."""
    dof, at = int(model.jnt_dofadr[k]), int(model.jnt_qposadr[k])
    if model.jnt_springyield[k] > 0:
        notes.append(f"joint '{name}' yields: its spring is taken for elastic")
    limits = (float(model.jnt_range[k, 0]), float(model.jnt_range[k, 1])) if model.jnt_limited[k] else None
    d, d2, d3 = model.dof_damping[dof], *model.dof_dampingpoly[dof]
    s, s2, s3 = model.jnt_stiffness[k], *model.jnt_stiffnesspoly[k]
    return RobotJoint(
        name,
        motion,
        parent,
        place,
        np.zeros(10),
        armature=float(model.dof_armature[dof]),
        damping=(float(d), float(d2), float(d3)),
        friction=float(model.dof_frictionloss[dof]),
        spring=spring((float(s), float(s2), float(s3)), float(model.qpos_spring[at])),
        range=limits,
    )


def _with_motors(
    mujoco: Any, model: Any, joints: list[RobotJoint], names: list[str], notes: list[str]
) -> list[RobotJoint]:
    """Return the joints with the armature and damping of actuators, which count by the gear's square."""
    out = {joint.name: joint for joint in joints}
    for k in range(len(model.actuator_trntype)):
        name = names[int(model.actuator_trnid[k, 0])]
        if not is_one_of(model.actuator_trntype[k], mujoco.mjtTrn.mjTRN_JOINT) or name not in out:
            continue
        gear, joint = float(model.actuator_gear[k, 0]), out[name]
        if np.any(model.actuator_dampingpoly[k]):
            notes.append(f"damping of actuator {k + 1} is taken for linear")
        out[name] = replace(
            joint,
            armature=joint.armature + gear**2 * float(model.actuator_armature[k]),
            damping=(joint.damping[0] + gear**2 * float(model.actuator_damping[k]), *joint.damping[1:]),
        )
    return list(out.values())


def _equalities(
    mujoco: Any, model: Any, names: list[str], notes: list[str]
) -> tuple[dict[str, Follows], list[str]]:
    """Return joints that follow others by an equality, and those that one fixes; list the other ones."""
    follows: dict[str, Follows] = {}
    held: list[str] = []
    moving = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    for k in range(model.neq):
        kind = mujoco.mjtEq(model.eq_type[k]).name.removeprefix("mjEQ_").lower()
        title = f"equality '{model.equality(k).name or kind}' ({kind})"
        if not model.eq_active0[k]:
            continue
        one, other = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        usable = (
            kind == "joint" and not np.any(model.eq_data[k, 2:5]) and is_one_of(model.jnt_type[one], *moving)
        )
        if not usable or names[one] in follows:
            notes.append(f"{title} is not kept")
            continue
        if other < 0:
            held.append(names[one])
            continue
        start = float(model.qpos0[model.jnt_qposadr[one]]), float(model.qpos0[model.jnt_qposadr[other]])
        ratio = float(model.eq_data[k, 1])
        follows[names[one]] = Follows(
            names[other], ratio, start[0] + float(model.eq_data[k, 0]) - ratio * start[1]
        )
        notes.append(f"{title} is taken for rigid")
    return _free_leaders(follows, notes), held


def _free_leaders(follows: dict[str, Follows], notes: list[str]) -> dict[str, Follows]:
    """Return the same with leaders that are free: chains of equalities are joined."""
    out = {}
    for name, one in follows.items():
        seen = [name]
        while one.joint in follows and one.joint not in seen:
            seen.append(one.joint)
            more = follows[one.joint]
            one = Follows(more.joint, one.ratio * more.ratio, one.ratio * more.offset + one.offset)
        if one.joint in follows:
            notes.append(f"the equality of joint '{name}' closes a ring, and is not kept")
        else:
            out[name] = one
    return out


def _drives(mujoco: Any, model: Any, names: list[str], notes: list[str]) -> Iterator[RobotDrive]:
    """Return the actuators on joints that are one gain on a command, or a position servo."""
    seen: set[str] = set()
    for k in range(len(model.actuator_trntype)):
        drive, lost = _drive(mujoco, model, k, names)
        notes += lost
        if drive is None:
            continue
        if drive.joint in seen:
            notes.append(f"actuator '{drive.name}' is a second one of joint '{drive.joint}', and is not kept")
            continue
        seen.add(drive.joint)
        yield drive


def _drive(mujoco: Any, model: Any, k: int, names: list[str]) -> tuple[RobotDrive | None, list[str]]:
    """Return one actuator, None if a tree cannot have it; and sentences on what it lacks."""
    title = f"actuator '{model.actuator(k).name or k + 1}'"
    gear, *others = (float(g) for g in model.actuator_gear[k])
    if not is_one_of(model.actuator_trntype[k], mujoco.mjtTrn.mjTRN_JOINT) or any(others):
        return None, [f"{title} does not act on one joint, and is not kept"]
    j = int(model.actuator_trnid[k, 0])
    if not is_one_of(model.jnt_type[j], mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        return None, [f"{title} drives no hinge or slide, and is not kept"]

    lost: list[str] = []
    law = _law(mujoco, model, k, gear, title, lost)
    if law is None:
        return None, lost
    gain, kp, kd, drag = law
    kinds, dyntype, lag = mujoco.mjtDyn, model.actuator_dyntype[k], 0.0
    if is_one_of(dyntype, kinds.mjDYN_FILTER, kinds.mjDYN_FILTEREXACT):
        lag = float(model.actuator_dynprm[k, 0])
        if kp is not None and lag > 0:
            lost.append(f"{title} filters its reference by {lag:g} s: it is not kept")
            lag = 0.0
    elif not is_one_of(dyntype, kinds.mjDYN_NONE, kinds.mjDYN_DCMOTOR):
        return None, [f"{title} has an activation, and is not kept"]
    limits = []
    for limited, size, what, (low, high) in (
        (model.actuator_forcelimited[k], abs(gear), "forcerange", model.actuator_forcerange[k]),
        (model.jnt_actfrclimited[j], 1.0, "actuatorfrcrange", model.jnt_actfrcrange[j]),
    ):
        if limited and math.isclose(-low, high):
            limits.append(size * float(high))
        elif limited:
            lost.append(f"{what} at {title} differs by direction: it is not kept")
    return RobotDrive(
        name=model.actuator(k).name or f"actuator{k + 1}",
        joint=names[j],
        gain=gain,
        kp=kp,
        kd=kd,
        limit=min(limits, default=None),
        drag=drag,
        lag=lag,
        delay=float(model.actuator_delay[k]),
    ), lost


def _law(
    mujoco: Any, model: Any, k: int, gear: float, title: str, lost: list[str]
) -> tuple[float, float | None, float | None, float] | None:
    """Return gain, kp, kd and drag of an actuator; None if it is none that a tree can have."""
    gains, biases = mujoco.mjtGain, mujoco.mjtBias
    gainprm, biasprm = np.asarray(model.actuator_gainprm[k]), np.asarray(model.actuator_biasprm[k])
    if is_one_of(model.actuator_gaintype[k], gains.mjGAIN_DCMOTOR):
        resistance, constant = float(gainprm[0]), float(gainprm[1])
        voltage = int(model.actuator_ctrlspec[k]) == int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)
        if np.any(gainprm[2:]) or np.any(model.actuator_dynprm[k]) or np.any(biasprm) or not voltage:
            lost.append(f"{title} is more than a winding without inductance, driven by a voltage: not kept")
            return None
        return gear * constant / resistance, None, None, gear**2 * constant**2 / resistance

    biastype = model.actuator_biastype[k]
    if not is_one_of(model.actuator_gaintype[k], gains.mjGAIN_FIXED) or not is_one_of(
        biastype, biases.mjBIAS_NONE, biases.mjBIAS_AFFINE
    ):
        lost.append(f"{title} is none of motor, position, velocity and dcmotor, and is not kept")
        return None
    own = float(gainprm[0])
    offset, slope, rate = (float(b) for b in biasprm[:3])
    if is_one_of(biastype, biases.mjBIAS_NONE):
        offset, slope, rate = 0.0, 0.0, 0.0
    if offset:
        lost.append(f"{title} has a constant force of {offset:g}: it is not kept")

    if slope == 0.0:
        # A velocity servo is a gain on the wanted velocity, and drag.
        return gear * own, None, None, -(gear**2) * rate
    if own == -slope and gear == 1.0:
        return 1.0, own, -rate, 0.0
    lost.append(f"{title} is a servo with a gear, or of unequal gains, and is not kept")
    return None


def _absent(mujoco: Any, model: Any) -> list[str]:
    """Return a sentence on each further part of the model that acts on its joints and is not kept."""
    out = []
    for field, one, many in _ABSENT:
        count = int(getattr(model, field, 0))
        if count:
            out.append(f"{count} {one if count == 1 else many} {'is' if count == 1 else 'are'} not kept")
    if np.any(model.body_gravcomp):
        out.append("compensation of gravity (gravcomp) is not kept")
    if model.opt.density or model.opt.viscosity:
        out.append("drag by a fluid (density, viscosity) is not kept")
    return out


def is_one_of(value: Any, *kinds: Any) -> bool:
    """Check that a number of the model is one of some members of an enumeration of MuJoCo."""
    return int(value) in [int(kind) for kind in kinds]


def _place(mujoco: Any, pos: np.ndarray, quat: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Return the homogeneous transform of a position and a quaternion."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(quat, dtype=np.float64))
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn.reshape(3, 3), pos
    return out
