"""What the tables of a case may hold, declared: one line a key."""

from __future__ import annotations

from dataclasses import MISSING, fields

from jaxid.case.schema import (
    Key,
    Keys,
    by_joint,
    choice,
    columns,
    either_text,
    flag,
    inline,
    number,
    odd,
    rows,
    several,
    span,
    stretch,
    text,
    whole,
)
from jaxid.controllers import CONTROLLERS, Controller
from jaxid.names import (
    CRITERIA,
    DERIVATIVES,
    DISCOVER,
    HOLDS,
    IN_LOOP,
    METHODS,
    MOTIONS,
    OPTIONAL_COLUMNS,
    ORIENTATIONS,
    OUTPUTS,
    STARTS,
)

# Tables at the top of a case, in the order in which they are checked; [[ ]] where it may recur.
TOP = {
    "plant": False,
    "effects": True,
    "actuator": False,
    "log": False,
    "preprocess": False,
    "identification": False,
    "algebraic": False,
    "output_error": False,
    "recursive": False,
    "controller": False,
    "sensor": False,
    "inertial_sensors": True,
    "limits": False,
    "validation": True,
    "discover": False,
    "design": False,
    "reference": False,
    "input": False,
    "simulation": False,
    "study": False,
}
# Fields of controllers that are bounded; all others may have any sign.
_CONTROLLER_SIGNS = {"derivative_filter": "nonnegative", "epsilon": "positive", "tolerance": "positive"}
# Keys that a law which identifies shares with [recursive].
ON_LINE = ("half_life", "gate_velocity", "gate_acceleration", "rows", "start", "instrument")
# And fields that are no value by drive.
_CONTROLLER_READS = {
    "poles": several(number("negative"), shortest=2, longest=3),
    "regularization": number("positive"),
    "reach": whole(1),
}

DISTURBANCE = either_text(
    inline(
        {
            "level": Key(number(), "height of the square wave, in units of the command", True),
            "on": Key(number("positive"), "how long it is on [s]", True),
            "off": Key(number("nonnegative"), "how long it is off in between [s]", True),
            "start": Key(number(), "when it first goes on [s]; default 0"),
        }
    )
)

PLANT: Keys = {
    "motion": Key(choice(MOTIONS)),
    "orientation": Key(choice(ORIENTATIONS)),
    "gravity": Key(number("nonnegative")),
    "units": Key(inline({"position": Key(text), "force": Key(text)})),
}
ALGEBRAIC: Keys = {"window": Key(span(), "from and to [s]; absent: many windows over the log")}
OUTPUT_ERROR: Keys = {
    "on": Key(choice(OUTPUTS)),
    "start": Key(choice(STARTS)),
    "prior": Key(number("positive"), "relative standard deviation of the guesses; fits what the log tells"),
    "starts": Key(whole(1), "how many, drawn within the prior"),
    "hessian": Key(flag, "curvature of the cost in place of Gauss-Newton's"),
    "profile": Key(flag, "profile likelihoods of what is fitted"),
    "drawn": Key(flag, "draw what else is as probable, and what rounding does; default true"),
}
DESIGN: Keys = {
    "criterion": Key(choice(CRITERIA)),
    "harmonics": Key(whole(2), "of the Fourier series, by joint"),
    "base_frequency_hz": Key(number("positive"), "of the first one; default one over the duration"),
}
IDENTIFICATION: Keys = {
    "physically_consistent": Key(flag, "whether links must be what bodies can be"),
}
STUDY: Keys = {
    "estimators": Key(several(choice((*METHODS, DISCOVER, IN_LOOP)))),
    "hidden": Key(several(text)),
    "noise": Key(several(number("nonnegative"))),
    "sample_rate": Key(several(number("positive"))),
    "position_resolution": Key(several(number("positive"))),
    "draw": Key(number("nonnegative")),
    "start_spread": Key(number("nonnegative")),
    "runs": Key(whole(1)),
    "chunk": Key(whole(1)),
}


def log_keys(joints: int, drives: int, names: tuple[str, ...] = ()) -> Keys:
    """Keys of [log]; columns may go by the names of the joints, where these have any."""
    of_joints = Key(columns(joints, names=names), "name of its column")
    of_drives = Key(columns(drives, "drive", names), "name of its column")
    return {
        "time": Key(text, "name of its column"),
        "sample_rate": Key(number("positive"), "samples per second"),
        "position": of_joints,
        "force": of_drives,
        "hold": Key(choice(HOLDS)),
        "rows": Key(rows),
        **{k: of_drives if k == "reference" else of_joints for k in OPTIONAL_COLUMNS},
    }


