"""The step under set-valued friction, in which a joint sticks exactly and friction reverses with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.dynamics.rhs import (
    State,
    acceleration,
    balance_of,
    inverse,
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
from jaxid.numerics.lanes import accelerator
from jaxid.numerics.smooth import ramp
from jaxid.numerics.tangents import varying

T = TypeVar("T")

# Gauss-Seidel sweeps; chosen: 20 converge to rounding on six joints.
_SWEEPS = 20


def set_valued_step(
    plant: Plant,
    x: State,
    u: Callable[[Array], Array],
    t: Array,
    h: Array,
    flow: Callable[..., State] | None = None,
) -> tuple[State, Array]:
    """Advance one step under set-valued friction: flow without it, then the reaction that stops or drags.

    A port slides under the level of dry friction halfway, in motion and time. If it comes to rest within the
    step it stays if the break-away level holds it, and otherwise moves back for the rest of the step: the
    reaction is then the mean of both parts, and the position that of two parabolas, of second order in the
    step.
    Ports that are coupled through the mass matrix share their reactions by Gauss-Seidel sweeps, each
    computed with the current reactions of the others.

    Args:
        plant, x, u, t, h: Arguments of `jaxid.dynamics.rhs.step`.
        flow: The step as a function of state and reaction (omitted: zero), if there is a cheaper one.

    Returns:
        The state a step later, and the reaction of every port over the step.

    Raises:
        InputError: If friction depends on the acceleration and ports accelerate each other.
    """
    none, standing = jnp.zeros(plant.ports(x.q).size), jnp.zeros_like(x.q)
    if flow is None:
        flow = lambda x, reaction=none: step(plant, x, u, t, h, reaction)
    end = u(jnp.asarray(1.0))

    def at(q: Array, qd: Array, qdd: Array = standing) -> Balance:
        return balance_of(plant, q, qd, qdd, end, t + 0.5 * h, x.own, none)

    def action(free: State) -> _Answer:
        """Return the action of friction over the step, given the step without it."""
        # A mass that depends on the position is evaluated halfway, like everything else.
        halfway = 0.5 * (x.q + free.q) if plant.coupled else x.q, 0.5 * (x.qd + free.qd)

        def residual(qdd: Array) -> tuple[Array, Balance]:
            levels = at(*halfway, qdd)
            return levels.residual, levels

        # The mass does not depend on the velocity: one balance gives it and the levels.
        mass, levels = mass_of(plant, residual, halfway[0])
        at_rest = at(halfway[0], standing) if moves else levels
        yielding = mass
        if plant.coupled and x.qd.size > 1:
            # Because of damping, a force changes a velocity over a step by less than its impulse: a joint at
            # rest would otherwise pull at the others by a force with an error of first order in the step.
            yielding = mass + 0.5 * h * jax.jacfwd(lambda qd: at(halfway[0], qd).residual)(halfway[1])
        slides = _sliding(plant, x, free, yielding, levels, end, t, h)
        answer = slides.answer(levels, at_rest)
        if moves:
            # Without friction motion begins too fast, and friction that falls with speed is too small.
            reaction = spread(answer.reaction, ports, none.size)
            slowed = free.qd + h * solved(mass, jax.vjp(plant.ports, x.q)[1](reaction)[0])
            answer = slides.answer(at(halfway[0], 0.5 * (x.qd + slowed)), at_rest)
        return answer

    def under(answer: _Answer, end_of_step: State, reaction: Array) -> tuple[State, Array]:
        at_rest = _rest_exactly(end_of_step, answer.stuck, ports)
        return _turned(x, at_rest, answer, h, ports), reaction

    here = at(x.q, x.qd)
    ports = here.slides
    if not ports:
        return flow(x), none
    levels_at = lambda *motion: [getattr(at(*motion), n) for n in ("dry", "stick", "rising")]
    moves = depends(lambda qd: levels_at(x.q, qd), (x.qd,))

    def direct() -> tuple[State, Array]:
        answer = action(flow(x))
        reaction = spread(answer.reaction, ports, none.size)
        return under(answer, flow(x, reaction), reaction)

    if here.rises or depends(levels_at, (x.q, x.qd)):
        return direct()

    # Nearly all steps only drag. No level depends on the motion, so that the step under this reaction can be
    # taken first; the other steps, and their derivatives, belong to a branch that few samples take.
    before = _port_speed(plant, x, ports)
    drag = spread(-jnp.sign(before) * picked(here.dry, ports), ports, none.size)

    def goes_on(dragged: State) -> Array:
        """Check that no port nears its reversal, which the general case decides on."""
        after = _port_speed(plant, dragged, ports)
        return jnp.all((before * after > 0.0) & (jnp.abs(after - before) <= jnp.abs(after)))

    if not plant.coupled:
        dragged = flow(x, drag)
        return _unless(goes_on(dragged), (dragged, drag), direct)

    def once(trial: _Trial, k: Array) -> tuple[_Trial, None]:
        def tried() -> _Trial:
            after = flow(x, trial.reaction)
            drags = (k == 0) & goes_on(after)
            answer = _only_if(k == 1, lambda: action(after), trial.answer)
            without = jnp.where(drags, drag, none)
            reaction = jnp.where(k == 0, without, spread(answer.reaction, ports, none.size))
            new = _Trial(trial.done | drags, after, reaction, answer)
            return jax.tree.map(lambda old, new: jnp.where(trial.done, old, new), trial, new)

        return _only_if(~_in_all_lanes(trial.done), tried, trial), None

    # The step that drags, that without friction and that under the answer as a loop: three copies of an arm
    # compile three times as long.
    zeros = varying(jnp.zeros(len(ports)), x.qd)
    no = jnp.zeros(len(ports), bool)
    first = _Trial(jnp.zeros((), bool), x, varying(drag, x.qd), _Answer(zeros, no, no, 1.0 + zeros))
    last, _ = jax.lax.scan(once, first, jnp.arange(3))
    return under(last.answer, last.after, last.reaction)


class _Trial(NamedTuple):
    """A step under a reaction of dry friction.

    Args:
        done: Whether that is the reaction of the step.
        after: The state after the step.
        reaction: The reaction of the next step to try; once done, of this one.
        answer: Action of friction over the step; without an effect if it only drags.
    """

    done: Array
    after: State
    reaction: Array
    answer: _Answer


def _unless(done: Array, answer: tuple[State, Array], general: Callable[[], tuple]) -> tuple[State, Array]:
    """Return the answer if it is done, else the general one; a batch leaves that out if all are done."""

    def otherwise() -> tuple[State, Array]:
        return jax.tree.map(lambda a, b: jnp.where(done, a, b), answer, general())

    return _only_if(~_in_all_lanes(done), otherwise, answer)


def _only_if(flag: Array, function: Callable[[], T], otherwise: T) -> T:
    """Return the result of a function if a flag is set, else another value, without the function."""
    if accelerator():  # it would wait for the host to choose a branch
        return jax.tree.map(lambda a, b: jnp.where(flag, a, b), function(), otherwise)
    return jax.lax.cond(flag, function, lambda: otherwise)


@jax.custom_batching.custom_vmap
def _in_all_lanes(flag: Array) -> Array:
    """Return a flag; of a batch, whether it is set in all lanes, so that a branch stays one under `vmap`."""
    return flag


@_in_all_lanes.def_vmap
def _in_all_lanes_of_batch(_: int, batched: list[bool], flag: Array) -> tuple[Array, bool]:
    return jnp.all(flag, axis=0) if batched[0] else flag, False


class _Answer(NamedTuple):
    """The action of dry friction over a step, an entry for each sliding port.

    Args:
        reaction: Mean reaction [N or N m].
        stuck: Whether the port rests at the end of the step.
        stands: Whether its velocity does not change at all.
        part: Fraction of the step before the port comes to rest; one if it does not.
    """

    reaction: jax.Array
    stuck: jax.Array
    stands: jax.Array
    part: jax.Array


@dataclass(frozen=True)
class _Sliding:
    """The ports on which friction slides, and their motion over a step without it.

    Args:
        ports: Indices of the ports among all ports.
        before: Velocity at the start of the step, (ports,).
        speed: Velocity at its end, (ports,).
        mobility: Change of that per unit reaction, (ports, ports), if ports accelerate each other.
        own: Change of a port's velocity by its reaction alone, (ports,).
        corner: Fraction of its level over which the corners of rising friction are rounded.
    """

    ports: tuple[int, ...]
    before: Array
    speed: Array
    mobility: Array | None
    own: Array
    corner: Array

    def answer(self, levels: Balance, at_rest: Balance) -> _Answer:
        """Compute the action of friction at given levels, sliding and at rest."""
        dry = picked(levels.dry, self.ports)
        held = picked(at_rest.dry, self.ports) + picked(at_rest.stick, self.ports)
        if levels.rises:
            rising, resting = (
                jnp.stack([picked(r, self.ports) for r in b.rising]) for b in (levels, at_rest)
            )
            return _own_reaction(self.own, self.speed, self.before, dry, held, rising, resting, self.corner)
        drag = -jnp.sign(self.before) * dry
        if self.mobility is None:
            after = self.speed + self.own * drag
            general = lambda: _own_reaction(self.own, self.speed, self.before, dry, held)
        else:
            after = self.speed + jnp.sum(self.mobility * drag, axis=1)
            shared = (self.mobility, self.speed, self.before, dry, held)
            general = lambda: _shared_reaction(*shared)

        no = jnp.zeros(drag.shape, bool)
        # Nearly all steps only drag. A branch in place of a selection: the general case costs more.
        return jax.lax.cond(
            jnp.all(self.before * after > 0.0), lambda: _Answer(drag, no, no, jnp.ones_like(drag)), general
        )


def _sliding(
    plant: Plant, x: State, free: State, mass: Array, levels: Balance, u: Array, t: Array, h: Array
) -> _Sliding:
    """Collect the ports that slide over a step h from x to `free`, under the force u."""
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
    """Return the effect of a force on a velocity over a step, relative to its impulse without damping.

    A velocity either stands exactly or jumps: the two cases must meet without a gap.
    """
    none = jnp.zeros_like(plant.ports(x.q))
    slope = jax.jacfwd(lambda v: acceleration(plant, State(x.q, v, x.own), u, t, none))(x.qd)
    return phi(h * jnp.diagonal(slope))[1]


def _port_speed(plant: Plant, x: State, slides: tuple[int, ...]) -> Array:
    """Return the velocities of some ports."""
    return picked(port_motion(plant, x.q, x.qd, jnp.zeros_like(x.q))[1], slides)


def _mobility(plant: Plant, mass: Array, q: Array, slides: tuple[int, ...]) -> Array:
    """Return the acceleration of some ports per unit force on each; only the diagonal if the rest is zero."""
    if mass.ndim == 1 and max(slides) < q.size:
        return picked(1.0 / mass, slides)
    jacobian = jax.jacfwd(lambda q: picked(plant.ports(q), slides))(q)
    if mass.ndim == 1 or len(mass) == 1:
        columns = jax.vmap(lambda row: solved(mass, row))(jacobian)
    else:
        columns = jnp.sum(jacobian[:, :, None] * inverse(mass).T, axis=1)
    # Sums of products: a call to a matrix library would defeat the loop flag.
    return jnp.sum(jacobian[:, None] * columns, axis=2)


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
    """Compute the mean reaction over a step of ports that do not accelerate each other.

    Args:
        own: Change of velocity over the step per unit reaction.
        speed: Velocity at the end of the step without reaction.
        before: Velocity at its start.
        dry, hold: Levels, sliding and at rest.
        rising, rising_at_rest: Additional levels while speed grows, forwards and backwards, (2, ports). They
            balance an accelerating force up to their size: if they are not exceeded, the velocity stands.
        corner: Fraction of these over which their two corners are rounded.
    """
    starts = before == 0.0
    drag = jnp.sign(jnp.where(starts, speed, before)) * dry
    slid = speed - own * drag
    turns = before * slid < 0.0
    part = jnp.where(turns, before / jnp.where(turns, before - slid, 1.0), 1.0)
    if rising is not None:
        assert rising_at_rest is not None, "given with rising"
        hold = hold + jnp.where(speed > before, rising_at_rest[0], rising_at_rest[1])
    stuck = (starts | turns) & (jnp.abs(speed - before) <= own * hold)
    stands, reaction = starts & stuck, (1.0 - 2.0 * part) * drag
    if rising is not None:
        # After a turn a port speeds up for the rest of the step in the other direction.
        direction = jnp.where(turns, -1.0, 1.0) * jnp.sign(jnp.where(starts, speed, before))
        remaining = direction * (speed - before) / own - dry
        most = jnp.where(direction > 0, rising[0], rising[1])
        more = ramp(remaining, most, corner * most)
        reaction = reaction - direction * jnp.where(turns, 1.0 - part, 1.0) * more
        # Twenty widths from a corner its rounding has vanished.
        edge = 20.0 * corner * most
        stands = stands | (~turns & (remaining > edge) & (remaining < most - edge))
    return _Answer(jnp.where(stuck, -speed / own, reaction), stuck, stands, part)


def _turned(x: State, end: State, answer: _Answer, h: Array, slides: tuple[int, ...]) -> State:
    """Correct the end of a step for joints that came to rest within it, or kept their velocity."""
    joints = [k for k, i in enumerate(slides) if i < x.qd.size]
    if not joints:
        return end
    size = max(*slides, x.qd.size - 1) + 1
    part = spread(answer.part - 1.0, slides, size)[: x.qd.size] + 1.0
    # The reaction balances the mean force; an error by damping within the step would add up.
    keeps = spread(answer.stands, slides, size).astype(bool)[: x.qd.size]
    q = jnp.where(keeps, x.q + h * x.qd, end.q - _overshot(x.qd, end.qd, part, h))
    return State(q, jnp.where(keeps, x.qd, end.qd), end.own)


def _overshot(before: Array, after: Array, part: Array, h: Array) -> Array:
    """Return the error of position if one line of velocity spans a step in which a joint came to rest.

    Before and after that instant velocity is a line; a single line over the whole step is off by half
    a step times the velocity of either end in the other part.
    """
    return jnp.where(part < 1.0, 0.5 * h * ((1.0 - part) * before + part * after), 0.0)


def _shared_reaction(mobility: Array, speed: Array, before: Array, dry: Array, hold: Array) -> _Answer:
    """Compute the mean reaction over a step of ports that accelerate each other, one after the other.

    The slope of a reaction in the remaining speed lies between 0 and -1 over the port's mobility, as for a
    force clipped to a box, so that the sweeps converge. Clipped to a box, a port that turns within the step
    would be dragged in one direction for all of it: an error of first order, 7e-6 rad of a robot's 0.6 at
    1 kHz.

    Args:
        mobility: Change of velocities over the step per unit reaction.
        speed, before, dry, hold: Arguments of `_own_reaction`.
    """
    n = speed.size
    own = jnp.diagonal(mobility)

    def one(at: _Answer, i: Array) -> tuple[_Answer, None]:
        remaining = speed[i] + jnp.sum(mobility[i] * at.reaction) - own[i] * at.reaction[i]
        entries = _own_reaction(own[i], remaining, before[i], dry[i], hold[i])
        return _Answer(*(a.at[i].set(entry) for a, entry in zip(at, entries, strict=True))), None

    no, zeros = jnp.zeros(n, bool), varying(jnp.zeros(n), speed)
    start = _Answer(zeros, no, no, 1.0 + zeros)
    # A loop, not a copy for each port and sweep: those of six joints took a minute and a half to compile.
    return jax.lax.scan(one, start, jnp.tile(jnp.arange(n), _SWEEPS))[0]


def _rest_exactly(x: State, stuck: Array, slides: tuple[int, ...]) -> State:
    """Set the velocity of joints that stick to exactly zero."""
    joints = [k for k, i in enumerate(slides) if i < x.qd.size]
    if len(joints) == x.qd.size:
        stuck = picked(stuck, tuple(joints))
    else:
        held = {slides[k]: stuck[k] for k in joints}
        stuck = jnp.stack([held.get(i, jnp.zeros((), bool)) for i in range(x.qd.size)])
    return State(x.q, jnp.where(stuck, 0.0, x.qd), x.own)
