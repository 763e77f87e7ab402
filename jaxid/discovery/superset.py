"""The superset: effects that a machine might be missing, at each place, and the plant with all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.discovery.candidates import Candidate, CandidateModel
from jaxid.discovery.user_effects import check_user_effect, is_user_effect
from jaxid.effects import EFFECTS
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.balance import port_motion
from jaxid.model.effect import Effect, Scales, carries_force
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Free, Parameters, colours, free_effect, label
from jaxid.numerics.kept import kept_jit
from jaxid.simulation.force_balance import ForceData, sharpened, whole_motion


def scales_of(
    plant: Plant, data: Prepared, between: Float[np.ndarray, " m"] | None = None
) -> tuple[Scales, ...]:
    """Compute the scales of motion and force in a prepared log, by port of a plant.

    Args:
        plant: The plant.
        data: The log.
        between: Largest absolute force of each drive between the rows of the log, (m,); None: not known.
    """
    y, yd, ydd = (np.asarray(a) for a in _port_motion(plant, ForceData.of(data)))
    n, drives = data.q.shape[1], data.force.shape[1]
    force = data.force - np.mean(data.force, axis=0)

    def rms(x: np.ndarray) -> float:
        return float(np.sqrt(np.mean(x**2)))

    scales = []
    for port in range(y.shape[1]):
        rows = data.moving[:, port] if port < n else data.moving.any(axis=1)
        v, a = data.at_kept(yd)[rows, port], data.at_kept(ydd)[rows, port]
        drive = plant.drive_of(port, drives) if len(v) else None
        drive_columns = slice(None) if drive is None else slice(drive, drive + 1)
        scales.append(
            Scales(
                position=float(np.ptp(y[:, port]) / 2),
                velocity=rms(v) if len(v) else 0.0,
                acceleration=rms(a) if len(v) else 0.0,
                force=rms(force[:, drive_columns]),
                peak_velocity=float(np.abs(v).max(initial=0.0)),
                peak_force=float(np.abs(data.force[:, drive_columns]).max()),
                period=data.period,
                duration=data.period * len(data.q),
                between=0.0 if between is None else float(np.max(between[drive_columns])),
                farthest=float(np.abs(y[:, port]).max()),
            )
        )
    return tuple(scales)


@kept_jit
def _port_motion(plant: Plant, data: ForceData) -> tuple[Array, Array, Array]:
    motion = whole_motion(plant, data, data.force)
    return jax.vmap(lambda *now: port_motion(plant, *now))(*motion)


def build_candidate_model(
    machine: Machine,
    data: Prepared,
    effects: Sequence[type[Effect]] | None = None,
    between: Float[np.ndarray, " m"] | None = None,
) -> CandidateModel:
    """Add every effect that the plant does not have yet, at every joint and spring that accepts it.

    Args:
        machine: The baseline.
        data: The log to be searched, for scales.
        effects: Effects to add; default all except those on request.
        between: See `scales_of`.

    Raises:
        InputError: If a user-defined effect cannot be searched for.
    """
    if effects is None:
        effects = [cls for cls in EFFECTS.values() if not cls.on_request]
    scales = scales_of(machine.plant, data, between)
    plant, parameters = machine.plant, machine.parameters
    base = np.arange(len(parameters.free))
    candidates = []

    # Kind by kind, so that the effects of one kind are traced together.
    for cls in effects:
        ports = [i for i, s in enumerate(scales) if s.velocity > 0.0 and _missing(machine, cls, i, data)]
        if ports and is_user_effect(cls):
            check_user_effect(cls, machine, data, scales[ports[0]], ports[0])
        for port in ports:
            plant, free = free_effect(plant, cls(**cls.neutral(scales[port]), port=port), machine.units)
            free = _limited(free, cls.limits(scales[port]))
            first = len(parameters.free)
            parameters = parameters.extended(free)
            index = np.arange(first, first + len(free))
            place = label(plant, cls.kind, port)
            candidates.append(_candidate(cls, place, port, index, scales[port]))

    superset = machine.with_plant(sharpened(plant, data), parameters)
    enters = _enters(plant, parameters, data.q.shape[1], data.force.shape[1])
    return CandidateModel(superset, base, tuple(candidates), enters, colours(enters))


def _enters(plant: Plant, parameters: Parameters, joints: int, drives: int) -> Bool[np.ndarray, "n p"]:
    """Return which unknowns occur in the balance of which joints, as declared by the plant."""
    enters = np.ones((joints, len(parameters.free)), bool)
    undriven = [i for i in range(joints) if plant.drive_of(i, drives) is None]
    for k, f in enumerate(parameters.free):
        if f.path[0] != "effects":
            continue
        effect = plant.effects[int(f.path[1])]
        if is_user_effect(type(effect)):  # it may act on the drive without declaring it
            continue
        # Joints without a drive scale their forces by all drives.
        rows = [*plant.joints_loaded_by(effect.port, joints), *(undriven if effect.in_drive else [])]
        enters[:, k] = np.isin(np.arange(joints), rows)
    return enters


def _missing(machine: Machine, cls: type[Effect], port: int, data: Prepared) -> bool:
    """Check that a port may lack an effect: it has none of its kind, nor an equivalent parameter."""
    plant = machine.plant
    if not plant.accepts(cls, port, data.force.shape[1]):
        return False
    if not _free_in_controller(machine, cls):
        return False
    if cls.of_rotary and (plant.motion(port) or machine.units.motion) != "rotary":
        return False
    equivalent = plant.equivalent_parameter(cls, port)
    fitted = equivalent is not None and any(
        f.path == (equivalent[0],) and f.index == equivalent[1] for f in machine.parameters.free
    )
    return not fitted and all(e.kind != cls.kind or e.port != port for e in plant.effects)


def _free_in_controller(machine: Machine, cls: type[Effect]) -> bool:
    """Check that the controller does not state what an effect is, and has the field that the effect sets."""
    law, name = machine.controller, cls.controller_field
    if name is None:
        return True
    return law is not None and (law.sees_error or cls.of_reference) and getattr(law, name) is None


def _limited(free: list[Free], limits: dict[str, tuple[float, float]]) -> list[Free]:
    """Bound unknowns by the limits of a search."""
    out = []
    for f in free:
        lower, upper = limits.get(f.name.rpartition(".")[2], (-np.inf, np.inf))
        out.append(replace(f, lower=lower, upper=upper))
    return out


def _candidate(cls: type[Effect], place: str, port: int, index: np.ndarray, scales: Scales) -> Candidate:
    """Describe one effect at one port as a candidate."""
    neutral, infos = cls.neutral(scales), parameters_of(cls)
    names = [n for n in infos if n in neutral]

    def values(starts: list[dict[str, float]]) -> np.ndarray:
        return np.asarray([[s[n] for n in names] for s in starts], float)

    finer = cls.finer_starts(scales)
    return Candidate(
        kind=cls.kind,
        label=place,
        port=port,
        index=index,
        neutral=np.asarray([neutral[n] for n in names], float),
        starts=values(cls.starts(scales)),
        amplitude=np.asarray([cls.adds_force and carries_force(infos[n]) for n in names]),
        finer_starts=values(finer) if finer else None,
    )
