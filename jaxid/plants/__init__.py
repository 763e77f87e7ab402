"""The plants, by the names of the case file.

A new plant is one file here and one name in `PLANTS`; docs/adding_a_plant.md shows how to write it.
Then run `python -m jaxid.case.kinds`, which declares it to checks that do without JAX.
"""

from jaxid.model.plant import Plant
from jaxid.plants.axis import Axis as Axis
from jaxid.plants.chain import Chain as Chain
from jaxid.plants.denavit_hartenberg import DenavitHartenberg as DenavitHartenberg
from jaxid.plants.five_bar import FiveBar as FiveBar
from jaxid.plants.flexible_axis import FlexibleAxis as FlexibleAxis
from jaxid.plants.geometry import JointFrames as JointFrames
from jaxid.plants.link_tree import LinkTree as LinkTree
from jaxid.plants.micropositioning_stage import MicropositioningStage as MicropositioningStage
from jaxid.plants.micropositioning_stage import RigidMicropositioningStage as RigidMicropositioningStage
from jaxid.plants.pa10 import pa10 as pa10
from jaxid.plants.righettini_five_bar import righettini_five_bar as righettini_five_bar
from jaxid.plants.serial_arm import SerialArm as SerialArm

PLANTS: dict[str, type[Plant]] = {
    cls.kind: cls for cls in (Axis, Chain, FlexibleAxis, MicropositioningStage, SerialArm, LinkTree, FiveBar)
}
