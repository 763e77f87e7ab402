"""What a check found."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """One fault of a log, or one reason for care.

    Attributes:
        severity: "error" stops the work, "warning" is told.
        what: The fault, with its size and unit.
        where: File and quantity.
        hint: What the user can do about it.
    """

    severity: Literal["error", "warning"]
    what: str
    where: str
    hint: str

    def __str__(self) -> str:
        """One line for a terminal."""
        return f"{self.severity}: {self.where}: {self.what}; {self.hint}"
