"""A good case, and every fault that a case can have with the words that must tell it."""

from pathlib import Path

import pytest

from jaxid.case.case import load_case
from jaxid.errors import InputError

GOOD = """
[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 80.0, min = 10.0, max = 200.0, true = 95.0 }

[[effects]]
kind = "viscous_friction"
coefficient = { guess = 100.0 }

[[effects]]
kind = "coulomb_friction"
level = 20.0

[actuator]
gain = 35.15

[log]
time = "t"
position = "q"
force = "u"

[controller]
kind = "cascade_pd"
kp = 160.18
kv = 243.45
period = 0.001
"""


def write(folder: Path, text: str, name: str = "case.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def message(folder: Path, text: str) -> str:
    """What a faulty case is told; always one line that starts with the file."""
    path = write(folder, text)
    with pytest.raises(InputError) as caught:
        load_case(path)
    told = str(caught.value)
    assert "\n" not in told
    assert told.startswith(str(path))
    return told.removeprefix(str(path))


def swapped(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new, 1)


COGGING = '[[effects]]\nkind = "cogging"\namplitude = 1.0\nperiod = 0.1\n'
INERTIA = "inertia = { guess = 80.0, min = 10.0, max = 200.0, true = 95.0 }"
VISCOUS = "coefficient = { guess = 100.0 }"
PID = 'kind = "pid"\nkp = 1.0\nki = 1.0\nkd = 1.0\n'
CASCADE = 'kind = "cascade_pd"\nkp = 160.18\nkv = 243.45\n'
CONTROLLER = f"[controller]\n{CASCADE}period = 0.001\n"


def more(lines: str) -> str:
    return GOOD + "\n" + lines


def level(value: str) -> str:
    return swapped("level = 20.0", f"level = {value}")


def pulses(keys: str) -> str:
    return more(f"disturbance = {{ {keys} }}")


def second(keys: str) -> str:
    return more(f'[[validation]]\nname = "second"\n{keys}\n')


# Each fault, and what its message must hold: table, key, hint.
FAULTS = {
    # names
    "unknown table": (more("[sensr]"), ["[sensr]", "'sensor'"]),
    "key outside of tables": ("gain = 3.0\n" + GOOD, ["'gain'", "outside", "move it below"]),
    "table far from any": (more("[zzz]"), ["[zzz]", "there is: plant, effects"]),
    "unknown key": (swapped("[plant]", "[plant]\nmotoin = 1"), ["[plant]", "motoin", "'motion'"]),
    "unknown inline key": (
        swapped("max = 200.0", "maximum = 200.0"),
        ["[plant.parameters]", "inertia", "maximum", "'max'"],
    ),
    "unknown plant parameter": (
        swapped(INERTIA, "mass = 3.0"),
        ["[plant.parameters]", "'mass'", "there is: inertia"],
    ),
    "unknown effect parameter": (
        swapped("level = 20.0", "levl = 20.0"),
        ["[[effects]] 2 (coulomb_friction)", "'levl'", "'level'", "friction_coefficient"],
    ),
    "unknown disturbance key": (pulses("level = 1, on = 1, of = 1"), ["disturbance", "'off'"]),
    "unknown unit": (
        swapped("[plant]", '[plant]\nunits = { torque = "V" }'),
        ["[plant]: units", "torque", "position, force"],
    ),
    # tables of the wrong kind
    "one effect": ("[plant]\n[effects]\n", ["[effects]", "[[effects]]"]),
    "two plants": ("[[plant]]\n", ["'plant'", "write [plant] once"]),
    "plant is a number": ("plant = 3\n", ["'plant'", "write [plant]"]),
    "parameters are a number": (
        '[plant]\nkind = "axis"\nparameters = 3',
        ["[plant.parameters]", "3 is not a table"],
    ),
    # missing
    "no plant": ("[log]\n", ["[plant]", 'add [plant] with kind = "axis"']),
    "no plant kind": ("[plant]\n", ["[plant]", "'kind'", "axis"]),
    "no parameters": ('[plant]\nkind = "axis"', ["'parameters'", "inertia = { guess"]),
    "no inertia": (swapped(INERTIA, ""), ["'inertia' is missing", "add inertia"]),
    "no effect kind": (swapped('kind = "viscous_friction"', ""), ["[[effects]] 1", "'kind'"]),
    "no phase": (more(COGGING), ["(cogging)", "'phase' is missing", "amplitude, period, phase"]),
    "no level": (swapped("level = 20.0", ""), ["coulomb_friction", "level", "friction_coeff"]),
    "no kv": (swapped("kv = 243.45", ""), ["[controller]", "'kv' is missing", "cascade_pd"]),
    "no controller kind": (swapped('kind = "cascade_pd"', ""), ["[controller]", "pid"]),
    "no position": (swapped('position = "q"', ""), ["[log]", "'position'", "column"]),
    "no guess": (swapped("guess = 80.0", "min = 0.0").replace("min = 10.0, ", ""), ["'guess'"]),
    "no validation name": (more("[[validation]]\nrows = [0, 9]"), ["[[validation]] 1", "'name'"]),
    "no reference kind": (more("[reference]\namplitude = 1"), ["[reference]", "'kind'", "csv"]),
    "no disturbance level": (pulses("on = 1, off = 1"), ["'level' is missing"]),
    "both friction levels": (
        level("20.0\nfriction_coefficient = 0.1"),
        ["(coulomb_friction)", "either", "level (optional)"],
    ),
    # kinds
    "plant kind": (swapped('"axis"', '"axes"'), ["[plant]", "kind", "axes", "'axis'"]),
    "effect kind": (swapped('"viscous_friction"', '"viscos_friction"'), ["'viscous_friction'"]),
    "controller kind": (swapped('"cascade_pd"', '"cascade"'), ["[controller]", "'cascade_pd'"]),
    "reference kind": (more('[reference]\nkind = "multisin"'), ["[reference]", "'multisine'"]),
    "kind is a number": (swapped('"axis"', "3"), ["[plant]", "kind = 3", "text"]),
    # values
    "text for a number": (swapped(INERTIA, 'inertia = "80"'), ["inertia", '"80"', "guess"]),
    "bool for a number": (swapped(INERTIA, "inertia = true"), ["inertia = true", "guess"]),
    "bool guess": (swapped(VISCOUS, "coefficient = { guess = true }"), ["coefficient.guess"]),
    "bool gain": (swapped("35.15", "true"), ["[actuator]", "gain = true", "give a number"]),
    "nan": (level("nan"), ["level = nan", "finite"]),
    "infinite": (level("{ guess = inf }"), ["level.guess = inf", "finite"]),
    "infinite bound": (level("{ guess = 1, max = inf }"), ["level.max = inf", "finite"]),
    "longer than a float": (level("1" + "0" * 400), ["level", "finite"]),
    "list for one": (swapped(INERTIA, "inertia = [1.0, 2.0]"), ["inertia", "takes one value"]),
    "list of joints": (level("[1.0, 2.0]"), ["level", "2 entries", "one a joint"]),
    "guess below min": (
        swapped("guess = 80.0", "guess = 8.0"),
        ["inertia", "guess 8", "[10, 200]"],
    ),
    "guess above max": (swapped("guess = 80.0", "guess = 208.0"), ["guess 208", "[10, 200]"]),
    "min above max": (swapped("min = 10.0", "min = 300.0"), ["inertia", "min 300", "exchange"]),
    "min is max": (level("{ guess = 1, min = 1, max = 1 }"), ["min equal", "level = 1.0"]),
    "negative known": (level("-1.0"), ["level = -1.0", "must be >= 0"]),
    "negative guess": (
        swapped(VISCOUS, "coefficient = { guess = -3.0 }"),
        ["coefficient.guess = -3.0", "must be >= 0"],
    ),
    "negative truth": (swapped("true = 95.0", "true = -95.0"), ["inertia.true", "must be > 0"]),
    "zero inertia": (swapped(INERTIA, "inertia = 0.0"), ["inertia = 0.0", "must be > 0"]),
    "unknown is not known": (swapped("35.15", "{ guess = 3.0 }"), ["gain", "known number"]),
    # plant
    "motion": (swapped("[plant]", '[plant]\nmotion = "rotate"'), ["motion", "'rotary'"]),
    "orientation": (swapped("[plant]", '[plant]\norientation = "up"'), ["vertical"]),
    "vertical and rotary": (
        swapped("[plant]", '[plant]\nmotion = "rotary"\norientation = "vertical"'),
        ["[plant]", "orientation", "rotary", "leave orientation out"],
    ),
    "gravity": (swapped("[plant]", "[plant]\ngravity = -9.81"), ["gravity = -9.81", ">= 0"]),
    "unit label": (swapped("[plant]", "[plant]\nunits = { force = 3 }"), ["units.force", "text"]),
    # places
    "joint": (level("1.0\njoint = 2"), ["joint = 2", "1 joint", "leave joint out"]),
    "joint 0": (level("1.0\njoint = 0"), ["joint = 0", "at least 1"]),
    "joint text": (level('1.0\njoint = "x"'), ["joint", "whole number"]),
    "joint list": (level("1.0\njoint = [1, 3]"), ["joint = [1, 3]", "out of range"]),
    "joint twice": (level("1.0\njoint = [1, 1]"), ["joint", "twice", "once"]),
    "spring": (level("1.0\nspring = 1"), ["spring = 1", "axis", "leave spring out"]),
    "passive": (level("1.0\npassive = 1"), ["passive = 1", "axis", "leave passive out"]),
    "joint and spring": (level("1.0\njoint = 1\nspring = 1"), ["joint and spring exclude", "keep"]),
    "shared": (level("1.0\nshared = 1"), ["shared = 1", "true or false"]),
    # actuator
    "zero gain": (swapped("35.15", "0.0"), ["[actuator]", "gain = 0.0", "must not be 0"]),
    "gains": (swapped("35.15", "[1.0, 2.0]"), ["gain", "2 entries", "1 value"]),
    "transmission": (
        swapped("gain = 35.15", "transmission = [[1.0]]"),
        ["[actuator]", "transmission", "several joints", "gain"],
    ),
    # log
    "no time": (swapped('time = "t"', ""), ["[log]", "neither time nor sample_rate", "add time"]),
    "two times": (swapped('time = "t"', 'time = "t"\nsample_rate = 1e3'), ["[log]", "keep one"]),
    "sample rate": (swapped('time = "t"', "sample_rate = 0"), ["sample_rate = 0", "> 0"]),
    "hold": (swapped('"u"', '"u"\nhold = "zero_orde"'), ["[log]", "hold", "'zero_order'"]),
    "rows": (swapped('"u"', '"u"\nrows = [0.0, 5.0]'), ["rows = [0.0, 5.0]", "two whole"]),
    "rows backwards": (swapped('"u"', '"u"\nrows = [9, 5]'), ["rows = [9, 5]", "first and end"]),
    "column": (swapped('"q"', "3"), ["[log]", "position = 3", "name of a column"]),
    "columns": (swapped('"q"', '["q1", "q2"]'), ["position", "1 joint", "1 column"]),
    # preprocess
    "cutoff": (more("[preprocess]\ncutoff_hz = -1"), ["[preprocess]", "cutoff_hz", "> 0"]),
    "decimation": (more("[preprocess]\ndecimation = 2.5"), ["decimation = 2.5", "whole number"]),
    "order": (more("[preprocess]\norder = 0"), ["order = 0", "at least 1"]),
    "median even": (more("[preprocess]\nmedian = 4"), ["median = 4", "is even", "median = 5"]),
    "median of one": (more("[preprocess]\nmedian = 1"), ["median = 1", "at least 3"]),
    "derivatives": (
        more('[preprocess]\nderivatives = "parabola"'),
        ["derivatives", "did you mean 'parabolic'"],
    ),
    "reach of none": (
        more('[preprocess]\nderivatives = "parabolic"\nreach = 0'),
        ["reach = 0", "at least 1"],
    ),
    "starts without a prior": (more("[output_error]\nstarts = 4"), ["starts goes with prior only"]),
    "reach alone": (more("[preprocess]\nreach = 3"), ["reach", 'derivatives = "parabolic"']),
    "parabola of a low-pass": (
        more('[preprocess]\nderivatives = "parabolic"\ncutoff_hz = 60.0'),
        ["cutoff_hz", "leave out one"],
    ),
    "align_hold": (more("[preprocess]\nalign_hold = 1"), ["align_hold", "true or false"]),
    # controller
    "gain of another": (more("kd = 3.0"), ["[controller]", "'kd'", "there is: kind, acceleration, kp, kv"]),
    "period": (swapped("0.001", "0.0"), ["period = 0.0", "> 0"]),
    "average": (more("velocity_average = 0"), ["velocity_average = 0", "at least 1"]),
    "limit": (more("limit = -3"), ["limit = -3", "> 0"]),
    "disturbance": (more("disturbance = 3"), ["disturbance = 3", "level, on, off, start"]),
    "disturbance on": (pulses("level = 1, on = 0, off = 1"), ["disturbance.on = 0", "> 0"]),
    "anti_windup": (
        swapped(CASCADE, PID + "anti_windup = 1\n"),
        ["[controller]", "anti_windup = 1", "true or false"],
    ),
    "derivative_filter": (
        swapped(CASCADE, PID + "derivative_filter = -1\n"),
        ["derivative_filter = -1", ">= 0"],
    ),
    # sensor
    "resolution": (more("[sensor]\nposition_resolution = 0"), ["position_resolution", "> 0"]),
    "noise": (more("[sensor]\nforce_noise = -1"), ["[sensor]", "force_noise = -1", ">= 0"]),
    # validation
    "same log": (second(""), ["[[validation]] 1", "validation log is identical to the fitted log", "rows"]),
    "same name": (
        second('log = "a.csv"') + '[[validation]]\nname = "second"\nlog = "b.csv"',
        ["[[validation]] 2", '"second"', "a different name"],
    ),
    "validation key": (second('file = "a.csv"'), ["[[validation]] 1", "'file'", "there is"]),
    "validation disturbance": (
        second('log = "a.csv"\ndisturbance = "d"').replace(CONTROLLER, ""),
        ["[[validation]] 1", "disturbance", "add [controller]"],
    ),
    # reference and input
    "reference key": (
        more('[reference]\nkind = "bezier"\npoints = [0, 1]\npoint = 3'),
        ["[reference]", "'point'", "'points'"],
    ),
    "reference value": (
        more('[reference]\nkind = "bezier"\npoints = [0, "1"]'),
        ["[reference]", "points", "number"],
    ),
    "reference without a loop": (
        more('[reference]\nkind = "bezier"\npoints = [0, 1]').replace(CONTROLLER, ""),
        ["[reference]", "no loop", "[input]"],
    ),
    "reference and input": (
        more('[reference]\nkind = "bezier"\npoints = [0, 1]\n')
        + '[input]\nkind = "bezier"\npoints = [0, 1]\n',
        ["[reference] and [input]", "keep"],
    ),
    "input of two joints": (
        more('[input]\nkind = "bezier"\npoints = [[0, 1], [0, 2]]'),
        ["[input]", "2 joints", "1"],
    ),
    # simulation and study
    "duration": (more("[simulation]\nduration = 0"), ["[simulation]", "duration = 0", "> 0"]),
    "substeps": (more("[simulation]\nsubsteps = 1.5"), ["substeps = 1.5", "whole number"]),
    "estimator": (more('[study]\nestimators = ["didm"]'), ["[study]", "estimators[1]", "'didim'"]),
    "noise factors": (more("[study]\nnoise = 1.0"), ["[study]", "noise = 1.0", "list"]),
    "runs": (more("[study]\nruns = 0"), ["[study]", "runs = 0", "at least 1"]),
    # TOML itself
    "syntax": ("[plant]\nkind axis\n", ["not TOML", "line 2", "correct"]),
    "twice": (swapped("gain = 35.15", "gain = 1\ngain = 2"), ["not TOML", "line"]),
}
