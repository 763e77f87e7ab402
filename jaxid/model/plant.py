"""One statement of the physics: the balance of generalized forces.

A plant states `M(q) qdd + h(q, qd)` and carries effects; `Plant.balance` puts them together. All
else (right-hand side, regressor, iterated integrals, set-valued step) reads that one statement and
lives in `jaxid.dynamics.rhs`, `jaxid.dynamics.residuals` and `jaxid.dynamics.dry_friction`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.model.batching import act_batched, group_by_kind
from jaxid.model.effect import Effect, Signals
from jaxid.numerics import smooth

# What the ports of a plant may be called; they count from 1 by kind.
PLACES = ("joint", "spring", "shaft", "passive", "tool")


class Balance(eqx.Module):
    """What `Plant.balance` returns.

    Args:
        residual: Force that is missing for equilibrium, by coordinate [N or N m].
        dry: Level of dry friction, by port.
        stick: Level above it at rest, by port.
        rising: Level above it while speed grows, (2, ports): forwards and backwards.
        rates: Time derivatives of the effects' own states.
        drive: Force at the load of each drive, after all effects in its path [N or N m].
        slides: Ports on which any effect is dry friction.
        rises: Ports on which it is more while speed grows.
    """

    residual: Array
    dry: Array
    stick: Array
    rising: Array
    rates: tuple
    drive: Array
    slides: tuple[int, ...] = eqx.field(static=True)
    rises: tuple[int, ...] = eqx.field(static=True)


class Plant(eqx.Module):
    """A machine: inertial forces and the effects beside them.

    Fields of every plant: `effects`, a tuple in the order of the drive; `sharpness`, the
    dimensionless width of the smoothed sign; `velocity_scale`, the velocity that it multiplies.
    """

    kind: ClassVar[str]
    joints: ClassVar[int] = 1
    # Whether no joint's acceleration enters the balance of another: there is nothing to solve then.
    diagonal: ClassVar[bool] = False
    # Whether joints push one another through a mass matrix that varies.
    coupled: ClassVar[bool] = False
    # Joint behind an elastic coupling, which may go without an encoder; None where there is none.
    load: ClassVar[int | None] = None
    # Whether it is a stage (see `Effect.of_stages`).
    stage: ClassVar[bool] = False
    # Classes by the coupling that a case may state; none where there is no choice.
    couplings: ClassVar[Mapping[str, type[Plant]]] = {}
    # Joints that are driven, 0-based, in the order of their drives; None: the first ones, all of them.
    actuated = None
    # "linear" or "rotary" where a case does not say; None: linear.
    usual_motion: ClassVar[str | None] = None
    # Whether a case describes it link by link: then it takes a `geometry`.
    linked: ClassVar[bool] = False
    # How many angles between links that no drive turns, and tools, are ports behind the joints.
    passives: ClassVar[int] = 0
    tools: ClassVar[int] = 0
    effects: eqx.AbstractVar[tuple[Effect, ...]]
    sharpness: eqx.AbstractVar[Array]
    velocity_scale: eqx.AbstractVar[Array]

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        """M(q) qdd + h(q, qd), weight included."""
        raise NotImplementedError

    def ports(self, q: Array) -> Array:
        """Coordinates on which effects act: the joints, and behind them what else there is."""
        return q

    @property
    def ports_are_joints(self) -> bool:
        """Whether there is nothing else: to differentiate `ports` takes half of all compile time."""
        return type(self).ports is Plant.ports

    def own_inertia(self) -> Array | None:
        """What a force on each joint accelerates of it alone [kg or kg m^2]; None where that varies."""
        return None

    @classmethod
    def bodies(cls, joints: int) -> int:
        """How many ports are called joints: a part that another moves rigidly has a port without a motion."""
        return joints

    @classmethod
    def springs(cls, joints: int) -> int:
        """How many ports behind the parts are elongations of springs."""
        return 0

    def motion(self, port: int) -> str | None:
        """Whether a port is "linear" or "rotary", of a machine that has both; None: as the case says."""
        return None

    @property
    def geared(self) -> tuple[tuple[int, int, Array], ...]:
        """Ports that move in proportion to a joint: port, joint, and ratio (positive).

        Their dry friction is that joint's: two that slide as one share no load that anything could tell.
        """
        return ()

    @property
    def gearing(self) -> Array | float:
        """Force at each driven joint per unit of its drive's own: known ratios of gears.

        `balance` counts at the joints; the gain of a machine holds these ratios.
        """
        return 1.0

    def impossible(self, q: Float[np.ndarray, "time n"]) -> tuple[int, str] | None:
        """First row of some positions that the machine cannot take, and why; None where it can take all."""
        return None

    def any_motion(self, random: np.random.Generator) -> Float[np.ndarray, "3 n"]:
        """A position that it can take, a velocity and an acceleration, to ask what the balance depends on.

        Raises:
            InputError: If no position in a thousand is possible.
        """
        motion = random.uniform(0.5, 1.5, (3, self.joints))
        for _ in range(1000):
            if self.impossible(motion[:1]) is None:
                return motion
            motion[0] = random.uniform(-np.pi, np.pi, self.joints)
        raise InputError(f"kind = '{self.kind}' cannot take any position", hint="check its lengths")

    def directions(self, port: int) -> tuple[int, ...]:
        """Coordinates, as entries of `ports`, along which an effect on a port acts, each for itself."""
        return (port,)

    def joint_positions(self, tool: Float[np.ndarray, " k"]) -> Float[np.ndarray, " n"] | None:
        """Coordinates that bring the tool to a place; NaN out of reach, None of a plant that cannot say."""
        return None

    @classmethod
    def links(cls, joints: int) -> int:
        """How many links have a `frame`."""
        return 0

    def frame(self, link: int, q: Float[Array, " n"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """Axes of a link's frame, as columns, and its origin [m], in the base's frame.

        Raises:
            InputError: If the plant has no links that move in space.
        """
        what = f"kind = '{self.kind}' has no links that move in space"
        raise InputError(what, hint="put sensors on the links of a serial_arm or five_bar")

    @property
    def base_gravity(self) -> Float[Array, "3"]:
        """Acceleration of gravity in the base's frame [m/s^2]."""
        return jnp.asarray(getattr(self, "gravity_vector", (0.0, 0.0, -9.81)))

    def place(self, port: int) -> tuple[str, int]:
        """What a port is called: one of `PLACES`, and which, counted from 1."""
        parts = self.bodies(self.joints)
        return ("joint", port + 1) if port < parts else ("spring", port - parts + 1)

    def joints_loaded_by(self, port: int, joints: int) -> tuple[int, ...]:
        """Joints in whose balance a force on a port stands; all by default."""
        return tuple(range(joints))

    def drive_of(self, port: int, drives: int) -> int | None:
        """Index of the drive that acts on a port; None where there is none."""
        if self.actuated is None:
            return port if port < drives else None
        return self.actuated.index(port) if port in self.actuated else None

    def at_drives(self, x: Array) -> Array:
        """Of a quantity by joint (its last axis), the joints that are driven, by drive."""
        return x if self.actuated is None else x[..., list(self.actuated)]

    def driven(self, coordinates: int) -> tuple[int, ...]:
        """Joints that are driven, in the order of the drives."""
        return tuple(int(i) for i in self.at_drives(np.arange(coordinates)))

    def applied(self, u: Array, coordinates: int) -> Array:
        """Generalized forces of the drives, by coordinate."""
        if self.actuated is None:
            return u
        drives = [self.drive_of(i, u.size) for i in range(coordinates)]
        return jnp.stack([jnp.zeros((), u.dtype) if j is None else u[j] for j in drives])

    def accepts(self, effect: type[Effect], port: int, drives: int) -> bool:
        """Whether a search may name such an effect on a port."""
        springs = self.springs(self.joints) > 0
        if effect.with_springs not in (None, springs) or (effect.of_stages and not self.stage):
            return False
        if springs and effect.of_spring != (port >= self.bodies(self.joints)):
            return False
        return not effect.in_drive or self.drive_of(port, drives) is not None

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int] | None:
        """Parameter of the plant, and its entry, that an effect on a port is by another name."""
        return None

    def port_gravity(self, q: Array) -> Array:
        """Acceleration of gravity along each port [m/s^2]."""
        return jnp.zeros_like(self.ports(q))

    def port_normal(self, q: Array) -> Array:
        """Force that presses the sliding surfaces of each port together [N]."""
        return jnp.zeros_like(self.ports(q))

    def port_width(self, q: Array) -> Array:
        """Velocity of each port over which the sign is smoothed."""
        return jnp.broadcast_to(self.width, self.ports(q).shape)

    def port_spring(self, q: Array) -> tuple[Array, Array]:
        """Stiffness and damping of the plant's own spring at each port; zero on joints."""
        zero = jnp.zeros_like(self.ports(q))
        return zero, zero

    @property
    def width(self) -> Array:
        """Velocity over which the sign is smoothed."""
        return self.sharpness * self.velocity_scale

    def command_delays(self, drives: int) -> Float[Array, " m"]:
        """Total delay of the command of each drive [s]."""
        total = [0.0] * drives
        for e in self.effects:
            j = self.drive_of(e.port, drives)
            if j is not None:
                total[j] = total[j] + e.command_delay()
        return _stack(total)

    def initial_states(self, u: Array) -> tuple:
        """Own states of the effects where the drive has long been at `u`."""
        drives = [self.drive_of(e.port, u.size) for e in self.effects]
        zero = jnp.zeros((), u.dtype)
        return tuple(
            e.initial_state(zero if j is None else u[j]) for e, j in zip(self.effects, drives, strict=True)
        )

    def with_effect(self, effect: Effect) -> Plant:
        """The same plant with one effect more, last on the drive."""
        return eqx.tree_at(lambda p: p.effects, self, (*self.effects, effect))

    def balance(
        self,
        q: Float[Array, " n"],
        qd: Float[Array, " n"],
        qdd: Float[Array, " n"],
        u: Float[Array, " m"],
        t: Float[Array, ""],
        states: tuple,
        reaction: Float[Array, " ports"] | None = None,
    ) -> Balance:
        """State the balance of forces at one instant.

        Args:
            q: Coordinates [m or rad].
            qd: Velocities.
            qdd: Accelerations.
            u: Declared force of each drive, delay already applied [N or N m].
            t: Time from the start of the log [s].
            states: Own state of each effect (None where it has none).
            reaction: Force of dry friction by port, where a set-valued step has found it. Absent:
                smoothed, -level tanh(yd / width).

        Returns:
            Residual `M qdd + h - effects - drive`, levels of dry friction, rates of the states, drive.
        """
        y, yd, ydd = port_motion(self, q, qd, qdd)
        gravity, normal, width = self.port_gravity(q), self.port_normal(q), self.port_width(q)
        stiffness, damping = self.port_spring(q)
        # Sums by port and drive in lists: arrays updated in place compile much more slowly.
        force, dry, stick, dry_scale, forth, back = ([x] * y.size for x in (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
        for e in self.effects:
            dry_scale[e.port] = dry_scale[e.port] + e.dry_drift(t)
        drive, rates = [u[j] for j in range(u.size)], []
        ports = [e.port for e in self.effects]
        drives = [self.drive_of(i, u.size) for i in ports]
        for run in group_by_kind(self.effects, drives):
            spots = [(k, i, drives[k]) for k in run for i in self.directions(ports[k])]
            signals = [
                Signals(
                    y[i],
                    yd[i],
                    ydd[i],
                    jnp.zeros(()) if j is None else drive[j],
                    t,
                    width[i],
                    jnp.asarray(dry_scale[i]),
                    gravity[i],
                    normal[i],
                    stiffness[i],
                    damping[i],
                )
                for _, i, j in spots
            ]
            each = [k for k, _, _ in spots]
            actions = act_batched([self.effects[k] for k in each], signals, [states[k] for k in each])
            for (k, i, j), action in zip(spots, actions, strict=True):
                force[i], dry[i] = force[i] + action.force, dry[i] + action.dry
                stick[i] = stick[i] + action.stick
                if action.rising is not None:
                    forth[i], back[i] = forth[i] + action.rising[0], back[i] + action.rising[1]
                if j is not None and action.drive is not None:
                    drive[j] = action.drive
                if i == ports[k]:
                    rates.append(action.rate)
        for levels in (dry, stick, forth, back):
            for i in (i for i in range(y.size) if not isinstance(levels[i], float)):
                levels[i] = levels[i] * dry_scale[i]
            for i, joint, ratio in self.geared:
                if not isinstance(levels[i], float):
                    levels[i], levels[joint] = 0.0, levels[joint] + ratio * levels[i]
        rises = _given(forth)
        slides = tuple(sorted({*_given(dry), *_given(stick), *rises}))
        at_rest_only, levels, rising = _stack(stick), _stack(dry), jnp.stack([_stack(forth), _stack(back)])
        if reaction is None:
            held = levels
            # Not even added where it is nothing: its exponential would be evaluated all the same.
            if not all(isinstance(s, float) for s in stick):
                held = held + at_rest_only * (smooth.at_rest(yd, width) / smooth.REST_PEAK)
            way = smooth.sign(yd, width)
            reaction = -held * way
            if rises:
                reaction = reaction - _while_rising(rising, way, ydd)
        react = _pull_back(self, q, _stack(force) + reaction)
        u = _stack(drive)
        residual = self.inertial(q, qd, qdd) - react - self.applied(u, q.size)
        return Balance(residual, levels, at_rest_only, rising, tuple(rates), u, slides, rises)


def _given(levels: list[Array | float]) -> tuple[int, ...]:
    """Ports for which anything was said."""
    return tuple(i for i, x in enumerate(levels) if not isinstance(x, float))


def _while_rising(rising: Float[Array, "2 ports"], way: Array, ydd: Array) -> Array:
    """Friction that acts while speed grows only; `way` is the smoothed sign of the velocity."""
    forth = jnp.where(ydd > 0, 0.5 * (1 + way) * rising[0], 0.0)
    return forth - jnp.where(ydd < 0, 0.5 * (1 - way) * rising[1], 0.0)


def port_motion(plant: Plant, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array, Array]:
    """Coordinate, velocity and acceleration of the ports by forward-mode differentiation."""
    if plant.ports_are_joints:
        return q, qd, qdd

    def velocity(q: Array, qd: Array) -> tuple[Array, Array]:
        return jax.jvp(plant.ports, (q,), (qd,))

    (y, yd), (_, ydd) = jax.jvp(velocity, (q, qd), (qd, qdd))
    return y, yd, ydd


def _pull_back(plant: Plant, q: Array, force: Array) -> Array:
    """Generalized force of forces on the ports: the transposed Jacobian."""
    return force if plant.ports_are_joints else jax.vjp(plant.ports, q)[1](force)[0]


def _stack(parts: list[Array | float]) -> Array:
    return jnp.stack([jnp.asarray(p, dtype=jnp.float64) for p in parts])
