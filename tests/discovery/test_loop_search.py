"""The search in simulated loops: unstable loops of incomplete models, and one effect in place of two."""

from types import SimpleNamespace

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_machines import servo
from jaxid.discovery.in_loop import positions
from jaxid.discovery.in_loop.positions import LoopSamples, LoopSearch
from jaxid.discovery.search import Model
from jaxid.simulation.noisy_loop import ReadingNoise


def noise(shift: float) -> ReadingNoise:
    rng = np.random.default_rng(0)
    moved = shift * rng.standard_normal((500, 1))
    return ReadingNoise(np.array([1.5e-3]), np.array([2e-4]), np.zeros(2), shift=moved)


@pytest.mark.parametrize(
    ("shift", "nearer", "by_mean", "kept"),
    [
        (3e-4, False, False, True),
        (1.5e-2, False, True, False),
        (1.5e-2, True, False, False),
        (1.5e-2, True, True, True),
    ],
)
def test_an_unstable_loop_gives_other_models_no_mean_readings(shift, nearer, by_mean, kept, monkeypatch):
    monkeypatch.setattr(positions, "estimated_noise", lambda *args, **kwargs: noise(shift))
    monkeypatch.setattr(positions, "_nearer", lambda *args: nearer)
    monkeypatch.setattr(LoopSamples, "_alone", lambda self, superset, added, theta: (None, None))
    before = LoopSamples(None, None, None, (None, None), np.ones((5, 1), bool), np.ones((5, 1)), noise(1e-5))
    after = before.renewed(None, (), np.zeros(1), by_mean=by_mean)
    assert (after.noise is not None) == kept


@pytest.mark.parametrize("superfluous", [True, False])
def test_an_effect_takes_the_place_of_two_that_it_explains(superfluous):
    saturation, drag, supply = ("saturation", "quadratic_drag", "voltage_limit")
    score = SimpleNamespace(candidate=SimpleNamespace(label=supply), refitted="values")
    added = (SimpleNamespace(label=saturation), SimpleNamespace(label=drag))

    def drop(model, limit, effects):
        assert effects == [added[1]]
        assert model.added == (score.candidate, added[1])
        return (Model((score.candidate,), "fewer"), ["dropped"]) if superfluous else (model, [])

    search = SimpleNamespace(
        model=Model(added, "both"),
        limit=10.0,
        progress=lambda text: None,
        fit=lambda theta, active: theta,
        fitted_by=lambda effects: effects,
        drop_superfluous=drop,
        step=lambda model, **of: of,
    )
    steps: list = []
    assert LoopSearch._joined(search, {0: (score,), 1: ()}, steps) == superfluous
    if superfluous:
        assert search.model.added == (score.candidate,)
        assert (steps[0]["added"], steps[0]["dropped"], steps[1]) == (score, added[0], "dropped")
    else:
        assert (search.model.added, steps) == (added, [])


def test_a_single_effect_is_not_exchanged():
    search = SimpleNamespace(model=Model((SimpleNamespace(label="saturation"),), "one"))
    assert not LoopSearch._joined(search, {0: (SimpleNamespace(),)}, [])


@pytest.mark.slow
def test_a_spring_beside_which_the_declared_loop_is_unstable():
    """The fit without the spring ends in a limit cycle, whose mean readings are 15 mrad off."""
    drawn = servo(10_022, "linear_stiffness")
    found = jaxid.discover(drawn.case(), drawn.columns())
    assert found.kinds == ["linear_stiffness"]
    assert found.model_complete
    truth = drawn.truth() | {"linear_stiffness.coefficient": drawn.effects["linear_stiffness"]["coefficient"]}
    for name, value, std in zip(found.after.names, found.after.theta, found.after.std, strict=True):
        assert abs(value - truth[name]) < 4 * std
