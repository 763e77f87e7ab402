"""A case's controller in the loop of two links that move by textbook equations."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxid.commands.live import Live
from truth.arm.two_links import TwoLinks
from truth.arm.two_links_case import PERIOD, TRUTH


@dataclass(frozen=True)
class Ran:
    """A run: the loop, errors of both joints at every tick [rad], and commands [N m]."""

    live: Live
    error: np.ndarray
    command: np.ndarray

    def rms(self, start: int = 8000) -> np.ndarray:
        """From a tick on, by joint."""
        return np.sqrt(np.mean(self.error[start:] ** 2, axis=0))


def driven(
    case: Path,
    *,
    encoder: float = 0.0,
    torque: float = 0.0,
    inertial: tuple[float, float] | None = None,
    seed: int = 0,
    live: Live | None = None,
    ticks: int | None = None,
) -> Ran:
    """Drive textbook equations of motion by a case's controller.

    Args:
        case: Its file.
        encoder, torque: Standard deviations of what the law reads [rad, N m].
        inertial: Of velocity and mean acceleration [rad/s, rad/s^2]; None: it has no such sensors.
        seed: Of these.
        live: The loop, in place of a new one.
        ticks: How many; absent: as the case says.
    """
    live = live or Live(case)
    arm, rng = TwoLinks(coulomb=tuple(TRUTH[4:])), np.random.default_rng(seed)
    x, before, u = (0.3, 0.2, 0.0, 0.0), np.zeros(2), np.zeros(2)
    positions, commands = [], []
    for _ in range(ticks or len(live.reference)):
        q, v = np.array(x[:2]), np.array(x[2:])
        noise = rng.standard_normal((4, 2))
        sensed = {"measured": u + torque * noise[0]} if torque else {}
        if inertial is not None:
            sensed["velocity"] = v + inertial[0] * noise[1]
            sensed["acceleration"] = (v - before) / PERIOD + inertial[1] * noise[2]
        u = live.command(q + encoder * noise[3], **sensed)
        positions.append(q)
        commands.append(u)
        before, x = v, arm.advance(x, (TRUTH[0] * u[0], TRUTH[1] * u[1]), PERIOD / 4, 4)
    return Ran(live, np.array(positions) - live.reference[: len(positions)], np.array(commands))
