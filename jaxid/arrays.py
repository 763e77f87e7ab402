"""Arrays: their type in annotations, and the library that computes with them."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import jax
    import numpy as np

    Array = jax.Array | np.ndarray
else:
    from jaxtyping import Array as Array

# Array of the same library as another one.
A = TypeVar("A", bound="Array")


def library(*values: Any) -> Any:
    """Return `jax.numpy` if any value is traced, else `numpy`.

    Outside of compiled code JAX compiles every single operation, which takes longer than a small one itself.
    """
    jax = sys.modules.get("jax")
    if jax is not None and any(isinstance(value, jax.core.Tracer) for value in values):
        return jax.numpy
    import numpy

    return numpy
