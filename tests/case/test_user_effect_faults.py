"""Faults of a user's effect class: each is one line with file, class, what is wrong and a hint."""

import numpy as np
import pytest

from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.session import open_session
from tests.support.case_faults import message, more, write

HEAD = """
import math
import jax.numpy as jnp
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
        ["no attribute 'presure', line 9"],
    ),
    "a misspelt signal": (
        [PARAMETER, act("Action(force=x.velocity)")],
        ["'velocity', line 9", "x has y, yd"],
    ),
    "a misspelt action": ([PARAMETER, act("Action(forces=1.0)")], ["unexpected keyword argument 'forces'"]),
    "a branch": (
        [PARAMETER, act("Action(force=self.pressure if x.yd > 0 else 0.0)")],
        ["needs the value of a signal", "line 9", "jnp.where"],
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
        ["initial_state fails", "line 11"],
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
        ["argument: 'doc'", "line 7"],
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
    "syntax": (["def act(self x):"], ["SyntaxError", "line 7", "correct mine.py"]),
    "an exit": (["raise SystemExit(3)"], ["cannot be imported (SystemExit: 3, line 7)"]),
    "an import": (["import not_there"], ["No module named 'not_there', line 7", "correct mine.py"]),
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


@pytest.mark.parametrize("force", ["jnp.nan", "jnp.sqrt(x.yd)", "jnp.log(x.y - 1.0)"])
def test_a_force_that_is_not_finite_along_the_log_is_refused(tmp_path, force):
    write(tmp_path, source(PARAMETER, act(f"Action(force=self.pressure * {force})")), "mine.py")
    text = more('[[effects]]\nkind = "mine.py:Wind"\npressure = { guess = 3.0 }\n')
    with pytest.raises(
        InputError, match="effect mine.py:Wind: .*not finite at .* of log.csv, first at y = "
    ) as e:
        open_session(write(tmp_path, text), log())
    assert "\n" not in str(e.value)


def test_a_sound_class_passes(tmp_path):
    write(
        tmp_path,
        source(PARAMETER, STATE, act("Action(force=-self.pressure * state, rate=x.yd - state)")),
        "mine.py",
    )
    path = write(tmp_path, more('[[effects]]\nkind = "mine.py:Wind"\npressure = { guess = 3.0 }\n'))
    assert load_case(path).effects[2].cls.__name__ == "Wind"
    assert np.isfinite(open_session(path, log()).fit.data.q).all()
