"""A user's own effect: a class in a file beside the case."""

from pathlib import Path

import pytest
from case_faults import message, more, write

from jaxid.effects import EFFECTS
from jaxid.io.case import load_case
from jaxid.machine import build_machine

OWN_EFFECT = """
from jaxid.model import Action, Effect, parameter

class Wind(Effect):
    {kind}
    pressure: object = parameter("{dimension}", "positive", "p")

    def act(self, x, state):
        return Action(force=-self.pressure)

class NotAnEffect:
    pass

class Idle(Effect):
    pass
"""


@pytest.fixture(autouse=True)
def _effects_as_before():
    """A user's effect stays registered for the process; tests must not see each other's."""
    before = dict(EFFECTS)
    yield
    EFFECTS.clear()
    EFFECTS.update(before)


def own_case(tmp_path: Path, kind: str = "", dimension: str = "force", name: str = "Wind") -> str:
    write(tmp_path, OWN_EFFECT.format(kind=kind or "pass", dimension=dimension), "mine.py")
    return more(f'[[effects]]\nkind = "mine.py:{name}"\npressure = {{ guess = 3.0 }}\n')


@pytest.mark.parametrize(("kind", "known_as"), [("", "mine.py:Wind"), ('kind = "wind"', "wind")])
def test_own_effect_takes_part(tmp_path, kind, known_as):
    case = load_case(write(tmp_path, own_case(tmp_path, kind)))
    cls = case.effects[2].cls
    assert EFFECTS[known_as] is cls
    assert cls.kind == known_as
    # the same class again: what was compiled for it still serves
    assert load_case(case.path).effects[2].cls is cls
    assert build_machine(case).parameters.names[-1] == f"{known_as}.pressure"


OWN_FAULTS = {
    "no such file": ('"my.py:Wind"', ["my.py", "does not exist", "there is: mine.py"]),
    "no such class": ('"mine.py:Wnid"', ["Wnid is not there", "'Wind'"]),
    "no class": ('"mine.py"', ["names no class", "my_effects.py:MyEffect"]),
    "not an effect": ('"mine.py:NotAnEffect"', ["not a subclass of jaxid.model.Effect"]),
    "no act": ('"mine.py:Idle"', ["no method act", "define act"]),
}


@pytest.mark.parametrize("fault", OWN_FAULTS)
def test_own_effect_fault(tmp_path, fault):
    kind, words = OWN_FAULTS[fault]
    told = message(tmp_path, own_case(tmp_path).replace('"mine.py:Wind"', kind))
    assert "[[effects]] 3: kind" in told
    assert all(word in told for word in words), told


def test_own_effect_that_does_not_import(tmp_path):
    write(tmp_path, "1 / 0", "broken.py")
    told = message(tmp_path, more('[[effects]]\nkind = "broken.py:Wind"\n'))
    assert "ZeroDivisionError" in told
    assert "mend broken.py" in told


def test_own_effect_with_an_unknown_dimension(tmp_path):
    assert "'N/m'" in message(tmp_path, own_case(tmp_path, dimension="N/m"))


def test_own_effect_does_not_take_a_name_there_is(tmp_path):
    viscous = EFFECTS["viscous_friction"]
    told = message(tmp_path, own_case(tmp_path, 'kind = "viscous_friction"'))
    assert "takes the name of an effect there is: viscous_friction" in told
    write(
        tmp_path,
        "from jaxid.effects import register\nfrom jaxid.model import Effect\n"
        '@register("viscous_friction")\nclass ViscousFriction(Effect):\n    pass\n',
        "theirs.py",
    )
    told = message(tmp_path, more('[[effects]]\nkind = "theirs.py:ViscousFriction"\n'))
    assert "viscous_friction" in told
    assert EFFECTS["viscous_friction"] is viscous
