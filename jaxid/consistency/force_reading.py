"""A fault of the reading of a force that explains a log as well as effects which a search found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class ForceReading:
    """A fault of the reading of a force, held against effects.

    Args:
        gap: Force gap of each driven joint under the fault, without the effects [N or N m].
        rival: Force gap with the effects, and the force as logged.
        effects: Names of the effects.
        unit: Unit of the gaps.
    """

    gap: Float[np.ndarray, " driven"]
    rival: Float[np.ndarray, " driven"]
    effects: tuple[str, ...]
    unit: str

    # Object of discovery.json, and the fault in words.
    key: ClassVar[str]
    short: ClassVar[str]

    def json(self) -> dict[str, object]:
        """Return the object `key` of discovery.json."""
        gaps = {"gap": self.gap.tolist(), "gap_with_effects": self.rival.tolist()}
        return {**gaps, "effects": list(self.effects)}

    @property
    def findings(self) -> list[str]:
        """Sentences on it and on what to do."""
        raise NotImplementedError

    def beside_effects(self, relation: str) -> str:
        """Return how it compares with the effects: it explains the log, the relation, and the gaps."""
        *others, last = self.effects
        named, worst = f"{', '.join(others)} and {last}" if others else last, int(np.argmax(self.rival))
        sizes = f"{self.gap[worst]:.3g} {self.unit}, with them {self.rival[worst]:.3g} {self.unit}"
        verb = "does" if len(self.effects) == 1 else "do"
        return f"explains the log {relation} {named} {verb} (it leaves a force gap of {sizes})"
