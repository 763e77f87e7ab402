"""Check from its trace that a function is affine in its arguments, and compute its matrix."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import Jaxpr, Literal, jaxpr_as_fun

from jaxid.arrays import Array


class Dependence(enum.IntEnum):
    """How a value depends on the arguments: not at all, affinely, or in any other way."""

    CONSTANT, AFFINE, OTHER = range(3)


_CONSTANT, _AFFINE, _OTHER = Dependence
# Entries of a vector up to which its product with a matrix is one sum: the compiler hands larger sums, with
# many columns, to a matrix library, and a chain of ten masses takes three times as long.
_MOST_AT_ONCE = 6
# Operations that are affine in all operands together; in the first alone; in any single one of them.
_SUMS = {
    "add",
    "sub",
    "neg",
    "add_any",
    "broadcast_in_dim",
    "concatenate",
    "copy",
    "pad",
    "reduce_sum",
    "reshape",
    "slice",
    "split",
    "squeeze",
    "stack",
    "transpose",
    "unstack",
}
_FIRST = {"div", "dynamic_slice", "gather"}
# Operations that run another trace, by the name under which they hold it.
_INNER = {"jit": "jaxpr", "pjit": "jaxpr", "custom_jvp_call": "call_jaxpr"}
_PRODUCTS = {"mul", "dot_general"}


class Affine(eqx.Module):
    """A function `f(*args)` as an offset plus matrices, one for every pair of an output and an input leaf.

    Args:
        offset: Value at zero arguments, a tree like the result of `f`.
        matrices: For each output leaf the Jacobians with respect to all input leaves, whose axes come first.
    """

    offset: Any
    matrices: Any

    def __call__(self, *args: Any) -> Any:
        """Return the value at some arguments; the last ones may be left out if they are zero."""
        leaves, treedef = jax.tree.flatten(self.offset)
        entering = jax.tree.leaves(args)
        out = []
        for leaf, blocks in zip(leaves, self.matrices, strict=True):
            for block, z in zip(blocks, entering, strict=False):
                leaf = leaf + _contracted(block, z)
            out.append(leaf)
        return jax.tree.unflatten(treedef, out)


def _contracted(block: Array, z: Array) -> Array:
    """Return the product of a Jacobian, its input axes first, and a leaf, without a call to a library."""
    if z.ndim != 1 or z.size <= _MOST_AT_ONCE:
        wide = z.reshape(z.shape + (1,) * (block.ndim - z.ndim))
        return jnp.sum(block * wide, axis=tuple(range(z.ndim)))
    terms = [block[k] * z[k] for k in range(z.size)]
    return sum(terms[1:], terms[0])


def affine(f: Callable, args: tuple, fixed: tuple = ()) -> Affine | None:
    """Return a function as an affine map, or None if the trace does not prove that it is affine.

    Args:
        f: The function, called with `args` and `fixed`; it takes and returns trees of arrays.
        args: Arguments in which it should be affine; only their shapes count.
        fixed: Arguments on which it should not depend at all.

    Returns:
        The map; its evaluation costs as many products as its matrix has entries.
    """
    zeros = jax.tree.map(jnp.zeros_like, args)
    closed, shape = jax.make_jaxpr(f, return_shape=True)(*zeros, *fixed)
    entering = [_AFFINE] * len(jax.tree.leaves(args))
    banned = [_OTHER] * len(jax.tree.leaves(fixed))
    if max(_follow(closed.jaxpr, [*entering, *banned])) == _OTHER:
        return None

    def flat(*leaves: Array) -> tuple[list, list]:
        out = jaxpr_as_fun(closed)(*leaves, *jax.tree.leaves(fixed))
        return out, out

    places = tuple(range(len(entering)))
    matrices, offset = jax.jacfwd(flat, places, has_aux=True)(*jax.tree.leaves(zeros))
    # Input axes first: the rows that a product adds up are then contiguous.
    matrices = [
        [jnp.moveaxis(block, range(leaf.ndim, block.ndim), range(block.ndim - leaf.ndim)) for block in row]
        for leaf, row in zip(offset, matrices, strict=True)
    ]
    return Affine(jax.tree.unflatten(jax.tree.structure(shape), offset), matrices)


def is_affine(f: Callable, args: tuple, fixed: tuple = ()) -> bool:
    """Check that `affine` would return a map, without computing its matrix."""
    zeros = jax.tree.map(jnp.zeros_like, args)
    closed = jax.make_jaxpr(f)(*zeros, *fixed)
    entering = [_AFFINE] * len(jax.tree.leaves(args)) + [_OTHER] * len(jax.tree.leaves(fixed))
    return max(_follow(closed.jaxpr, entering), default=_CONSTANT) != _OTHER


def depends(f: Callable, args: tuple) -> bool:
    """Check that the result of a function depends on its arguments, or may depend on them."""
    return max(dependences(f, args), default=_CONSTANT) != _CONSTANT


def dependences(f: Callable, args: tuple) -> list[Dependence]:
    """Return how each leaf of a function's result depends on the arguments, as far as its trace proves."""
    closed = jax.make_jaxpr(f)(*jax.tree.map(jnp.zeros_like, args))
    return _follow(closed.jaxpr, [_AFFINE] * len(jax.tree.leaves(args)))


def _follow(jaxpr: Jaxpr, entering: list[Dependence]) -> list[Dependence]:
    """Return how each output of a trace depends on the arguments."""
    known = dict(zip(jaxpr.invars, entering, strict=True))

    def of(variable: Any) -> Dependence:
        return _CONSTANT if isinstance(variable, Literal) else known.get(variable, _CONSTANT)

    for step in jaxpr.eqns:
        kinds = [of(v) for v in step.invars]
        inner = step.params.get(_INNER.get(step.primitive.name, ""))
        if inner is not None:
            known.update(zip(step.outvars, _follow(inner.jaxpr, kinds), strict=True))
        else:
            known.update(dict.fromkeys(step.outvars, _after(step, kinds)))
    return [of(v) for v in jaxpr.outvars]


def _after(step: Any, kinds: list[Dependence]) -> Dependence:
    """Return the dependence of one operation's result."""
    name, worst = step.primitive.name, max(kinds, default=_CONSTANT)
    if worst == _CONSTANT:
        return _CONSTANT
    keeps = (
        name in _SUMS
        or (name in _FIRST and max(kinds[1:]) == _CONSTANT)
        or (name in _PRODUCTS and kinds.count(_CONSTANT) == 1)
        or (name == "scatter" and kinds[1] == _CONSTANT)
        or (name == "select_n" and kinds[0] == _CONSTANT)
        or (name == "convert_element_type" and step.params["new_dtype"] == jnp.float64)
    )
    return worst if keeps else _OTHER
