"""Sampled controllers, by the names of the case file.

To add one: write its class and register it here.
"""

from jaxid.controllers.adaptive import Adaptive as Adaptive
from jaxid.controllers.base import Controller as Controller
from jaxid.controllers.base import Path as Path
from jaxid.controllers.base import Tick as Tick
from jaxid.controllers.computed_torque import ComputedTorque
from jaxid.controllers.flatness import Flatness
from jaxid.controllers.flatness import flat_inputs as flat_inputs
from jaxid.controllers.linear import PD, PID, CascadePD, FrictionCompensation

CONTROLLERS: dict[str, type[Controller]] = {
    "cascade_pd": CascadePD,
    "pd": PD,
    "pid": PID,
    "flatness": Flatness,
    "friction_compensation": FrictionCompensation,
    "computed_torque": ComputedTorque,
    "adaptive": Adaptive,
}
