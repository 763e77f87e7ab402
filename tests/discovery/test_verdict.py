"""The verdict of a search that named nothing."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid import gap
from jaxid.commands import discover


@pytest.mark.parametrize(
    ("times_the_floor", "significant", "beyond_numerics", "by_filter", "verdict"),
    [
        (1.2, True, True, 0.0, "nothing_missing"),
        (2.0, False, True, 0.0, "nothing_missing"),
        (2.0, True, True, 0.0, "unexplained"),
        # So much is never nothing, even if it stands out over no variable, unless the filter leaves as much.
        (3.5, False, True, 0.0, "unexplained"),
        (3.5, False, True, 0.4, "unexplained"),
        (3.5, False, True, 2.0, "nothing_missing"),
        (3.5, True, True, 2.0, "unexplained"),
        (3.5, True, False, 0.0, "nothing_missing"),
    ],
)
def test_the_verdict_follows_from_what_is_left(
    monkeypatch, times_the_floor, significant, beyond_numerics, by_filter, verdict
):
    monkeypatch.setattr(discover, "_rms", lambda search, samples, theta: times_the_floor * search.floor)
    monkeypatch.setattr(discover, "filter_floor", lambda machine, run: by_filter * np.array([0.5]))
    search = SimpleNamespace(
        floor=np.array([0.5]),
        samples=None,
        acceptance=SimpleNamespace(above_numerics=lambda theta: beyond_numerics),
    )
    where, steps = SimpleNamespace(significant=significant), [SimpleNamespace(theta=np.zeros(1))]
    assert discover._verdict_on_none(where, steps, search, SimpleNamespace(fit=None), None) == verdict


@pytest.mark.parametrize(("integrated", "command"), [(True, np.ones((5, 1))), (False, None)])
def test_the_filter_is_judged_by_positions_in_a_known_loop_only(monkeypatch, integrated, command):
    """Else the measured motion, or a simulation that drifts, would be taken for what the filter leaves."""
    monkeypatch.setattr(gap, "simulated", lambda machine, log: SimpleNamespace(command=command))
    run = SimpleNamespace(
        machine=lambda machine: machine,
        log=SimpleNamespace(measured=(True,), integrated=integrated),
        data=SimpleNamespace(q=np.zeros((5, 1))),
    )
    np.testing.assert_array_equal(gap.filter_floor(None, run), [0.0])
