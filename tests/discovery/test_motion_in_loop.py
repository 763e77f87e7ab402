"""What fits the forces and moves wrongly is taken out again, and the search goes on without it."""

import pytest

import jaxid
from benchmarks import hidden_run
from jaxid.commands.discover import start_search
from jaxid.discovery.in_loop.confirm import WHY, hindering
from jaxid.discovery.search import Model
from jaxid.effects import EFFECTS
from jaxid.gap import filter_floor
from jaxid.model.unknowns import free_effect
from truth.axis.cases import write_case
from truth.hidden import cases as hidden_cases
from truth.hidden.bench import text_of


def opened(seed: int, folder, *, closed: bool = True):
    """A short log of a 500-count encoder, and what its case file knows; None where nobody asks."""
    case = next(c for c in hidden_cases.cases("seen_too", 1) if c.seed == seed)
    logs = [hidden_run.logged(case, validation=v) for v in ((False, True) if case.validated else (False,))]
    text = text_of(case)
    if not closed:
        text = text[: text.index("[controller]")] + text[text.index("[sensor]") :]
    return write_case(folder, text), logs


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """A hidden spring, which a limit that no force reaches imitates in the band of the filter."""
    case, logs = opened(6387, tmp_path_factory.mktemp("spring"))
    with pytest.MonkeyPatch.context() as patch:
        # The limit takes away the inertia, for which it would be turned down at once.
        patch.setattr("jaxid.discovery.acceptance._NOTHING", 0.0)
        return jaxid.discover(case, logs[0], validate=logs[1:], refit=False)


@pytest.mark.slow
def test_the_effect_that_worsens_the_simulation_makes_room_for_the_right_one(spring):
    assert spring.kinds == ["linear_stiffness"]
    before, after = spring.gaps_before, spring.gaps_after
    for old, new in zip(before, after, strict=True):
        assert new.simulation.relative[0] < 0.3 * old.simulation.relative[0]


@pytest.mark.slow
def test_the_steps_and_the_notes_say_what_was_taken_out(spring, tmp_path):
    (out,) = [r.step for r in spring.rounds if r.step.why]
    assert out.dropped.kind == "saturation"
    assert out.why == WHY
    assert f"note: saturation was taken out again: {WHY}" in str(spring)
    added = [r.step.added.candidate.kind for r in spring.rounds if r.step.added]
    # What is added between the two goes with the first.
    assert (added[0], added[-1]) == ("saturation", "linear_stiffness")
    assert "saturation dropped" in (spring.save(tmp_path / "out") / "report.html").read_text()


@pytest.mark.slow
def test_a_complete_model_gets_no_ripple(tmp_path, monkeypatch):
    case, logs = opened(6410, tmp_path)
    # Beyond the band of the filter it is not even added.
    monkeypatch.setattr("jaxid.discovery.acceptance._IN_BAND", 0.0)
    found = jaxid.discover(case, logs[0], refit=False)
    assert found.verdict == "nothing_missing"
    assert [r.step.dropped.kind for r in found.rounds if r.step.why] == ["cogging"]


def test_the_filter_of_a_short_coarse_log_leaves_more_than_its_noise_and_another_does_not(tmp_path):
    left = {}
    for seed in (6410, 6252):
        path, logs = opened(seed, tmp_path)
        session = jaxid.open_session(path, logs[0], align_hold=True)
        baseline, search = start_search(session)
        left[seed] = filter_floor(baseline.machine, session.fit) / search.floor
    assert left[6410] > 3.0
    assert left[6252] < 0.1


@pytest.mark.parametrize("closed", [True, False])
def test_an_effect_hinders_by_what_it_does_to_the_loop(tmp_path, closed):
    path, logs = opened(6384, tmp_path, closed=closed)  # a constant force is hidden
    true = next(c for c in hidden_cases.cases("seen_too", 1) if c.seed == 6384).values
    session = jaxid.open_session(path, logs[0], logs[1:], align_hold=True)
    baseline, search = start_search(session)
    search.run(0)
    assert hindering(search, session, baseline.machine) is None, "nothing was added"
    force = next(c for c in search.rest() if c.kind == "constant_force")
    search.model = Model((force,), search.theta.copy())
    effect, machine = EFFECTS["constant_force"](level=0.0), baseline.machine
    plant, free = free_effect(machine.plant, effect, machine.units)
    machine = machine.with_plant(plant, machine.parameters.extended(free))
    for sign in (1.0, -1.0):
        search.theta[force.index] = sign * true["constant_force"]["level"]
        found = hindering(search, session, machine.with_estimate(search.theta[search.active]))
        # In open loop the distance says little, and nothing is asked.
        assert found is (force if sign < 0 and closed else None)
