"""Second logs of a designed motion, with another payload or another gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.case.case import Case
from jaxid.effects.inertia import AddedMass
from jaxid.errors import InputError
from jaxid.estimators.several.parts import Part
from jaxid.estimators.unforced import common_scale_group, stated_gains
from jaxid.experiment_design.limits import Limits
from jaxid.experiment_design.position_information import PositionInformation, peaks_of, played
from jaxid.experiment_design.present import Present
from jaxid.experiment_design.unforced_design import SecondLog
from jaxid.machine import Machine
from jaxid.model.parameter import parameters_of
from jaxid.model.unknowns import CONTROLLER
from jaxid.plants.link_tree import LinkTree

# Payloads that are tried, as parts of the inertia of an axis and of the mass of a robot; changes of a gain.
_PAYLOADS, _OF_ROBOT, _GAINS = (0.25, 1.0), (0.05, 0.2), (0.5, 2.0)

# What differs in words, the values that `set` in [[fit]] takes, and the machine with them.
Change = tuple[str, dict[str, float | list[float]], Machine]


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
    changes = (
        *_loaded(case, present.machine),
        *_loaded_link(case, present.machine),
        *_other_gains(case, present.machine),
    )
    for what, values, machine in changes:
        try:
            log = played(machine, signal, rate, present.start)
        except InputError:
            # Other gains may make the loop unstable.
            continue
        if limits.broken(peaks_of(machine, log)):
            continue
        part = Part.alone(machine, log)
        of_both = whole + PositionInformation.of(part, present.noise, width)
        scaled = not common_scale_group(machine, [part])
        out.append(SecondLog(what, values, present.std(of_both, () if scaled else held)))
    return tuple(out)


def _loaded(case: Case, machine: Machine) -> list[Change]:
    """Return an axis with payloads that are known; none if an added mass is an unknown."""
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


def _loaded_link(case: Case, machine: Machine) -> list[Change]:
    """Return a robot with payloads that are known at the last place that its case names for them.

    A place at the origin of a link is left out: the plant does not hold which link it is.
    """
    plant = machine.plant
    if not isinstance(plant, LinkTree) or plant.payload is None or plant.payload_position is None:
        return []
    if any(f.path[0] == "payload" for f in machine.parameters.free):
        return []
    carriers = np.flatnonzero(np.any(np.asarray(plant.payload_position) != 0, axis=1))
    if not carriers.size:
        return []
    link, movers = int(carriers[-1]), case.plant.links or case.plant.names
    there, robot = float(plant.payload[link]), float(np.sum(np.asarray(plant.mass)))
    out = []
    for part in sorted(_OF_ROBOT, reverse=True):
        mass = float(f"{part * robot:.2g}")
        if mass <= 0:
            continue
        loaded = replace(plant, payload=jnp.asarray(plant.payload).at[link].add(mass))
        values = {f"payload[{link + 1}]": there + mass}
        what = f"a payload of {mass:g} kg that is known, at the link that {movers[link]} moves"
        out.append((what, values, machine.with_plant(loaded, machine.parameters)))
    return out


def _other_gains(case: Case, machine: Machine) -> list[Change]:
    """Return the machine with its first stated gain halved and doubled; none if [controller] states none."""
    law, names = machine.controller, stated_gains(machine)
    if law is None or not names or "controller" not in case.tables:
        return []
    out = []
    for factor in _GAINS:
        value = factor * np.asarray(getattr(law, names[0]), float)
        changed = replace(machine, controller=replace(law, **{names[0]: jnp.asarray(value)}))
        numbers = [float(x) for x in value.ravel()]
        what = f"{names[0]} = {', '.join(f'{x:g}' for x in numbers)}"
        out.append((what, {f"{CONTROLLER}.{names[0]}": numbers if len(numbers) > 1 else numbers[0]}, changed))
    return out
