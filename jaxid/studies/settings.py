"""The settings that a study may vary, and their text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

# Entries of [study] that list values to try, from the outermost to the innermost loop.
SETTINGS = ("sample_rate", "position_resolution", "noise")
_WORDS = {"sample_rate": "{:g} Hz", "position_resolution": "resolution {:g}", "noise": "noise {:g}"}


def setting_of(row: Mapping) -> dict[str, float]:
    """Return the settings of a row of a summary."""
    return {name: row[name] for name in SETTINGS if name in row}


def words_of(row: Mapping, *, without: str = "") -> str:
    """Return a setting in words, such as `200 Hz, noise 3`.

    Args:
        row: A setting, or a row of a summary.
        without: Name of a setting to leave out.
    """
    setting = setting_of(row).items()
    return ", ".join(_WORDS[name].format(value) for name, value in setting if name != without)


def widest(rows: Sequence[Mapping]) -> str:
    """Return the setting with most values, which is the abscissa of the figures."""
    counts = {name: len({row[name] for row in rows}) for name in setting_of(rows[0])}
    return max(reversed(counts), key=counts.__getitem__)
