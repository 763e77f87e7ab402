"""The text of a first case: its tables with everything that was assumed and asked as comments."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

# Most characters of a line of comment.
_WIDTH = 105


@dataclass
class Section:
    """One table of a case.

    Attributes:
        head: Name of the table in its brackets, as "[plant]" or "[[effects]]".
        keys: Values by key.
        notes: Comments behind values, by key.
        assumed: Lines that say what was assumed.
        questions: Lines that ask what the log does not show.
        offers: Lines of TOML that stand as comments.
    """

    head: str
    keys: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    assumed: list[str] = field(default_factory=list)
    questions: list[str] = field(default_factory=list)
    offers: list[str] = field(default_factory=list)

    def text(self) -> str:
        """Return the table as TOML."""
        lines = [self.head]
        for word, texts in (("assumed", self.assumed), ("question", self.questions)):
            for text in texts:
                lines += _wrapped(f"# {word}: ", text)
        for key, value in self.keys.items():
            note = f"    # {self.notes[key]}" if key in self.notes else ""
            lines.append(f"{key} = {toml(value)}{note}")
        return "\n".join([*lines, *(f"# {offer}" for offer in self.offers)])


def _wrapped(begin: str, text: str) -> list[str]:
    """Break a comment into lines; each further one is indented."""
    lines, line = [], begin
    for word in text.split():
        if len(line) + len(word) > _WIDTH and line.strip() != "#":
            lines.append(line.rstrip())
            line = "#   "
        line += f"{word} "
    return [*lines, line.rstrip()]


def toml(value: Any) -> str:
    """Format a value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, Mapping):
        entries = ", ".join(f"{_key(k)} = {toml(v)}" for k, v in value.items())
        return f"{{ {entries} }}"
    return "[" + ", ".join(toml(entry) for entry in value) + "]"


def _key(name: str) -> str:
    plain = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if plain else json.dumps(name, ensure_ascii=False)


def _number(value: float) -> str:
    text = repr(value)
    return text if "." in text or "e" in text or "inf" in text or "nan" in text else f"{text}.0"


def rounded(value: float, digits: int = 2) -> float:
    """Round a number to some digits that count."""
    return float(f"{value:.{digits - 1}e}")


def near_whole(ratio: float, within: float) -> float:
    """Return the whole number that a ratio is within a part of; else the ratio, rounded to five digits."""
    whole = round(ratio)
    return float(whole) if whole and abs(ratio / whole - 1) < within else rounded(ratio, 5)


def case_text(title: Sequence[str], sections: Sequence[Section]) -> str:
    """Return a whole case: lines of comment, then its tables."""
    head = [line for text in title for line in _wrapped("# ", text)]
    return "\n\n".join(["\n".join(head), *(section.text() for section in sections)]) + "\n"
