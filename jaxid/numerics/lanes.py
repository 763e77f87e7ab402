"""Estimators as generators: they yield the problems to be solved and receive the solutions.

An estimator that is written as a generator of `SolveRequest` can run alone or together with others.
Requests for the same solver at the same shapes are stacked and solved in one compiled call.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from jaxid.arrays import Array

T = TypeVar("T")


class SolveRequest(NamedTuple):
    """A compiled function and its arguments.

    Args:
        function: Compiled function that takes and returns trees of arrays; other leaves are static.
        args: Arguments of the function for one run.
        alone: Whether it is not stacked with others, since each would take the long branches of all.
    """

    function: Callable
    args: tuple
    alone: bool = False


class Precompile(NamedTuple):
    """A call to compile ahead of time in a background thread.

    Args:
        function: Function that will be called later; its result and its exceptions are discarded now.
        args: Arguments with the types and shapes of the later call; their values do not matter.
        key: Hashable key of the compiled code; each key is compiled once per process.
    """

    function: Callable
    args: tuple
    key: Any


class ParallelCalls(NamedTuple):
    """A compiled function and the arguments of many calls, which run in parallel, one per core.

    Args:
        function: Compiled function, as in `SolveRequest`.
        args: Arguments of each call.
    """

    function: Callable
    args: Sequence[tuple]


Steps = Generator[SolveRequest | Precompile | ParallelCalls, Any, T]


def run_alone(steps: Steps[T], behind: Precompile | None = None) -> T:
    """Run the generator of one estimator and return its result.

    Args:
        steps: Generator of the requests.
        behind: Call that will follow later; it is compiled in the background from the first solve on.
    """
    answer = None
    while True:
        try:
            asked = steps.send(answer)
        except StopIteration as end:
            return end.value
        if isinstance(asked, Precompile):
            _prepare(asked)
            answer = None
            continue
        if isinstance(asked, ParallelCalls):
            answer = in_threads(*asked)
            continue
        if behind is not None:
            _prepare(behind)
            behind = None
        answer = asked.function(*asked.args)


_PREPARED: set = set()


def _prepare(soon: Precompile) -> None:
    """Call the function once in a background thread; compiling does not hold Python's lock."""
    if soon.key not in _PREPARED:
        _PREPARED.add(soon.key)
        _beside().submit(_called, soon)


def begin(function: Callable[..., T], *args: Any) -> Future[T]:
    """Start a call in the background thread; its result or its exception is that of the future."""
    return _beside().submit(function, *args)


@functools.cache
def _beside() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="jaxid-compile")


def _called(soon: Precompile) -> None:
    # An exception is ignored here because the later call raises it again.
    with contextlib.suppress(Exception):
        soon.function(*soon.args)


def in_threads(function: Callable[..., T], args: Sequence[tuple]) -> list[T]:
    """Return the results of many calls, run in threads, one per core: compiled code releases Python's lock.

    The first call of its kind runs before the others, since otherwise each of them would compile the same
    code. The function must not call `in_threads` itself.
    """
    leaves, structure = jax.tree.flatten(args[0])
    kind = (function, structure, tuple(x.shape if isinstance(x, _ARRAYS) else type(x) for x in leaves))
    ahead = [] if kind in _CALLED else [function(*args[0])]
    _CALLED.add(kind)
    return [*ahead, *_threads().map(lambda own: function(*own), args[len(ahead) :])]


_CALLED: set = set()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="jaxid-parts")


def accelerator() -> bool:
    """Return whether JAX has an accelerator."""
    return jax.default_backend() != "cpu"


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_batched(many: Sequence[Steps[T]], lanes: int) -> list[T | Exception]:
    """Run the generators of several runs side by side, equal requests in one compiled call.

    Args:
        many: Generators, one for each run.
        lanes: Runs in one compiled call. A smaller batch is padded, so that one shape serves all. On a
            processor a batch of at most half as many is solved run by run, because a padded run takes as long
            as a real one. The last bits of a run thus depend on those beside it.

    Returns:
        For each run its result, or the exception that ended it.
    """
    ended: dict[int, T | Exception] = {}
    # Requests that wait to be solved: the runs and their arrays by key, in the order of the requests.
    groups: dict[_Key, list[tuple[int, list[np.ndarray]]]] = {}

    def advance(k: int, answer: Any) -> None:
        try:
            asked = many[k].send(answer)
            while not isinstance(asked, SolveRequest):
                asked = many[k].send(in_threads(*asked) if isinstance(asked, ParallelCalls) else None)
            key, arrays = _parted(asked)
        except StopIteration as end:
            ended[k] = end.value
        except Exception as error:  # it ends this run only
            ended[k] = error
        else:
            groups.setdefault(key, []).append((k, arrays))

    for k in range(len(many)):
        advance(k, None)
    while groups:
        # The largest group is solved first; the smaller ones may grow meanwhile.
        key = max(groups, key=lambda key: len(groups[key]))
        most = len(groups[key]) if key.alone else lanes
        some, groups[key] = groups[key][:most], groups[key][most:]
        if not groups[key]:
            del groups[key]
        runs = [arrays for _, arrays in some]
        if key.alone or accelerator() or 2 * len(some) > lanes:
            answers = _solved(key, runs, lanes)
        else:
            answers = [answer for one in runs for answer in _solved(key, [one], 1)]
        for (k, _), answer in zip(some, answers, strict=True):
            advance(k, answer)
    return [ended[k] for k in range(len(many))]


