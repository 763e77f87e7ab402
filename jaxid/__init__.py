"""jaxid: identify machines with friction, and find the physics that a simulation is missing."""

from typing import TYPE_CHECKING, Any

from jaxid import _platform

_platform.configure()

if TYPE_CHECKING:
    from jaxid.discovery.discover import discover as discover
    from jaxid.effects import EFFECTS as EFFECTS
    from jaxid.effects import register as register_effect  # noqa: F401
    from jaxid.errors import InputError as InputError
    from jaxid.estimators.real_time import RealTime as RealTime
    from jaxid.experiment import design as design
    from jaxid.io.case import load_case as load_case
    from jaxid.io.log import Log as Log
    from jaxid.io.log import read_log as read_log
    from jaxid.live import Live as Live
    from jaxid.live import follow as follow
    from jaxid.plants import PLANTS as PLANTS
    from jaxid.session import open_session as open_session
    from jaxid.studies.study import study as study

# Loaded on first use: importing JAX takes a second, and much of jaxid (its help, its checks of
# bad input) does without.
_HOMES = {
    "discover": ("jaxid.discovery.discover", "discover"),
    "identify": ("jaxid.identification", "identify"),
    "simulate": ("jaxid.virtual", "simulate"),
    "check": ("jaxid.checks", "check"),
    "design": ("jaxid.experiment", "design"),
    "study": ("jaxid.studies.study", "study"),
    "load_case": ("jaxid.io.case", "load_case"),
    "read_log": ("jaxid.io.log", "read_log"),
    "Log": ("jaxid.io.log", "Log"),
    "Live": ("jaxid.live", "Live"),
    "follow": ("jaxid.live", "follow"),
    "RealTime": ("jaxid.estimators.real_time", "RealTime"),
    "open_session": ("jaxid.session", "open_session"),
    "InputError": ("jaxid.errors", "InputError"),
    "EFFECTS": ("jaxid.effects", "EFFECTS"),
    "PLANTS": ("jaxid.plants", "PLANTS"),
    "register_effect": ("jaxid.effects", "register"),
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
