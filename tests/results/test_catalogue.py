"""The tables of effects and plants that commands print."""

import pytest

from jaxid.results.catalogue import effects_table, plants_table

# When `discover` searches for an effect.
SEARCHED = {
    "dead_band": "`discover` searches for it without a force; with one, on request.",
    "voltage_limit": "`discover` searches for it on request.",
    "cubic_friction": "Without a force `discover` searches for it on request.",
    "static_friction": "Without a force `discover` does not search for it.",
    "joint_flexibility": "At an arm without a force `discover` searches for it on request.",
    "unbalance": "At an arm `discover` searches for it on request.",
}


def row(kind: str) -> str:
    return next(line for line in effects_table().splitlines() if line.startswith(f"{kind} "))


@pytest.mark.parametrize("kind", SEARCHED)
def test_an_effect_says_when_it_is_searched_for(kind):
    assert row(kind).endswith(f". {SEARCHED[kind]}")


@pytest.mark.parametrize("kind", ["coulomb_friction", "viscous_friction", "saturation"])
def test_an_effect_that_is_always_searched_for_says_nothing(kind):
    assert "discover" not in row(kind)


def test_plants_are_never_searched_for():
    assert "discover" not in plants_table()
