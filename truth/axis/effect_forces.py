"""One row per registered effect: the parameters of a 100 kg slide, and the exact force in plain Python.

The forces are written out from the published formulas; no line is shared with the package. The stepper takes
effects under the same names and parameters.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

MASS = 100.0  # kg
GRAVITY = 9.81  # m/s^2
VISCOUS = ("viscous_friction", {"coefficient": 50.0})
COULOMB = ("coulomb_friction", {"level": 30.0})


class Instant(NamedTuple):
    """Motion, declared force, time and the effect's own state, SI."""

    q: float
    v: float
    a: float
    u: float
    t: float
    z: float | tuple[float, ...] = 0.0


@dataclass(frozen=True)
class Row:
    """Facts about one effect that tests need.

    Attributes:
        kind: Its registered name.
        values: Its parameters.
        load: Force at the load, drive and `beside` included, away from rest [N].
        beside: Effects without which it would do nothing, declared before it.
        own: Own state for the force test; None where it has none.
        dry: Whether it makes, or changes, set-valued friction.
        affine: Whether its force is affine in the acceleration.
    """

    kind: str
    values: Mapping[str, float]
    load: Callable[[Instant], float]
    beside: tuple = ()
    own: float | tuple[float, ...] | None = None
    dry: bool = False
    affine: bool = True
    effects: tuple = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, "effects", (*self.beside, (self.kind, self.values)))


def sign(v: float) -> float:
    return math.copysign(1.0, v)


def clip(u: float, limit: float) -> float:
    return max(-limit, min(limit, u))


ROWS: dict[str, Row] = {
    "viscous_friction": Row("viscous_friction", {"coefficient": 200.0}, lambda x: x.u - 200.0 * x.v),
    "back_emf_damping": Row("back_emf_damping", {"coefficient": 150.0}, lambda x: x.u - 150.0 * x.v),
    "coulomb_friction": Row(*COULOMB, lambda x: x.u - 30.0 * sign(x.v), dry=True),
    "coulomb_friction of mu": Row(
        "coulomb_friction",
        {"friction_coefficient": 0.04},
        lambda x: x.u - 0.04 * MASS * GRAVITY * sign(x.v),
        dry=True,
    ),
    "static_friction": Row(
        "static_friction",
        {"level": 40.0},
        lambda x: x.u - 30.0 * sign(x.v),
        beside=(COULOMB,),
        dry=True,
    ),
    "stribeck_friction": Row(
        "stribeck_friction",
        {"level": 30.0, "velocity": 0.08},
        lambda x: x.u - 30.0 * math.exp(-((x.v / 0.08) ** 2)) * sign(x.v),
        dry=True,
    ),
    "asymmetric_viscous": Row("asymmetric_viscous", {"coefficient": 100.0}, lambda x: x.u - 100.0 * abs(x.v)),
    "quadratic_drag": Row("quadratic_drag", {"coefficient": 300.0}, lambda x: x.u - 300.0 * x.v * abs(x.v)),
    "cubic_friction": Row("cubic_friction", {"coefficient": 700.0}, lambda x: x.u - 700.0 * x.v**3),
    "quartic_friction": Row(
        "quartic_friction", {"coefficient": 2000.0}, lambda x: x.u - 2000.0 * x.v**3 * abs(x.v)
    ),
    "constant_force": Row("constant_force", {"level": 25.0}, lambda x: x.u + 25.0),
    "linear_stiffness": Row("linear_stiffness", {"coefficient": 2000.0}, lambda x: x.u - 2000.0 * x.q),
    "quadratic_stiffness": Row("quadratic_stiffness", {"coefficient": 3e4}, lambda x: x.u - 3e4 * x.q**2),
    "cubic_stiffness": Row("cubic_stiffness", {"coefficient": 5e5}, lambda x: x.u - 5e5 * x.q**3),
    "cogging": Row(
        "cogging",
        {"amplitude": 20.0, "period": 0.02, "phase": 0.4},
        lambda x: x.u - 20.0 * math.cos(2 * math.pi * x.q / 0.02 + 0.4),
    ),
    "unbalance": Row(
        "unbalance",
        {"moment": 2.5, "phase": 0.4},
        lambda x: x.u - 2.5 * GRAVITY * math.cos(x.q + 0.4),
    ),
    # own state: friction over its level, here 0.6
    "hysteresis": Row("hysteresis", {"stiffness": 1e5, "level": 30.0}, lambda x: x.u - 30.0 * x.z, own=0.6),
    "velocity_hysteresis": Row(
        "velocity_hysteresis",
        {"level": 30.0, "velocity": 0.3, "level_negative": 12.0},
        lambda x: (
            x.u
            - math.exp(-((x.v / 0.3) ** 2)) * (30.0 * (x.v > 0 and x.a > 0) - 12.0 * (x.v < 0 and x.a < 0))
        ),
        dry=True,
        affine=False,
    ),
    "actuator_gain": Row("actuator_gain", {"gain": 1.2}, lambda x: 1.2 * x.u),
    "actuator_offset": Row("actuator_offset", {"level": 25.0}, lambda x: x.u + 25.0),
    "actuator_lag": Row("actuator_lag", {"time_constant": 5e-3}, lambda x: x.z, own=70.0),
    # the delay is in the look-up of u, which tests of `interval_forces` cover
    "input_delay": Row("input_delay", {"delay": 2.4e-3}, lambda x: x.u),
    # On the reference and on the error in front of the law: tests of the loop cover them.
    "command_delay": Row("command_delay", {"delay": 2.4e-3}, lambda x: x.u),
    "command_lag": Row("command_lag", {"time_constant": 6e-3}, lambda x: x.u),
    "velocity_limit": Row("velocity_limit", {"limit": 0.3}, lambda x: x.u),
    "acceleration_limit": Row("acceleration_limit", {"limit": 40.0}, lambda x: x.u),
    "dead_band": Row("dead_band", {"width": 1e-3}, lambda x: x.u),
    "load_friction of one coefficient": Row(
        "load_friction",
        {"coefficient": 0.25},
        lambda x: x.u - 0.25 * abs(x.u) * sign(x.v),
        dry=True,
    ),
    "load_friction": Row(
        "load_friction",
        {"coefficient": 0.15, "back": 0.4},
        lambda x: x.u - (0.4 if x.u * x.v < 0 else 0.15) * abs(x.u) * sign(x.v),
        dry=True,
    ),
    "saturation": Row("saturation", {"limit": 150.0}, lambda x: clip(x.u, 150.0)),
    "voltage_limit": Row(
        "voltage_limit",
        {"stall": 350.0, "velocity": 0.5},
        lambda x: max(min(x.u, 350.0 * (1 - x.v / 0.5)), -350.0 * (1 + x.v / 0.5)),
    ),
    "added_mass": Row("added_mass", {"mass": 20.0}, lambda x: x.u - 20.0 * x.a),
    # own state: elongation times the spring's frequency of 200 rad/s, and its velocity
    "joint_flexibility": Row(
        "joint_flexibility",
        {"stiffness": 1.2e6, "damping": 300.0, "load_inertia": 30.0},
        lambda x: x.u + 30.0 * x.a + 1.2e6 * x.z[0] / 200.0 + 300.0 * x.z[1],
        own=(0.004, 0.03),
    ),
    "friction_drift": Row(
        "friction_drift",
        {"rate": 1.5},
        lambda x: x.u - 30.0 * (1 + 1.5 * x.t) * sign(x.v),
        beside=(COULOMB,),
        dry=True,
    ),
}
