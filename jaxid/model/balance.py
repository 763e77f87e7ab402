"""The balance of generalized forces of a plant and its effects, at one instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.batching import act_batched, group_by_kind
from jaxid.model.effect import Action, Signals
from jaxid.numerics import smooth

if TYPE_CHECKING:
    from jaxtyping import Float

    from jaxid.model.plant import Plant

# A sum that no effect has contributed to is a Python float: it then takes no part in compiled code.
Sum = Array | float


class Balance(eqx.Module):
    """The balance at one instant, with all that its readings need.

    Args:
        residual: Force that is missing for equilibrium, by coordinate [N or N m].
        dry: Level of dry friction, by port.
        stick: Additional level at rest, by port.
        rising: Additional level while speed grows, (2, ports): forwards and backwards.
        rates: Time derivatives of the effects' internal states.
        drive: Force at the load of each drive, after all effects in its path [N or N m].
        slides: Ports on which any effect is dry friction.
        rises: Ports on which dry friction is larger while speed grows.
    """

    residual: Array
    dry: Array
    stick: Array
    rising: Array
    rates: tuple
    drive: Array
    slides: tuple[int, ...] = eqx.field(static=True)
    rises: tuple[int, ...] = eqx.field(static=True)


class PortSignals(eqx.Module):
    """Motion and surroundings of every port: the signals that effects may use."""

    y: Array
    yd: Array
    ydd: Array
    gravity: Array
    normal: Array
    width: Array
    stiffness: Array
    damping: Array
    field: Array
    elongating: tuple[Array | None, ...] | None = None

    @classmethod
    def of(cls, plant: Plant, q: Array, qd: Array, qdd: Array) -> PortSignals:
        motion = port_motion(plant, q, qd, qdd)
        gravity, normal, width = plant.port_gravity(q), plant.port_normal(q), plant.port_width(q)
        return cls(*motion, gravity, normal, width, *plant.port_spring(q), plant.field)

    def at(self, i: int, u: Array, t: Array, dry_scale: Sum, *, springs: bool) -> Signals:
        """Return the signals of an effect on port i, with those of its spring if it adds one."""
        return Signals(
            y=self.y[i],
            yd=self.yd[i],
            ydd=self.ydd[i],
            u=u,
            t=t,
            width=self.width[i],
            dry_scale=jnp.asarray(dry_scale),
            gravity=self.gravity[i],
            normal=self.normal[i],
            stiffness=self.stiffness[i],
            damping=self.damping[i],
            field=self.field,
            elongating=self.elongating[i] if springs and self.elongating is not None else None,
        )


class BehindSprings(eqx.Module):
    """What a plant does whose links, or a part of them, are behind springs that effects add to its joints.

    Args:
        inertial: Inertial forces and weight by coordinate, the pull of the springs included [N or N m].
        elongating: Second derivative of the elongation of the spring of each port [m/s^2, rad/s^2]; None: it
            has none, or its effect computes it.
    """

    inertial: Array
    elongating: tuple[Array | None, ...]


class BarePlant(eqx.Module):
    """The part of a balance that belongs to the plant without its effects, at one instant.

    It is the same whatever the effects are: along a known motion it is computed once for all of them.

    Args:
        inertial: Inertial forces and weight, by coordinate [N or N m].
        port: Motion and surroundings of the ports.
        slope: Derivative of the ports by the coordinates, (ports, n); None: the ports are the joints.
    """

    inertial: Array
    port: PortSignals
    slope: Array | None

    @classmethod
    def of(cls, plant: Plant, q: Array, qd: Array, qdd: Array) -> BarePlant:
        """Return it for a plant in motion."""
        slope = None if plant.ports_are_joints else jax.jacfwd(plant.ports)(q)
        return cls(plant.inertial(q, qd, qdd), PortSignals.of(plant, q, qd, qdd), slope)

    def pulled_back(self, force: Float[Array, " ports"]) -> Float[Array, " n"]:
        """Return the generalized force of forces on the ports."""
        return force if self.slope is None else jnp.sum(self.slope * force[:, None], axis=0)


def balance(
    plant: Plant,
    q: Float[Array, " n"],
    qd: Float[Array, " n"],
    qdd: Float[Array, " n"],
    u: Float[Array, " m"],
    t: Float[Array, ""],
    states: tuple,
    reaction: Float[Array, " ports"] | None,
    bare: BarePlant | None = None,
    *,
    behind: bool = False,
) -> Balance:
    """Compute the balance; see `Plant.balance` for the arguments.

    Args:
        plant, q, qd, qdd, u, t, states, reaction, behind: See there.
        bare: The plant without effects at this motion, if it is known.
    """
    port = PortSignals.of(plant, q, qd, qdd) if bare is None else bare.port
    links = plant.behind_springs(q, qd, qdd, u, states) if behind else None
    if links is not None:
        port = replace(port, elongating=links.elongating)
    sums = _Sums.of(plant, port.y.size, u, t)

    for run in group_by_kind(plant.effects, sums.drives):
        _act(plant, run, port, sums, t, states)
    _finish_levels(plant, sums)

    rises = _contributed(sums.forth)
    slides = tuple(sorted({*_contributed(sums.dry), *_contributed(sums.stick), *rises}))
    at_rest_only, levels = stacked(sums.stick), stacked(sums.dry)
    rising = jnp.stack([stacked(sums.forth), stacked(sums.back)])

    if reaction is None:
        reaction = _smoothed_reaction(port, sums, levels, at_rest_only, rising, bool(rises))
    force = stacked(sums.force) + reaction
    react = _pull_back(plant, q, force) if bare is None else bare.pulled_back(force)
    drive = stacked(sums.drive)
    if links is not None:
        inertial = links.inertial
    else:
        inertial = plant.inertial(q, qd, qdd) if bare is None else bare.inertial
    residual = inertial - react - plant.applied(drive, q.size)
    return Balance(
        residual=residual,
        dry=levels,
        stick=at_rest_only,
        rising=rising,
        rates=tuple(sums.rates),
        drive=drive,
        slides=slides,
        rises=rises,
    )


@dataclass
class _Sums:
    """Sums over the effects, by port and by drive.

    They are lists: arrays updated in place compile much more slowly.
    """

    force: list[Sum]
    dry: list[Sum]
    stick: list[Sum]
    forth: list[Sum]
    back: list[Sum]
    dry_scale: list[Sum]
    drive: list[Array]
    # Drive of each effect; None if its port has none.
    drives: list[int | None]
    rates: list[Array | None]

    @classmethod
    def of(cls, plant: Plant, ports: int, u: Array, t: Array) -> _Sums:
        none: list[Sum] = [0.0] * ports
        force, dry, stick, forth, back = (list(none) for _ in range(5))
        scale: list[Sum] = [1.0] * ports
        for e in plant.effects:
            scale[e.port] = scale[e.port] + e.dry_drift(t)
        drives = [plant.drive_of(e.port, u.size) for e in plant.effects]
        return cls(
            force=force,
            dry=dry,
            stick=stick,
            forth=forth,
            back=back,
            dry_scale=scale,
            drive=[u[j] for j in range(u.size)],
            drives=drives,
            rates=[],
        )

    def add(self, i: int, action: Action) -> None:
        """Add the action of an effect on port i."""
        self.force[i], self.dry[i] = self.force[i] + action.force, self.dry[i] + action.dry
        self.stick[i] = self.stick[i] + action.stick
        if action.rising is not None:
            self.forth[i] = self.forth[i] + action.rising[0]
            self.back[i] = self.back[i] + action.rising[1]


def _act(plant: Plant, run: list[int], port: PortSignals, sums: _Sums, t: Array, states: tuple) -> None:
    """Compute the actions of a run of effects of one kind in one batch, and add them to the sums."""
    effects = plant.effects
    spots = [(k, i, sums.drives[k]) for k in run for i in plant.directions(effects[k].port)]
    signals = [
        port.at(
            i,
            jnp.zeros(()) if j is None else sums.drive[j],
            t,
            sums.dry_scale[i],
            springs=effects[k].adds_spring,
        )
        for k, i, j in spots
    ]
    each = [k for k, _, _ in spots]
    actions = act_batched([effects[k] for k in each], signals, [states[k] for k in each])

    for (k, i, j), action in zip(spots, actions, strict=True):
        sums.add(i, action)
        if j is not None and action.drive is not None:
            sums.drive[j] = action.drive
        if i == effects[k].port:
            sums.rates.append(action.rate)


def _finish_levels(plant: Plant, sums: _Sums) -> None:
    """Apply the drift to all levels of dry friction, and move those of geared ports to their joints."""
    for levels in (sums.dry, sums.stick, sums.forth, sums.back):
        for i in _contributed(levels):
            levels[i] = levels[i] * sums.dry_scale[i]
        for i, joint, ratio in plant.geared:
            if _is_sum(levels[i]):
                levels[i], levels[joint] = 0.0, levels[joint] + ratio * levels[i]


def _smoothed_reaction(
    port: PortSignals, sums: _Sums, levels: Array, at_rest_only: Array, rising: Array, rises: bool
) -> Array:
    """Return the force of dry friction by port, with the smoothed sign of the velocity."""
    held = levels
    # The term is left out if no effect has it: its exponential would be evaluated nevertheless.
    if _contributed(sums.stick):
        held = held + at_rest_only * (smooth.at_rest(port.yd, port.width) / smooth.REST_PEAK)
    sign = smooth.sign(port.yd, port.width)
    reaction = -held * sign
    return reaction - _while_rising(rising, sign, port.ydd) if rises else reaction


def _while_rising(rising: Float[Array, "2 ports"], sign: Array, ydd: Array) -> Array:
    """Return the friction that acts only while speed grows; `sign` is the smoothed sign of the velocity."""
    forth = jnp.where(ydd > 0, 0.5 * (1 + sign) * rising[0], 0.0)
    return forth - jnp.where(ydd < 0, 0.5 * (1 - sign) * rising[1], 0.0)


def _contributed(levels: list[Sum]) -> tuple[int, ...]:
    """Return the ports to whose sum any effect has contributed."""
    return tuple(i for i, x in enumerate(levels) if _is_sum(x))


def _is_sum(x: Sum) -> bool:
    """Check that any effect has contributed; numpy's numbers, of which plants may consist, are floats too."""
    return type(x) is not float


def port_motion(plant: Plant, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array, Array]:
    """Compute coordinate, velocity and acceleration of the ports by forward-mode differentiation."""
    if plant.ports_are_joints:
        return q, qd, qdd

    def velocity(q: Array, qd: Array) -> tuple[Array, Array]:
        return jax.jvp(plant.ports, (q,), (qd,))

    (y, yd), (_, ydd) = jax.jvp(velocity, (q, qd), (qd, qdd))
    return y, yd, ydd


def _pull_back(plant: Plant, q: Array, force: Array) -> Array:
    """Return the generalized force of forces on the ports: the transposed Jacobian times them."""
    return force if plant.ports_are_joints else jax.vjp(plant.ports, q)[1](force)[0]


def stacked(parts: Sequence[Sum]) -> Float[Array, " k"]:
    """Stack numbers and scalars as a float64 vector."""
    return jnp.stack([jnp.asarray(p, dtype=jnp.float64) for p in parts])
