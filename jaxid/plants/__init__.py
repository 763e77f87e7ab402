"""The plants, by the names of the case file.

To add one: write its class in a file of its own and register it here.
"""

from jaxid.model import Plant
from jaxid.plants.axis import Axis as Axis
from jaxid.plants.chain import Chain as Chain
from jaxid.plants.flexible_axis import FlexibleAxis as FlexibleAxis

PLANTS: dict[str, type[Plant]] = {"axis": Axis, "chain": Chain, "flexible_axis": FlexibleAxis}
