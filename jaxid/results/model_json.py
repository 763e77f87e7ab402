"""The object `model` of results: an arm or a tree of links with all its values, for `export`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxid.arms.bodies import bodies_of
from jaxid.controllers import CONTROLLERS
from jaxid.model.parameter import parameters_of
from jaxid.model.unknowns import effect_name
from jaxid.names import TEN
from jaxid.plants.link_tree import LinkTree
from jaxid.results.found_case import changed_in_python

if TYPE_CHECKING:
    from jaxid.case.case import Case
    from jaxid.case.declared import PlantEntry
    from jaxid.estimators.estimate import Estimate
    from jaxid.machine import Machine
    from jaxid.session import Session


def model_json(session: Session, estimate: Estimate) -> dict[str, Any]:
    """Return the object `model` of results: a whole arm or tree of links, for `export`; else nothing."""
    entry, machine = session.case.plant, estimate.machine
    if not isinstance(machine.plant, LinkTree):
        return {}
    held = session.case.tables["plant"].get("held", {})
    return {
        "model": {
            **robot_json(machine.plant, entry, held),
            "bodies": bodies_json(machine.plant, entry),
            "drives": drives_json(machine, session.declared),
            **_case_json(session.declared),
        }
    }


def robot_json(plant: LinkTree, entry: PlantEntry, held: Mapping[str, float]) -> dict[str, Any]:
    """Return all values of a robot: its joints and links by name, their frames, parameters, and effects.

    Joints of an arm that no file describes are called joint1 and so on.
    """
    names = entry.names or tuple(f"joint{k + 1}" for k in range(plant.joints))
    values = {name: getattr(plant, name) for name in parameters_of(LinkTree)}
    effects, before = [], replace(plant, effects=())
    for effect in plant.effects:
        place = plant.place(effect.port)
        numbers = {name: getattr(effect, name) for name in parameters_of(type(effect))}
        effects.append(
            {
                "kind": effect.kind,
                place[0]: place[1],
                **joint_name(place, names),
                "name": effect_name(before, effect),
                "shafts": [list(ratios) for ratios in plant.shafts],
                "parameters": {n: None if v is None else float(v) for n, v in numbers.items()},
            }
        )
        before = before.with_effect(effect)
    frames = plant.geometry.at_zero()
    return {
        "joints": list(names),
        "links": list(entry.links or names),
        "of_file": bool(entry.names),
        "held": dict(held),
        "gravity_vector": np.asarray(plant.gravity_vector).tolist(),
        "gear_ratio": None if plant.gear_ratio is None else np.asarray(plant.gear_ratio).tolist(),
        "tree": {
            "parents": list(plant.tree.parents),
            "motions": list(frames.joints),
            "axes": np.asarray(frames.axes).tolist(),
            "origins": np.asarray(frames.origins).tolist(),
            "copies": [list(copy) for copy in plant.copies],
            "leading": list(plant.leading),
        },
        "shafts": [list(ratios) for ratios in plant.shafts],
        "parameters": {n: None if v is None else np.asarray(v).tolist() for n, v in values.items()},
        "effects": effects,
    }


def bodies_json(plant: LinkTree, entry: PlantEntry) -> dict[str, Any] | None:
    """Return links and rotors that can exist and move as those of a result, near those of its file.

    Parameters behind sums are no bodies, and a fit may end at links that none can be. `error` is the largest
    difference of a sum from that of the result, relative to its size; above 1e-6 no bodies have these sums.
    """
    if entry.bodies is None or entry.rotors is None:
        return None
    rotors = plant.rotor_inertia
    if rotors is not None and plant.gear_ratio is not None:
        rotors = rotors * plant.gear_ratio**2
    bare = replace(plant, effects=(), rotor_inertia=rotors, gear_ratio=None, payload=None)
    found = bodies_of(bare, entry.bodies, entry.rotors)
    links = dict(zip(TEN, found.links.T.tolist(), strict=True))
    return {**links, "rotor_inertia": found.rotors.tolist(), "error": found.error}


def drives_json(machine: Machine, declared: Case | None = None) -> dict[str, Any]:
    """Return the driven joints, from 1, the force of each per unit of its command, and the control law.

    With the case as it was declared also the turns of its motors for one of each joint, if its log is theirs.
    """
    rows = None if declared is None else declared.actuator.transmission
    law = machine.controller
    known: dict[str, Any] = {}
    if law is not None:
        known["kind"] = next(kind for kind, cls in CONTROLLERS.items() if type(law) is cls)
        for field in fields(law):
            value = getattr(law, field.name)
            if isinstance(value, bool | int | float | str | np.ndarray | jax.Array):
                known[field.name] = np.asarray(value).tolist()
    return {
        "joints": [joint + 1 for joint in machine.plant.driven(machine.plant.joints)],
        "gain": np.asarray(machine.gain).tolist(),
        "controller": known or None,
        **({} if rows is None else {"transmission": [list(row) for row in rows]}),
    }


def _case_json(case: Case) -> dict[str, Any]:
    """Return the case as it was given, from which `export` replays logs; nothing if it changed in Python."""
    if changed_in_python(case):
        return {}
    return {"case": {"folder": str(case.folder), "tables": tables_json(case.tables)}}


def tables_json(tables: Any) -> Any:
    """Return the tables of a case by the types of JSON."""
    if isinstance(tables, Mapping):
        return {str(name): tables_json(value) for name, value in tables.items()}
    if isinstance(tables, list | tuple):
        return [tables_json(value) for value in tables]
    return tables if isinstance(tables, bool | int | float) else str(tables)


def joint_name(place: tuple[str, int], names: Sequence[str]) -> dict[str, str]:
    """Return the name of the joint on which an effect acts; nothing without names, or in another place."""
    return {"joint_name": names[place[1] - 1]} if names and place[0] == "joint" else {}
