"""Logs of a flexible ball-screw axis at the published values, made without jax and jaxid.

Source:
    The axis of `flexible_axes`, in another loop and with pulses that excite its resonance; noise on the
    logged command chosen.
"""

from pathlib import Path

import numpy as np
from chain_stepper import simulate_chain
from flexible_axes import COUNT, GAIN, RATE, machine
from flexible_axes import TRUTH as TRUTH
from stepper import Loop, Sensor
from stepper_machines import moves

FRICTION = (("viscous_friction", "coefficient", 100.0), ("coulomb_friction", "level", 10.0))
PULSES = {"level": 4.0, "on": 0.012, "off": 0.119, "start": 0.25}  # V, s: 83 ms excites 30 Hz


def flexible_log(
    *, duration: float = 20.0, force_noise: float = 0.02, seed: int = 1, pulses: dict | None = PULSES,
    resolution: float = COUNT, **changed: float,
) -> dict[str, np.ndarray]:
    """Trapezoids of velocity with pulses of force, in closed loop; as `simulate_chain` returns it.

    Args:
        duration: [s].
        force_noise: On the logged command [V].
        seed: Of the noise.
        pulses: Added to the command; None: none.
        resolution: Of both encoders [m].
        changed: Parameters other than the published ones.
    """
    t = np.arange(round(duration * RATE)) / RATE
    reference = moves(t, (0.0, 0.22, 0.05, 0.18), (0.08, 0.2, 0.13, 0.25), 1.5, 0.15)
    loop = Loop(
        "cascade_pd", reference=reference, kp=40.0, kv=320.0, velocity_average=2, limit=10.0,
        disturbance=pulses,
    )
    sensor = Sensor(position_resolution=resolution, force_noise=force_noise)
    return simulate_chain(machine(**changed), [loop], sensor, rate=RATE, duration=duration, seed=seed)


def write(log: dict[str, np.ndarray], folder: Path) -> Path:
    """The log as a file: t, q1, q2, a2 (of the load), u, r."""
    acceleration = log["true_acceleration"][:, 1]
    columns = np.column_stack(
        [log["t"], log["position"], acceleration, log["force"], log["reference"][:, 0]]
    )
    path = folder / "log.csv"
    np.savetxt(path, columns, delimiter=",", header="t,q1,q2,a2,u,r", comments="", fmt="%.12g")
    return path


def case(
    measured: str, extra: str = "", effects: str = "", far: float = 2.0, joints: tuple[int, ...] = (1, 2)
) -> str:
    """A case whose guesses are off by a factor, and that names what was measured.

    Args:
        measured: "positions", "acceleration" or "motor".
        extra: More tables.
        effects: More effects.
        far: Factor of the guesses, half of them above and half below.
        joints: With friction.
    """
    columns = {"positions": 'load_position = "q2"', "acceleration": 'load_acceleration = "a2"', "motor": ""}
    own = [f"{n} = {{ guess = {v * far:.6g} }}" for n, v in zip(
        ("motor_inertia", "load_inertia", "damping"), (72.3, 34.8, 126.0), strict=True)]
    own.append(f"stiffness = {{ guess = {8e5 / far:.6g} }}")
    friction = "\n".join(
        f'[[effects]]\nkind = "{kind}"\njoint = {joint}\n{name} = {{ guess = {value / far:.6g} }}'
        for kind, name, value in FRICTION for joint in joints
    )
    return "\n".join([
        '[plant]\nkind = "flexible_axis"\n[plant.parameters]', *own, friction, effects,
        f"[actuator]\ngain = {GAIN}",
        f'[log]\ntime = "t"\nposition = "q1"\nforce = "u"\nreference = "r"\n{columns[measured]}',
        "[controller]\nkind = \"cascade_pd\"\nkp = 40.0\nkv = 320.0\nvelocity_average = 2\nlimit = 10.0",
        f"[controller.disturbance]\nlevel = {PULSES['level']}\non = {PULSES['on']}\noff = {PULSES['off']}\n"
        f"start = {PULSES['start']}",
        extra,
    ])

