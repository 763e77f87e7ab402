"""Logs that lack a position or a force: what the machine must be for them, and what it is refused for."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.effect import Effect, Signals, carries_force
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Free, label

# Part of a force that is rounding.
_ROUNDING = 1e-9
# Instants at which a machine is evaluated.
_INSTANTS = 4
# Methods that take a measured velocity as it is.
BY_VELOCITY = ("inverse_dynamics", "prediction_error", "output_error", "power", "recursive")


def check_absent(case: Case, machine: Machine, log: Log, *, alone: bool = True) -> None:
    """Refuse a log without position or force for a machine that needs it.

    Args:
        case: The case.
        machine: Its machine.
        log: The log.
        alone: Whether it is the only log of the fit; others may tell what a step leaves open.

    Raises:
        InputError: If a force depends on where the machine is and only the velocity was logged; if nothing
            drives the machine and nothing known acts on it; or if one step drives it and an unknown takes any
            part of it.
    """
    if log.stepped and alone:
        _need_known_part(machine, log)
    if log.integrated:
        _need_no_position(case, machine, log)
    if log.passive:
        _need_known_force(case, machine, log)


def need_position(method: str, log: Log) -> None:
    """Refuse a log of velocities for a method that reads positions, and a steady table for one of time.

    Raises:
        InputError: If only the velocity was logged, and the method needs the position; or if the rows are
            steady speeds, and the method needs samples over time.
    """
    if log.steady is not None and method != "inverse_dynamics":
        what = f'{method} needs a log over time, and [log] has kind = "steady"'
        raise InputError(what, where=log.source, hint="leave the method out, or choose inverse_dynamics")
    if log.integrated and method not in BY_VELOCITY:
        hint = f"choose one of {', '.join(BY_VELOCITY)}"
        raise InputError(f"the log has no position, which {method} needs", where=log.source, hint=hint)


def _need_no_position(case: Case, machine: Machine, log: Log) -> None:
    """Refuse a log of velocities for a machine whose forces depend on where it is."""
    hint = "name the column of the position in [log]"
    if case.controller is not None:
        what = "the log has no position, which the law of [controller] needs"
        raise InputError(what, where=log.source, hint=f"{hint}, or leave [controller] out")
    named = position_dependent(machine.plant)
    if named:
        what = f"the log has no position, and {named} acts by where the machine is"
        raise InputError(what, where=log.source, hint=f"{hint}, or leave {named} out")


def position_dependent(plant: Plant) -> str:
    """Return the name of an effect, or of the plant, whose force depends on the position; empty if none."""
    for effect in plant.effects:
        if acts_by_position(effect):
            return label(plant, effect.kind, effect.port)
    bare = eqx.tree_at(lambda p: p.effects, plant, ())
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.standard_normal((3, plant.joints))
    near, far = (np.asarray(bare.inertial(jnp.asarray(at), qd, qdd)) for at in (q, q + 0.7))
    moved = np.max(np.abs(far - near)) > _ROUNDING * np.max(np.abs(near))
    return f"the {plant.kind}" if moved else ""


def acts_by_position(effect: Effect) -> bool:
    """Check that the force of an effect depends on the coordinate of its port, at some parameters."""
    names = [name for name in parameters_of(type(effect)) if getattr(effect, name) is not None]
    # At a guess of zero no force would show.
    effect = replace(effect, **{name: jnp.asarray(1.0) for name in names})
    state = effect.initial_state(jnp.asarray(0.5))

    def forces(y: float) -> np.ndarray:
        named = {name: jnp.asarray(0.3) for name in Signals.__dataclass_fields__}
        action = effect.act(Signals(**{**named, "y": jnp.asarray(y)}), state)
        parts = (action.force, action.dry, action.stick, action.drive, action.rate)
        return np.concatenate([np.ravel(np.asarray(p, float)) for p in parts if p is not None])

    near, far = forces(0.11), forces(0.47)
    return bool(np.any(np.abs(far - near) > _ROUNDING * (np.abs(near) + np.abs(far))))


def _need_known_force(case: Case, machine: Machine, log: Log) -> None:
    """Refuse a free motion in which nothing is known that would give forces their scale.

    All unknown masses, frictions and springs may then be multiplied by one factor. In a loop the controller
    gives the force, from its reference.
    """
    missing = "the force is zero throughout"
    if case.log is not None and case.log.force is None:
        missing = "'force' is missing"
    if case.controller is not None:
        if case.log is not None and case.log.force is not None:
            what = f"{missing}, and [controller] drives the machine"
            hint = "check that force names the right column, or leave it out to fit the loop by its reference"
            raise InputError(what, where=log.source, hint=hint)
        if log.reference is None and machine.unknown_reference is None and case.reference is None:
            hint = "name the column of the command to the servo as reference in [log], or that of the force"
            what = f"{missing}, and so is the reference that [controller] follows"
            raise InputError(what, where=log.source, hint=hint)
        return
    unscaled = without_scale(machine, log)
    if unscaled:
        listed = ", ".join(unscaled[:6]) + (", ..." if len(unscaled) > 6 else "")
        what = f"{missing}, and nothing known acts: {listed} may be multiplied by one factor"
        if len(unscaled) == 1:
            what = f"{missing}, and nothing known acts beside {listed}"
        hint = "state one as a known number (a weight, a spring or an inertia), or log the force that drives"
        raise InputError(what, where=log.source, hint=hint)


def _need_known_part(machine: Machine, log: Log) -> None:
    """Refuse a step of the force against an unknown that is as constant as the step.

    Masses and frictions of zero and all of the force in that unknown then fit best.
    """
    plant, free = machine.plant, machine.parameters.free
    travel = np.sign(log.filled[-1] - log.filled[0])
    theta = np.asarray(machine.parameters.guess, float)
    u = jnp.asarray(log.force[0] * machine.gain)

    def residual(values: np.ndarray, speed: float, rate: float) -> np.ndarray:
        at = machine.parameters.insert(plant, values)
        states = at.initial_states(u)
        balance = at.balance(log.filled[0], speed * travel, rate * travel, u, jnp.zeros(()), states)
        return np.asarray(balance.residual)

    for k, f in enumerate(free):
        if not _is_force(plant, f):
            continue
        more = theta + (np.arange(theta.size) == k) * max(abs(theta[k]), 1.0)
        # Speeds far beyond the width over which the sign is smoothed.
        slow, fast = (residual(more, *at) - residual(theta, *at) for at in ((1e6, 2.0), (3e6, -1.0)))
        if np.any(slow) and np.allclose(slow, fast, rtol=1e-6, atol=0.0):
            others = [g.name for g in free if g is not f and _is_force(plant, g)]
            level = ", ".join(f"{x:.4g}" for x in log.force[0])
            what = f"the force is {level} throughout, as after a step, of which {f.name} may take any part"
            together = f"{', '.join(others[:4])} change with it: " if others else ""
            hint = f"{together}state {f.name} as a known number, or take a log in which the force changes"
            raise InputError(what, where=log.source, hint=hint)


def without_scale(machine: Machine, log: Log) -> list[str]:
    """Return the unknowns that a free motion leaves without an absolute scale; empty if something is known.

    Args:
        machine: The machine at its guesses.
        log: The log, for its positions.
    """
    plant, free = machine.plant, machine.parameters.free
    forces = [f for f in free if _is_force(plant, f)]
    if not forces:
        return []
    theta = np.asarray(machine.parameters.guess, float)
    silent = np.where([_is_force(plant, f) for f in free], 0.0, theta)
    rng = np.random.default_rng(0)
    picks = np.linspace(0, log.samples - 1, _INSTANTS).astype(int)
    sizes = []
    for values in (silent, theta):
        at = machine.parameters.insert(plant, values)
        largest = 0.0
        for k in picks:
            q, (qd, qdd) = jnp.asarray(log.filled[k]), rng.standard_normal((2, plant.joints))
            u = jnp.zeros(log.force.shape[1])
            states = at.initial_states(u)
            residual = at.balance(q, jnp.asarray(qd), jnp.asarray(qdd), u, jnp.zeros(()), states).residual
            largest = max(largest, float(np.max(np.abs(np.asarray(residual)))))
        sizes.append(largest)
    return [f.name for f in forces] if sizes[0] <= _ROUNDING * sizes[1] else []


def known_forces(machine: Machine) -> list[str]:
    """Return the known values in proportion to which forces act, each as name, value and unit.

    A free motion gives all others relative to them.
    """
    plant, unknown = machine.plant, set(machine.parameters.places)
    owners: list[tuple[str, object, tuple[str | int, ...]]] = [("", plant, ())]
    owners += [(f"{label(plant, e.kind, e.port)}.", e, ("effects", k)) for k, e in enumerate(plant.effects)]
    out = []
    for prefix, owner, before in owners:
        for name, info in parameters_of(type(owner)).items():
            value = getattr(owner, name)
            if value is None or not carries_force(info) or np.ndim(value) > 1:
                continue
            for index, number in enumerate(np.atleast_1d(np.asarray(value, float)).tolist()):
                at = None if np.ndim(value) == 0 else index
                if number == 0 or ((*before, name), at) in unknown:
                    continue
                place = "" if at is None else f"[{index + 1}]"
                unit = machine.units.label(info.dimension, info.motion or plant.motion(index))
                out.append(f"{prefix}{name}{place} = {number:.4g} {unit}")
    return out


def _is_force(plant: Plant, free: Free) -> bool:
    """Check that a force is in proportion to an unknown."""
    owner = plant if free.effect is None else plant.effects[free.effect]
    info: ParameterInfo | None = parameters_of(type(owner)).get(str(free.path[-1]))
    return info is not None and carries_force(info)
