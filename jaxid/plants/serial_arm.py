"""An arm: an open chain of rigid links with revolute and prismatic joints."""

from __future__ import annotations

from jaxid.plants.link_tree import LinkTree


class SerialArm(LinkTree):
    """tau = M(q) qdd + h(q, qd), of a chain of links by ten inertial parameters each.

    It is the tree in which each link hangs on the one before; see `jaxid.plants.link_tree.LinkTree` for its
    arguments.
    """

    kind = "serial_arm"
