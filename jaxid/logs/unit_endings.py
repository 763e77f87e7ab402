"""Units in which the names of columns end, as in position_mm or t_us."""

from __future__ import annotations

import re

# Units by the endings that stand for them.
UNITS = {
    **{u: u for u in "s ms us ns mm um cm deg rad mrad rev rpm A mA V mV N kN Nm mNm lbf kgf counts".split()},
    "sec": "s",
    "degrees": "deg",
    "radps": "rad/s",
    "rads": "rad/s",
    "degs": "deg/s",
    "dps": "deg/s",
    "mps": "m/s",
    "mmps": "mm/s",
    "mms": "mm/s",
    "percent": "%",
    "pct": "%",
}
# Longest first: mNm ends in Nm, and mA in A.
_ENDINGS = sorted(UNITS, key=len, reverse=True)


def unit_ending(name: str) -> tuple[str, str]:
    """Split off the unit in which a name ends behind a sign; empty if there is none."""
    for ending in _ENDINGS:
        rest = name.removesuffix(ending)
        if rest != name and re.search(r"[A-Za-z0-9]", rest) and not rest[-1].isalnum():
            return rest, UNITS[ending]
    return name, ""
