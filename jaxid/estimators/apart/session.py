"""The session of one joint of an arm: its logs, with the load of the links along each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxid.estimators.apart.joint import JointAlone, own_place
from jaxid.machine import Machine
from jaxid.own_values import OwnValues
from jaxid.session import OpenedLog, Session


def session_of_joint(session: Session, alone: JointAlone) -> Session:
    """Return the session of a joint alone, with the logs that the joint has.

    Args:
        session: Case and logs of the arm.
        alone: The joint; its values are the guesses.
    """
    fits, validations = ({run.name: run for run in some} for some in (session.fits, session.validations))

    def opened(run: OpenedLog, k: int, of: str) -> OpenedLog:
        part = getattr(alone, of)[k]
        own = _own(run.own, session.machine, alone)
        return replace(
            run,
            log=part.log,
            data=part.data,
            own=own,
            load=part.machine.load,
            held_load=part.machine.held_load,
        )

    first, *more = (opened(fits[part.name], k, "parts") for k, part in enumerate(alone.parts))
    others = tuple(opened(validations[part.name], k, "others") for k, part in enumerate(alone.others))
    first_machine = alone.parts[0].machine
    machine = replace(alone.machine, load=first_machine.load, held_load=first_machine.held_load)
    return replace(session, machine=machine, fit=first, more=tuple(more), validations=others, findings=())


def _own(own: OwnValues | None, machine: Machine, alone: JointAlone) -> OwnValues | None:
    """Return the values of one log that belong to a joint; those of the links are in its load."""
    if own is None:
        return None
    drive = machine.plant.driven(machine.plant.joints).index(alone.joint)
    plant = {}
    for (path, index), value in own.plant.items():
        place = own_place(path, index, machine, alone.joint)
        if place is not None:
            rotor = place[0] == ("inertia",)
            plant[place] = alone.links + alone.ratio * value if rotor else value
    controller = {
        name: np.asarray(value)[drive : drive + 1] if np.size(value) == len(machine.gain) else value
        for name, value in own.controller.items()
    }
    return replace(own, plant=plant, controller=controller)
