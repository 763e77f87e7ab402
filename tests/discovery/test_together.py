"""Laws of several joints that are added at once."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.discovery import together
from jaxid.discovery.candidates import Candidate


def law(number: int) -> Candidate:
    one = np.ones(1)
    return Candidate(f"law{number}", f"law{number}", 0, np.array([2 + number]), 0 * one, one[None], one > 0)


def linear_search(truth: np.ndarray, rng: np.random.Generator) -> tuple[SimpleNamespace, np.ndarray]:
    """A search whose residual is linear in two unknowns of its case and in laws that resemble each other."""
    columns = rng.normal(size=(400, 3, len(truth)))
    columns[..., 3] = columns[..., 2] + 0.3 * columns[..., 3]
    measured = columns @ truth + 1e-3 * rng.normal(size=(400, 3))
    theta = np.linalg.lstsq(columns.reshape(-1, len(truth)), measured.ravel(), rcond=None)[0]
    search = SimpleNamespace(
        superset=SimpleNamespace(base=np.arange(2)),
        samples=SimpleNamespace(moving=np.ones((400, 3), bool)),
        domain=SimpleNamespace(evaluate=lambda samples, at, wanted: (columns @ at - measured, columns)),
        fitted_by=lambda laws: np.concatenate([[0, 1], *[c.index for c in laws]]).astype(int),
    )
    return search, theta


@pytest.mark.parametrize("strengths", [[0.5, 0.0, 2.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
def test_only_laws_that_act_are_needed(strengths):
    search, theta = linear_search(np.array([1.0, -1.0, *strengths]), np.random.default_rng(0))
    found = together._needed(search, theta, [law(k) for k in range(4)])
    assert {c.kind for c in found} == {f"law{k}" for k, value in enumerate(strengths) if value}


def test_the_least_needed_law_comes_first():
    search, theta = linear_search(np.array([1.0, -1.0, 0.0, 3.0, 0.0, 0.7]), np.random.default_rng(1))
    assert [c.kind for c in together._needed(search, theta, [law(k) for k in range(4)])] == ["law3", "law1"]


def test_a_law_takes_up_what_its_twin_explained():
    search, theta = linear_search(np.array([1.0, -1.0, 0.4, 0.0, 0.0, 0.0]), np.random.default_rng(2))
    measured, columns = search.domain.evaluate(None, 0 * theta, None)
    noise = np.random.default_rng(3).normal(size=measured.shape)
    columns[..., 3] = columns[..., 2] + 1e-5 * columns[..., 4]
    search.domain.evaluate = lambda samples, at, wanted: (columns @ at + measured + noise, columns)
    # Each has half of what one of them has alone: a tenth of the sum of squares, and by itself a fortieth.
    first = [0, 1, 2]
    rows = columns[..., first].reshape(-1, 3), -(measured + noise).ravel()
    alone = np.linalg.lstsq(*rows, rcond=None)[0]
    theta = np.array([*alone[:2], 0.5 * alone[2], 0.5 * alone[2], 0.0, 0.0])
    assert len(together._needed(search, theta, [law(k) for k in range(4)])) == 1
