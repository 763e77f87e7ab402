"""Effects in words: name, formula in the names of their parameters, and the machines in which each is met.

No JAX is needed for it. An effect without an entry here, such as one of the user's, is described by the first
line of its docstring.
"""

from __future__ import annotations

from dataclasses import dataclass

# Parts of the drive chain on which an effect may act, in their order.
CONTROLLER, DRIVE, GEAR, LOAD = "controller", "drive", "gear", "load"


@dataclass(frozen=True)
class EffectWords:
    """An effect in words.

    Args:
        name: Name in a sentence.
        formula: Its force, or its change of the command, in the names of its parameters; q is the position,
            v the velocity, a the acceleration, u the force that the drive is asked for.
        met: Machines and conditions in which it is met.
        part: Part of the drive chain on which it acts.
    """

    name: str
    formula: str
    met: str
    part: str = LOAD


_TORN = "guides, bearings and seals"
WORDS = {
    "actuator_gain": EffectWords(
        "a drive whose force differs from the declared one by a factor",
        "force of the drive = gain · u",
        "a torque constant from a data sheet, warm magnets, losses of a gear",
        DRIVE,
    ),
    "actuator_offset": EffectWords(
        "an offset of the drive",
        "force of the drive = u + level",
        "amplifiers with an uncalibrated zero, and current sensors that drift",
        DRIVE,
    ),
    "actuator_lag": EffectWords(
        "a drive that follows its command with a lag",
        "time_constant · df/dt = u − f, f being the force of the drive",
        "slow current loops, pneumatic and hydraulic valves, filtered commands",
        DRIVE,
    ),
    "input_delay": EffectWords(
        "a command that acts late",
        "force of the drive at time t = u(t − delay)",
        "field buses, computing time of a controller, and clocks of loggers that differ",
        DRIVE,
    ),
    "saturation": EffectWords(
        "a drive at its limit",
        "force of the drive = u, held between −limit and +limit",
        "current limits and peak torque of motors",
        DRIVE,
    ),
    "voltage_limit": EffectWords(
        "a supply whose voltage runs out",
        "|force of the drive| ≤ stall · (1 − v / velocity)",
        "small servos and battery drives at high speed",
        DRIVE,
    ),
    "backlash": EffectWords(
        "backlash",
        "force of the spring = stiffness · (elongation, less a dead zone of gap)",
        "gears, worn couplings, keys and splines",
        GEAR,
    ),
    "joint_flexibility": EffectWords(
        "an elastic transmission",
        "stiffness · e + damping · ė = load_inertia · a of the part behind it, e being the elongation",
        "belts, long screws, harmonic drives and couplings",
        GEAR,
    ),
    "viscous_friction": EffectWords(
        "viscous friction", "−coefficient · v", f"lubricated {_TORN}, and eddy currents"
    ),
    "back_emf_damping": EffectWords(
        "damping by the back-EMF", "−coefficient · v", "motors that are driven by a voltage", DRIVE
    ),
    "coulomb_friction": EffectWords(
        "dry friction", "−level · sign v", f"{_TORN} under preload, brushes and brakes"
    ),
    "static_friction": EffectWords(
        "break-away friction",
        "up to level more than dry friction, at rest only",
        f"{_TORN} after a rest",
    ),
    "stribeck_friction": EffectWords(
        "Stribeck friction",
        "−level · exp(−(v / velocity)²) · sign v",
        f"oil- and grease-lubricated {_TORN} at low speed, where the film is thin",
    ),
    "asymmetric_viscous": EffectWords(
        "viscous friction that differs by direction",
        "−coefficient · |v|",
        "lip seals, valves and wipers, which act unlike in both directions",
    ),
    "quadratic_drag": EffectWords(
        "quadratic drag", "−coefficient · v · |v|", "motion through air, water or oil, and fans"
    ),
    "cubic_friction": EffectWords(
        "friction that grows with the cube of the velocity",
        "−coefficient · v³",
        "joints of robots at high speed, and lubricants whose film grows",
    ),
    "quartic_friction": EffectWords(
        "friction that grows with the fourth power of the velocity",
        "−coefficient · v³ · |v|",
        "joints of robots over a wide range of speed",
    ),
    "friction_drift": EffectWords(
        "friction that changes with time",
        "dry friction · (1 + rate · t)",
        "warming bearings and gears",
    ),
    "hysteresis": EffectWords(
        "presliding friction",
        "a spring of stiffness at each reversal, which slips at level",
        "rolling guides and preloaded bearings within some micrometres of a reversal",
    ),
    "velocity_hysteresis": EffectWords(
        "Stribeck friction with memory",
        "−level · exp(−(v / velocity)²) · sign v while the speed grows",
        "lubricated contacts whose film lags behind the speed",
    ),
    "added_mass": EffectWords(
        "an added mass", "−mass · (a + g)", "tools, payloads, rotors behind a gear, forgotten parts"
    ),
    "constant_force": EffectWords(
        "a constant force",
        "+level",
        "weight balances, cable chains, an offset of the drive, friction that differs by direction",
    ),
    "linear_stiffness": EffectWords(
        "a spring", "−coefficient · q", "flexures, hoses, cable chains, bellows", GEAR
    ),
    "quadratic_stiffness": EffectWords(
        "a spring that is stiffer on one side", "−coefficient · q²", "hoses and preloaded flexures", GEAR
    ),
    "cubic_stiffness": EffectWords(
        "a spring that stiffens",
        "−coefficient · q³",
        "flexures, belts and rubber at large elongation",
        GEAR,
    ),
    "unbalance": EffectWords(
        "an unbalanced mass",
        "−moment · g · cos(q + phase)",
        "joints that turn with their centre of mass off the axis",
    ),
    "cogging": EffectWords(
        "a ripple over the position",
        "−amplitude · cos(2π · q / period + phase)",
        "motors with iron cores (cogging), teeth of belts and gears, ball screws (once a turn or a ball)",
        DRIVE,
    ),
}


def words_of(kind: str, doc: str = "", *, in_drive: bool = False, of_spring: bool = False) -> EffectWords:
    """Return an effect in words.

    Args:
        kind: Kind of the effect.
        doc: Docstring of its class, whose first line describes an effect that has no entry.
        in_drive: Whether the effect changes the force of the drive.
        of_spring: Whether it is the law of a spring.
    """
    if kind in WORDS:
        return WORDS[kind]
    first = doc.strip().splitlines()[0].rstrip(".") if doc.strip() else ""
    return EffectWords(kind.replace("_", " "), first, "", DRIVE if in_drive else GEAR if of_spring else LOAD)
