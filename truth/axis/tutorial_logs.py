"""Make the tutorial's two logs on the exact axis: traces of a drive, in the units and columns of its export.

A ball screw moves a slide. Its friction rises below 12 mm/s, which the tutorial's case does not declare.
Run in the checkout: python -m truth.axis.tutorial_logs
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from truth.axis.machines import moves, varied
from truth.axis.stepper import Loop, Machine, Sensor, simulate

FOLDER = Path(__file__).parents[2] / "docs" / "examples"
# Torque constant [N m/A] and lead [m/rev]: force per current [N/A].
TORQUE_CONSTANT, LEAD = 0.72, 0.02
GAIN = TORQUE_CONSTANT * 2.0 * math.pi / LEAD
INERTIA, VISCOUS, COULOMB = 180.0, 400.0, 60.0
# The effect that the case lacks.
HIDDEN = {"level": 35.0, "velocity": 0.012}
RATE, SECONDS = 500.0, 8.0
WAYPOINTS = (0.0, 0.02, 0.11, 0.1, 0.16, 0.04, 0.05)  # m
SPEEDS = (0.015, 0.15, 0.006, 0.08, 0.25, 0.01, 0.05)  # m/s


def trace(seed: int) -> dict[str, np.ndarray]:
    """Simulate one trace; return its columns as the drive exports them: ms, mm and A."""
    t = np.arange(round(SECONDS * RATE)) / RATE
    reference = moves(t, WAYPOINTS, varied(seed, SPEEDS, 0.2), 2.0, rest=0.05)
    machine = Machine(
        inertia=INERTIA,
        actuator_gain=GAIN,
        effects={
            "viscous_friction": {"coefficient": VISCOUS},
            "coulomb_friction": {"level": COULOMB},
            "stribeck_friction": HIDDEN,
        },
    )
    loop = Loop(kind="cascade_pd", kp=40.0, kv=120.0, limit=20.0, reference=reference)
    sensor = Sensor(position_resolution=1e-6, force_noise=0.03)
    log = simulate(machine, loop, sensor, rate=RATE, duration=SECONDS, seed=seed)
    return {"Time [ms]": 1e3 * log["t"], "Position [mm]": 1e3 * log["position"], "Current [A]": log["force"]}


def main() -> None:
    for seed, name in ((1, "slide.csv"), (2, "slide_again.csv")):
        columns = trace(seed)
        rows = zip(*columns.values(), strict=True)
        lines = [f"{t:.0f},{q:.3f},{i:.4f}" for t, q, i in rows]
        (FOLDER / name).write_text("\n".join([",".join(columns), *lines]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
