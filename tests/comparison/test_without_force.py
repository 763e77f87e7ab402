"""`compare` of logs without a force, made by an exact stepper: the simulated loop shows what differs."""

import dataclasses

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_pairs import pair

pytestmark = pytest.mark.slow


def drawn_pair(what: str):
    """Return the first drawn pair of servos that differ in something."""
    return next(p for p in (pair("differ", k) for k in range(12)) if p.what == what)


def test_a_friction_that_differs_is_named_without_a_scale():
    drawn = drawn_pair("friction")
    case = dataclasses.replace(drawn.first, known=False).case()
    result = jaxid.compare(case, drawn.columns())
    (found,) = result.differences
    assert found.parameter == "coulomb_friction.level"
    assert found.evidence > found.threshold
    one, two = (v.value for v in found.by_log.values())
    assert two / one == pytest.approx(drawn.change, rel=0.03)

    assert (result.quantity, result.scale) == ("position", "inertia")
    assert "inertia was held at its guess" in str(result)
    content = result.json()
    assert content["gap"]["quantity"] == "position"
    assert content["gap"]["unit"] == "rad"


def test_a_payload_is_named_though_nothing_gives_a_scale():
    drawn = drawn_pair("payload")
    case = dataclasses.replace(drawn.first, known=False).case()
    result = jaxid.compare(case, drawn.columns())
    (found,) = result.differences
    assert found.parameter == "inertia"
    one, two = found.by_log.values()
    assert not np.isfinite(one.std)
    assert two.value / one.value == pytest.approx(drawn.change, abs=4 * two.std / one.value)
    assert "(held)" in str(result)


def test_an_effect_in_one_log_is_named():
    drawn = drawn_pair("unbalance")
    (found,) = jaxid.compare(drawn.first.case(), drawn.columns()).differences
    assert found.kind == "unbalance"
    one, two = found.by_log.values()
    assert one is None
    moment = two["moment"]
    if drawn.first.known:
        assert moment.value == pytest.approx(drawn.change, abs=4 * moment.std)


@pytest.mark.parametrize("number", [0, 1])
def test_equal_servos_do_not_differ(number):
    drawn = pair("equal", number)
    result = jaxid.compare(drawn.first.case(), drawn.columns())
    assert (result.verdict, result.differences) == ("same", ())
