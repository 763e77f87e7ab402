"""jaxid: identify machines with friction, and find the physics that a simulation is missing."""

from typing import TYPE_CHECKING, Any

from jaxid import _platform

_platform.configure()

if TYPE_CHECKING:
    from jaxid.build import make_plant as make_plant
    from jaxid.case.case import load_case as load_case
    from jaxid.commands.design import design as design
    from jaxid.commands.discover import discover as discover
    from jaxid.commands.live import Live as Live
    from jaxid.commands.live import follow as follow
    from jaxid.commands.study import study as study
    from jaxid.dynamics.rhs import State as State
    from jaxid.dynamics.rhs import vector_field as vector_field
    from jaxid.effects import EFFECTS as EFFECTS
    from jaxid.effects import register as register_effect  # noqa: F401
    from jaxid.errors import InputError as InputError
    from jaxid.estimators.common.levenberg_marquardt import (
        BoundedLevenbergMarquardt as BoundedLevenbergMarquardt,
    )
    from jaxid.estimators.fit import Fit as Fit
    from jaxid.estimators.fit import fit as fit
    from jaxid.estimators.fit import parameter_names as parameter_names
    from jaxid.estimators.recursive.real_time import RealTime as RealTime
    from jaxid.logs.log import Log as Log
    from jaxid.logs.log import read_log as read_log
    from jaxid.plants import PLANTS as PLANTS
    from jaxid.session import open_session as open_session
    from jaxid.simulation.loops import initial_state as initial_state

# Loaded on first use: importing JAX takes a second, and much of jaxid (its help, its checks of
# bad input) does without.
_HOMES = {
    "discover": ("jaxid.commands.discover", "discover"),
    "identify": ("jaxid.commands.identify", "identify"),
    "simulate": ("jaxid.commands.simulate", "simulate"),
    "check": ("jaxid.commands.check", "check"),
    "design": ("jaxid.commands.design", "design"),
    "study": ("jaxid.commands.study", "study"),
    "load_case": ("jaxid.case.case", "load_case"),
    "read_log": ("jaxid.logs.log", "read_log"),
    "Log": ("jaxid.logs.log", "Log"),
    "Live": ("jaxid.commands.live", "Live"),
    "follow": ("jaxid.commands.live", "follow"),
    "RealTime": ("jaxid.estimators.recursive.real_time", "RealTime"),
    "open_session": ("jaxid.session", "open_session"),
    "InputError": ("jaxid.errors", "InputError"),
    "EFFECTS": ("jaxid.effects", "EFFECTS"),
    "PLANTS": ("jaxid.plants", "PLANTS"),
    "register_effect": ("jaxid.effects", "register"),
    # the physics alone, for JAX
    "make_plant": ("jaxid.build", "make_plant"),
    "State": ("jaxid.dynamics.rhs", "State"),
    "initial_state": ("jaxid.simulation.loops", "initial_state"),
    "vector_field": ("jaxid.dynamics.rhs", "vector_field"),
    "parameter_names": ("jaxid.estimators.fit", "parameter_names"),
    "fit": ("jaxid.estimators.fit", "fit"),
    "Fit": ("jaxid.estimators.fit", "Fit"),
    "BoundedLevenbergMarquardt": (
        "jaxid.estimators.common.levenberg_marquardt",
        "BoundedLevenbergMarquardt",
    ),
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxid' has no attribute {name!r}")
    from importlib import import_module

    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