def validation_keys(joints: int, drives: int, names: tuple[str, ...] = ()) -> Keys:
    """Keys of [[validation]]."""
    own = {
        "name": Key(text, "what it is called in results", required=True),
        "log": Key(text, "its file, relative to the case"),
        "disturbance": Key(DISTURBANCE),
    }
    return {**own, **log_keys(joints, drives, names)}


def actuator_keys(drives: int) -> Keys:
    """Keys of [actuator]."""
    row = several(number(), shortest=drives)
    return {
        "gain": Key(by_joint(number("nonzero"), drives, "drive")),
        "transmission": Key(several(row, shortest=drives)),
    }


def preprocess_keys(joints: int) -> Keys:
    """Keys of [preprocess]."""
    return {
        "cutoff_hz": Key(number("positive")),
        "order": Key(whole(1)),
        "decimation": Key(whole(1)),
        "trim": Key(whole(0)),
        "rest_velocity": Key(by_joint(number("nonnegative"), joints)),
        "align_hold": Key(flag),
        "median": Key(odd(3), "samples of the running median of the force"),
        "derivatives": Key(choice(DERIVATIVES)),
        "reach": Key(whole(1), "samples on each side of a parabola"),
    }


def recursive_keys(joints: int) -> Keys:
    """Keys of [recursive]."""
    return {
        "half_life": Key(number("positive"), "s of motion after which a sample counts half"),
        "regularization": Key(number("positive"), "how many samples the start counts as"),
        "gate_velocity": Key(by_joint(number("nonnegative"), joints)),
        "gate_acceleration": Key(by_joint(number("nonnegative"), joints)),
        "rows": Key(choice(("full", "summed"))),
        "start": Key(choice(("neutral", "guess"))),
        "instrument": Key(choice(("none", "model"))),
        "restart": Key(text, "result.json of an earlier run, relative to the case"),
    }


def controller_keys(kind: str, drives: int) -> Keys:
    """Keys of [controller]: those of every controller, and the fields of the class of this kind."""
    keys = {
        "period": Key(number("positive"), "sampling time [s]"),
        "velocity_average": Key(whole(1), "samples"),
        "limit": Key(by_joint(number("positive"), drives, "drive"), "of the command"),
        "disturbance": Key(DISTURBANCE),
    }
    cls = CONTROLLERS[kind]
    unstated = {field.name for field in fields(Controller)} | set(cls.of_machine)
    own = {}
    for field in fields(cls):
        if field.name not in unstated:
            required = field.default is MISSING and field.default_factory is MISSING
            sign = _CONTROLLER_SIGNS.get(field.name, "free")
            yes_or_no = field.type in (bool, "bool")
            read = flag if yes_or_no else by_joint(number(sign), drives, "drive")
            read = _CONTROLLER_READS.get(field.name, read)
            own[field.name] = Key(read, f"it belongs to kind = '{kind}'", required)
    if "estimator" in cls.of_machine:
        own |= {k: v for k, v in recursive_keys(drives).items() if k in ON_LINE}
    return {**own, **keys}


def sensor_keys(joints: int, drives: int) -> Keys:
    """Keys of [sensor]."""
    return {
        "position_resolution": Key(by_joint(number("positive"), joints)),
        "position_noise": Key(by_joint(number("nonnegative"), joints)),
        "force_noise": Key(by_joint(number("nonnegative"), drives, "drive")),
        "rate": Key(number("positive"), "readings per second, held in between; absent: one a tick"),
    }


def limits_keys(joints: int, drives: int) -> Keys:
    """Keys of [limits]."""
    return {
        "stroke": Key(stretch(joints), "lowest and highest position"),
        "speed": Key(by_joint(number("positive"), joints), "largest speed"),
        "force": Key(by_joint(number("positive"), drives, "drive"), "largest command, in its units"),
    }


def design_keys(joints: int) -> Keys:
    """Keys of [design]."""
    most = Key(by_joint(number("positive"), joints), "largest acceleration")
    return {**DESIGN, "acceleration": most}


def simulation_keys(joints: int) -> Keys:
    """Keys of [simulation]."""
    return {
        "duration": Key(number("positive"), "s"),
        "sample_rate": Key(number("positive"), "samples per second"),
        "substeps": Key(whole(1)),
        "sharpness": Key(number("positive")),
        "initial_position": Key(by_joint(number(), joints)),
        "initial_velocity": Key(by_joint(number(), joints)),
    }
