"""References with unknown numbers, for loops whose reference was not logged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.unknowns import REFERENCE
from jaxid.references import REFERENCES


class UnknownReference(eqx.Module):
    """A family of references at its numbers, some of them unknown.

    Args:
        numbers: Values of the unknowns.
        time: Instants from the start of the log [s].
        names: Names of the unknowns.
        kind: Kind of the family.
        known: Its other values.
    """

    numbers: Float[Array, " k"]
    time: Float[Array, " ticks"]
    names: tuple[str, ...] = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    known: tuple[tuple[str, Any], ...] = eqx.field(static=True)

    @classmethod
    def of(cls, table: Mapping[str, Any], unknown: Mapping[str, float]) -> UnknownReference:
        """Build the reference of a table of a case, with values of its unknowns."""
        family = REFERENCES[table["kind"]]
        (values,) = family.read({**table, **unknown}, f"[{REFERENCE}]")
        # Static fields must be hashable.
        lists = {k: tuple(v.tolist()) for k, v in values.items() if isinstance(v, np.ndarray)}
        numbers = jnp.asarray(list(unknown.values()), dtype=jnp.float64)
        rest = tuple((k, v) for k, v in (values | lists).items() if k not in unknown)
        return cls(numbers, jnp.zeros(1), tuple(unknown), family.kind, rest)

    def at(self, time: Float[Array, " ticks"]) -> UnknownReference:
        """Return the reference at other instants."""
        return replace(self, time=jnp.asarray(time))

    def with_unknowns(self, places: tuple, theta: Float[Array, " p"]) -> UnknownReference:
        """Return the reference with theta[k] for each places[k] that is one of its unknowns."""
        ours = [k for k, (path, _) in enumerate(places) if path[0] == REFERENCE]
        return replace(self, numbers=jnp.stack([jnp.asarray(theta[k]) for k in ours])) if ours else self

    def __call__(self) -> Float[Array, "ticks 1"]:
        """Return the position of the one drive at its instants [m or rad]."""
        values = dict(self.known) | dict(zip(self.names, self.numbers, strict=True))
        follow = REFERENCES[self.kind].follow
        assert follow is not None, "only families that can be followed have unknowns"
        return follow(values, self.time)[:, None]
