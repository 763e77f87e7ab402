"""Estimators as steps: what is to be solved goes out, what was found comes back.

An estimator that is written as a generator of `SolveRequest` can be run alone, or many of them together:
those that ask for the same solver at the same shapes are stacked and solved in one compiled call.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from jaxid.arrays import Array

T = TypeVar("T")


class SolveRequest(NamedTuple):
    """A compiled function and its arguments.

    Args:
        function: Takes and returns trees of arrays; what is no array is static.
        args: Of one run.
    """

    function: Callable
    args: tuple


class Precompile(NamedTuple):
    """What will be asked for later, with other values: it may be compiled beside what runs until then.

    Args:
        function: As it will be called; what it returns or raises now nobody sees.
        args: Of the kind and of the shapes that it will get.
        key: What its compiled code depends on: asked for once a process.
    """

    function: Callable
    args: tuple
    key: Any


class ParallelCalls(NamedTuple):
    """A compiled function and the arguments of many calls of it, one to a core at a time.

    Args:
        function: As of `SolveRequest`.
        args: Of each call.
    """

    function: Callable
    args: Sequence[tuple]


Steps = Generator[SolveRequest | Precompile | ParallelCalls, Any, T]


def run_alone(steps: Steps[T], behind: Precompile | None = None) -> T:
    """Run steps one after the other.

    Args:
        steps: The steps.
        behind: What will be asked for after them.
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
    """Call it in a thread of its own: compiling leaves Python's lock alone."""
    if soon.key not in _PREPARED:
        _PREPARED.add(soon.key)
        _beside().submit(_called, soon)


@functools.cache
def _beside() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="jaxid-compile")


def _called(soon: Precompile) -> None:
    # Who asks for it in earnest gets the error.
    with contextlib.suppress(Exception):
        soon.function(*soon.args)


def in_threads(function: Callable[..., T], args: Sequence[tuple]) -> list[T]:
    """Return the results of many calls, one call a core at a time: compiled code releases Python's lock.

    The first of its kind goes ahead of the others, which would all compile what it does. A call must not ask
    for the same in its turn.
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


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_batched(many: Sequence[Steps[T]], lanes: int) -> list[T | Exception]:
    """Run the steps of several runs side by side, what is alike in one compiled call.

    Args:
        many: One for each run.
        lanes: Runs in a compiled call; fewer are filled up, so that one shape serves all, and a
            run's bits do not depend on how many there are beside it.

    Returns:
        What each returns, or the exception that ended it.
    """
    ended: dict[int, T | Exception] = {}
    # What waits to be solved: by what must be alike, the runs and their arrays, in the order of asking.
    groups: dict[Any, list[tuple[int, list[np.ndarray]]]] = {}

    def advance(k: int, answer: Any) -> None:
        try:
            asked = many[k].send(answer)
            while not isinstance(asked, SolveRequest):
                asked = many[k].send(in_threads(*asked) if isinstance(asked, ParallelCalls) else None)
            key, arrays = _parted(asked)
        except StopIteration as end:
            ended[k] = end.value
        except Exception as error:  # it ends its own run only
            ended[k] = error
        else:
            groups.setdefault(key, []).append((k, arrays))

    for k in range(len(many)):
        advance(k, None)
    while groups:
        # The largest group first: those left in small ones may grow meanwhile.
        key = max(groups, key=lambda key: len(groups[key]))
        some, groups[key] = groups[key][:lanes], groups[key][lanes:]
        if not groups[key]:
            del groups[key]
        for (k, _), answer in zip(some, _solved(key, [arrays for _, arrays in some], lanes), strict=True):
            advance(k, answer)
    return [ended[k] for k in range(len(many))]


def _parted(asked: SolveRequest) -> tuple[Any, list[np.ndarray]]:
    """Return the key that runs solved together share, and the arrays of this one."""
    leaves, structure = jax.tree.flatten(asked.args)
    arrays = [np.asarray(x) for x in leaves if isinstance(x, _ARRAYS)]
    static = tuple(_Hole if isinstance(x, _ARRAYS) else x for x in leaves)
    shapes = tuple((x.shape, x.dtype) for x in arrays)
    return (asked.function, structure, static, shapes), arrays


class _Hole:
    """Stands where an array belongs."""


_ARRAYS = (np.ndarray, np.generic, jax.Array)


def _solved(key: Any, runs: list[list[np.ndarray]], lanes: int) -> list[Any]:
    filled = [*runs, *[runs[-1]] * (lanes - len(runs))]
    # Stacked by numpy: one transfer each, where JAX would dispatch an operation a run.
    stacked = [np.stack(x) for x in zip(*filled, strict=True)]
    found = jax.tree.map(np.asarray, _batched(*key[:3], stacked))
    leaves, structure = jax.tree.flatten(found)
    return [jax.tree.unflatten(structure, [x[k] for x in leaves]) for k in range(len(runs))]


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _batched(function: Callable, structure: Any, static: tuple, stacked: list[Array]) -> Any:
    def one(own: list[Array]) -> Any:
        rest = iter(own)
        leaves = [next(rest) if x is _Hole else x for x in static]
        return function(*jax.tree.unflatten(structure, leaves))

    return jax.vmap(one)(stacked)
