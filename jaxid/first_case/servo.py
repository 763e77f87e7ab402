"""The loop of servos of which a log has command and position alone: its table [controller], with guesses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxid.case.robot import Robot
from jaxid.first_case.section import Section, rounded
from jaxid.logs.log import SLOW_LOOP

# Bandwidth of a servo's loop [Hz], time between its ticks and delay of its command [s] that nothing states.
BANDWIDTH = 5.0
_TICK, _DELAY = 1e-3, 0.02


def has_servos(robot: Robot, joints: Sequence[str]) -> bool:
    """Check whether a robot's file has position servos at any of some joints."""
    return any(drive.kp is not None and drive.joint in joints for drive in robot.drives)


def loop_of_servos(inertias: Sequence[float], period: float) -> Section:
    """Return [controller] with the gains of a loop of 5 Hz about each inertia, and an unknown delay.

    Args:
        inertias: What each servo moves [kg m^2 or kg].
        period: Time between two rows of the log [s].
    """
    rate = 2 * np.pi * BANDWIDTH
    keys = {
        "kind": "pd",
        "kp": _guesses([rounded(inertia * rate**2) for inertia in inertias]),
        "kd": _guesses([rounded(1.4 * inertia * rate) for inertia in inertias]),
        "delay": _guesses([_DELAY] * len(inertias)),
    }
    if period <= SLOW_LOOP:
        keys["period"] = rounded(period / max(round(period / _TICK), 1), 9)
    notes = {"delay": "s, between the command and the loop", "period": "s, of the servo's own loop"}
    loop = Section("[controller]", keys, notes)
    loop.assumed.append(
        "the law is kp times the error and kd times its derivative, or that of the position alone: "
        "identify compares the two"
    )
    loop.questions.append("at which rate does the servo's own loop run? Then period; else identify finds it")
    return loop


def _guesses(values: Sequence[float]) -> dict[str, float] | list[dict[str, float]]:
    """Return unknowns with these guesses: one for each servo."""
    unknowns = [{"guess": value} for value in values]
    return unknowns[0] if len(unknowns) == 1 else unknowns
