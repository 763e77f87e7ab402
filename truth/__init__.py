"""Ground truth: simulators with exact dry friction, and oracles that know what a log hides.

Nothing here imports jax or jaxid, or any library that simulates on them: agreement with the package means
something.
"""
