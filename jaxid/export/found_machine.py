"""The machine of a result, built again from what `result.json` states, on any log of its case."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from jaxid.case.case import Case, read_case
from jaxid.controllers import Controller
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.machine import Machine
from jaxid.model.parameter import as_array
from jaxid.model.unknowns import Parameters
from jaxid.names import PLACES
from jaxid.plants.link_tree import LinkTree


def case_of(model: Mapping[str, Any], where: str) -> Case:
    """Return the case of a result.

    Args:
        model: `model` of result.json.
        where: The result, for messages.

    Raises:
        InputError: If the result does not hold it, or its files are not where they were.
    """
    case = model.get("case")
    if case is None:
        what = "does not hold its case: it was changed in Python, or an older jaxid wrote it"
        raise InputError(what, where=where, hint="run identify or discover on a case file")
    return read_case(case["tables"], None, Path(case["folder"]))


def found_machine(model: Mapping[str, Any], case: Case, machine: Machine) -> Machine:
    """Return a machine with the values of a result, all of them known.

    Args:
        model: `model` of result.json.
        case: Its case.
        machine: The machine of the case.

    Raises:
        InputError: If the result has an effect that neither jaxid nor the case knows.
    """
    plant = machine.plant
    assert isinstance(plant, LinkTree), "only trees have a model"
    values = {name: None if v is None else as_array(v) for name, v in model["parameters"].items()}
    plant = replace(plant, **values, effects=())
    classes = {**EFFECTS, **{cls.kind: cls for cls in case.own_effects}}
    for effect in model["effects"]:
        if effect["kind"] not in classes:
            hint = "add it to candidates in [discover], with its file"
            raise InputError(f"no effect is called {effect['kind']}", where=case.where, hint=hint)
        place = next(name for name in PLACES if name in effect)
        port = effect[place] - 1 + (plant.joints if place == "shaft" else 0)
        numbers = {n: None if v is None else as_array(v) for n, v in effect["parameters"].items()}
        plant = plant.with_effect(classes[effect["kind"]](port=port, **numbers))
    law = (model.get("drives") or {}).get("controller")
    controller = machine.controller
    if controller is not None and law is not None:
        controller = _with_values(controller, law)
    return replace(machine.with_plant(plant, Parameters(())), controller=controller)


def _with_values(controller: Controller, law: Mapping[str, Any]) -> Controller:
    """Return a control law with the numbers of a result; what is no array stays as the case has it."""
    arrays = {
        name: jnp.asarray(value)
        for name, value in law.items()
        if name != "kind" and not isinstance(value, bool | str | int) and name != "period"
    }
    return replace(controller, **arrays)


def without_effects(machine: Machine, numbers: set[int]) -> Machine:
    """Return a machine without some of its effects, by their numbers."""
    effects = tuple(e for k, e in enumerate(machine.plant.effects) if k not in numbers)
    return replace(machine, plant=replace(machine.plant, effects=effects))
