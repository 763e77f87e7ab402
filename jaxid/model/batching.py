"""Effects of one kind on several joints, traced and compiled as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxid.arrays import Array

if TYPE_CHECKING:
    from jaxid.model.effect import Action, Effect, Signals


def group_by_kind(effects: Sequence[Effect], drives: Sequence[int | None]) -> list[list[int]]:
    """Group the indices of effects in runs of one kind, no two of a run on one port or one drive.

    Args:
        effects: Effects in the order of the drive, which the runs keep.
        drives: Drive of each effect; None if it has none.
    """
    runs: list[list[int]] = []
    for k, e in enumerate(effects):
        last = runs[-1] if runs else []
        apart = all(e.port != effects[i].port for i in last)
        alone = drives[k] is None or all(drives[k] != drives[i] for i in last)
        if last and apart and alone and _same(effects[last[0]], e):
            last.append(k)
        else:
            runs.append([k])
    return runs


def _same(one: Effect, two: Effect) -> bool:
    """Check that two effects differ only in port and values."""
    if type(one) is not type(two):
        return False
    for f in fields(one):
        a, b = getattr(one, f.name), getattr(two, f.name)
        if f.metadata.get("static"):
            if f.name != "port" and a != b:
                return False
        elif jax.tree.structure(a) != jax.tree.structure(b):
            return False
    return True


def act_batched(effects: list[Effect], signals: list[Signals], states: list) -> list[Action]:
    """Compute the actions of a run of effects; several are traced as one.

    Args:
        effects: Effects of one kind.
        signals: Signals of each effect.
        states: Internal state of each effect; None if the kind has none.
    """
    # A plant may know more of some ports than of others.
    if len({jax.tree.structure(x) for x in signals}) > 1 or len(effects) == 1:
        return [effect.act(x, state) for effect, x, state in zip(effects, signals, states, strict=True)]
    treedef = jax.tree.structure(effects[0])
    omitted: list[Any] = []

    def act(leaves: Sequence[Array], x: Signals, state: Array | None) -> Action:
        action = jax.tree.unflatten(treedef, leaves).act(x, state)
        # An omitted entry stays a plain number, which lets `balance` skip it.
        arrays, numbers = eqx.partition(action, eqx.is_array)
        omitted.append(numbers)
        return arrays

    leaves = [jnp.stack(column) for column in zip(*map(jax.tree.leaves, effects), strict=True)]
    together = [jax.tree.map(lambda *x: jnp.stack(x), *each) for each in (signals, states)]
    actions = jax.vmap(act)(leaves, *together)
    return [eqx.combine(jax.tree.map(lambda a, k=k: a[k], actions), omitted[-1]) for k in range(len(effects))]
