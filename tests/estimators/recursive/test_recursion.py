"""Recursive least squares against closed forms, by numpy alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.estimators.recursive.recursion import IDENTIFIED, Recursion, instants, run

TRUTH = np.array([95.0, 203.0, 20.0, 0.85])
START = np.array([40.0, 0.0, 0.0, 1.0])


def regression(samples: int, rows: int = 2, noise: float = 0.1, seed: int = 0):
    """Rows of unlike size, a right-hand side, and which count: three of four."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((samples, rows, 4)) * [0.5, 0.1, 1.0, 20.0]
    counts = rng.random((samples, rows)) < 0.75
    return y, y @ TRUTH + noise * rng.standard_normal((samples, rows)), counts


def closed_form(recursion: Recursion, y, r, counts):
    """Minimiser of the weighted squares by the normal equations, and their matrix."""
    start, own, beta = (np.asarray(x) for x in (recursion.start, recursion.information, recursion.forgetting))
    if recursion.summed:
        y = np.sum(np.where(counts[..., None], y, 0.0), axis=1, keepdims=True)
        r = np.sum(np.where(counts, r, 0.0), axis=1, keepdims=True)
        counts = counts.any(axis=1)[:, None]
    moved = counts.any(axis=1)
    weight = beta ** (np.cumsum(moved[::-1])[::-1] - moved)
    w = weight[:, None] * counts
    normal, moment = np.einsum("tm,tmi,tmj->ij", w, y, y), np.einsum("tm,tmi,tm->i", w, y, r)
    n, p = int(moved.sum()), len(start)
    left = own * beta**n
    for k in range(n):  # unknown k mod p is reminded of its start at sample k
        left[k % p] += own[k % p] * (1 - beta**p) * beta ** (n - 1 - k)
    whole = normal + np.diag(left)
    return np.linalg.solve(whole, moment + left * start), whole


@pytest.mark.parametrize("summed", [False, True])
@pytest.mark.parametrize("beta", [1.0, 0.995])
def test_it_is_weighted_least_squares(beta, summed):
    """With nothing forgotten it is ridge regression towards the start. All is rounding: 1e-9."""
    y, r, counts = regression(3000)
    own = np.array([0.05, 0.2, 0.01, 0.3]) * (200.0 if beta == 1.0 else 1.0)
    recursion = Recursion(START, own, np.asarray(beta), summed)
    theta, normal = closed_form(recursion, y, r, counts)
    memory, told, _ = run(recursion, recursion.memory(), y, r, counts, 100)
    np.testing.assert_allclose(memory.theta, theta, rtol=1e-9)
    np.testing.assert_allclose(told.theta[-1], theta, rtol=1e-9)
    covariance = memory.root @ memory.root.T
    np.testing.assert_allclose(np.linalg.inv(covariance), normal, rtol=1e-9, atol=1e-9 * normal.max())
    # The start is there, and is not all.
    plain, _ = closed_form(Recursion(START, 1e-9 * own, np.asarray(beta), summed), y, r, counts)
    assert np.max(np.abs(theta / plain - 1)) > 1e-6
    assert np.max(np.abs(START / theta - 1)) > 0.5


def test_standard_deviations_are_the_scatter():
    """Of 400 runs with white noise, forgetting included: to 3.5 %, here four times that."""
    recursion = Recursion(START, np.full(4, 1e-4), np.asarray(0.95))
    y, _, counts = regression(600)
    noise = 0.3 * np.random.default_rng(1).standard_normal((400, *counts.shape))

    def one(e):
        return run(recursion, recursion.memory(), y, y @ TRUTH + e, counts, 600)[1]

    told = jax.jit(jax.vmap(one))(noise)
    scatter = np.std(told.theta[:, -1], axis=0)
    np.testing.assert_allclose(np.sqrt(np.mean(told.std[:, -1] ** 2, axis=0)), scatter, rtol=0.14)
    np.testing.assert_allclose(np.mean(told.noise[:, -1] ** 2), 0.09, rtol=0.03)
    assert np.all(told.identifiable[:, -1])


def test_it_goes_on_bit_for_bit():
    y, r, counts = regression(1000)
    recursion = Recursion(START, np.full(4, 1e-3), np.asarray(0.99))
    whole, told, _ = run(recursion, recursion.memory(), y, r, counts, 10)
    half, _, _ = run(recursion, recursion.memory(), y[:500], r[:500], counts[:500], 10)
    rest, again, _ = run(recursion, half, y[500:], r[500:], counts[500:], 10)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(rest), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(told.theta[50:], again.theta)
    assert not np.array_equal(half.theta, whole.theta)


