"""The controller of a case one tick at a time, for a real machine or another simulator.

With `identify` the unknowns are identified algebraically in the first instants. The controller uses them
from then on.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.build import build_machine
from jaxid.case.case import CaseLike, load_case
from jaxid.controllers import Controller, Tick, base, laws_with_model
from jaxid.errors import InputError
from jaxid.estimators.algebraic.online import Online, OnlineEstimate, OnlineMemory
from jaxid.estimators.recursive.recursion import RecursiveEstimate
from jaxid.logs.in_memory import LogLike, as_log
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.scene import Scene

# A joint counts as at rest below this fraction of its reference's largest speed, and below this number
# of standard deviations of a difference of two readings.
_REST = 5e-3
_NOISE = 5.0
# Quantities that may be measured beside positions.
_OTHERS = ("velocity", "acceleration", "measured")


class Live:
    """The loop of a case without its plant: readings in, commands out.

    Args:
        case: The case, its file, or a dict with its tables; it needs [controller], [reference] and
            [simulation].
        identify: Whether to identify the unknowns on-line and, once all of them are trusted, to put them into
            the model of a controller that has one.
        tolerance: Relative tolerance of that trust, see `jaxid.estimators.algebraic.online.OnlineEstimate`.

    Attributes:
        online_estimate: Estimate from the rows so far; None without `identify`, and before the second tick.
        adapts: Whether the controller identifies by itself.
        switched: First tick at which the controller uses the identified values; None: not yet.

    Raises:
        InputError: If the case has no controller or reference, or has unknowns that cannot be identified
            on-line.
    """

    def __init__(self, case: CaseLike, *, identify: bool = False, tolerance: float = 0.05):
        case = load_case(case)
        scene = Scene.of(case)
        law = scene.machine.law
        if law is None:
            raise InputError("there is no loop", where=case.where, hint="add a [controller]")

        self.machine = build_machine(case, period=scene.drive.period)
        self.reference: Float[np.ndarray, "ticks m"] = scene.signal
        self.period: float = scene.drive.period
        self.online_estimate: OnlineEstimate | None = None
        self.switched: int | None = None

        self._controller = law
        path = self._controller.path(jnp.asarray(self.reference))
        self._path = jax.tree.map(np.asarray, path)
        self._driven = self.machine.plant.driven(case.plant.joints)
        self._tick = 0
        self._law = _Law(self._controller, scene.signal.shape[1], path, self._driven)
        self._memory: np.ndarray | None = None
        sensor = self.machine.sensor
        self._holds = sensor.hold, 1 if sensor.inertial is None else sensor.inertial.hold
        self.adapts = "estimator" in self._controller.of_machine
        self._last: np.ndarray | None = None
        self._as_given = np.full(self.machine.gain.size, np.nan)
        self._online, self._rows = None, None

        if identify:
            if "model" not in self._controller.of_machine or self.adapts:
                kind = "" if case.controller is None else case.controller.kind
                what = "identifies by itself" if self.adapts else "has no model for identified values"
                laws = laws_with_model(self.machine.plant, case.plant.drives, case.plant.joints)
                raise InputError(
                    f"a controller of kind {kind!r} {what}",
                    where=case.where,
                    hint=f"take kind = '{laws[0]}'" if laws and not self.adapts else "leave identify out",
                )
            self._online = _online(self.machine, self.reference, self._driven, self.period, tolerance)

    def command(
        self,
        position: Float[np.ndarray, " n"],
        velocity: Float[np.ndarray, " n"] | None = None,
        acceleration: Float[np.ndarray, " n"] | None = None,
        measured: Float[np.ndarray, " m"] | None = None,
    ) -> Float[np.ndarray, " m"]:
        """Return the command to hold until the next tick.

        Args:
            position: Readings of all joints [m or rad].
            velocity, acceleration: Readings of a gyroscope and an accelerometer; None: differenced positions.
                Give the same ones at every tick, and hold them at ticks between two readings, whose rate
                [[inertial_sensors]] states.
            measured: Command that the drives report since the last tick; None: the command as it was given.

        Raises:
            InputError: If the reference has ended, or there is not one reading a joint, or command a drive.
        """
        if self._tick >= len(self.reference):
            raise InputError(
                f"the reference ends after {len(self.reference)} ticks",
                hint="let [simulation] duration be longer",
            )

        position = np.asarray(position, dtype=np.float64)
        joints = self.machine.plant.joints
        if position.shape != (joints,):
            what = f"position has shape {position.shape}"
            raise InputError(what, where="Live.command", hint=f"give one reading of each of {joints} joints")
        if measured is None and self.adapts:
            measured = self._as_given
        others = [None if x is None else np.asarray(x, float) for x in (velocity, acceleration, measured)]
        # All go into one vector, in which an entry of another length would shift the next.
        for name, x, like in zip(_OTHERS, others, (position, position, self._as_given), strict=True):
            if x is not None and x.shape != like.shape:
                what = f"{name} has shape {x.shape}"
                raise InputError(what, where="Live.command", hint=f"give {like.size} numbers")

        fresh = tuple(self._tick % hold == 0 for hold in self._holds)
        if self._tick == 0:
            path = jax.tree.map(lambda x: x[0], self._path)
            tick = Tick(
                joints=position,
                path=path,
                driven=self._driven,
                fresh=np.asarray(fresh[0]),
                velocity=others[0],
                acceleration=others[1],
                measured=others[2],
                renewed=np.asarray(fresh[1]),
            )
            start, saved = self._controller.start(tick, np.zeros_like(position), self._path), self.memory
            # A difference of readings of an earlier run and of this one would have no meaning.
            self.memory = start if saved is None else self._controller.resumed(start, saved)

        if self._online is not None and self.switched is None:
            self._identify(position)
        assert self._memory is not None, "the first tick has set it"
        u, self._memory, closed = self._law(self._tick, position, fresh, others, self._memory)
        if self.adapts and self.switched is None and closed:
            self.switched = self._tick
        self._tick, self._last = self._tick + 1, u
        return self._last

    @property
    def memory(self) -> object:
        """The controller's state, a tree of arrays.

        If a saved state is assigned before the first tick, the identified values in it are kept.
        """
        return None if self._memory is None else self._law.memory.unpacked(self._memory)

    @memory.setter
    def memory(self, memory: object) -> None:
        self._memory = self._law.remembers(memory)

    @property
    def told(self) -> OnlineEstimate | None:
        """Alias of `online_estimate`, with the name of version 0.1."""
        return self.online_estimate

    @property
    def estimate(self) -> RecursiveEstimate:
        """The estimate of a controller that identifies, in the order of `machine.parameters`.

        Raises:
            InputError: If it does not identify, or nothing has been read yet.
        """
        if not self.adapts or self.memory is None:
            what = "no reading yet" if self.adapts else "the controller does not identify"
            raise InputError(what, where="Live", hint="take kind = 'adaptive', and give it readings")
        # Only laws that adapt have this method; `adapts` is true for them.
        return self._controller.estimate(self.memory)  # pyright: ignore[reportAttributeAccessIssue]  # see above

    def _identify(self, position: np.ndarray) -> None:
        assert self._online is not None, "the caller has asked"
        if self._rows is None:
            self._rows = self._online.start(jnp.asarray(position))
            return
        assert self._last is not None, "a command follows the first reading"
        self._rows, estimate = _learned(self._online, self._rows, position, self._last)
        self.online_estimate = found = jax.tree.map(np.asarray, estimate)
        if found.trusted.all():
            model = self.machine.with_estimate(found.theta).plant
            self._controller = eqx.tree_at(lambda c: c.model, self._controller, model)
            self._law.take(self._controller)
            self.switched = self._tick


def follow(case: CaseLike, log: LogLike, *, tolerance: float = 0.05) -> OnlineEstimate:
    """Return the estimates of the on-line estimator at every sample of a log but the first, (time, p) each.

    Args:
        case: The case, its file, or a dict with its tables.
        log: The log, its file, or a table of the columns that [log] names; its command is held.
        tolerance: Relative tolerance of trust, see `jaxid.estimators.algebraic.online.OnlineEstimate`.

    Raises:
        InputError: If the case has unknowns that cannot be identified on-line.
    """
    case = load_case(case)
    if not isinstance(log, Log):
        log = as_log(log, case.columns, joints=case.plant.joints, drives=case.plant.drives)
    log.need_every_encoder("on-line identification")
    machine = build_machine(case, period=log.period)
    fast = np.abs(np.diff(log.position, axis=0)).max(axis=0) / log.period
    rest = np.maximum(_REST * fast, _noise(machine, log.position.shape[1]) / log.period)
    online = Online.of(machine, log.period, rest, fast, tolerance)
    return jax.tree.map(np.asarray, _followed(online, log.position, log.force))


@eqx.filter_jit
def _followed(online: Online, position: Array, command: Array) -> OnlineEstimate:
    def step(memory: OnlineMemory, now: tuple) -> tuple[OnlineMemory, OnlineEstimate]:
        return _learn(online, memory, *now)

    return jax.lax.scan(step, online.start(position[0]), (position[1:], command[:-1]))[1]


class _Law:
    """A controller's command, compiled as a function of one vector: its values, the tick, and its memory.

    Building trees at every tick, and passing an array for each of their leaves, takes five times as long
    as the law itself.

    Args:
        controller: The control law.
        drives: Number of commands that it gives.
        path: Path of the reference, one row a tick.
        driven: Joints that are driven, 0-based.
    """

    def __init__(self, controller: Controller, drives: int, path: base.Path, driven: tuple[int, ...]):
        self.take(controller)
        self._drives, self._driven = drives, driven
        leaves, self._path = jax.tree.flatten(path)
        self._rows = [np.asarray(x, float).reshape(len(x), -1) for x in leaves]
        self._shapes = tuple(x.shape[1:] for x in leaves)
        self._compiled: dict[tuple[bool, ...], Callable] = {}
        self._once = jnp.asarray(1)

    def take(self, controller: Controller) -> None:
        """Take another controller of the same structure."""
        arrays, self._static = eqx.partition(controller, eqx.is_array)
        self._values = _Packed.of(arrays)
        self._leaves = self._values.packed(arrays)

    def remembers(self, memory: object) -> np.ndarray:
        """Store the structure of a memory, and return it as the vector that the law takes."""
        self.memory = _Packed.of(memory)
        return self.memory.packed(memory)

    def __call__(
        self,
        k: int,
        position: np.ndarray,
        fresh: tuple[bool, bool],
        others: Sequence[np.ndarray | None],
        memory: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        """Return the command, the new memory, and a flag that identified values take part in the command.

        Args:
            k: Number of the tick.
            position: Readings of all joints [m or rad].
            fresh: Whether these are new, and whether those of inertial sensors are.
            others: Velocity, acceleration and command, as measured.
            memory: Memory of the tick before, as a vector.
        """
        given = tuple(x is not None for x in others)
        if given not in self._compiled:
            self._compiled[given] = jax.jit(functools.partial(self._command, len(position), given))
        rows = (x[k] for x in self._rows)
        now = (position, *rows, fresh, *(x for x in others if x is not None), np.zeros(1 + self._drives))
        before = np.concatenate([self._leaves, memory, *now])
        after = np.asarray(self._compiled[given](before, self._once))
        first = len(self._leaves)
        end = first + self.memory.size
        return after[-self._drives :], after[first:end], bool(after[-1 - self._drives])

    def _command(self, joints: int, given: tuple[bool, ...], before: Array, once: Array) -> Array:
        sizes = [self._values.size, self.memory.size, joints, *(x.shape[1] for x in self._rows), 2]
        sizes += [size for size, there in zip((joints, joints, self._drives), given, strict=True) if there]
        ends = [int(x) for x in np.cumsum(sizes)]

        def body(_: Array, before: Array) -> Array:
            values, memory, position, *now, _ = jnp.split(before, ends)
            path = [now.pop(0).reshape(shape) for shape in self._shapes]
            fresh = now.pop(0) != 0
            others = [now.pop(0) if there else None for there in given]
            path = jax.tree.unflatten(self._path, path)
            tick = Tick(
                joints=position,
                path=path,
                driven=self._driven,
                fresh=fresh[0],
                velocity=others[0],
                acceleration=others[1],
                measured=others[2],
                renewed=fresh[1],
            )
            controller: Controller = eqx.combine(self._values.unpacked(values), self._static)  # pyright: ignore[reportAssignmentType]  # both halves of one
            u, memory = controller.command(tick, self.memory.unpacked(memory), jnp.zeros(1))
            learned = controller.learned(memory)
            closed = jnp.zeros(1) if learned is None else learned.closed.astype(float)[None]
            memory = self.memory.packed(memory, jnp)
            return jnp.concatenate([values, memory, before[ends[1] : ends[-1]], closed, u])

        # A loop of one iteration, a number that the compiler does not know, is one kernel (see
        # `jaxid._platform`). All is in one vector, because the compiler would move the entries that the
        # iteration leaves unchanged out of it, and start a hundred kernels one by one.
        return jax.lax.fori_loop(0, once, body, before)


@dataclass(frozen=True)
class _Packed:
    """The layout of a tree of arrays in one vector of float64, exact for booleans and integers below 2^53."""

    structure: object
    shapes: tuple

    @classmethod
    def of(cls, tree: object) -> _Packed:
        leaves, structure = jax.tree.flatten(tree)
        return cls(structure, tuple((np.shape(x), np.asarray(x).dtype.str) for x in leaves))

    @functools.cached_property
    def size(self) -> int:
        return sum(int(np.prod(shape)) for shape, _ in self.shapes)

    def packed(self, tree: object, xp: Any = np) -> Any:
        parts = [xp.ravel(x).astype(np.float64) for x in jax.tree.leaves(tree)]
        return xp.concatenate(parts) if parts else xp.zeros(0)

    def unpacked(self, vector: Any) -> object:
        leaves, end = [], 0
        for shape, dtype in self.shapes:
            first, end = end, end + int(np.prod(shape))
            leaves.append(vector[first:end].reshape(shape).astype(dtype))
        return jax.tree.unflatten(self.structure, leaves)


def _learn(
    online: Online, memory: OnlineMemory, position: Array, command: Array
) -> tuple[OnlineMemory, OnlineEstimate]:
    memory, _ = online.update(memory, position, command)
    return memory, online.estimate(memory)


_learned = eqx.filter_jit(_learn)


def _online(
    machine: Machine, reference: np.ndarray, driven: tuple[int, ...], period: float, tolerance: float
) -> Online:
    speed = np.abs(np.diff(reference, axis=0)).max(axis=0) / period
    joints = machine.plant.joints
    fast = np.full(joints, speed.max())
    fast[list(driven)] = np.where(speed > 0, speed, speed.max())
    rest = np.maximum(_REST * fast, _noise(machine, joints) / period)
    return Online.of(machine, period, rest, fast, tolerance)


def _noise(machine: Machine, joints: int) -> np.ndarray:
    """Return the difference of two readings that noise alone hardly exceeds, by joint."""
    stated = machine.sensor.position_std
    std = np.zeros(joints) if stated is None else np.broadcast_to(np.asarray(stated), joints)
    return _NOISE * np.sqrt(2) * std
