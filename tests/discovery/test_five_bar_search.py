"""What a search names on a five-bar robot from the exact stepper's log: which hinge, or the payload."""

import dataclasses

import numpy as np
import pytest

from jaxid.commands.discover import discover
from tests.case.test_five_bar_case import LOG, NOISE, effect, unknown
from tests.support.written_logs import write_csv
from truth.five_bar.oracle import PLANT, Robot
from truth.five_bar.stepper import followed

DECLARED = {"coulomb_friction": [6.0, 5.0, 0.0, 0.0, 0.0], "viscous_friction": [4.0, 3.0, 0.0, 0.0, 0.0]}
CASE = PLANT + "".join(effect(kind, unknown(1.0, 2)) for kind in DECLARED) + LOG
SECOND = '[[validation]]\nname = "second"\nlog = "second.csv"\n'


def hidden(kind: str, hinge: int, value: float) -> Robot:
    """The declared robot with friction in one more hinge, counted from 0."""
    values = {k: [*v] for k, v in DECLARED.items()}
    values[kind][hinge] = value
    return Robot(friction=values)


CASES = {
    "coulomb": (hidden("coulomb_friction", 3, 0.8), ("coulomb_friction", "passive", 2), "level", 0.8),
    "viscous": (hidden("viscous_friction", 2, 0.6), ("viscous_friction", "passive", 1), "coefficient", 0.6),
    "payload": (
        dataclasses.replace(Robot(friction=DECLARED), tip_mass=2.72 + 0.5),
        ("added_mass", "tool", 1),
        "mass",
        0.5,
    ),
    "nothing": (Robot(friction=DECLARED), None, "", 0.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_what_is_hidden_is_named_with_its_place(tmp_path, name):
    robot, wanted, parameter, true = CASES[name]
    for file, seed in (("log", 0), ("second", 7)):
        write_csv(tmp_path / f"{file}.csv", followed(robot, seed=seed, **NOISE))
    (tmp_path / "case.toml").write_text(CASE + SECOND)
    found = discover(tmp_path / "case.toml", tmp_path / "log.csv")
    if wanted is None:
        assert (found.verdict, found.effects) == ("nothing_missing", ())
        return
    assert found.verdict == "found"
    assert [(e.kind, *e.place) for e in found.effects] == [wanted]
    value = dict(zip(found.after.names, zip(found.after.theta, found.after.std, strict=True), strict=True))
    mean, std = value[f"{wanted[0]}[{wanted[1]} {wanted[2]}].{parameter}"]
    assert abs(mean - true) < 3 * std
    assert std < 0.01 * np.abs(true)
