"""A case's controller one tick at a time, for a machine or a simulator that is not jaxid's.

With `identify` it finds the unknowns in the first instants, algebraically, and goes on with what it found.
"""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxid.controllers import Controller, Tick
from jaxid.errors import InputError
from jaxid.estimators.online import Memory, Online, Told
from jaxid.estimators.recursion import Told as Estimate
from jaxid.io.case import Case, load_case
from jaxid.io.log import Log
from jaxid.machine import Machine, build_machine
from jaxid.virtual import Scene

# A joint is taken to rest below this part of its reference's largest speed, and below so many
# standard deviations of a difference of two readings.
_REST = 5e-3
_NOISE = 5.0


class Live:
    """The loop of a case without its plant: readings in, commands out.

    Args:
        case: The case, or its file; it needs [controller], [reference] and [simulation].
        identify: Identify the unknowns on-line and, once all may be trusted, put what was found into
            the model of a controller that has one.
        tolerance: Of that trust (see `jaxid.estimators.online.Told`).

    Attributes:
        told: What the rows so far say; None without `identify`, and before the second tick.
        adapts: Whether the controller identifies by itself.
        switched: Tick from which on the controller knows what was found; None: not yet.

    Raises:
        InputError: If the case has no controller or reference, or asks for what cannot be identified
            on-line.
    """

    def __init__(self, case: Case | str | Path, *, identify: bool = False, tolerance: float = 0.05):
        case = case if isinstance(case, Case) else load_case(case)
        scene = Scene.of(case)
        if scene.machine.controller is None:
            raise InputError("there is no loop", where=str(case.path), mend="add a [controller]")
        self.machine = build_machine(case, period=scene.drive.period)
        self.reference: Float[np.ndarray, "ticks m"] = scene.signal
        self.period: float = scene.drive.period
        self.told: Told | None = None
        self.switched: int | None = None
        self._controller = scene.machine.controller
        path = self._controller.path(jnp.asarray(self.reference))
        self._path = jax.tree.map(np.asarray, path)
        self._driven = self.machine.plant.driven(case.plant.joints)
        self._tick = 0
        self._law = _Law(self._controller)
        self._memory: list[Array] | None = None
        sensor = self.machine.sensor
        self._holds = sensor.hold, 1 if sensor.inertial is None else sensor.inertial.hold
        self.adapts = "estimator" in self._controller.of_machine
        self._last: np.ndarray | None = None
        self._online, self._rows = None, None
        if identify:
            if "model" not in self._controller.of_machine or self.adapts:
                kind = (case.controller or {})["kind"]
                what = "identifies by itself" if self.adapts else "has no model to put what is found into"
                raise InputError(
                    f"a controller of kind {kind!r} {what}",
                    where=str(case.path),
                    mend="leave identify out" if self.adapts else "take kind = 'flatness'",
                )
            self._online = _online(self.machine, self.reference, self._driven, self.period, tolerance)

    def command(
        self, position: Float[np.ndarray, " n"], velocity: Float[np.ndarray, " n"] | None = None,
        acceleration: Float[np.ndarray, " n"] | None = None, measured: Float[np.ndarray, " m"] | None = None,
    ) -> Float[np.ndarray, " m"]:
        """The command to hold until the next tick.

        Args:
            position: Readings of all joints [m or rad].
            velocity, acceleration: Likewise, of a gyroscope and an accelerometer; absent: differenced.
                The same are to be given at every tick, held where they are not new: at ticks that are no
                multiple of what [[inertial_sensors]] rate says.
            measured: Command that the drives report since the last tick; absent: as it was given.

        Raises:
            InputError: If the reference has ended, or there is not one reading a joint.
        """
        if self._tick >= len(self.reference):
            raise InputError(
                f"the reference ends after {len(self.reference)} ticks",
                mend="let [simulation] duration be longer",
            )
        position = np.asarray(position, dtype=np.float64)
        joints = self.machine.plant.joints
        if position.shape != (joints,):
            what = f"position has shape {position.shape}"
            raise InputError(what, where="Live.command", mend=f"give one reading of each of {joints} joints")
        fresh, renewed = (np.asarray(self._tick % hold == 0) for hold in self._holds)
        path = jax.tree.map(lambda x: x[self._tick], self._path)
        others = (None if x is None else np.asarray(x, float) for x in (velocity, acceleration, measured))
        tick = Tick(position, path, self._driven, fresh, *others, renewed)
        if self._tick == 0:
            start, saved = self._controller.start(tick, np.zeros_like(position), self._path), self.memory
            # Readings of an earlier run would be differenced with those of this one.
            self.memory = start if saved is None else self._controller.resumed(start, saved)
        if self._online is not None and self.switched is None:
            self._identify(position)
        u, self._memory = self._law(tick, self._memory)
        if self.adapts and self.switched is None and self._controller.told(self.memory).closed:
            self.switched = self._tick
        self._tick, self._last = self._tick + 1, np.asarray(u)
        return self._last

    @property
    def memory(self) -> object:
        """What the controller remembers, a tree of arrays.

        Of one that was saved, and put back before the first tick, what was identified is kept.
        """
        return None if self._memory is None else jax.tree.unflatten(self._law.memory, self._memory)

    @memory.setter
    def memory(self, memory: object) -> None:
        leaves, self._law.memory = jax.tree.flatten(memory)
        self._memory = [jnp.asarray(x) for x in leaves]

    @property
    def estimate(self) -> Estimate:
        """What a controller that identifies says of the unknowns, in the order of `machine.parameters`.

        Raises:
            InputError: If it does not identify, or nothing has been read yet.
        """
        if not self.adapts or self.memory is None:
            what = "no reading yet" if self.adapts else "the controller does not identify"
            raise InputError(what, where="Live", mend="take kind = 'adaptive', and give it readings")
        return self._controller.estimate(self.memory)

    def _identify(self, position: np.ndarray) -> None:
        if self._rows is None:
            self._rows = self._online.start(jnp.asarray(position))
            return
        self._rows, told = _learned(self._online, self._rows, position, self._last)
        self.told = jax.tree.map(np.asarray, told)
        if self.told.trusted.all():
            model = self.machine.with_estimate(self.told.theta).plant
            self._controller = eqx.tree_at(lambda c: c.model, self._controller, model)
            self._law.take(self._controller)
            self.switched = self._tick


