"""Numbers as text: as many digits as their precision supports, and readable units."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeGuard

import numpy as np

ABSENT = "–"
_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
# Units that take a prefix; others, such as V per rad and labels of the user, stay unchanged.
_SCALED = {"m", "rad", "m/s", "rad/s", "N", "N m", "V", "A"}
_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


def is_number(value: object) -> TypeGuard[float]:
    """Check that a value is a finite number."""
    return (
        isinstance(value, (int, float, np.integer, np.floating))
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def pretty_unit(unit: str) -> str:
    """Write powers as superscripts: "kg m^2" becomes "kg m²"."""
    parts = unit.split("^")
    text = parts[0]
    for part in parts[1:]:
        digits = len(part) - len(part.lstrip("-0123456789"))
        text += part[:digits].translate(_SUPERSCRIPTS) + part[digits:]
    return "" if text == "1" else text


def plain(value: object, digits: int = 3) -> str:
    """Write one number with so many significant digits, or an en dash if it is absent."""
    if not is_number(value):
        return ABSENT
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(float(f"{float(value):.{digits - 1}e}"))))
    if -4 <= exponent <= 5:
        return _fixed(float(value), digits - 1 - exponent)
    return f"{_fixed(value / 10.0**exponent, digits - 1)} {_power(exponent)}"


def short(value: object, digits: int = 4) -> str:
    """Write one number without trailing zeros, for settings rather than estimates."""
    text = plain(value, digits)
    if "×" in text or "." not in text:
        return text
    return text.rstrip("0").rstrip(".")


def nats(value: object) -> str:
    """Write an evidence: one decimal, as a tenth of a nat decides nothing."""
    return _fixed(float(value), 1) if is_number(value) else ABSENT


def with_std(value: object, std: object) -> tuple[str, str]:
    """Write a value and its standard deviation, both to two digits of the latter.

    Args:
        value: The estimate.
        std: Its standard deviation, in the same unit.

    Returns:
        Both texts; with a common power of ten if the numbers are very large or small.
        Without a usable standard deviation the value gets four digits.
    """
    if not is_number(value) or not is_number(std) or std <= 0:
        return plain(value, 4), (plain(std, 2) if is_number(std) else ABSENT)
    largest = max(abs(float(value)), float(std))
    exponent = math.floor(math.log10(largest))
    shift = exponent if not -4 <= exponent <= 5 else 0
    shifted, deviation = float(value) / 10.0**shift, float(std) / 10.0**shift
    # Rounding 0.0996 to two digits gives 0.10: take the exponent after the rounding.
    places = 1 - math.floor(math.log10(float(f"{deviation:.1e}")))
    tail = f" {_power(shift)}" if shift else ""
    return _fixed(shifted, places) + tail, _fixed(deviation, places) + tail


def percent(part: object, whole: object = 1.0, digits: int = 2) -> str:
    """Write |part / whole| as a percentage."""
    if not is_number(part) or not is_number(whole) or whole == 0:
        return ABSENT
    return f"{plain(abs(100.0 * part / whole), digits)} %"


def scaled_unit(unit: str, values: Iterable) -> tuple[float, str]:
    """Choose a prefix so that the largest number is easy to read.

    Args:
        unit: An SI label; any other is kept as it is.
        values: Numbers or arrays in that unit; None and non-finite ones are passed over.

    Returns:
        The prefixed unit in terms of `unit` (0.001 for "mm"), and the prefixed label.
    """
    peak = 0.0
    for value in values:
        if value is not None:
            array = np.abs(np.asarray(value, dtype=float))
            peak = max(peak, float(np.max(array, where=np.isfinite(array), initial=0.0)))
    if unit in _SCALED and peak > 0.0:
        for scale, prefix in _PREFIXES:
            # Chosen: 0.1 m stays in m, 0.09 m becomes 90 mm.
            if peak >= 0.1 * scale:
                return scale, pretty_unit(prefix + unit)
    return 1.0, pretty_unit(unit)


def usual_unit(unit: str, value: object, std: object = None) -> tuple[float, str]:
    """Choose a prefix for a parameter, as `scaled_unit` does; seconds take one too.

    Args:
        unit: An SI label; any other is kept as it is.
        value: The estimate; if it is zero, its standard deviation decides.
        std: Its standard deviation.
    """
    size = value if is_number(value) and value else std
    if not is_number(size) or not size or unit not in {*_SCALED, "s"}:
        return 1.0, pretty_unit(unit)
    scale, prefix = next(((s, p) for s, p in _PREFIXES if abs(size) >= 0.1 * s), _PREFIXES[-1])
    return scale, pretty_unit(prefix + unit)


def _fixed(value: float, places: int) -> str:
    text = f"{round(value, places):.{max(places, 0)}f}"
    if float(text) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def _power(exponent: int) -> str:
    return "× 10" + str(exponent).translate(_SUPERSCRIPTS)
