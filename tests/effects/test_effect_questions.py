"""Shared code asks an effect what it is: no module outside of `jaxid/effects` knows one by its name."""

import ast
from pathlib import Path

import jax.numpy as jnp
import pytest

import jaxid
from jaxid.effects import EFFECTS
from jaxid.model.effect import Signals
from jaxid.model.parameter import parameters_of

PACKAGE = Path(jaxid.__file__).parent
NAMES_A_PARAMETER = (
    "sliding_level",
    "break_away_level",
    "stribeck_velocity",
    "viscous_coefficient",
    "drive_gain",
)
# Folders that may name effects, with the reason.
NAMING = {
    "effects": "their home",
    "plants": "a plant states which effects are its own parameters by another name",
    "demo": "its case",
    "export": "a model of another program has words for some effects only",
    "first_case": "it writes the friction of a first case",
}
# Files that may, with the reason.
NAMING_FILES = {
    "case/tables.py": "a dead band is a key of [controller] too",
    "case/user_faults.py": "a method of effects has the name of one",
    "case/tree.py": "damping, dry friction and springs of a robot's file become effects",
}
# Modules that import the class of an effect, because they add one themselves or ask for its equivalent.
ADDING = {
    "build.py": {"BackEmfDamping"},
    "discovery/at_rest/break_away.py": {"StaticFriction"},
    "simulation/step_size.py": {"ViscousFriction"},
    "estimators/minimal/read_back.py": {"ViscousFriction"},
    "experiment_design/next_case.py": {"AddedMass"},
    "experiment_design/second_logs.py": {"AddedMass"},
}


def shared_modules() -> list[Path]:
    return [
        path
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.relative_to(PACKAGE).parts[0] not in NAMING
        and path.relative_to(PACKAGE).as_posix() not in NAMING_FILES
    ]


def test_no_shared_module_knows_an_effect_by_its_name():
    named = [
        f"{path.relative_to(PACKAGE)}:{node.lineno} {node.value}"
        for path in shared_modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in EFFECTS
    ]
    assert named == []


def test_only_modules_that_add_an_effect_import_its_class():
    imported = {}
    for path in shared_modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("jaxid.effects."):
                imported.setdefault(path.relative_to(PACKAGE).as_posix(), set()).update(
                    a.name for a in node.names
                )
    assert imported == ADDING


@pytest.mark.parametrize("kind", EFFECTS)
def test_an_answer_is_a_parameter_of_the_effect(kind):
    cls = EFFECTS[kind]
    answers = [getattr(cls, name) for name in NAMES_A_PARAMETER]
    assert {a for a in answers if a is not None} <= set(parameters_of(cls))


def answering(name: str) -> set[str]:
    return {kind for kind, cls in EFFECTS.items() if getattr(cls, name) not in (None, False)}


def test_the_answers_of_jaxids_effects():
    assert answering("break_away_level") == {"static_friction"}
    assert {"coulomb_friction"} <= answering("sliding_level")
    assert answering("viscous_coefficient") == {"viscous_friction"}
    assert answering("drive_gain") == {"actuator_gain"}
    assert {kind for kind, cls in EFFECTS.items() if cls.delays_command()} == {"input_delay"}
    assert answering("adds_spring") == {"joint_flexibility"}
    assert answering("opens_spring") == {"backlash"}


def test_break_away_says_so_where_it_acts():
    """A level at rest breaks the continuity of a motion in the unknowns: numerics ask for it."""
    for kind, cls in EFFECTS.items():
        infos = parameters_of(cls)
        values = {n: jnp.asarray(0.5) for n, info in infos.items() if not info.optional}
        values |= {"level": jnp.asarray(0.5)} if "level" in infos else {}
        effect = cls(**values)
        zero = jnp.zeros(())
        x = Signals(zero, zero, zero, zero, zero, zero + 1e-3, zero + 1, zero, zero, zero, zero)
        sticks = not isinstance(effect.act(x, effect.initial_state(zero)).stick, float)
        assert sticks == (cls.break_away_level is not None), kind
