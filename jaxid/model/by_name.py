"""All parameters of a plant and its effects, known and unknown, by their names in results."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import effect_name, leaf

# Path from the plant to a leaf, and the entry of that leaf if it is a list.
Place = tuple[tuple[str | int, ...], int | tuple[int, int] | None]


def parameters_by_name(plant: Plant) -> dict[str, tuple[Place, ParameterInfo]]:
    """Return place and description of every parameter by its name in results."""
    out: dict[str, tuple[Place, ParameterInfo]] = {}

    def add(name: str, path: tuple[str | int, ...], info: ParameterInfo) -> None:
        value = leaf(plant, path)
        if value is None:
            return
        if jnp.ndim(value) == 0:
            out[name] = (path, None), info
        for index in np.ndindex(jnp.shape(value)) if jnp.ndim(value) else ():
            at = index[0] if len(index) == 1 else (index[0], index[1])
            out[f"{name}[{', '.join(str(k + 1) for k in index)}]"] = (path, at), info

    for name, info in parameters_of(type(plant)).items():
        add(name, (name,), info)
    before = eqx.tree_at(lambda p: p.effects, plant, ())
    for k, effect in enumerate(plant.effects):
        for field, info in parameters_of(type(effect)).items():
            add(f"{effect_name(before, effect)}.{field}", ("effects", k, field), info)
        before = before.with_effect(effect)
    return out
