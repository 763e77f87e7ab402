"""The plants, by the names of the case file.

To add one: write its class in a file of its own and register it here.
"""

from jaxid.model import Plant
from jaxid.plants.axis import Axis as Axis
from jaxid.plants.chain import Chain as Chain
from jaxid.plants.flexible_axis import FlexibleAxis as FlexibleAxis
from jaxid.plants.micropositioning_stage import MicropositioningStage as MicropositioningStage
from jaxid.plants.micropositioning_stage import RigidMicropositioningStage as RigidMicropositioningStage

PLANTS: dict[str, type[Plant]] = {
    cls.kind: cls for cls in (Axis, Chain, FlexibleAxis, MicropositioningStage)
}
