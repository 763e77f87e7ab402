"""Estimators as steps: what is to be solved goes out, what was found comes back.

An estimator that is written as a generator of `Solve` can be run alone, or many of them together:
those that ask for the same solver at the same shapes are stacked and solved in one compiled call.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")


class Solve(NamedTuple):
    """A compiled function and its arguments.

    Args:
        function: Takes and returns trees of arrays; what is no array is static.
        args: Of one run.
    """

    function: Callable
    args: tuple


Steps = Generator[Solve, Any, T]


def alone(steps: Steps[T]) -> T:
    """Run steps one after the other."""
    answer = None
    while True:
        try:
            asked = steps.send(answer)
        except StopIteration as end:
            return end.value
        answer = asked.function(*asked.args)


def together(many: Sequence[Steps[T]], lanes: int) -> list[T | Exception]:
    """Run the steps of several runs side by side, what is alike in one compiled call.

    Args:
        many: One for each run.
        lanes: Runs in a compiled call; fewer are filled up, so that one shape serves all, and a
            run's bits do not depend on how many there are beside it.

    Returns:
        What each returns, or the exception that ended it.
    """
    ended: dict[int, T | Exception] = {}
    waiting = {k: _advanced(steps, None, k, ended) for k, steps in enumerate(many)}
    while waiting := {k: asked for k, asked in waiting.items() if asked is not None}:
        groups: dict[Any, list[int]] = {}
        parts = {k: _parted(asked) for k, asked in waiting.items()}
        for k, (key, _, _) in parts.items():
            groups.setdefault(key, []).append(k)
        answers: dict[int, Any] = {}
        for members in groups.values():
            for first in range(0, len(members), lanes):
                some = members[first : first + lanes]
                found = _solved(waiting[some[0]].function, [parts[k] for k in some], lanes)
                answers.update(zip(some, found, strict=True))
        waiting = {k: _advanced(many[k], answers[k], k, ended) for k in waiting}
    return [ended[k] for k in range(len(many))]


def _advanced(steps: Steps[T], answer: Any, k: int, ended: dict[int, T | Exception]) -> Solve | None:
    try:
        return steps.send(answer)
    except StopIteration as end:
        ended[k] = end.value
    except Exception as error:  # it ends its own run only
        ended[k] = error
    return None


def _parted(asked: Solve) -> tuple[Any, Any, Any]:
    """What two runs must share to be solved together; arrays; the rest."""
    args = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, asked.args)
    arrays, static = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(static)
    shapes = tuple((x.shape, x.dtype) for x in jax.tree.leaves(arrays))
    return (asked.function, structure, tuple(leaves), shapes), arrays, static


def _solved(function: Callable, runs: list[tuple[Any, Any, Any]], lanes: int) -> list[Any]:
    filled = [arrays for _, arrays, _ in runs]
    filled += [filled[-1]] * (lanes - len(filled))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *filled)
    found = jax.tree.map(np.asarray, _batched(function, runs[0][2], stacked))
    return [jax.tree.map(lambda x, k=k: x[k], found) for k in range(len(runs))]


@eqx.filter_jit
def _batched(function: Callable, static: Any, stacked: Any) -> Any:
    return jax.vmap(lambda own: function(*eqx.combine(own, static)))(stacked)
