"""The start of a fit of a servo's joint, by a balance that is linear in the reciprocal of its gain.

With the law u = kp (r - q) - kd dq the error of the position is

    r - q = (J ddq - load) / kp + (kd + c) / kp dq + F / kp sign(dq)

in which only the delay of the reference r is not linear. Errors of the encoder are small beside the error of
the position, and nothing has to be near the truth: a gain of the file may be wrong by a factor of fifty.
"""

from __future__ import annotations

import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxid.controllers.linear import CascadePD
from jaxid.estimators.apart.joint import JointAlone
from jaxid.estimators.several.parts import Part
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER

# Delays that are tried, if the delay is unknown [s].
_DELAYS = np.arange(0.0, 0.305, 0.005)
# Largest factor by which the start may differ from the guess.
_FARTHEST = 1e3
# Part of the guess at which a friction starts that the balance does not show.
_LITTLE = 1e-2


def start_by_balance(alone: JointAlone) -> Float[np.ndarray, " own"] | None:
    """Return values of a joint's unknowns by the balance of its servo; None if it gives no gain.

    Unknowns that do not enter the balance stay at their guesses.

    Args:
        alone: The joint, with its logs.
    """
    machine = alone.machine
    unknown = {_role(f.path, machine): k for k, f in enumerate(machine.parameters.free)}
    if "kp" not in unknown:
        return None
    delays = _DELAYS if "delay" in unknown else np.array([_delay(machine)])
    found = [_balance(alone.parts, delay) for delay in delays]
    best = int(np.argmin([misfit for _, misfit in found]))
    (compliance, lag, dry), _ = found[best]
    if compliance <= 0:
        return None

    stiffness, drive = 1.0 / compliance, float(np.abs(machine.gain[0]))
    damping, known = lag * stiffness, _damping(machine)
    free = [name for name in ("kd", "viscous") if name in unknown]
    # Both dampings act alike: their guesses divide the sum that was found.
    spare = max(damping - sum(v for n, v in known.items() if n not in free), _LITTLE * damping)
    parts = {n: spare * max(known[n], 1e-12) / sum(max(known[m], 1e-12) for m in free) for n in free}
    values = {"kp": stiffness / drive, "dry": dry * stiffness, "delay": float(delays[best]), **parts}
    if "kd" in parts:
        values["kd"] = parts["kd"] / drive

    start, guess = machine.parameters.guess, machine.parameters.guess
    for name, value in values.items():
        k = unknown.get(name)
        if k is None:
            continue
        size = abs(guess[k]) if guess[k] else max(abs(value), 1e-12)
        least = 0.0 if name == "delay" else _LITTLE * size / _FARTHEST
        start[k] = np.clip(value, least, _FARTHEST * size)
    if isinstance(machine.controller, CascadePD):
        # Its gain of the position multiplies that of the velocity.
        rate = float(start[unknown["kd"]]) if "kd" in unknown else known["kd"] / drive
        start[unknown["kp"]] = stiffness / drive / max(rate, 1e-12)
    return np.clip(start, *machine.parameters.bounds)


def _role(path: tuple[str | int, ...], machine: Machine) -> str:
    """Return the part that an unknown has in the balance; its own name if it has none."""
    if path[0] == CONTROLLER:
        name = str(path[1])
        return "kd" if isinstance(machine.controller, CascadePD) and name == "kv" else name
    if path[0] == "effects" and isinstance(path[1], int):
        kind = machine.plant.effects[path[1]].kind
        return {"viscous_friction": "viscous", "coulomb_friction": "dry"}.get(kind, f"{kind}.{path[-1]}")
    return str(path[0])


def _delay(machine: Machine) -> float:
    law = machine.controller
    return 0.0 if law is None or law.delay is None else float(np.max(np.asarray(law.delay)))


def _damping(machine: Machine) -> dict[str, float]:
    """Return the damping of the servo and that of the joint at their guesses, seen at the joint."""
    law = machine.controller
    kd = getattr(law, "kv" if isinstance(law, CascadePD) else "kd")
    own = [e for e in machine.plant.effects if e.kind == "viscous_friction"]
    return {
        "kd": float(np.abs(machine.gain[0]) * np.max(np.asarray(kd))),
        "viscous": sum(float(np.asarray(e.coefficient)) for e in own),  # pyright: ignore[reportAttributeAccessIssue]
    }


def _balance(parts: tuple[Part, ...], delay: float) -> tuple[Float[np.ndarray, "3"], float]:
    """Return 1/kp, damping over kp and dry friction over kp, and the misfit at a delay of the reference."""
    rows, errors = [], []
    for part in parts:
        log, machine = part.log, part.machine
        assert log.reference is not None, "checked by stands_apart"
        assert machine.load is not None, "a joint alone has one"
        late = np.interp(log.time - delay, log.time, log.reference[:, 0])
        q, v, a = (x[:, 0] for x in (part.data.q, part.data.qd, part.data.qdd))
        speed = np.std(v)
        force = float(np.asarray(machine.plant.own_inertia())) * a - machine.load[:, 0]
        # Of rest the balance says no more than an interval for dry friction.
        counts = (np.abs(v) > 0.2 * speed) & (log.time > log.time[0] + _DELAYS[-1])
        rows.append(np.stack([force, v, np.sign(v)], axis=1)[counts])
        errors.append((late - q)[counts])
    matrix, error = np.concatenate(rows), np.concatenate(errors)
    if len(error) < 10:
        return np.zeros(3), np.inf
    size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    found, misfit = scipy.optimize.nnls(matrix / size, error)
    return found / size, float(misfit)
