"""Faults of a user's effect class: each is one line with file, class, what is wrong and a hint."""

import numpy as np
import pytest

from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.session import open_session
from tests.support.case_faults import message, more, write
from tests.support.cli_setup import refused
from tests.support.written_logs import write_csv

HEAD = """
import math
import jax
import jax.numpy as jnp
import numpy as np
from jaxid.model import Action, Effect, parameter

class Wind(Effect):
"""
PARAMETER = 'pressure: object = parameter("force", "positive", "p")'
STATE = "def initial_state(self, u):\n        return jnp.zeros_like(u)"


def act(returned: str) -> str:
    return f"def act(self, x, state):\n        return {returned}"


def source(*lines: str) -> str:
    return HEAD + "".join(f"    {line}\n" for line in lines)


# The lines of the class, and words that the message must hold.
FAULTS = {
    "a number": ([PARAMETER, act("-self.pressure")], ["act returns a number, not an Action"]),
    "nothing": ([PARAMETER, act("None")], ["act returns nothing (None)", "return Action("]),
    "a dictionary": ([PARAMETER, act("{'force': 1.0}")], ["act returns a dict, not an Action"]),
    "a vector": ([PARAMETER, act("Action(force=jnp.ones(2))")], ["Action.force has shape (2,)"]),
    "a text": ([PARAMETER, act("Action(force='3')")], ["Action.force is a str"]),
    "one level": ([PARAMETER, act("Action(rising=self.pressure)")], ["rising is not a pair"]),
    "a misspelt parameter": (
        [PARAMETER, act("Action(force=self.presure)")],
        ["no attribute 'presure', line 11"],
    ),
    "a misspelt signal": (
        [PARAMETER, act("Action(force=x.velocity)")],
        ["'velocity', line 11", "x has y, yd"],
    ),
    "a misspelt action": ([PARAMETER, act("Action(forces=1.0)")], ["unexpected keyword argument 'forces'"]),
    "a branch": (
        [PARAMETER, act("Action(force=self.pressure if x.yd > 0 else 0.0)")],
        ["needs the value of a signal", "line 11", "jnp.where"],
    ),
    "math": ([PARAMETER, act("Action(force=math.sin(x.y))")], ["needs the value of a signal", "jax.numpy"]),
    "no state argument": (
        [PARAMETER, "def act(self, x):\n        return Action()"],
        ["takes 2 positional arguments", "define act(self, x, state)"],
    ),
    "no rate": ([PARAMETER, act("Action(force=state)"), STATE], ["has a state, but act returns no rate"]),
    "a rate of another shape": (
        [PARAMETER, act("Action(rate=jnp.ones(3))"), STATE],
        ["Action.rate is of shape (3,)", "the shape of the state, ()"],
    ),
    "a rate without a state": ([PARAMETER, act("Action(rate=x.yd)")], ["a rate, but there is no state"]),
    "a rate that is not affine": (
        [PARAMETER, act("Action(rate=x.yd - state**2)"), STATE],
        ["not affine in the state", "a + b state"],
    ),
    "a vector whose rate varies": (
        [
            PARAMETER,
            act("Action(rate=-x.yd * state)"),
            "def initial_state(self, u):\n        return jnp.zeros(2)",
        ],
        ["coefficients that change with the signals"],
    ),
    "a state that is a list": (
        [PARAMETER, act("Action()"), "def initial_state(self, u):\n        return [0.0]"],
        ["initial_state returns a list", "jnp.zeros_like(u)"],
    ),
    "a state that is a matrix": (
        [PARAMETER, act("Action()"), "def initial_state(self, u):\n        return jnp.zeros((2, 2))"],
        ["initial_state returns an array of shape (2, 2)"],
    ),
    "a state that fails": (
        [PARAMETER, act("Action()"), "def initial_state(self, u):\n        return u.foo"],
        ["initial_state fails", "line 13"],
    ),
    "a delay that is a text": (
        [PARAMETER, act("Action()"), "def command_delay(self):\n        return 'a'"],
        ["command_delay is a str"],
    ),
    "break-away that does not say so": (
        [PARAMETER, act("Action(stick=self.pressure)")],
        ["acts at rest", "add break_away_level ="],
    ),
    "an answer that is no parameter": (
        [PARAMETER, "sliding_level = 'level'", act("Action(dry=self.pressure)")],
        ["sliding_level = 'level' names no parameter of Wind", "name one of pressure"],
    ),
    "a field that is no parameter": (
        ["pressure: float = 3.0", act("Action(force=self.pressure)")],
        ["'pressure' is a field of the class that is not a parameter", "= parameter("],
    ),
    "no doc": (
        ['pressure: object = parameter("force", "free")', act("Action()")],
        ["argument: 'doc'", "line 9"],
    ),
    "a dimension that is none": (
        ['pressure: object = parameter(None, "free", "p")', act("Action()")],
        ["pressure has dimension None, which is not a text"],
    ),
    "a reserved name": (
        ['joint: object = parameter("force", "free", "p")', act("Action()")],
        ["cannot be called 'joint'", "rename it"],
    ),
    "a list": (
        ['pressure: object = parameter("force", "free", "p", more=0)', act("Action()")],
        ["pressure is a list", "leave out more and width"],
    ),
    "a kind that is a number": ([PARAMETER, "kind = 3", act("Action()")], ["its kind is 3"]),
    "a check that fails": (
        [PARAMETER, act("Action()"), "def __check_init__(self):\n        raise RuntimeError('too much')"],
        ["too much", "it takes pressure"],
    ),
    "a complex force": ([PARAMETER, act("Action(force=1j * x.y)")], ["force is a complex128 number"]),
    "NaN": ([PARAMETER, act("Action(force=jnp.nan * x.y)")], ["Action.force is not finite at any of"]),
    "a level that is infinite": ([PARAMETER, act("Action(dry=x.y / 0.0)")], ["Action.dry is not finite"]),
    "a rate that is not finite": (
        [PARAMETER, act("Action(rate=jnp.nan * state)"), STATE],
        ["Action.rate is not finite at any of"],
    ),
    "NumPy": ([PARAMETER, act("Action(force=np.sin(x.y))")], ["needs the value of a signal", "jax.numpy"]),
    "a callback": (
        [PARAMETER, act("Action(force=jax.pure_callback(math.sin, x.y, x.y))")],
        ["act calls back into Python", "jax.numpy alone"],
    ),
    "an endless recursion": ([PARAMETER, act("self.act(x, state)")], ["RecursionError", "line 11"]),
    "an assignment": (
        [PARAMETER, "def act(self, x, state):\n        self.k = 3"],
        ["cannot assign to field 'k', line 11"],
    ),
    "no annotation": (['pressure = parameter("force", "free", "p")'], ["no type annotation", "line 8"]),
    "a negative delay": (
        [PARAMETER, act("Action()"), "def command_delay(self):\n        return -self.pressure"],
        ["command_delay is -3 s", "between 0 and 60 s"],
    ),
    "a delay that is not finite": (
        [PARAMETER, act("Action()"), "def command_delay(self):\n        return jnp.nan"],
        ["command_delay is nan s"],
    ),
    "another's class": ([PARAMETER, "act = 3"], ["'int' object is not callable"]),
    "syntax": (["def act(self x):"], ["SyntaxError", "line 9", "correct mine.py"]),
    "an exit": (["raise SystemExit(3)"], ["cannot be imported (SystemExit: 3, line 9)"]),
    "an import": (["import not_there"], ["No module named 'not_there', line 9", "correct mine.py"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_line(tmp_path, fault):
    lines, words = FAULTS[fault]
    write(tmp_path, source(*lines), "mine.py")
    told = message(tmp_path, more('[[effects]]\nkind = "mine.py:Wind"\npressure = { guess = 3.0 }\n'))
    assert "[[effects]] 3" in told
    assert "mine.py:Wind" in told
    assert all(word in told for word in words), told


def test_file_and_class_are_named_if_the_kind_is_a_word(tmp_path):
    write(tmp_path, source('kind = "wind"', PARAMETER, act("None")), "mine.py")
    told = message(tmp_path, more('[[effects]]\nkind = "mine.py:Wind"\npressure = 3.0\n'))
    assert "[[effects]] 3 (wind): mine.py:Wind: act returns nothing" in told


def log() -> Log:
    t = 1e-3 * np.arange(2000)
    q = 0.05 * (1 - np.cos(2 * np.pi * 2.0 * t)) + 0.01 * np.sin(2 * np.pi * 5.0 * t)
    return Log(t, q, np.cos(2 * np.pi * 2.0 * t), source="log.csv")


@pytest.mark.parametrize("force", ["jnp.sqrt(x.yd)", "jnp.log(x.y - 0.08)"])
def test_a_force_that_is_not_finite_along_the_log_is_refused(tmp_path, force):
    write(tmp_path, source(PARAMETER, act(f"Action(force=self.pressure * {force})")), "mine.py")
    text = more('[[effects]]\nkind = "mine.py:Wind"\npressure = { guess = 3.0 }\n')
    with pytest.raises(
        InputError, match="effect mine.py:Wind: .*not finite at .* of log.csv, first at y = "
    ) as e:
        open_session(write(tmp_path, text), log())
    assert "\n" not in str(e.value)


SIMULATED = """
[[effects]]
kind = "mine.py:Wind"
pressure = { guess = 3.0, true = 4.0 }
[reference]
kind = "trapezoid"
start = 0.0
targets = [0.1, 0.0]
speed = 0.12
acceleration = 0.8
[sensor]
position_noise = 1e-6
[simulation]
duration = 1.0
sample_rate = 1000.0
[study]
runs = 1
[limits]
stroke = [-0.1, 0.2]
speed = 0.3
"""
COMMANDS = {
    "simulate": ["-o", "new.csv"],
    "design": ["-o", "new.csv"],
    "check": ["log.csv"],
    "identify": ["log.csv", "-o", "out"],
    "discover": ["log.csv", "-o", "out"],
    "study": ["-o", "out"],
}
LATE = {
    "a branch": (act("Action(force=self.pressure if x.yd > 0 else 0.0)"), "act needs the value of a signal"),
    "NaN": (act("Action(force=jnp.nan * x.y)"), "Action.force is not finite at any of"),
    "nothing": (act("None"), "act returns nothing"),
    "missing": ("pass", "has no method act"),
    "an import": ("import not_there", "No module named 'not_there'"),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("fault", LATE)
def test_every_command_refuses_it(tmp_path, capsys, monkeypatch, command, fault):
    method, told = LATE[fault]
    write(tmp_path, source(PARAMETER, method), "mine.py")
    write(tmp_path, more(SIMULATED))
    save_log(tmp_path / "log.csv")
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, tmp_path, command, "case.toml", *COMMANDS[command], told=told)
    assert "mine.py:Wind" in line


def save_log(path):
    columns = zip("tqu", (log().time, log().position[:, 0], log().force[:, 0]), strict=True)
    write_csv(path, dict(columns))


@pytest.mark.parametrize("command", ["simulate", "study"])
def test_a_class_that_refuses_the_true_values(tmp_path, capsys, monkeypatch, command):
    check = (
        "def __check_init__(self):\n        if self.pressure > 3.5:\n            raise ValueError('too much')"
    )
    write(tmp_path, source(PARAMETER, act("Action(force=-self.pressure * x.yd)"), check), "mine.py")
    write(tmp_path, more(SIMULATED))
    monkeypatch.chdir(tmp_path)
    told = "mine.py: Wind.__check_init__ fails (ValueError: too much, line 14); correct mine.py"
    refused(capsys, tmp_path, command, "case.toml", *COMMANDS[command], told=told)


def test_a_simulation_that_diverges_names_the_effect(tmp_path, capsys, monkeypatch):
    write(tmp_path, source(PARAMETER, act("Action(force=self.pressure * jnp.sqrt(x.yd))")), "mine.py")
    write(tmp_path, more(SIMULATED))
    monkeypatch.chdir(tmp_path)
    told = "the simulation diverged; act of effect mine.py:Wind: Action.force is not finite at y = "
    refused(capsys, tmp_path, "simulate", "case.toml", *COMMANDS["simulate"], told=told)


def test_a_sound_class_passes(tmp_path):
    write(
        tmp_path,
        source(PARAMETER, STATE, act("Action(force=-self.pressure * state, rate=x.yd - state)")),
        "mine.py",
    )
    path = write(tmp_path, more('[[effects]]\nkind = "mine.py:Wind"\npressure = { guess = 3.0 }\n'))
    assert load_case(path).effects[2].cls.__name__ == "Wind"
    assert np.isfinite(open_session(path, log()).fit.data.q).all()
