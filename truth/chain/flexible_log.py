"""The exact axis of `truth.chain.flexible_axes` in another loop, with pulses that excite its resonance.

Noise on the logged command is chosen, none on the encoders; guesses are off by a factor.
"""

from pathlib import Path

import numpy as np

from truth.axis.machines import moves
from truth.axis.stepper import Sensor
from truth.chain import flexible_axes as axes
from truth.chain.flexible_axes import COUNT, RATE
from truth.chain.flexible_axes import GAIN as GAIN
from truth.chain.flexible_axes import TRUTH as TRUTH

LAW = {"kp": 40.0, "kv": 320.0, "velocity_average": 2}
PULSES = {"level": 4.0, "on": 0.012, "off": 0.119, "start": 0.25}  # V, s: 83 ms excites 30 Hz
# Guesses of the inertias and the damping are too large; these are too small.
SMALL = {"stiffness": 8e5} | {
    f"{name}[{joint}].{key}": value
    for joint in (1, 2)
    for name, key, value in (("viscous_friction", "coefficient", 100.0), ("coulomb_friction", "level", 10.0))
}


def flexible_log(
    *, duration: float = 20.0, force_noise: float = 0.02, resolution: float = COUNT, **changed: float
) -> dict[str, np.ndarray]:
    """Simulate trapezoids of velocity with pulses of force in closed loop, as `simulate_chain` does.

    Args:
        duration: [s].
        force_noise: On the logged command [V].
        resolution: Of both encoders [m].
        changed: Parameters other than the published ones.
    """
    t = np.arange(round(duration * RATE)) / RATE
    reference = moves(t, (0.0, 0.22, 0.05, 0.18), (0.08, 0.2, 0.13, 0.25), 1.5, 0.15)
    sensor = Sensor(position_resolution=resolution, force_noise=force_noise)
    return axes.record(
        axes.machine(**changed),
        duration=duration,
        reference=reference,
        pulses=PULSES,
        law=LAW,
        sensor=sensor,
        seed=1,
    )


def write(log: dict[str, np.ndarray], folder: Path) -> Path:
    """Write the log to a file, its accelerometer exact."""
    path = folder / "log.csv"
    axes.write(log, path, noise=0.0)
    return path


def case(
    measured: str, extra: str = "", effects: str = "", far: float = 2.0, joints: tuple[int, ...] = (1, 2)
) -> str:
    """Return a case whose guesses are off by a factor, and that names what was measured.

    Args:
        measured: "positions", "acceleration" or "motor".
        extra: More tables.
        effects: More effects.
        far: Factor of the guesses, half of them above and half below.
        joints: With friction.
    """
    guess = {name: SMALL[name] / far if name in SMALL else true * far for name, true in TRUTH.items()}
    text = axes.text(
        load=measured == "positions",
        accelerometer=measured == "acceleration",
        guess=guess,
        law=LAW,
        pulses=PULSES,
        sensor=Sensor(),
        joints=joints,
        effects=effects,
    )
    return text + extra
