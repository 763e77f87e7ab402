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
# Least inertia of a guess, as a part of the largest.
_LEAST = 1e-3


def servos_of(robot: Robot, joints: Sequence[str]) -> tuple[str, ...]:
    """Return those of some joints at which a robot's file has a position servo."""
    served = {drive.joint for drive in robot.drives if drive.kp is not None}
    return tuple(joint for joint in joints if joint in served)


def loop_of_servos(inertias: Sequence[float], period: float) -> Section:
    """Return [controller] with the gains of a loop of 5 Hz about each inertia, and an unknown delay.

    Args:
        inertias: Inertia that each servo moves [kg m^2 or kg]; zero counts as a small part of the largest.
        period: Time between two rows of the log [s].
    """
    rate, least = 2 * np.pi * BANDWIDTH, _LEAST * max(inertias, default=0.0) or 1.0
    inertias = [max(inertia, least) for inertia in inertias]
    keys = {
        "kind": "pd",
        "kp": _guesses([rounded(inertia * rate**2) for inertia in inertias]),
        "kd": _guesses([rounded(1.4 * inertia * rate) for inertia in inertias]),
        "delay": _guesses([_DELAY] * len(inertias)),
    }
    stated = period <= SLOW_LOOP
    if stated:
        keys["period"] = rounded(period / max(round(period / _TICK), 1), 9)
    notes = {"delay": "s, between the command and the loop", "period": "s, of the servo's own loop"}
    loop = Section("[controller]", keys, notes)
    loop.assumed.append(
        "the law is kp times the error and kd times its derivative, or that of the position alone: "
        "identify compares the two"
    )
    question = "at which rate does the servo's own loop run?"
    if stated:
        loop.assumed.append("the servo's own loop runs at about 1 kHz")
        loop.questions.append(f"{question} State 1 / rate as period")
    else:
        loop.questions.append(f"{question} Then period; else identify finds it")
    return loop


def _guesses(values: Sequence[float]) -> dict[str, float] | list[dict[str, float]]:
    """Return unknowns with these guesses: one for each servo."""
    unknowns = [{"guess": value} for value in values]
    return unknowns[0] if len(unknowns) == 1 else unknowns
