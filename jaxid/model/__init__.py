"""One statement of the physics: parameters, effects, and the balance of a plant.

User-defined classes import from here: these names stay, even if their modules move.
"""

from jaxid.model.effect import Action as Action
from jaxid.model.effect import Effect as Effect
from jaxid.model.effect import Scales as Scales
from jaxid.model.effect import Signals as Signals
from jaxid.model.parameter import parameter as parameter
from jaxid.model.plant import Plant as Plant
