"""Findings of the checks of a log."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """One fault of a log, or one reason for care.

    Attributes:
        severity: "error" stops the work, "warning" is reported only.
        what: The fault, with its size and unit.
        where: File and quantity in which it is.
        hint: Remedy for the user.
        about: "time", "units" or "wrap" for a doubt on how the log was read; empty: on its content.
    """

    severity: Literal["error", "warning"]
    what: str
    where: str
    hint: str
    about: str = ""

    def __str__(self) -> str:
        """Format the finding as one line for a terminal."""
        return f"{self.severity}: {self.where}: {self.what}; {self.hint}"
