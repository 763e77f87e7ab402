"""A user's own effect: a class in a file beside the case."""

from pathlib import Path

import pytest
from case_faults import message, more, write

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.effects import EFFECTS

OWN_EFFECT = """
from jaxid.model.effect import Action, Effect
from jaxid.model.parameter import parameter

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


def own_case(tmp_path: Path, kind: str = "", dimension: str = "force", name: str = "Wind") -> str:
    write(tmp_path, OWN_EFFECT.format(kind=kind or "pass", dimension=dimension), "mine.py")
    return more(f'[[effects]]\nkind = "mine.py:{name}"\npressure = {{ guess = 3.0 }}\n')


@pytest.mark.parametrize(("kind", "known_as"), [("", "mine.py:Wind"), ('kind = "wind"', "wind")])
def test_own_effect_takes_part(tmp_path, kind, known_as):
    case = load_case(write(tmp_path, own_case(tmp_path, kind)))
    cls = case.effects[2].cls
    assert cls.kind == known_as
    assert case.own_effects == (cls,)
    assert known_as not in EFFECTS  # it is this case's
    # the same class again: what was compiled for it still serves
    assert load_case(case.path).effects[2].cls is cls
    assert build_machine(case).parameters.names[-1] == f"{known_as}.pressure"


def test_own_effects_of_two_cases_do_not_meet(tmp_path):
    classes = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        path = write(tmp_path / name, own_case(tmp_path / name, 'kind = "wind"'))
        classes += load_case(path).own_effects
    assert classes[0] is not classes[1]
    assert [c.kind for c in classes] == ["wind", "wind"]


def test_candidates_are_no_part_of_the_model(tmp_path):
    own_case(tmp_path)
    case = load_case(write(tmp_path, more('[discover]\ncandidates = ["mine.py:Wind"]\n')))
    assert [c.__name__ for c in case.candidates] == ["Wind"]
    assert case.own_effects == case.candidates
    assert len(case.effects) == 2


CANDIDATE_FAULTS = {
    "no such class": ('candidates = ["mine.py:Wnid"]', "candidates[1] = ", "did you mean 'Wind'?"),
    "no such file": ('candidates = ["my.py:Wind"]', "does not exist", "there is: mine.py"),
    "not a class": ('candidates = ["Wind"]', "names no class", "my_effects.py:MyEffect"),
    "known": ('candidates = ["cogging"]', "takes part in every search", "leave it out"),
    "no list": ('candidates = "mine.py:Wind"', "is not a list", "in [ ]"),
    "no text": ("candidates = [3]", "candidates[1] = 3", "is not a text"),
    "unknown key": ('candidate = ["mine.py:Wind"]', "unknown key", "did you mean 'candidates'?"),
    "two of a kind": ('candidates = ["mine.py:Wind", "also.py:Wind"]', "of kind 'wind'", "another kind"),
}


@pytest.mark.parametrize("fault", CANDIDATE_FAULTS)
def test_candidate_fault(tmp_path, fault):
    line, *words = CANDIDATE_FAULTS[fault]
    own_case(tmp_path, 'kind = "wind"')
    if fault == "two of a kind":
        write(tmp_path, (tmp_path / "mine.py").read_text(), "also.py")
    told = message(tmp_path, more(f"[discover]\n{line}\n"))
    assert all(word in told for word in words), told


OWN_FAULTS = {
    "no such file": ('"my.py:Wind"', ["my.py", "does not exist", "there is: mine.py"]),
    "no such class": ('"mine.py:Wnid"', ["Wnid is not there", "'Wind'"]),
    "no class": ('"mine.py"', ["names no class", "my_effects.py:MyEffect"]),
    "not an effect": ('"mine.py:NotAnEffect"', ["not a subclass of jaxid.model.effect.Effect"]),
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
    assert "correct broken.py" in told


def test_own_effect_with_an_unknown_dimension(tmp_path):
    assert "'N/m'" in message(tmp_path, own_case(tmp_path, dimension="N/m"))


def test_own_effect_does_not_take_a_name_there_is(tmp_path):
    viscous = EFFECTS["viscous_friction"]
    told = message(tmp_path, own_case(tmp_path, 'kind = "viscous_friction"'))
    assert "takes the name of an effect there is: viscous_friction" in told
    write(
        tmp_path,
        "from jaxid.effects import register\nfrom jaxid.model.effect import Effect\n"
        '@register("viscous_friction")\nclass ViscousFriction(Effect):\n    pass\n',
        "theirs.py",
    )
    told = message(tmp_path, more('[[effects]]\nkind = "theirs.py:ViscousFriction"\n'))
    assert "viscous_friction" in told
    assert EFFECTS["viscous_friction"] is viscous