def solved_together(requests: Sequence[SolveRequest]) -> Steps[list[Any]]:
    """Solve many requests of one run, equal ones in one compiled call, and return their answers in order."""
    groups: dict[Any, list[int]] = {}
    arrays: list[list[np.ndarray]] = []
    for k, asked in enumerate(requests):
        key, own = _parted(asked)
        groups.setdefault(key, []).append(k)
        arrays.append(own)
    answers: list[Any] = [None] * len(requests)
    for key, group in groups.items():
        if len(group) == 1:
            answers[group[0]] = yield requests[group[0]]
            continue
        found = _solved(key, [arrays[k] for k in group], len(group))
        for k, answer in zip(group, found, strict=True):
            answers[k] = answer
    return answers


class _Key(NamedTuple):
    """Common part of requests that are solved together: all but the values of their arrays."""

    function: Callable
    structure: Any
    static: tuple
    shapes: tuple
    alone: bool


def _parted(asked: SolveRequest) -> tuple[_Key, list[np.ndarray]]:
    """Return the key of a request, and its arrays."""
    leaves, structure = jax.tree.flatten(asked.args)
    arrays = [np.asarray(x) for x in leaves if isinstance(x, _ARRAYS)]
    static = tuple(_Hole if isinstance(x, _ARRAYS) else x for x in leaves)
    shapes = tuple((x.shape, x.dtype) for x in arrays)
    return _Key(asked.function, structure, static, shapes, asked.alone), arrays


class _Hole:
    """Placeholder for an array among static leaves."""


_ARRAYS = (np.ndarray, np.generic, jax.Array)


def _solved(key: _Key, runs: list[list[np.ndarray]], lanes: int) -> list[Any]:
    if key.alone:
        return in_threads(key.function, [_joined(key.structure, key.static, own) for own in runs])
    filled = [*runs, *[runs[-1]] * (lanes - len(runs))]
    # Numpy stacks them, which needs one transfer each; JAX would dispatch one operation per run.
    stacked = [np.stack(x) for x in zip(*filled, strict=True)]
    found = jax.tree.map(np.asarray, _batched(key.function, key.structure, key.static, stacked))
    leaves, structure = jax.tree.flatten(found)
    return [jax.tree.unflatten(structure, [x[k] for x in leaves]) for k in range(len(runs))]


def _batched(function: Callable, structure: Any, static: tuple, stacked: Sequence[Array]) -> Any:
    return _compiled_batch()(function, structure, static, stacked)


@functools.cache
def _compiled_batch() -> Callable[..., Any]:
    def batched(function: Callable, structure: Any, static: tuple, stacked: Sequence[Array]) -> Any:
        return jax.vmap(lambda own: function(*_joined(structure, static, own)))(stacked)

    return jax.jit(batched, static_argnums=(0, 1, 2), compiler_options=wide_vectors())


def _joined(structure: Any, static: tuple, arrays: Sequence[Array]) -> Any:
    """Return a tree of arguments from its static leaves and its arrays."""
    rest = iter(arrays)
    return jax.tree.unflatten(structure, [next(rest) if x is _Hole else x for x in static])


def side_by_side(function: Callable[..., T]) -> Callable[..., T]:
    """Compile a function of runs side by side, so that they fill the vectors of the processor.

    Leaves of its arguments that are no arrays are static. An argument has no name.
    """

    @functools.cache
    def compiled() -> Callable:
        def on_arrays(structure: Any, static: tuple, arrays: list[Array]) -> T:
            return function(*_joined(structure, static, arrays))

        return jax.jit(on_arrays, static_argnums=(0, 1), compiler_options=wide_vectors())

    @functools.wraps(function)
    def call(*args: Any) -> T:
        leaves, structure = jax.tree.flatten(args)
        arrays = [x for x in leaves if isinstance(x, _ARRAYS)]
        static = tuple(_Hole if isinstance(x, _ARRAYS) else x for x in leaves)
        return compiled()(structure, static, arrays)

    return call


def wide_vectors() -> dict[str, Any]:
    """Return the compiler's options for vectors as wide as the processor has; none if it knows none.

    By itself XLA takes half of a vector of 512 bits. Eight runs side by side take 0.29 ms each, in place of
    0.45, for a Jacobian of 25 000 samples.
    """
    return _known(xla_cpu_prefer_vector_width=512)


def quick_to_compile() -> dict[str, Any]:
    """Return the compiler's options that take least time to compile; none if it knows none.

    XLA's newer emitters lower each fused kernel through passes of its own. Without them compiling takes half
    of the time, and the code is as fast.
    """
    return _known(xla_cpu_use_fusion_emitters=False)


@functools.cache
def _known(**options: Any) -> dict[str, Any]:
    """Return options of the compiler for the processor if it knows them: each version has its own."""
    if accelerator():
        return {}
    try:
        jax.jit(lambda x: x + 1.0, compiler_options=options)(0.0)
    except Exception:  # the compiler says so in one of several ways
        return {}
    return options
