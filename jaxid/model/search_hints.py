"""Hints of a plant to the search for missing effects."""

from __future__ import annotations

from typing import ClassVar

from jaxid.model.drives import Drives
from jaxid.model.effect import Effect


class SearchHints(Drives):
    """The part of every plant that guides a search. Its answers hold for any plant.

    A plant overrides them to exclude candidates that its motion cannot distinguish, or to name the
    parameter that an effect would duplicate.
    """

    # Whether the mass matrix varies with the position, and joints accelerate each other through it.
    coupled: ClassVar[bool] = False
    # Whether the plant is a positioning stage (see `Effect.of_stages`).
    stage: ClassVar[bool] = False

    @property
    def starts_alone(self) -> bool:
        """True if starts from rest show break-away friction, because only its drive pushes each joint."""
        return not self.coupled

    @property
    def designs_experiments(self) -> bool:
        """True if `discover` designs experiments by default; for coupled joints that compiles for minutes."""
        return not self.coupled

    @property
    def filters_fast(self) -> bool:
        """True if a Kalman filter may be chosen by default; along coupled joints it takes minutes."""
        return not self.coupled or self.joints <= 2

    @classmethod
    def bodies(cls, joints: int) -> int:
        """Return the number of ports that are called joints, those of rigidly geared parts included."""
        return joints

    @classmethod
    def springs(cls, joints: int) -> int:
        """Return the number of ports behind the bodies that are elongations of springs."""
        return 0

    def accepts(self, effect: type[Effect], port: int, drives: int) -> bool:
        """Check that a search may add such an effect on a port."""
        springs = self.springs(self.joints) > 0
        if effect.with_springs not in (None, springs) or (effect.of_stages and not self.stage):
            return False
        if springs and effect.of_spring != (port >= self.bodies(self.joints)):
            return False
        return not (effect.in_drive or effect.needs_drive) or self.drive_of(port, drives) is not None

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int | None] | None:
        """Return the parameter, and its entry if it is a list, that an effect on a port duplicates."""
        return None

    def joints_loaded_by(self, port: int, joints: int) -> tuple[int, ...]:
        """Return the joints whose balance contains a force on a port; all by default."""
        return tuple(range(joints))
