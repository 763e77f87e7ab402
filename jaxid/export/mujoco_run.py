"""Motions of a robot's file by MuJoCo, under the inputs of a replay of jaxid."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.case.mjcf import is_one_of, need_mujoco, robot_of_spec
from jaxid.case.robot import Robot, kept
from jaxid.controllers import Path as Reference
from jaxid.controllers import Tick
from jaxid.errors import InputError
from jaxid.export.soft_friction import Softness
from jaxid.references.unknown import UnknownReference
from jaxid.simulation.replay import Replay

# Factor by which the time step of a file is shortened to see what it costs.
FINER = 10
# Inertia of a joint that is held [kg m^2 or kg]: forces of a robot do not move it.
_HELD = 1e12


@dataclass(frozen=True)
class Setting:
    """Choices of a run that a file leaves to its user.

    Args:
        finer: Factor by which the time step of the file is shortened, at most `FINER`.
        softness: Softness of the dry friction of joints, by name, in place of the file's.
        locked: Names of joints that stand still.
    """

    finer: int = 1
    softness: Mapping[str, Softness] = field(default_factory=dict)
    locked: tuple[str, ...] = ()


@dataclass(frozen=True)
class MujocoRobot:
    """A robot's file, compiled, with the joints of a result.

    Args:
        model: The compiled model, contacts off and held joints made immovable.
        robot: Its kept joints.
        held: Positions of the other joints, by name.
        servo: Whether its position actuators close the loop.
        driven: Whether its actuators take the commands; otherwise forces act on its joints.
        gains: Force at each driven joint per unit of its command.
        drives: Driven joints, 0-based among the free ones.
    """

    model: Any
    robot: Robot
    held: dict[str, float]
    servo: bool
    driven: bool
    gains: Float[np.ndarray, " m"]
    drives: tuple[int, ...]

    @property
    def softness(self) -> dict[str, Softness]:
        """Softness of the dry friction of the free joints that have some, by name."""
        dofs = {joint.name: int(self.model.joint(joint.name).dofadr[0]) for joint in self.robot.free}
        rubs = self.model.dof_frictionloss
        return {name: Softness.of(self.model, dof) for name, dof in dofs.items() if rubs[dof] > 0}

    def motion(self, replay: Replay, setting: Setting = Setting()) -> Float[np.ndarray, "time n"]:
        """Return the positions of the free joints at the samples of a replay's log.

        Args:
            replay: Inputs of a log, by `jaxid.simulation.replay.make_replay`.
            setting: Choices of the run.
        """
        mujoco = need_mujoco(self.robot.file)
        model, period = self.model, replay.drive.period
        step, rotors = float(model.opt.timestep), model.dof_armature.copy()
        solref, solimp = model.dof_solref.copy(), model.dof_solimp.copy()
        count = max(1, round(period / step)) * setting.finer
        try:
            model.opt.timestep = period / count
            for name, softness in setting.softness.items():
                softness.put(model, int(model.joint(name).dofadr[0]))
            for name in setting.locked:
                model.dof_armature[model.joint(name).dofadr] = _HELD
            return _Run(mujoco, self, replay, count).positions()
        finally:
            model.opt.timestep, model.dof_armature[:] = step, rotors
            model.dof_solref[:], model.dof_solimp[:] = solref, solimp


def load(
    content: bytes,
    path: Path,
    names: list[str],
    held: dict[str, float],
    gravity: list[float],
    added: Sequence[str] = (),
) -> tuple[Any, Robot]:
    """Compile a robot's file beside the user's own, so that its parts are found.

    Args:
        content: Its text.
        path: The user's file.
        names: Names of the free joints that a result keeps.
        held: Positions of held joints.
        gravity: Acceleration of gravity in the base's frame [m/s^2].
        added: Names of joints that move beside those of the result.

    Raises:
        InputError: If MuJoCo cannot read it.
    """
    mujoco = need_mujoco(str(path), "a replay")
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".jaxid-", suffix=path.suffix) as file:
            file.write(content)
            file.flush()
            spec = mujoco.MjSpec.from_file(file.name)
            # A delay must fit into its memory at the shortest time step too.
            for actuator in spec.actuators:
                actuator.nsample *= 2 * FINER
            whole, model = robot_of_spec(spec, str(path))
    except OSError as error:
        what = f"cannot be replayed: no file can be written beside it ({error.strerror})"
        raise InputError(what, where=str(path), hint="copy it and its parts to a folder of yours") from error
    except (ValueError, mujoco.FatalError) as error:
        what = f"MuJoCo cannot read it: {' '.join(str(error).split())}"
        raise InputError(what, where=str(path), hint="see what it says of the file as it was") from error
    robot = kept(whole, names, held)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model.opt.gravity[:] = gravity
    moves = [*added, *(joint.name for joint in robot.joints)]
    stays = {model.joint(name).id for name in moves if name in _names(model)}
    for dof in range(model.nv):
        if int(model.dof_jntid[dof]) not in stays:
            model.dof_armature[dof], model.dof_frictionloss[dof] = _HELD, 0.0
    return model, robot


def _names(model: Any) -> list[str]:
    return [model.joint(k).name for k in range(model.njnt)]


class _Run:
    """One run of a model under the inputs of a replay."""

    def __init__(self, mujoco: Any, of: MujocoRobot, replay: Replay, count: int) -> None:
        self.mujoco, self.of, self.replay, self.count = mujoco, of, replay, count
        self.model, self.data = of.model, mujoco.MjData(of.model)
        names, moving = _names(of.model), (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        free = [joint.name for joint in of.robot.free]
        self.at = [int(of.model.jnt_qposadr[names.index(name)]) for name in free]
        self.dofs = [int(of.model.jnt_dofadr[names.index(name)]) for name in free]
        # Joints that follow others: their addresses, leader among the free ones, ratio and offset.
        self.following = [
            (
                int(of.model.jnt_qposadr[names.index(joint.name)]),
                int(of.model.jnt_dofadr[names.index(joint.name)]),
                free.index(joint.follows.joint),
                joint.follows,
            )
            for joint in of.robot.joints
            if joint.follows is not None
        ]
        for k, name in enumerate(names):
            if is_one_of(of.model.jnt_type[k], *moving) and name not in of.robot.names:
                self.data.qpos[of.model.jnt_qposadr[k]] = of.held.get(name, 0.0)
        self.ctrl = self._actuators(free)

    def _actuators(self, free: list[str]) -> list[int]:
        """Return the index of the actuator of each drive, and switch actuators off if none is used."""
        off, model = int(self.mujoco.mjtDisableBit.mjDSBL_ACTUATION), self.model
        if not (self.of.driven or self.of.servo):
            model.opt.disableflags |= off
            return []
        model.opt.disableflags &= ~off
        by_joint = {drive.joint: drive.name for drive in self.of.robot.drives}
        names = [model.actuator(k).name or f"actuator{k + 1}" for k in range(len(model.actuator_trntype))]
        return [names.index(by_joint[free[joint]]) for joint in self.of.drives]

    def place(self, q: np.ndarray, v: np.ndarray) -> None:
        """Start from a state of the free joints."""
        self.data.qpos[self.at], self.data.qvel[self.dofs] = q, v
        for position, dof, leader, follows in self.following:
            self.data.qpos[position] = follows.ratio * q[leader] + follows.offset
            self.data.qvel[dof] = follows.ratio * v[leader]
        self.data.qacc_warmstart[:] = 0.0

    def act(self, command: np.ndarray) -> None:
        """Let a command act until the next one."""
        if self.ctrl:
            self.data.ctrl[self.ctrl] = command
        else:
            for drive, joint in enumerate(self.of.drives):
                self.data.qfrc_applied[self.dofs[joint]] = self.of.gains[drive] * command[drive]

    def positions(self) -> Float[np.ndarray, "time n"]:
        """Return the positions of the free joints at the samples of the log."""
        replay = self.replay
        self.place(np.asarray(replay.position), np.asarray(replay.velocity))
        ticks = self._closed() if replay.controller is not None else self._open()
        out = np.array([q for k, q in enumerate(ticks) if k % replay.every == 0])
        return out

    def _open(self) -> Iterator[np.ndarray]:
        """Run under the logged commands, and from new starts at the replay's segments."""
        replay, count = self.replay, self.count
        commands = np.asarray(replay.command)
        restart = None if replay.restart is None else [np.asarray(x) for x in replay.restart]
        linear = replay.drive.hold != "zero_order"
        self._history(commands[0])
        for k, now in enumerate(commands):
            if restart is not None and restart[0][k]:
                self.place(restart[1][k], restart[2][k])
            yield self.data.qpos[self.at].copy()
            following = commands[min(k + 1, len(commands) - 1)]
            if not linear:
                self.act(now)
                self.mujoco.mj_step(self.model, self.data, count)
                continue
            for i in range(count):
                self.act(now + (following - now) * (i + 0.5) / count)
                self.mujoco.mj_step(self.model, self.data)

    def _closed(self) -> Iterator[np.ndarray]:
        """Run in the loop: by the file's servos, or by jaxid's law at each of its ticks."""
        replay = self.replay
        reference = replay.reference() if isinstance(replay.reference, UnknownReference) else replay.reference
        law, driven = replay.controller, tuple(self.of.drives)
        assert law is not None, "the caller has seen it"
        assert reference is not None, "a loop has its reference"
        disturbance = np.broadcast_to(np.asarray(replay.disturbance), np.shape(reference))
        if self.of.servo:
            # The file's actuators delay their references themselves.
            self._history(np.asarray(reference)[0])
            for now in np.asarray(reference):
                yield self.data.qpos[self.at].copy()
                self.act(now)
                self.mujoco.mj_step(self.model, self.data, self.count)
            return

        @jax.jit
        def tick(q: Array, v: Array, path: Reference, memory: Any, disturbance: Array) -> tuple[Array, Any]:
            own = v if law.own_velocity else None
            return law.command(Tick(replay.sensor.read(q), path, driven, velocity=own), memory, disturbance)

        path = jax.tree.map(np.asarray, law.path(jnp.asarray(reference)))
        first = Tick(jnp.asarray(replay.position), jax.tree.map(lambda x: x[0], path), driven)
        memory = law.start(first, jnp.asarray(replay.velocity), path)
        for k, extra in enumerate(disturbance):
            yield self.data.qpos[self.at].copy()
            state = self.data.qpos[self.at], self.data.qvel[self.dofs]
            u, memory = tick(*state, jax.tree.map(lambda x, k=k: x[k], path), memory, extra)
            self.act(np.asarray(u))
            self.mujoco.mj_step(self.model, self.data, self.count)

    def _history(self, command: np.ndarray) -> None:
        """Fill the memories of delayed actuators as if the first command had long acted."""
        for drive, actuator in enumerate(self.ctrl):
            if self.model.actuator_delay[actuator] > 0:
                samples = int(self.model.actuator_history[actuator, 0])
                values = np.full((samples, 1), float(command[drive]))
                self.mujoco.mj_initCtrlHistory(self.model, self.data, actuator, None, values)
