"""Held-out evidence of one effect and of two, against plain least squares on all blocks but one."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.discovery import evidence as ev
from jaxid.discovery.pairs import score_pairs

ROWS, BASE = 400, 6
RNG = np.random.default_rng(5)
COLUMNS = RNG.standard_normal((ROWS, BASE))
EXTRA = [RNG.standard_normal((ROWS, k)) for k in (1, 2, 3)]
OFFSET = RNG.standard_normal((ROWS, 1))
RESIDUALS = RNG.standard_normal((ROWS, 4)) + COLUMNS[:, :1] + 0.3 * EXTRA[1][:, :1]
BLOCKS = np.sort(RNG.integers(0, ev.BLOCKS, ROWS))


def left(columns, e):
    """Sum of squares on each block after a fit to the others."""
    total = np.zeros(e.shape[1])
    for b in range(ev.BLOCKS):
        on = b == BLOCKS
        x = np.linalg.lstsq(columns[~on], e[~on])[0]
        total += np.sum((e[on] - columns[on] @ x) ** 2, axis=0)
    return total


def test_a_base_alone():
    found = ev.held_out(ev.grams(COLUMNS, BLOCKS), *ev.products(COLUMNS, RESIDUALS, BLOCKS))
    np.testing.assert_allclose(found, left(COLUMNS, RESIDUALS), rtol=1e-6)


@pytest.mark.parametrize("offset", [None, OFFSET])
@pytest.mark.parametrize("extra", EXTRA)
def test_columns_beside_a_base(extra, offset):
    beside = ev.Beside(COLUMNS, RESIDUALS, BLOCKS)
    found = beside.held_out(extra, beside.crossed(extra), offset)
    e = RESIDUALS if offset is None else RESIDUALS + offset
    np.testing.assert_allclose(found, left(np.concatenate([COLUMNS, extra], axis=1), e), rtol=1e-6)


def test_a_column_of_zeros_changes_nothing():
    # For instance the slope by a limit that nothing reaches.
    one = np.random.default_rng(4).standard_normal((len(BLOCKS), 1))
    with_zeros = np.column_stack([COLUMNS, np.zeros(len(BLOCKS))])
    first, second = (ev.Beside(base, RESIDUALS, BLOCKS) for base in (COLUMNS, with_zeros))
    found = second.held_out(one, second.crossed(one))
    assert found == pytest.approx(first.held_out(one, first.crossed(one)), rel=1e-9)


def test_two_effects_beside_a_base():
    e, offsets = RESIDUALS[:, :1], (None, OFFSET, None)
    names = [SimpleNamespace(candidate=k) for k in range(3)]
    points = list(zip(names, EXTRA, offsets, strict=True))
    found = score_pairs(COLUMNS, e, points, BLOCKS).evidence
    before = left(COLUMNS, e)
    for i in range(3):
        for j in range(i, 3):
            chosen = {i, j}
            columns = np.concatenate([COLUMNS, *[EXTRA[k] for k in chosen]], axis=1)
            after = left(columns, sum((OFFSET for k in chosen if k == 1), e))
            assert found[i, j] == pytest.approx(float(-0.5 * ROWS * np.log(after / before)[0]), rel=1e-5)
