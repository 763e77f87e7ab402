"""What `discover` names in a log of the micropositioning stage that shows its table's friction."""

import pytest

import jaxid
from truth.chain import stages


@pytest.fixture(scope="module")
def both_ways(tmp_path_factory):
    """A log in which the table moves to and fro."""
    return jaxid.discover(*stages.long_case(tmp_path_factory.mktemp("stage"), stages.to_and_fro()))


@pytest.mark.slow
def test_the_friction_of_the_table_is_named_both_ways(both_ways):
    """Hysteresis twice as high forwards as backwards, and a ripple: all of Table 1 that acts there."""
    found, true = both_ways, stages.TRUTH[1]
    assert found.verdict == "found"
    assert {e.label for e in found.effects} == {"velocity_hysteresis[2]", "cogging[2]"}
    for name in ("velocity_hysteresis[2].level", "velocity_hysteresis[2].velocity", "cogging[2].amplitude"):
        assert found.after.value(name) == pytest.approx(true[name], rel=3e-3)
    assert found.after.value("cogging[2].period") == pytest.approx(stages.PITCH, rel=1e-3)
    before, after = (g[0].simulation.rms[0] for g in (found.gaps_before, found.gaps_after))
    assert after < 0.02 * before
    # Once it is there, nothing else may be added: rows of the whitened residual that another effect could
    # explain are no part of the gap.
    last = found.rounds[-1].step
    assert all(s.reason for s in last.scores if s.evidence > last.threshold)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="0.302 % off with four steps a sample, 0.12 % with eight")
def test_the_level_backwards_is_within_three_thousandths(both_ways):
    name = "velocity_hysteresis[2].level_negative"
    assert both_ways.after.value(name) == pytest.approx(stages.TRUTH[1][name], rel=3e-3)


@pytest.fixture(scope="module")
def one_way(tmp_path_factory):
    """A log in which the table never moves backwards."""
    return jaxid.discover(*stages.long_case(tmp_path_factory.mktemp("stage"), stages.one_way()))


@pytest.mark.slow
def test_a_limit_that_all_of_the_force_exceeds_is_refused(one_way):
    """At the level of the friction it leaves no force, nor any need of an inertia: 47 rad off in the loop."""
    tried = [s for r in one_way.rounds for s in r.step.scores if s.candidate.label == "saturation[1]"]
    # In the first round, and whenever it would explain something.
    assert tried[0].reason.startswith("motor_inertia would be next to nothing")
    for score in tried:
        lost = score.reason.startswith("motor_inertia would be next to nothing")
        assert lost or (score.evidence < 0 and score.reason == "it closes none of the gap")
    added = [r.step.added.candidate.kind for r in one_way.rounds if r.step.added]
    assert "saturation" not in added


@pytest.mark.slow
def test_the_friction_of_the_table_is_named_one_way(one_way):
    """The friction that is missing passes for inertia, 2.2 times the true one, until it is named.

    It also passes for coloured noise: a flexible joint gains more, and is taken out again.
    """
    assert {e.label for e in one_way.effects} == {"velocity_hysteresis[2]", "cogging[2]"}
    true = stages.TRUTH[1]
    assert one_way.before.value("motor_inertia") == pytest.approx(2.2 * true["motor_inertia"], rel=0.1)
    assert one_way.after.value("motor_inertia") == pytest.approx(true["motor_inertia"], rel=0.03)
    wanted = true["cogging[2].amplitude"]
    assert one_way.after.value("cogging[2].amplitude") == pytest.approx(wanted, rel=0.01)
    before, after = (g[0].simulation.rms[0] for g in (one_way.gaps_before, one_way.gaps_after))
    assert after < 0.2 * before
    # What acts backwards does not show one way.
    assert one_way.model_complete is False
    level = one_way.parameters["velocity_hysteresis[2].level_negative"]
    assert level.std > 1000.0 * true["velocity_hysteresis[2].level_negative"]


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="a value of 0 with a deviation of 12 kN counts as identifiable")
def test_a_level_that_never_acts_is_not_identifiable(one_way):
    assert not one_way.parameters["velocity_hysteresis[2].level_negative"].identifiable