def follow(case: Case | str | Path, log: Log, *, tolerance: float = 0.05) -> Told:
    """What the on-line estimator tells at every sample of a log but the first, (time, p) each.

    Args:
        case: The case, or its file.
        log: The log; its command is held between samples.
        tolerance: Of trust (see `jaxid.estimators.online.Told`).

    Raises:
        InputError: If the case asks for what cannot be identified on-line.
    """
    case = case if isinstance(case, Case) else load_case(case)
    log.need_every_encoder("on-line identification")
    machine = build_machine(case, period=log.period)
    fast = np.abs(np.diff(log.position, axis=0)).max(axis=0) / log.period
    rest = np.maximum(_REST * fast, _noise(machine, log.position.shape[1]) / log.period)
    online = Online.of(machine, log.period, rest, fast, tolerance)
    return jax.tree.map(np.asarray, _followed(online, log.position, log.force))


@eqx.filter_jit
def _followed(online: Online, position: Array, command: Array) -> Told:
    def step(memory: Memory, now: tuple) -> tuple[Memory, Told]:
        return _learn(online, memory, *now)

    return jax.lax.scan(step, online.start(position[0]), (position[1:], command[:-1]))[1]


class _Law:
    """A controller's command, compiled as a function of leaves, and of one array for the tick.

    To walk through the trees of controller and memory at every tick takes twice as long as all else.
    """

    def __init__(self, controller: Controller):
        self.take(controller)
        self.memory: object = None
        self._tick: object = None

    def take(self, controller: Controller) -> None:
        """Go on with a controller of the same structure."""
        arrays, self._static = eqx.partition(controller, eqx.is_array)
        leaves, self._arrays = jax.tree.flatten(arrays)
        self._leaves = [jnp.asarray(x) for x in leaves]

    def __call__(self, tick: Tick, memory: list[Array]) -> tuple[Array, list[Array]]:
        leaves, structure = jax.tree.flatten(tick)
        if self._tick is None or structure != self._tick:
            self._tick, self._compiled = structure, jax.jit(self._command)
            self._shapes = [(x.shape, x.dtype) for x in leaves]
        return self._compiled(self._leaves, np.concatenate([x.ravel() for x in leaves]), memory)

    def _command(self, own: list, tick: Array, memory: list) -> tuple[Array, list[Array]]:
        controller = eqx.combine(jax.tree.unflatten(self._arrays, own), self._static)
        ends = np.cumsum([int(np.prod(shape)) for shape, _ in self._shapes])[:-1]
        parts = zip(jnp.split(tick, ends), self._shapes, strict=True)
        tick = jax.tree.unflatten(self._tick, [x.reshape(shape).astype(d) for x, (shape, d) in parts])
        memory = jax.tree.unflatten(self.memory, memory)
        u, memory = controller.command(tick, memory, jnp.zeros(1))
        return u, jax.tree.leaves(memory)


def _learn(online: Online, memory: Memory, position: Array, command: Array) -> tuple[Memory, Told]:
    memory, _ = online.update(memory, position, command)
    return memory, online.told(memory)


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
    """Difference of two readings that noise alone hardly exceeds."""
    stated = machine.sensor.position_std
    std = np.zeros(joints) if stated is None else np.broadcast_to(np.asarray(stated), joints)
    return _NOISE * np.sqrt(2) * std
