"""Benchmarks: `python -m benchmarks.NAME` in the checkout."""

from truth.extras import need_extra

# speed_peers leaves out the peers that are not installed.
need_extra("benchmarks", "jax", "numba")
