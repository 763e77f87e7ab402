"""The command `simulate`: the log that a case describes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxid.build import build_machine
from jaxid.case.case import CaseLike, load_case
from jaxid.case.user_faults import named_faults
from jaxid.errors import InputError
from jaxid.numerics.lanes import run_alone
from jaxid.plants.link_tree import LinkTree
from jaxid.scene import Scene, SimulatedLog

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@named_faults()
def simulate(case: CaseLike, *, seed: int = 0) -> SimulatedLog:
    """Simulate the log of a case, at its `true` values if it states any.

    Args:
        case: The case, its file, or a dict with its tables; it needs [simulation] with duration and
            sample_rate, and [reference] (with a [controller]) or [input].
        seed: Seed of the sensors' noise.

    Raises:
        InputError: If the case does not state the simulation completely.
    """
    scene = Scene.of(load_case(case))
    return run_alone(scene.simulated_log(scene.machine, np.random.default_rng(seed)))


def motion_picture(case: CaseLike, simulated: SimulatedLog) -> Figure:
    """Draw an arm at instants of a simulated log.

    Args:
        case: The case behind it.
        simulated: The log.

    Raises:
        InputError: If the machine has no geometry to draw.
    """
    from jaxid.results.poses import strip_of
    from jaxid.results.report.pose_plots import plot_poses

    plant, log = build_machine(load_case(case)).plant, simulated.log
    strip = strip_of(plant, log.source, log.time, log.position) if isinstance(plant, LinkTree) else None
    if strip is None:
        hint = "leave the picture out; it is one of arms from URDF, MJCF or Denavit-Hartenberg rows"
        raise InputError(f"a plant {plant.kind!r} has no geometry to draw", hint=hint)
    return plot_poses(strip, first="simulated")