def test_what_does_not_count_leaves_no_trace():
    y, r, counts = regression(500)
    recursion = Recursion(START, np.full(4, 1e-3), np.asarray(0.99))
    memory, _, _ = run(recursion, recursion.memory(), y, r, counts, 500)
    still, told, _ = run(recursion, memory, y, 1e9 + r, np.zeros_like(counts), 500)
    for a, b in zip(jax.tree.leaves(memory), jax.tree.leaves(still), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.all(np.isfinite(told.std))


def test_the_running_residual():
    """(49): root mean square of what every sample leaves after its own update."""
    y, r, counts = regression(300)
    recursion = Recursion(START, np.full(4, 1e-2), np.asarray(0.99))
    _, told, _ = run(recursion, recursion.memory(), y, r, counts, 1)
    e = np.where(counts, np.einsum("tmp,tp->tm", y, told.theta) - r, 0.0)
    expected = np.sqrt(np.cumsum(np.sum(e**2, axis=1)) / np.maximum(np.cumsum(counts.sum(axis=1)), 1))
    np.testing.assert_allclose(told.residual, expected, rtol=1e-9)


def textbook(start, own, beta, y, r):
    """The covariance form as it is printed: P, and a regularisation that fades."""
    theta, p = start.copy(), np.diag(1 / own)
    for row, value in zip(y, r, strict=True):
        gain = p @ row / (beta + row @ p @ row)
        theta, p = theta + gain * (value - row @ theta), (p - np.outer(gain, row @ p)) / beta
    return theta, p


def test_wind_up_is_bounded_by_the_start():
    """One unknown is stirred for 500 samples of 20 000; the rest of the time nothing tells it."""
    y, r, _ = regression(20000, rows=1)
    y[500:, 0, 3] = 0.0
    r = np.einsum("tmp,p->tm", y, TRUTH)
    own, beta = np.full(4, 1e-3), 0.99
    recursion = Recursion(START, own, np.asarray(beta))
    memory, told, _ = run(recursion, recursion.memory(), y, r, np.ones_like(r, bool), 500)
    variance = np.diag(memory.root @ memory.root.T)
    assert np.all(variance * own < 1 / beta**4)
    _, p = textbook(START, own, beta, y[:, 0], r[:, 0])
    assert p[3, 3] * own[3] > 1e30
    # It is told while it is stirred, then goes back to its start, and says so.
    assert told.identifiable[0, 3]
    np.testing.assert_allclose(told.theta[0, 3], TRUTH[3], rtol=1e-3)
    assert not told.identifiable[-1, 3]
    assert np.isnan(told.std[-1, 3])
    np.testing.assert_allclose(told.theta[-1], [*TRUTH[:3], START[3]], rtol=1e-3)
    assert variance[3] * own[3] > IDENTIFIED > variance[0] * own[0]


def test_a_root_keeps_what_a_covariance_loses():
    """A start 1e9 times less certain than a sample, columns alike to 1 %: P loses it, its root does not."""
    rng = np.random.default_rng(0)
    y = rng.standard_normal((2000, 1)) + 1e-2 * rng.standard_normal((2000, 4))
    r, own = y @ TRUTH + 1e-3 * rng.standard_normal(2000), np.full(4, 1e-18)
    recursion = Recursion(START, own, np.asarray(1.0))
    memory, _, _ = run(recursion, recursion.memory(), y[:, None], r[:, None], np.ones((2000, 1), bool), 2000)
    theta, p = textbook(START, own, 1.0, y, r)
    inverse = np.linalg.inv(y.T @ y)
    exact, size = inverse @ (y.T @ r), inverse.max()
    off = np.max(np.abs(memory.root @ memory.root.T - inverse))
    assert off < 1e-7 * size
    # How much P loses is up to the processor.
    assert np.max(np.abs(p - inverse)) > 1e3 * off
    lost = np.max(np.abs(memory.theta / exact - 1))
    assert lost < 1e-6
    assert np.max(np.abs(theta / exact - 1)) > 1e3 * lost


@pytest.mark.parametrize("beta", [1.0, 1.0 - 1e-4])
def test_it_stays_sound_over_ten_million_updates(beta):
    """A block of 10 000 rows over and over: the sums are known in closed form, whatever their number.

    Without forgetting rounding adds up as a walk of so many steps: 1e-16 times 3000, times the condition.
    """
    y, r, _ = regression(10000, rows=1)
    counts, own = np.ones_like(r, bool), np.array([1e-1, 1e-2, 1.0, 1e2])
    recursion = Recursion(START, own, np.asarray(beta))
    memory = recursion.memory()
    args = [jnp.asarray(x) for x in (y, r, counts)]
    updates = 10**7
    for _ in range(updates // 10000):
        memory, told, _ = run(recursion, memory, *args, 10000)
    weight = beta ** np.arange(10000)[::-1]
    normal, moment = np.einsum("t,tmi,tmj->ij", weight, y, y), np.einsum("t,tmi,tm->i", weight, y, r)
    n, fade, turn = updates // 10000, beta**10000, beta ** np.arange(4)[::-1]
    many = n if beta == 1.0 else (1 - fade**n) / (1 - fade)
    # One round over the unknowns is as the other: it ends with all that it forgot made good.
    left = own * (beta**updates + (1 - beta**updates) * turn)
    theta = np.linalg.solve(many * normal + np.diag(left), many * moment + left * START)
    np.testing.assert_allclose(memory.theta, theta, rtol=1e-9)
    inverse = np.linalg.inv(many * normal + np.diag(left))
    np.testing.assert_allclose(memory.root @ memory.root.T, inverse, rtol=1e-7, atol=1e-7 * inverse.max())
    assert np.all(np.isfinite(told.std))


def gain_regression(samples: int, noise: float, seed: int):
    """A motion's known force, moved by a drive whose measured force is noisy: rows (v, sign v, -force)."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) * 1e-2
    v, known = np.sin(2.3 * t), 30.0 * np.cos(2.3 * t) + 20.0 * np.sin(5.1 * t)
    truth = np.array([4.0, 7.0, 0.85])
    force = (known + truth[0] * v + truth[1] * np.sign(v)) / truth[2]
    measured = force + noise * rng.standard_normal(samples)
    rows = np.stack([v, np.sign(v), -measured], axis=1)[:, None]
    return rows, -known[:, None], truth


def test_an_instrument_where_torque_noise_biases_the_gain():
    """Errors in the gain's column pull it towards zero; the instrument has none of them."""
    y, r, truth = gain_regression(40000, 10.0, 3)
    counts, start = np.ones_like(r, bool), np.array([0.0, 0.0, 1.0])
    found = {}
    for instrument in (False, True):
        recursion = Recursion(
            start, np.array([0.5, 1.0, 600.0]) * 1e-3, np.asarray(1.0), False, (2,), instrument
        )
        found[instrument] = run(recursion, recursion.memory(), y, r, counts, 1000)[1]
    plain, free = (np.asarray(found[k].theta[-1]) for k in (False, True))
    assert plain[2] < 0.92 * truth[2]
    std = np.asarray(found[True].std[-1])
    assert np.all(np.abs(free - truth) < 4 * std)
    assert std[2] < 0.01 * truth[2]
    np.testing.assert_allclose(found[True].noise[-1], 8.5, rtol=0.1)  # 10 N of noise times the gain


def test_instruments_of_summed_rows_are_their_sum():
    """Each row's own instrument, then the sum; not the instrument of a sum, whose gain nobody knows."""
    y, r, _ = gain_regression(200, 1.0, 3)
    both = np.concatenate([np.pad(y, ((0, 0), (0, 0), (0, 1))), y[::-1][..., [0, 1, 1, 2]]], axis=1)
    both[:, 1, 2] = 0.0
    target, counts = np.concatenate([r, r[::-1]], axis=1), np.ones((200, 2), bool)
    counts[::3, 0] = False
    start, own = np.array([0.0, 0.0, 1.0, 1.0]), np.full(4, 1e-2)
    options = (np.asarray(1.0), True, (2, 3), True)
    recursion = Recursion(start, own, *options)
    _, told, z = run(recursion, recursion.memory(), both, target, counts, 1)
    before = np.concatenate(
        [
            start[None],
            np.asarray(
                run(
                    Recursion(start, own, np.asarray(1.0), True), recursion.memory(), both, target, counts, 1
                )[1].theta
            ),
        ]
    )[:-1]
    e = np.einsum("tmp,tp->tm", both, before) - target
    expected = both.copy()
    for k, g in enumerate((2, 3)):
        expected[:, k, g] -= e[:, k] / np.where(np.abs(before[:, g]) > 0.1, before[:, g], 1.0)
    expected = np.sum(np.where(counts[..., None], expected, 0.0), axis=1)
    np.testing.assert_allclose(z[:, 0], expected, rtol=1e-9, atol=1e-9)


def test_instants_end_with_the_log():
    np.testing.assert_array_equal(instants(10, 4), [3, 7, 9])
    np.testing.assert_array_equal(instants(8, 4), [3, 7])
