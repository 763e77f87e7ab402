"""Notes of a result for people: those that differ in place and numbers only are stated once."""

from __future__ import annotations

import re
from collections.abc import Sequence

# Notes of one kind up to which each is shown.
_EACH = 3
_NUMBER = re.compile(r"[-−+]?\d[\d.,]*(?:[eE][-+]?\d+)?")
# A file at the beginning of a note, before what the note is about.
_FILE = re.compile(r"^\S*\.\w+(?=[,:] )")


def grouped_notes(notes: Sequence[str]) -> list[str]:
    """Return notes, and of more than three of one kind the first, with the number of the others.

    The notes of many logs and joints fill pages otherwise. The JSON file of a result holds each of them.

    Args:
        notes: The notes; two are of one kind if they differ in file and numbers only.
    """
    kinds: dict[str, list[str]] = {}
    for note in notes:
        kinds.setdefault(_NUMBER.sub("#", _FILE.sub("", note)), []).append(note)
    out = []
    for alike in kinds.values():
        if len(alike) <= _EACH:
            out += alike
        else:
            out.append(f"{alike[0]} ({len(alike) - 1} more notes of this kind)")
    return out
