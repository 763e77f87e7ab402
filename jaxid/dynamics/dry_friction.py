"""The step under set-valued friction: a joint sticks exactly, and turns where friction does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.dynamics.rhs import (
    State,
    acceleration,
    balance_of,
    mass_of,
    need_apart,
    phi,
    picked,
    solved,
    spread,
    step,
)
from jaxid.model.balance import Balance, port_motion
from jaxid.model.plant import Plant
from jaxid.numerics.affine import depends
from jaxid.numerics.smooth import ramp

# Of the Gauss-Seidel iteration; chosen.
_SWEEPS = 20


def set_valued_step(
    plant: Plant,
    x: State,
    u: Callable[[Array], Array],
    t: Array,
    h: Array,
    flow: Callable[..., State] | None = None,
) -> tuple[State, Array]:
    """One step under set-valued friction: flow without it, then the reaction that stops or drags.

    A port slides under the level of dry friction halfway. Where it comes to rest within the step it
    stays if the break-away level holds it, and else goes back for the rest of the step: the reaction
    is then the mean of both parts, and the position that of two parabolas, of second order in the
    step. Ports that are coupled through the mass matrix share their reactions by Gauss-Seidel sweeps,
    each that of such a port under what the others leave it.

    Args:
        plant, x, u, t, h: As of `jaxid.dynamics.rhs.step`.
        flow: That as a function of state and reaction (left out: zero), where there is a cheaper one.

    Returns:
        The state a step later, and the reaction of every port over the step.

    Raises:
        InputError: If there is friction that depends on the acceleration, and ports push one another.
    """
    none, standing = jnp.zeros(plant.ports(x.q).size), jnp.zeros_like(x.q)
    if flow is None:
        flow = lambda x, reaction=none: step(plant, x, u, t, h, reaction)
    end = u(jnp.asarray(1.0))

    def at(q: Array, qd: Array, qdd: Array = standing) -> Balance:
        return balance_of(plant, q, qd, qdd, end, t, x.own, none)

    def without() -> tuple[State, tuple[Array, Array], Array, Balance]:
        """The step without friction; position, velocity, mass and levels halfway."""
        free = flow(x)
        # A mass that depends on the position counts halfway, as all else does.
        halfway = 0.5 * (x.q + free.q) if plant.coupled else x.q, 0.5 * (x.qd + free.qd)

        def residual(qdd: Array) -> tuple[Array, Balance]:
            levels = at(*halfway, qdd)
            return levels.residual, levels

        # The mass does not depend on the velocity: one balance gives it and the levels.
        return free, halfway, *mass_of(plant, residual, halfway[0])

    def sliding(free: State, halfway: tuple, mass: Array, levels: Balance) -> _Sliding:
        q, qd = halfway
        if plant.coupled and qd.size > 1:
            # A force changes a velocity over a step by less than its impulse would, for damping: a joint that
            # stands would else pull at the others by a force that is off in the first order of the step.
            mass = mass + 0.5 * h * jax.jacfwd(lambda qd: at(q, qd).residual)(qd)
        return _sliding(plant, x, free, mass, levels, end, t, h)

    free, halfway, mass, levels = parts = without()
    if not levels.slides:
        return free, none
    told = lambda *motion: [getattr(at(*motion), n) for n in ("dry", "stick", "rising")]
    moves = depends(lambda qd: told(halfway[0], qd), halfway[1:])
    at_rest = at(halfway[0], standing) if moves else levels
    slides = sliding(*parts)
    # Where no level hangs on the motion, tangents of all this are asked for in few steps only.
    lean = plant.coupled and not depends(told, halfway)
    found = slides.answer(levels, at_rest, (lambda: sliding(*without())) if lean else None)
    reaction = spread(found.reaction, levels.slides, none.size)
    if moves:
        # Without friction motion begins too fast, and friction that falls with speed is too small.
        slowed = free.qd + h * solved(mass, jax.vjp(plant.ports, x.q)[1](reaction)[0])
        found = slides.answer(at(halfway[0], 0.5 * (x.qd + slowed)), at_rest)
        reaction = spread(found.reaction, levels.slides, none.size)
    end_of_step = _rest_exactly(flow(x, reaction), found.stuck, levels.slides)
    return _turned(x, end_of_step, found, h, levels.slides), reaction


class _Answer(NamedTuple):
    """What dry friction does over a step, an entry for each sliding port.

    Args:
        reaction: Its mean [N or N m].
        stuck: Which ports rest at the step's end.
        stands: Which do not change their velocity at all.
        part: Part of the step before a port comes to rest; one where it does not.
    """

    reaction: Array
    stuck: Array
    stands: Array
    part: Array


@dataclass(frozen=True)
class _Sliding:
    """The ports on which friction slides, and their motion over a step without it.

    Args:
        ports: Which of all.
        before: Velocity at the step's start, (ports,).
        speed: At its end.
        mobility: Change of that per unit reaction, (ports, ports), where ports push each other.
        own: The same by a port's own reaction, (ports,).
        corner: Over what part of itself the corners of friction that rises are rounded.
    """

    ports: tuple[int, ...]
    before: Array
    speed: Array
    mobility: Array | None
    own: Array
    corner: Array

    def answer(
        self, levels: Balance, at_rest: Balance, anew: Callable[[], _Sliding] | None = None
    ) -> _Answer:
        """Of friction at given levels, and at those at rest.

        Args:
            levels, at_rest: The balances that hold them.
            anew: Makes the same once more within the branch that takes it: derivatives are then worked out
                in that branch alone.
        """
        dry = picked(levels.dry, self.ports)
        held = picked(at_rest.dry, self.ports) + picked(at_rest.stick, self.ports)
        if levels.rises:
            rising = [jnp.stack([picked(r, self.ports) for r in b.rising]) for b in (levels, at_rest)]
            return _own_reaction(self.own, self.speed, self.before, dry, held, *rising, self.corner)
        drag = -jnp.sign(self.before) * dry
        if self.mobility is None:
            after = self.speed + self.own * drag
            general = lambda: _own_reaction(self.own, self.speed, self.before, dry, held)
        else:
            after = self.speed + jnp.sum(self.mobility * drag, axis=1)

            def general() -> _Answer:
                own = self if anew is None else anew()
                return _shared_reaction(own.mobility, own.speed, own.before, dry, held)

        no = jnp.zeros(drag.shape, bool)
        # Nearly all steps only drag. A branch, not a choice between two results: the others cost more.
        return jax.lax.cond(
            jnp.all(self.before * after > 0.0), lambda: _Answer(drag, no, no, jnp.ones_like(drag)), general
        )


def _sliding(
    plant: Plant, x: State, free: State, mass: Array, levels: Balance, u: Array, t: Array, h: Array
) -> _Sliding:
    """The ports that slide over a step h from x to `free`, under the force u."""
    ports = levels.slides
    speed, before = (_port_speed(plant, at, ports) for at in (free, x))
    mobility = h * _mobility(plant, mass, x.q, ports)
    own = mobility if mobility.ndim == 1 else jnp.diagonal(mobility)
    alone = mobility.ndim == 1 or own.size == 1
    if levels.rises:
        need_apart(plant, mass, ports)
        own = own * picked(_yielding(plant, x, u, t, h), ports)
    return _Sliding(ports, before, speed, None if alone else mobility, own, plant.smoothing.sharpness)


def _yielding(plant: Plant, x: State, u: Array, t: Array, h: Array) -> Array:
    """By how much less a force changes a velocity over a step than its impulse would, for damping.

    A velocity that stands does so exactly or jumps: nothing may be lost between the two.
    """
    none = jnp.zeros_like(plant.ports(x.q))
    slope = jax.jacfwd(lambda v: acceleration(plant, State(x.q, v, x.own), u, t, none))(x.qd)
    return phi(h * jnp.diagonal(slope))[1]


def _port_speed(plant: Plant, x: State, slides: tuple[int, ...]) -> Array:
    """Velocities of some ports."""
    return picked(port_motion(plant, x.q, x.qd, jnp.zeros_like(x.q))[1], slides)


def _mobility(plant: Plant, mass: Array, q: Array, slides: tuple[int, ...]) -> Array:
    """Acceleration of some ports per unit force on each; the diagonal where that is all there is."""
    if mass.ndim == 1 and max(slides) < q.size:
        return picked(1.0 / mass, slides)
    jacobian = jax.jacfwd(lambda q: picked(plant.ports(q), slides))(q)
    columns = jax.vmap(lambda row: solved(mass, row))(jacobian)
    return jacobian @ columns.T


def _own_reaction(
    own: Array,
    speed: Array,
    before: Array,
    dry: Array,
    hold: Array,
    rising: Array | None = None,
    rising_at_rest: Array | None = None,
    corner: Array | float = 0.0,
) -> _Answer:
    """Mean reaction over a step of ports that do not push each other.

    Args:
        own: Change of velocity over the step per unit reaction.
        speed: At the step's end without reaction.
        before: At its start.
        dry, hold: Levels, sliding and at rest.
        rising, rising_at_rest: What comes on top while speed grows, forwards and backwards, (2, ports). It
            takes up what would speed a port up, as far as it goes: where it is not all used, the
            velocity stands.
        corner: Over what part of that its two corners are rounded.
    """
    starts = before == 0.0
    drag = jnp.sign(jnp.where(starts, speed, before)) * dry
    slid = speed - own * drag
    turns = before * slid < 0.0
    part = jnp.where(turns, before / jnp.where(turns, before - slid, 1.0), 1.0)
    if rising is not None:
        hold = hold + jnp.where(speed > before, rising_at_rest[0], rising_at_rest[1])
    stuck = (starts | turns) & (jnp.abs(speed - before) <= own * hold)
    stands, reaction = starts & stuck, (1.0 - 2.0 * part) * drag
    if rising is not None:
        # After a turn a port speeds up for the rest of the step, the other way.
        way = jnp.where(turns, -1.0, 1.0) * jnp.sign(jnp.where(starts, speed, before))
        left = way * (speed - before) / own - dry
        most = jnp.where(way > 0, rising[0], rising[1])
        more = ramp(left, most, corner * most)
        reaction = reaction - way * jnp.where(turns, 1.0 - part, 1.0) * more
        # Twenty widths from a corner nothing is left of its rounding.
        edge = 20.0 * corner * most
        stands = stands | (~turns & (left > edge) & (left < most - edge))
    return _Answer(jnp.where(stuck, -speed / own, reaction), stuck, stands, part)


def _turned(x: State, end: State, found: _Answer, h: Array, slides: tuple[int, ...]) -> State:
    """The end of a step with the motion of joints that came to rest within it, or kept their velocity."""
    joints = [k for k, i in enumerate(slides) if i < x.qd.size]
    if not joints:
        return end
    size = max(*slides, x.qd.size - 1) + 1
    own = spread(found.part - 1.0, slides, size)[: x.qd.size] + 1.0
    # The reaction balances the mean force; damping within the step leaves a trace that would add up.
    keeps = spread(found.stands, slides, size).astype(bool)[: x.qd.size]
    q = jnp.where(keeps, x.q + h * x.qd, end.q - _overshot(x.qd, end.qd, own, h))
    return State(q, jnp.where(keeps, x.qd, end.qd), end.own)


def _overshot(before: Array, after: Array, part: Array, h: Array) -> Array:
    """By how much one line of velocity over a step misses the stroke of a joint that came to rest in it.

    Until then, and from then on, velocity runs in lines; one line over the whole step is off by half
    a step times the velocity of either end in the other part.
    """
    return jnp.where(part < 1.0, 0.5 * h * ((1.0 - part) * before + part * after), 0.0)


def _shared_reaction(mobility: Array, speed: Array, before: Array, dry: Array, hold: Array) -> _Answer:
    """Mean reaction over a step of ports that push each other: each answers what the others leave it.

    Its slope in the speed that is left lies between 0 and -1 over the port's own mobility, as that of a
    force clipped to a box does, so that the sweeps settle. Clipped to a box, a port that turns within the
    step would be dragged one way for all of it: of first order, 7e-6 rad of a robot's 0.6 at 1 kHz.

    Args:
        mobility: Change of velocities over the step per unit reaction.
        speed, before, dry, hold: As of `_own_reaction`.
    """
    n = speed.size
    own = jnp.diagonal(mobility)

    def sweep(_: Array, at: _Answer) -> _Answer:
        for i in range(n):
            left = speed[i] + jnp.sum(mobility[i] * at.reaction) - own[i] * at.reaction[i]
            one = _own_reaction(own[i], left, before[i], dry[i], hold[i])
            at = _Answer(*(whole.at[i].set(entry) for whole, entry in zip(at, one, strict=True)))
        return at

    no = jnp.zeros(n, bool)
    # A loop, not twenty copies: those of six joints, differentiated, took a minute and a half to compile.
    return jax.lax.fori_loop(0, _SWEEPS, sweep, _Answer(jnp.zeros(n), no, no, jnp.ones(n)))


def _rest_exactly(x: State, stuck: Array, slides: tuple[int, ...]) -> State:
    """Take the rounding off the velocity of joints that stick."""
    joints = [k for k, i in enumerate(slides) if i < x.qd.size]
    if len(joints) == x.qd.size:
        stuck = picked(stuck, tuple(joints))
    else:
        held = {slides[k]: stuck[k] for k in joints}
        stuck = jnp.stack([held.get(i, jnp.zeros((), bool)) for i in range(x.qd.size)])
    return State(x.q, jnp.where(stuck, 0.0, x.qd), x.own)
