"""Sampled laws of position and velocity: cascade PD, PD, PD with friction compensation, PID."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.controllers.base import Controller, Path, Tick


class CascadePD(Controller):
    """u = kv (kp (reference - q) - dq): a position loop around a velocity loop."""

    kp: Array
    kv: Array

    def law(self, tick: Tick, velocity: Array, memory: None, disturbance: Array) -> tuple:
        error = self.error(tick)
        return self.kv * (self.kp * error - tick.at_drives(velocity)), None


class PD(Controller):
    """u = kp (reference - q) + kd (d reference - dq), the reference differenced backwards.

    With derivative = "velocity" the reference is not differenced: u = kp (reference - q) - kd dq, as most
    servos of robots have it. `CascadePD` is that law with kv = kd and kp / kd in place of kp.
    """

    kp: Array
    kd: Array
    derivative: str = eqx.field(static=True, default="error", kw_only=True)

    def start_law(self, tick: Tick, velocity: Array, path: Path | None = None) -> Array:
        # A machine that moves already follows a reference that moves.
        return tick.reference - self.period * tick.at_drives(velocity)

    def law(self, tick: Tick, velocity: Array, memory: Array, disturbance: Array) -> tuple:
        slope = (tick.reference - memory) / self.period if self.derivative == "error" else 0.0
        error = self.error(tick)
        return self.kp * error + self.kd * (slope - tick.at_drives(velocity)), tick.reference


class FrictionCompensation(Controller):
    """u = kp (r - q) + kd (r' - dq) + inertia r'' + viscous dq + coulomb sign(dq).

    A PD law with a simple model of each drive fed forward: inertia from the reference, friction from the
    measured velocity. All in units of the command. Without kp and kd a joint moves as if without friction.

    Source:
        "PA-10 traineeship", (5.6), (5.13) and (5.14).
    """

    kp: Array
    kd: Array
    coulomb: Array = eqx.field(default=0.0, kw_only=True)
    viscous: Array = eqx.field(default=0.0, kw_only=True)
    inertia: Array = eqx.field(default=0.0, kw_only=True)

    anticipates = True

    def law(self, tick: Tick, velocity: Array, memory: None, disturbance: Array) -> tuple:
        v, reference = tick.at_drives(velocity), tick.path.reference
        slope, curvature = tick.path.derivatives
        fed = self.inertia * curvature + self.viscous * v + self.coulomb * jnp.sign(v)
        return self.kp * (reference - tick.position) + self.kd * (slope - v) + fed, None


class PID(Controller):
    """u = kp e + ki sum(e) period + kd de, de low-passed with time constant `derivative_filter`.

    With `anti_windup` the integral is held while the command is at its limit and the error
    would drive it further out. It starts at `integral`, which a log that begins in motion gives.
    """

    of_machine = ("integral",)

    kp: Array
    ki: Array
    kd: Array
    derivative_filter: Array = eqx.field(default=0.0, kw_only=True)
    anti_windup: bool = eqx.field(static=True, default=False, kw_only=True)
    integral: Array = eqx.field(default=0.0, kw_only=True)

    def start_law(self, tick: Tick, velocity: Array, path: Path | None = None) -> tuple:
        none = jnp.zeros_like(tick.reference)
        return tick.reference - self.period * tick.at_drives(velocity), none + self.integral, none

    def law(self, tick: Tick, velocity: Array, memory: Any, disturbance: Array) -> tuple:
        last, integral, slope = memory
        error = self.error(tick)
        raw = (tick.reference - last) / self.period - tick.at_drives(velocity)
        # Backward Euler, so that a filter faster than the sampling only passes the difference.
        slope = slope + (raw - slope) * self.period / (self.period + self.derivative_filter)
        grown = integral + error * self.period
        u = self.kp * error + self.ki * grown + self.kd * slope
        if self.anti_windup and self.limit is not None:
            outward = (jnp.abs(u + disturbance) > self.limit) & (error * u > 0)
            grown = jnp.where(outward, integral, grown)
            u = self.kp * error + self.ki * grown + self.kd * slope
        return u, (tick.reference, grown, slope)
