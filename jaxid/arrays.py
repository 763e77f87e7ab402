"""The array type of annotations: an array of JAX or of NumPy, as JAX's own functions take them."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jax
    import numpy as np

    Array = jax.Array | np.ndarray
else:
    from jaxtyping import Array as Array
