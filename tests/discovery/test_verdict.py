"""The verdict of a search that named nothing."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.commands import discover


@pytest.mark.parametrize(
    ("times_the_floor", "significant", "beyond_numerics", "verdict"),
    [
        (1.2, True, True, "nothing_missing"),
        (2.0, False, True, "nothing_missing"),
        (2.0, True, True, "unexplained"),
        # So much is never nothing, even if it stands out over no variable.
        (3.5, False, True, "unexplained"),
        (3.5, True, False, "nothing_missing"),
    ],
)
def test_the_verdict_follows_from_what_is_left(
    monkeypatch, times_the_floor, significant, beyond_numerics, verdict
):
    monkeypatch.setattr(discover, "_rms", lambda search, samples, theta: times_the_floor * search.floor)
    search = SimpleNamespace(
        floor=np.array([0.5]),
        samples=None,
        acceptance=SimpleNamespace(above_numerics=lambda theta: beyond_numerics),
    )
    where, steps = SimpleNamespace(significant=significant), [SimpleNamespace(theta=np.zeros(1))]
    assert discover._verdict((), where, steps, search) == verdict
