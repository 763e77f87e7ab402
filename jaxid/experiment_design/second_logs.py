"""Second logs of a designed motion: what another payload, or another gain, would add."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.case.case import Case
from jaxid.effects.inertia import AddedMass
from jaxid.estimators.several.parts import Part
from jaxid.estimators.unforced import common_scale_group, stated_gains
from jaxid.experiment_design.limits import Limits
from jaxid.experiment_design.position_information import PositionInformation, peaks_of, played
from jaxid.experiment_design.present import Present
from jaxid.experiment_design.unforced_design import SecondLog
from jaxid.machine import Machine
from jaxid.model.parameter import parameters_of
from jaxid.model.unknowns import CONTROLLER

# Payloads that are tried, as parts of the inertia, and changes of a known gain.
_PAYLOADS, _GAINS = (0.25, 1.0), (0.5, 2.0)


def second_logs(
    case: Case,
    present: Present,
    limits: Limits,
    signal: Float[np.ndarray, "rows m"],
    rate: float,
    whole: PositionInformation,
    held: Sequence[int],
) -> tuple[SecondLog, ...]:
    """Return second logs of a motion that keep within the limits: payloads that are known, then other gains.

    Args:
        case: The case.
        present: The machine and the noise.
        limits: Limits of the experiment.
        signal: The reference.
        rate: Rows of the log [Hz].
        whole: Information of the first log and the present ones.
        held: Unknowns that are held because nothing gives a scale.
    """
    width, out = len(present.machine.parameters.free), []
    for what, values, machine in (*_loaded(case, present.machine), *_other_gains(present.machine)):
        log = played(machine, signal, rate)
        if limits.broken(peaks_of(machine, log)):
            continue
        part = Part.alone(machine, log)
        of_both = whole + PositionInformation.of(part, present.noise, width)
        scaled = not common_scale_group(machine, [part])
        out.append(SecondLog(what, values, present.std(of_both, () if scaled else held)))
    return tuple(out)


def _loaded(case: Case, machine: Machine) -> list[tuple[str, dict[str, float], Machine]]:
    """Return the machine with payloads that are known; none if an added mass is an unknown."""
    inertia = machine.plant.own_inertia()
    declared = [e for e in case.effects if e.cls is AddedMass]
    unknown = [f for f in machine.parameters.free if f.name.startswith(AddedMass.kind)]
    if inertia is None or machine.plant.joints > 1 or unknown or len(declared) > 1:
        return []
    info = parameters_of(AddedMass)["mass"]
    unit = machine.units.label(info.dimension, machine.plant.motion(0))
    there = sum(float(np.sum(np.asarray(e.mass))) for e in machine.plant.effects if isinstance(e, AddedMass))
    out = []
    for part in sorted(_PAYLOADS, reverse=True):
        mass = float(f"{part * float(np.max(np.asarray(inertia))):.2g}")
        plant = machine.plant.with_effect(AddedMass(mass=jnp.asarray(mass)))
        values = {f"{AddedMass.kind}.mass": there + mass}
        loaded = machine.with_plant(plant, machine.parameters)
        out.append((f"a payload of {mass:g} {unit} that is known", values, loaded))
    return out


def _other_gains(machine: Machine) -> list[tuple[str, dict[str, float], Machine]]:
    """Return the machine with its first stated gain halved and doubled; none if no gain is stated."""
    law, names = machine.controller, stated_gains(machine)
    if law is None or not names:
        return []
    out = []
    for factor in _GAINS:
        value = factor * np.asarray(getattr(law, names[0]), float)
        if value.size == 1:
            changed = replace(machine, controller=replace(law, **{names[0]: jnp.asarray(value)}))
            number = float(value.ravel()[0])
            out.append((f"{names[0]} = {number:g}", {f"{CONTROLLER}.{names[0]}": number}, changed))
    return out
