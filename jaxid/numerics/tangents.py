"""Values that have a derivative from the start, for the carries of loops.

JAX differentiates a loop by a trace of its body for each guess at which entries of its carry have a
derivative: those that begin with one, then those that get one from these, and so on. Loops within loops
multiply the traces, and tracing a fit of an arm's simulation takes longer than it runs. If all entries begin
with a derivative, be it zero, one trace is enough.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp

from jaxid.arrays import Array

T = TypeVar("T")


def varying(x: T, by: Array) -> T:
    """Return a tree of floating-point arrays as it is, with a derivative of zero by some numbers.

    Args:
        x: The tree.
        by: The numbers, of any shape; they must be finite.
    """
    zero = 0.0 * jnp.sum(by)
    return jax.tree.map(lambda a: a + zero, x)
