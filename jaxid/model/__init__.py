"""One statement of the physics: parameters, effects, and the balance of a plant.

User-defined classes import from here: these names stay, even if their modules move. Those that need JAX are
loaded on first use, because cases are checked without it.
"""

from typing import TYPE_CHECKING, Any

from jaxid.model.parameter import parameter as parameter

if TYPE_CHECKING:
    from jaxid.model.effect import Action as Action
    from jaxid.model.effect import Effect as Effect
    from jaxid.model.effect import Scales as Scales
    from jaxid.model.effect import Signals as Signals
    from jaxid.model.plant import Plant as Plant

_HOMES = {
    "Action": "jaxid.model.effect",
    "Effect": "jaxid.model.effect",
    "Plant": "jaxid.model.plant",
    "Scales": "jaxid.model.effect",
    "Signals": "jaxid.model.effect",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxid.model' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
