"""What `discover` names in a log of the micropositioning stage that shows its table's friction."""

import pytest

import jaxid
from truth.chain import stages


@pytest.mark.slow
def test_the_friction_of_the_table_is_named_both_ways(tmp_path):
    """Hysteresis twice as high forwards as backwards, and a ripple: all of Table 1 that acts there."""
    found = jaxid.discover(*stages.long_case(tmp_path, stages.to_and_fro()))
    assert found.verdict == "found"
    assert {e.label for e in found.effects} == {"velocity_hysteresis[2]", "cogging[2]"}
    true = stages.TRUTH[1]
    at = dict(zip(found.after.names, found.after.theta, strict=True))
    for name in ("level", "level_negative", "velocity"):
        wanted = true[f"velocity_hysteresis[2].{name}"]
        assert at[f"velocity_hysteresis[2].{name}"] == pytest.approx(wanted, rel=3e-3)
    assert at["cogging[2].amplitude"] == pytest.approx(true["cogging[2].amplitude"], rel=3e-3)
    assert at["cogging[2].period"] == pytest.approx(stages.PITCH, rel=1e-3)
    before, after = (g[0].simulation.rms[0] for g in (found.gaps_before, found.gaps_after))
    assert after < 0.02 * before
    # Once it is there, nothing else may be added: rows of the whitened residual that another effect could
    # explain are no part of the gap.
    last = found.rounds[-1].step
    assert all(s.reason for s in last.scores if s.evidence > last.threshold)


@pytest.mark.slow
def test_a_limit_that_all_of_the_force_exceeds_is_taken_out_again(tmp_path):
    """At the level of the friction it leaves no force, nor any need of an inertia: 47 rad off in the loop.

    One way only the friction that is missing passes for inertia, 2.2 times the true one, until it is named.
    """
    found = jaxid.discover(*stages.long_case(tmp_path, stages.one_way()))
    taken_out = [r.step for r in found.rounds if r.step.dropped and r.step.why]
    assert "saturation[1]" in {step.dropped.label for step in taken_out}
    assert all("simulated loop comes nearer" in step.why for step in taken_out)
    assert {e.label for e in found.effects} == {"velocity_hysteresis[2]", "cogging[2]"}
    true = stages.TRUTH[1]
    assert found.before.value("motor_inertia") == pytest.approx(2.2 * true["motor_inertia"], rel=0.1)
    assert found.after.value("motor_inertia") == pytest.approx(true["motor_inertia"], rel=0.03)
    assert found.after.value("cogging[2].amplitude") == pytest.approx(true["cogging[2].amplitude"], rel=0.01)
    before, after = (g[0].simulation.rms[0] for g in (found.gaps_before, found.gaps_after))
    assert after < 0.2 * before
    # What acts backwards does not show one way.
    assert found.model_complete is False
    assert not found.parameters["velocity_hysteresis[2].level_negative"].identifiable
