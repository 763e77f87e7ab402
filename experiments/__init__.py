"""Published experiments, repeated: `python -m experiments.NAME` in the checkout."""

from truth.extras import need_extra

need_extra("experiments", "jax", "numba", "pinocchio")
