"""Estimators as steps: what is to be compiled beside does its work, and touches nothing else."""

import threading

import jax
import numpy as np
import pytest

from jaxid.numerics import lanes
from jaxid.numerics.lanes import (
    ParallelCalls,
    Precompile,
    SolveRequest,
    begin,
    quick_to_compile,
    run_alone,
    run_batched,
)


def double(x):
    return 2.0 * x


def estimator(x, soon=()):
    yield from soon
    found = yield SolveRequest(double, (np.asarray(x),))
    return float(found)


@pytest.fixture
def seen():
    """Threads in which a function was called, and an event that says it was."""
    threads, called = [], threading.Event()

    def function(x):
        threads.append(threading.current_thread())
        called.set()
        raise ValueError(x)

    return function, threads, called


def test_what_comes_soon_is_called_beside_once_and_its_error_is_nobodys(seen):
    function, threads, called = seen
    soon = Precompile(function, (1.0,), (function, "a"))
    assert run_alone(estimator(3.0, [soon])) == 6.0
    assert called.wait(10)
    assert run_alone(estimator(4.0, [soon])) == 8.0
    other = Precompile(function, (2.0,), (function, "b"))
    called.clear()
    assert run_alone(estimator(5.0), other) == 10.0
    assert called.wait(10)
    assert len(threads) == 2
    assert all(t is not threading.main_thread() for t in threads)


def test_parts_run_beside_each_other_after_the_first_of_their_kind():
    threads = []

    def function(x):
        threads.append(threading.current_thread())
        if x[0] < 0:
            raise ValueError("negative")
        return 2.0 * x

    def estimator(values):
        found = yield ParallelCalls(function, [(np.array([x]),) for x in values])
        return [float(x[0]) for x in found]

    assert run_alone(estimator([1.0, 2.0, 3.0])) == [2.0, 4.0, 6.0]
    assert threads[0] is threading.current_thread()
    assert all(t is not threads[0] for t in threads[1:])
    threads.clear()
    assert run_batched([estimator([4.0, 5.0]), estimator([6.0])], 2) == [[8.0, 10.0], [12.0]]
    assert threading.current_thread() not in threads
    with pytest.raises(ValueError, match="negative"):
        run_alone(estimator([1.0, -1.0]))
    assert isinstance(run_batched([estimator([-1.0])], 2)[0], ValueError)


def test_a_request_that_is_alone_is_not_stacked():
    shapes = []

    def function(x):
        shapes.append(x.shape)
        return 2.0 * x

    def estimator(x):
        return float((yield SolveRequest(function, (np.asarray(x),), alone=True)))

    assert run_batched([estimator(x) for x in (1.0, 2.0, 3.0)], 16) == [2.0, 4.0, 6.0]
    assert shapes == [()] * 3


@pytest.mark.parametrize(("on_accelerator", "sizes"), [(False, [4, 1, 1]), (True, [4, 4])])
def test_few_runs_are_not_padded_on_a_processor(monkeypatch, on_accelerator, sizes):
    solved, found = lanes._solved, []

    def counted(key, runs, count):
        found.append(count)
        return solved(key, runs, count)

    monkeypatch.setattr(lanes, "accelerator", lambda: on_accelerator)
    monkeypatch.setattr(lanes, "_solved", counted)
    values = np.arange(6.0)
    assert run_batched([estimator(x) for x in values], 4) == (2 * values).tolist()
    assert found == sizes


def test_many_together_do_without(seen):
    function, threads, _ = seen
    many = [estimator(x, [Precompile(function, (x,), (function, x))]) for x in (1.0, 2.0, 3.0)]
    assert run_batched(many, 2) == [2.0, 4.0, 6.0]
    assert not threads


def test_what_has_begun_runs_beside_and_its_error_is_that_of_its_result(seen):
    function, threads, called = seen
    begun = begin(function, 3.0)
    assert called.wait(10)
    assert threads[0] is not threading.current_thread()
    with pytest.raises(ValueError, match="3.0"):
        begun.result()
    assert begin(double, 2.0).result() == 4.0


def test_the_compiler_knows_the_option_that_halves_its_time():
    # The compiler of JAX 0.12 has no other emitters, and no such option.
    newer = tuple(int(part) for part in jax.__version__.split(".")[:2]) >= (0, 12)
    assert quick_to_compile() == ({} if newer else {"xla_cpu_use_fusion_emitters": False})
