"""The command of a control law along logged readings, without a plant."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.controllers import Controller, Tick
from jaxid.numerics.kept import kept_jit


@kept_jit
def commands(
    controller: Controller,
    driven: tuple[int, ...],
    position: Array,
    reference: Array,
    disturbance: Array,
    velocity: Array | None = None,
    own: Array | None = None,
) -> Array:
    """Run a controller's law over logged readings, (ticks, m).

    Args:
        controller: The law.
        driven: Driven joints, 0-based, in the order of the drives.
        position: Readings of all joints at every tick, (ticks, n).
        reference: Reference of the driven joints, (ticks, m).
        disturbance: Signal that is added to the command, (ticks, m).
        velocity: Velocity of all joints at the first tick, (n,); None: at rest.
        own: Velocity of all joints at every tick that the drive measures itself, (ticks, n); None: the law
            differences positions.
    """

    def tick(memory: tuple, now: tuple) -> tuple[tuple, Array]:
        position, path, disturbance, speed = now
        u, memory = controller.command(Tick(position, path, driven, velocity=speed), memory, disturbance)
        return memory, u

    path = controller.path(reference)
    first = Tick(position[0], jax.tree.map(lambda x: x[0], path), driven)
    start = controller.start(first, jnp.zeros_like(position[0]) if velocity is None else velocity)
    return jax.lax.scan(tick, start, (position, path, disturbance, own))[1]
