"""The PA-10's first joint, an exact-friction simulator, let go under a law that compensates friction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from truth.axis.stepper import Loop, Machine, Sensor, simulate

# Illustrative, for the report has none of the first joint but 14.4 N m at 1.2 rad/s: inertia [kg m^2],
# Coulomb [N m] and viscous friction [N m s/rad].
INERTIA, COULOMB, VISCOUS = 2.0, 9.6, 4.0
JOINT = Machine(
    INERTIA, {"viscous_friction": {"coefficient": VISCOUS}, "coulomb_friction": {"level": COULOMB}}
)
# Where friction and what compensates it cross [rad/s], and the largest velocity of the joint.
CROSSING, FASTEST = 0.5, 1.2
# Coulomb and viscous friction that are compensated; the last two cross the joint's own.
SITUATIONS = {
    "s1": (9.0, 3.6),
    "s2": (10.2, 4.4),
    "s3": (9.1, 4.0 + 0.5 / CROSSING),
    "s4": (10.1, 4.0 - 0.5 / CROSSING),
}
RATE, FAST = 1000.0, 20_000.0
EXACT = Sensor()
NOISE = Sensor(position_noise=1e-5, force_noise=0.2)


def law(situation: str, **more: float) -> Loop:
    """Return the law that lets the joint go in one of the situations."""
    coulomb, viscous = SITUATIONS[situation]
    return Loop("friction_compensation", coulomb=coulomb, viscous=viscous, **more)


def released(
    situation: str, velocity: float, *, duration: float = 20.0, rate: float = FAST
) -> dict[str, np.ndarray]:
    """Release the joint with a velocity and without a spring."""
    loop = replace(law(situation), reference=np.zeros(round(duration * rate)))
    return simulate(
        JOINT,
        loop,
        EXACT,
        rate=rate,
        duration=duration,
        step=5e-5,
        initial_velocity=velocity,
        log_rate=RATE,
    )


def swinging(
    kp: float,
    start: float,
    *,
    machine: Machine = JOINT,
    duration: float = 40.0,
    rate: float = RATE,
    situation: str = "s4",
    sensor: Sensor = EXACT,
    step: float = 5e-5,
    **more: float,
) -> dict[str, np.ndarray]:
    """Release the joint at an angle against a spring K_p."""
    loop = replace(law(situation, kp=kp, **more), reference=np.zeros(round(duration * rate)))
    return simulate(
        machine, loop, sensor, rate=rate, duration=duration, step=step, initial_position=start, log_rate=RATE
    )


def settled(log: dict[str, np.ndarray]) -> tuple[float, float]:
    """Amplitude and period of the last third; of a joint that rests, zero and NaN."""
    q, t = np.asarray(log["true_position"]).reshape(len(log["t"]), -1)[:, 0], log["t"]
    last = slice(2 * len(t) // 3, None)
    q, t = q[last], t[last]
    centred = q - 0.5 * (q.max() + q.min())
    up = np.flatnonzero((centred[:-1] < 0) & (centred[1:] >= 0))
    if np.ptp(q) < 1e-4 or up.size < 3:
        return 0.0, np.nan
    crossings = t[up] - centred[up] * (t[up + 1] - t[up]) / (centred[up + 1] - centred[up])
    return float(np.ptp(q) / 2), float(np.mean(np.diff(crossings)))


def unknown(guess: float, **bounds: float) -> dict[str, float]:
    """Return an unknown of a case."""
    return {"guess": float(guess), **bounds}


def case_text(
    inertia: float | dict[str, float],
    effects: dict[str, dict[str, float | dict[str, float]]],
    **tables: dict[str, float | str],
) -> str:
    """Return the case of one joint; a reference is logged where there is a controller."""

    def entry(value: float | str | dict[str, float]) -> str:
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{k} = {v!r}" for k, v in value.items()) + " }"
        return f'"{value}"' if isinstance(value, str) else repr(value)

    lines = ["[plant]", 'kind = "axis"', 'motion = "rotary"', "[plant.parameters]"]
    lines += [f"inertia = {entry(inertia)}"]
    for kind, values in effects.items():
        lines += ["[[effects]]", f'kind = "{kind}"', *[f"{k} = {entry(v)}" for k, v in values.items()]]
    columns = {"time": "t", "position": "q", "force": "u"}
    columns |= {"reference": "ref"} if "controller" in tables else {}
    for name, values in {"log": columns, **tables}.items():
        lines += [f"[{name}]", *[f"{k} = {entry(v)}" for k, v in values.items()]]
    return "\n".join(lines) + "\n"
