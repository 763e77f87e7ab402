"""Sampled controllers, by the names of the case file.

To add one: write its class, register it here, and run `python -m jaxid.case.kinds`.
"""

from jaxid.controllers.adaptive import Adaptive as Adaptive
from jaxid.controllers.base import Controller as Controller
from jaxid.controllers.base import Path as Path
from jaxid.controllers.base import Tick as Tick
from jaxid.controllers.base import with_effects as with_effects
from jaxid.controllers.computed_torque import ComputedTorque
from jaxid.controllers.flatness import Flatness
from jaxid.controllers.flatness import flat_inputs as flat_inputs
from jaxid.controllers.linear import PD, PID, CascadePD, FrictionCompensation
from jaxid.errors import InputError
from jaxid.model.plant import Plant

CONTROLLERS: dict[str, type[Controller]] = {
    "cascade_pd": CascadePD,
    "pd": PD,
    "pid": PID,
    "flatness": Flatness,
    "friction_compensation": FrictionCompensation,
    "computed_torque": ComputedTorque,
    "adaptive": Adaptive,
}


def laws_with_model(plant: type[Plant] | Plant, drives: int, joints: int) -> list[str]:
    """Return the kinds whose model holds for a plant and its drives; those that adapt are left out."""
    every = drives == joints
    return [
        kind
        for kind, cls in CONTROLLERS.items()
        if "model" in cls.of_machine
        and "estimator" not in cls.of_machine
        and (every or not cls.every_drive)
        and (every or plant.diagonal or not cls.separate_drives)
    ]


def check_drives(kind: str, plant: type[Plant], drives: int, joints: int, where: str) -> None:
    """Refuse a law that does not hold for a plant of which not every joint is driven.

    Args:
        kind: Name of the law.
        plant: Class of the plant.
        drives, joints: Numbers of its drives and joints.
        where: Place in the case, for the message.

    Raises:
        InputError: If the law needs a drive at every joint, or at every joint that others accelerate.
    """
    law = CONTROLLERS[kind]
    if drives == joints or kind in laws_with_model(plant, drives, joints) or "model" not in law.of_machine:
        return
    alternatives = laws_with_model(plant, drives, joints)
    without = ", ".join(name for name, cls in CONTROLLERS.items() if "model" not in cls.of_machine)
    hint = f"take kind = '{alternatives[0]}'" if alternatives else f"take a law without a model: {without}"
    reason = "of a plant whose joints accelerate each other"
    if law.every_drive:
        reason = "since no reference states the motion of the others"
    raise InputError(f"kind = '{kind}' needs a drive at every joint {reason}", where=where, hint=hint)
