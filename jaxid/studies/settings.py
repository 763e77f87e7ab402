"""What a study may vary beside the draws, and how it is said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

# Entries of [study] that are lists of what to try, from the outermost to the innermost.
SETTINGS = ("sample_rate", "position_resolution", "noise")
_WORDS = {"sample_rate": "{:g} Hz", "position_resolution": "resolution {:g}", "noise": "noise {:g}"}


def setting_of(row: Mapping) -> dict[str, float]:
    """The settings that a row of a summary names."""
    return {name: row[name] for name in SETTINGS if name in row}


def words_of(row: Mapping, *, without: str = "") -> str:
    """A setting in words: `200 Hz, noise 3`.

    Args:
        row: A setting, or a row of a summary.
        without: A setting that is not to be named.
    """
    setting = setting_of(row).items()
    return ", ".join(_WORDS[name].format(value) for name, value in setting if name != without)


def widest(rows: Sequence[Mapping]) -> str:
    """The setting with most values: what figures are drawn against."""
    counts = {name: len({row[name] for row in rows}) for name in setting_of(rows[0])}
    return max(reversed(counts), key=counts.__getitem__)
