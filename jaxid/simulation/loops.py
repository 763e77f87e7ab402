"""Simulation of a plant in open or closed loop by a scan over samples, or with diffrax.

The scan over the samples is for sampled loops and fits; between samples it takes fixed steps or a
solver of diffrax. `with_diffrax` takes a force that is any function of time, with the same right-hand
side. The hold of a command is applied outside the integration step, because a continuous controller is
a different model from a sampled one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers import Controller, Tick, with_effects
from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.rhs import State, acceleration, affine_flow, hold_polynomial, step, vector_field
from jaxid.model.plant import Plant
from jaxid.numerics.delays import shifted, shifted_hold
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.solvers import RELATIVE, AdaptiveStep

if TYPE_CHECKING:
    import diffrax

# Largest product of step and fastest decay for which the fourth-order step keeps both trajectory
# and gradient (it becomes unstable at 2.78; beyond 1 the gradient error exceeds 1 %).
_LARGEST_STEP = 1.0
# Shortest part of a sample before or after the change of a delayed command.
_SHORTEST = 1e-6


class Trajectory(eqx.Module):
    """Trajectory of a simulation, one row per sample.

    Args:
        position: Simulated position, (time, n) [m or rad].
        velocity: Simulated velocity, (time, n) [m/s or rad/s].
        command: Logged command, (time, m), before the declared gain.
        reading: Position as the sensor reports it, (time, n).
        found: Estimates of a law that identifies, see `Controller.learned`; None for other laws.
        links: Position and velocity of links behind springs, (time, n) each; None: there are none, or the run
            is no loop.
    """

    position: Float[Array, "time n"]
    velocity: Float[Array, "time n"]
    command: Float[Array, "time m"]
    reading: Float[Array, "time n"]
    found: Any = None
    links: tuple[Array, Array] | None = None


class Drive(eqx.Module):
    """The drive between command and force: declared gain, hold, delay and integration steps.

    Args:
        gain: Declared force per unit of command, (m,).
        period: Time between samples of the command [s].
        hold: Course of the command between samples: "zero_order", "linear" or "band_limited".
        substeps: Integration steps per sample.
        set_valued: Whether dry friction sticks exactly (replay) or is smoothed (gradients).
        longest_delay: Samples of past command kept for delays in a closed loop.
        solver: Solver that replaces the fixed steps; dry friction is then smoothed. None: fixed steps.
    """

    gain: Array
    period: float = eqx.field(static=True)
    hold: str = eqx.field(static=True, default="zero_order")
    substeps: int = eqx.field(static=True, default=1)
    set_valued: bool = eqx.field(static=True, default=False)
    longest_delay: int = eqx.field(static=True, default=0)
    solver: AdaptiveStep | None = None

    def stepper(
        self, plant: Plant, x: State, ends: tuple[Array, ...]
    ) -> Callable[[State, tuple[Array, ...], Array], State]:
        """Return a function that advances a state by one sample, given the force at its ends, and the time.

        Call it outside the loop over the samples: if the plant's forces are affine, its flow is one matrix,
        which is computed here once.

        Args:
            plant: The plant to simulate.
            x, ends: A state and the force at the ends of a sample, for their shapes; a held force
                is given once.
        """
        if self.solver is not None:
            whole, solver = jnp.asarray(self.period), self.solver
            return lambda x, ends, t: solver(plant, x, ends, t, whole)
        plant = plant.prepared()
        if len(ends) == 1 or not self.switches(plant):
            return self._fixed_steps(plant, x, ends, jnp.asarray(self.period))

        shift = plant.command_delays(1)[0] / self.period
        older = shift - jnp.floor(shift)
        # Neither part is empty, for the derivatives; the value is moved, and its slope is not.
        older = older + jax.lax.stop_gradient(jnp.clip(older, _SHORTEST, 1.0 - _SHORTEST) - older)
        lengths = (self.period * older, self.period * (1.0 - older))
        parts = [self._fixed_steps(plant, x, ends[:1], length) for length in lengths]

        def both(x: State, ends: tuple[Array, ...], t: Array) -> State:
            return parts[1](parts[0](x, ends[:1], t), ends[1:], t + lengths[0])

        return both

    def switches(self, plant: Plant) -> bool:
        """Check that the delayed command changes within the samples, at one instant.

        Dry friction turns where the force does: a line in place of the two values would turn it at another
        instant. Several drives may each change at their own, and take the line.
        """
        exact = self.set_valued and self.solver is None and self.gain.size == 1
        return exact and self.hold == "zero_order" and not stays_held(plant, self)

    def _fixed_steps(
        self, plant: Plant, x: State, ends: tuple[Array, ...], length: Array
    ) -> Callable[[State, tuple[Array, ...], Array], State]:
        """Return the advance of a state by a time [s], in `substeps` steps; see `stepper`."""
        h = length / self.substeps
        flow = affine_flow(plant, x, ends, jnp.zeros(()), h) if self.set_valued else None

        def one(x: State, ends: tuple[Array, ...], t: Array) -> State:
            if not self.set_valued:
                return step(plant, x, hold_polynomial(ends), t, h)
            if flow is None:
                return set_valued_step(plant, x, hold_polynomial(ends), t, h)[0]
            whole_step = flow
            bound = lambda x, *reaction: whole_step(x, ends, *reaction)
            return set_valued_step(plant, x, hold_polynomial(ends), t, h, bound)[0]

        def several(x: State, ends: tuple[Array, ...], t: Array) -> State:
            def inner(x: State, k: Array) -> tuple[State, None]:
                part = [hold_polynomial(ends)((k + i) / self.substeps) for i in range(len(ends))]
                return one(x, tuple(part), t + k * h), None

            return jax.lax.scan(inner, x, jnp.arange(self.substeps, dtype=jnp.float64))[0]

        return one if self.substeps == 1 else several


def open_loop(
    plant: Plant,
    drive: Drive,
    command: Float[Array, "time m"],
    position: Float[Array, " n"],
    velocity: Float[Array, " n"],
    sensor: Sensor | None = None,
    reset: tuple[Array, Array, Array] | None = None,
    start: Array | float = 0.0,
    own: tuple | None = None,
    past: Float[Array, "earlier m"] | None = None,
) -> Trajectory:
    """Simulate a plant under a logged command.

    Args:
        plant: The plant to simulate.
        drive: Gain, hold and integration of the command.
        command: Logged command, (time, m).
        position, velocity: State at the first sample, (n,) each.
        sensor: Sensor of the position; None: exact readings.
        reset: Samples at which a segment starts (time,) bool, and the positions and velocities
            to restart from, (time, n); for multiple shooting.
        start: Time of the first sample, from the start of the log [s].
        own: Internal states of the effects at the first sample; None: the steady states at its force.
        past: Logged command before the first sample, which a delay needs, (earlier, m); None: equal to
            the first sample.
    """
    earlier = 0 if past is None else past.shape[0]
    known = command if past is None else jnp.concatenate([past, command])
    before, after = (f[earlier:] for f in interval_forces(plant, drive, known))
    times = start + drive.period * jnp.arange(command.shape[0])
    x0 = State(position, velocity, plant.resting_states(position, before[0]) if own is None else own)
    held = stays_held(plant, drive)
    advance = drive.stepper(plant, x0, (before[0],) if held else (before[0], after[0]))
    n = command.shape[0]
    flag, q_new, v_new = (
        (jnp.zeros(n, bool), jnp.zeros((n, 1)), jnp.zeros((n, 1))) if reset is None else reset
    )

    def tick(x: State, now: tuple) -> tuple[State, tuple]:
        u0, u1, t, restart, q, v = now
        if reset is not None:
            x = State(jnp.where(restart, q, x.q), jnp.where(restart, v, x.qd), x.own)
        return advance(x, (u0,) if held else (u0, u1), t), (x.q, x.qd)

    _, (q, v) = jax.lax.scan(tick, x0, (before, after, times, flag, q_new, v_new))
    reading = q if sensor is None else sensor.read(q)
    return Trajectory(q, v, command, reading)


def interval_forces(plant: Plant, drive: Drive, command: Float[Array, "time m"]) -> tuple[Array, Array]:
    """Return the declared force at the start and the end of every interval, delay applied.

    In an interval with a change of a held command, a line has the same mean and first moment, see
    `shifted_hold`; or the values before and after the change are returned, see `Drive.switches`.
    """
    force = drive.gain * command
    shift = plant.command_delays(force.shape[1]) / drive.period
    if drive.switches(plant):
        older, newer = (shifted(force, jnp.floor(shift) + k) for k in (1, 0))
        return older, newer
    if stays_held(plant, drive):
        start = shifted(force, shift)
        return start, start
    if drive.hold == "zero_order":
        return shifted_hold(force, shift)
    return shifted(force, shift), shifted(force, shift, ahead=1)


def stays_held(plant: Plant, drive: Drive) -> bool:
    """Check that the force is constant between two samples: its command is held, and nothing delays it."""
    return drive.hold == "zero_order" and not any(e.delays_command() for e in plant.effects)


def closed_loop(
    plant: Plant,
    drive: Drive,
    controller: Controller,
    reference: Float[Array, "ticks m"],
    disturbance: Float[Array, "ticks m"],
    position: Float[Array, " n"],
    velocity: Float[Array, " n"],
    sensor: Sensor | None = None,
    noise: Float[Array, "ticks n"] | None = None,
    load: Float[Array, "ticks m"] | None = None,
) -> Trajectory:
    """Simulate a plant in its sampled loop.

    Args:
        plant: The plant to simulate.
        drive: Gain, hold and integration of the command; `drive.period` is the controller's.
        controller: The sampled control law.
        reference: Reference of the driven joints at every tick, (ticks, m).
        disturbance: Disturbance added to the command at every tick before its limit, (ticks, m or 1).
        position, velocity: State at the first tick, (n,) each.
        sensor: Sensor that the controller reads; None: exact readings.
        noise: Standard normal numbers for the noise of the positions and, if there are more
            columns, of the measured commands and the inertial sensors; None: no noise.
        load: What the plant takes behind the forces of its drives, held over each tick, see
            `jaxid.plants.loaded_axis`; None: nothing.

    Returns:
        The trajectory, one row per tick.
    """
    sensor, n = Sensor() if sensor is None else sensor, position.size
    driven = plant.driven(position.size)
    controller = with_effects(controller, plant, drive.gain.size)
    path = controller.path(reference)
    first = jax.tree.map(lambda x: x[0], path)
    memory = controller.start(Tick(position, first, driven), velocity, path)
    times = drive.period * jnp.arange(reference.shape[0])
    own = velocity if controller.own_velocity else None
    tick0 = Tick(sensor.read(position), first, driven, velocity=own)
    held = drive.gain * controller.command(tick0, memory, disturbance[0])[0]
    past = jnp.broadcast_to(held, (drive.longest_delay + 1, held.size))
    on_plant = held if load is None else jnp.concatenate([held, load[0]])
    x0 = State(position, velocity, plant.resting_states(position, on_plant))
    advance = drive.stepper(plant, x0, (on_plant,) * (1 if drive.longest_delay == 0 else 2))

    inertial, m = sensor.inertial, drive.gain.size

    def sensed(x: State, reading: Array, moved: tuple, noise: Array | None, renews: Array) -> tuple:
        """Return velocity and acceleration by inertial sensors, whether they are new, and the memory."""
        assert inertial is not None, "asked only with inertial sensors"
        before, v, a = moved
        mean = (x.qd - before) / drive.period
        raw = inertial.read(plant, x.q, x.qd, mean, noise)
        new_v, new_a, sound = inertial.fused(plant, reading, raw, v, a)
        v, a = jnp.where(renews, new_v, v), jnp.where(renews, new_a, a)
        return (v, a if inertial.accelerates else None, renews & sound), (x.qd, v, a)

    def tick(carry: tuple, now: tuple) -> tuple[tuple, tuple]:
        x, memory, past, last, held, moved = carry
        path, disturbance, noise, t, fresh, renews, beside = now
        reading = sensor.read(x.q, None if noise is None else noise[:n])
        if fresh is not None:
            reading = held = jnp.where(fresh, reading, held)
        v, a, renewed = x.qd if controller.own_velocity else None, None, True
        if inertial is not None:
            more = None if noise is None or noise.shape[0] <= n + m else noise[n + m :]
            (v, a, renewed), moved = sensed(x, reading, moved, more, renews)
        seen = Tick(reading, path, driven, True if fresh is None else fresh, v, a, last, renewed)
        u, memory = controller.command(seen, memory, disturbance)
        ends, past = _delayed_force(plant, drive, u, past)
        if beside is not None:
            ends = tuple(jnp.concatenate([force, beside]) for force in ends)
        new = advance(x, ends, t)
        if last is not None:
            assert noise is not None, "a command is measured only with noise"
            last = sensor.read_command(u, noise[n : n + m])
        links = plant.beyond_springs(x.q, x.qd, x.own)
        shown = (x.q, x.qd, u, reading, controller.learned(memory), links)
        return (new, memory, past, last, held, moved), shown

    fresh = None if sensor.hold == 1 else jnp.arange(len(times)) % sensor.hold == 0
    measures = noise is not None and noise.shape[1] > n and sensor.force_noise is not None
    last, held = held / drive.gain if measures else None, None if fresh is None else position
    moved = None if inertial is None else (velocity, velocity, jnp.zeros_like(velocity))
    renews = None if inertial is None else jnp.arange(len(times)) % inertial.hold == 0
    inputs = (path, disturbance, noise, times, fresh, renews, load)
    _, shown = jax.lax.scan(tick, (x0, memory, past, last, held, moved), inputs)
    return Trajectory(*shown)


def _delayed_force(plant: Plant, drive: Drive, u: Array, past: Array) -> tuple[tuple[Array, ...], Array]:
    """Return the declared force at the ends of the coming interval, and the updated memory of past ones.

    A force that is constant over the interval is given once; else see `interval_forces`.
    """
    force = drive.gain * u
    if drive.longest_delay == 0:
        return (force,), past
    past = jnp.concatenate([force[None], past[:-1]])
    shift = jnp.clip(plant.command_delays(u.size) / drive.period, 0.0, drive.longest_delay)
    if drive.switches(plant):
        whole = jnp.minimum(jnp.floor(shift), drive.longest_delay - 1.0)
        older, newer = (
            jnp.sum(jnp.where(jnp.arange(drive.longest_delay + 1)[:, None] == whole + k, past, 0.0), axis=0)
            for k in (1, 0)
        )
        return (older, newer), past
    # Hat weights over the last samples: linear interpolation without a data-dependent index.
    away = jnp.arange(drive.longest_delay + 1)[:, None] - shift
    hat = jnp.maximum(0.0, 1.0 - jnp.abs(away))
    mean = jnp.sum(hat * past, axis=0)
    lean = jnp.sum(-3.0 * away * hat * past, axis=0)
    return (mean - lean, mean + lean), past


def initial_state(
    plant: Plant,
    position: Float[Array, " n"],
    velocity: Float[Array, " n"] | None = None,
    force: Float[Array, " m"] | None = None,
) -> State:
    """Return the state of a plant at a motion, with the effects' internal states of a constant force.

    Args:
        plant: The plant whose state is built.
        position: Coordinates of the joints, (n,) [m or rad].
        velocity: Velocities of the joints, (n,) [m/s or rad/s]; None: at rest.
        force: Constant declared force that gives the internal states, (m,) [N or N m]; None: zero.
    """
    position = jnp.asarray(position, dtype=jnp.float64)
    velocity = jnp.zeros_like(position) if velocity is None else jnp.asarray(velocity, dtype=jnp.float64)
    drives = len(plant.driven(position.size))
    u = jnp.zeros(drives) if force is None else jnp.asarray(force, dtype=jnp.float64)
    return State(position, velocity, plant.resting_states(position, u))


def with_diffrax(
    plant: Plant,
    force: Callable[[Array], Array],
    times: Float[Array, " time"],
    position: Float[Array, " n"],
    velocity: Float[Array, " n"],
    *,
    solver: diffrax.AbstractSolver | None = None,
    controller: diffrax.AbstractStepSizeController | None = None,
    step_length: float | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = 1_000_000,
) -> tuple[Float[Array, "time n"], Float[Array, "time n"]]:
    """Simulate with any diffrax solver on the same right-hand side (smoothed friction).

    Args:
        plant: The plant to simulate.
        force: Declared force as a function of time, (m,).
        times: Times at which the motion is returned [s].
        position, velocity: State at times[0], (n,) each.
        solver: Solver of diffrax; by default Tsit5.
        controller: Step-size control; by default PID at 1e-8, or constant if `step_length` is given.
        step_length: Length of a fixed step [s].
        adjoint: Method by which diffrax differentiates; by default RecursiveCheckpointAdjoint.
        max_steps: Largest number of integration steps.

    Returns:
        Positions and velocities, (time, n).
    """
    import diffrax

    if controller is None:
        controller = (
            diffrax.ConstantStepSize()
            if step_length is not None
            else diffrax.PIDController(rtol=RELATIVE, atol=1e-10)
        )
    x0 = State(position, velocity, plant.resting_states(jnp.asarray(position), force(times[0])))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(vector_field),  # pyright: ignore[reportArgumentType]  # its times are arrays
        solver or diffrax.Tsit5(),
        times[0],
        times[-1],
        step_length,
        x0,
        args=(plant, force),
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=controller,
        adjoint=adjoint or diffrax.RecursiveCheckpointAdjoint(),
        max_steps=max_steps,
    )
    assert isinstance(solution.ys, State), "states are saved as they are"
    return solution.ys.q, solution.ys.qd


def needed_substeps(plant: Plant, drive: Drive, q: Array, v: Array, u: Array) -> int:
    """Return the integration steps per sample that the smoothed sign needs along a motion.

    The level times the step over (mass times width) must not exceed about one. With longer steps the
    trajectory is still plausible, but its gradient is wrong.

    Args:
        plant: The plant with its smoothed sign.
        drive: The drive; only its period is used.
        q, v, u: Motion and declared force at some samples, (time, n) and (time, m).
    """
    times = jnp.zeros(q.shape[0])

    def damping(q: Array, v: Array, u: Array, t: Array) -> Array:
        own = plant.initial_states(u)
        slope = jax.jacfwd(lambda v: acceleration(plant, State(q, v, own), u, t))(v)
        return jnp.abs(slope).max()

    # The velocity may also change its sign between two samples: then zero velocity is evaluated too.
    passes = v * jnp.concatenate([v[1:], v[-1:]]) < 0
    v = jnp.concatenate([v, jnp.where(passes, 0.0, v)])
    q, u, times = (jnp.concatenate([a, a]) for a in (q, u, times))
    worst = eqx.filter_jit(jax.vmap(damping))(q, v, u, times).max()
    return max(1, int(np.ceil(float(worst) * drive.period / _LARGEST_STEP)))
