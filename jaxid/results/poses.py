"""Poses of an arm at some instants of a log: places of its joints, measured and simulated."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.names import TEN
from jaxid.plants.link_tree import LinkTree
from jaxid.results.report.data import PoseStrip

if TYPE_CHECKING:
    from jaxid.gap import Gap
    from jaxid.session import OpenedLog, Session

# Instants that are drawn, spread evenly over a log.
_FRAMES = 8
# Size below which an arm has no picture [m].
_LEAST = 1e-6


def poses_of(session: Session, run: OpenedLog, after: Gap) -> PoseStrip | None:
    """Return the poses of an arm along a log; None if the machine has no geometry, or a joint no encoder.

    Args:
        session: Case and logs.
        run: The log.
        after: Its gap, with the simulated motion if there is one.
    """
    plant, log = session.machine.plant, run.log
    if not isinstance(plant, LinkTree) or log.steady is not None or not np.all(log.measured):
        return None
    simulated = None if after.simulation is None else np.asarray(after.simulation.position)
    of_file = session.case.plant.bodies
    if of_file is not None:
        # Sums of parameters place no end of an arm: a link whose mass is part of a sum has none left.
        plant = replace(plant, **dict(zip(TEN, of_file.T, strict=True)))
    return strip_of(plant, run.name, log.time, log.position, simulated)


def strip_of(
    plant: LinkTree,
    name: str,
    time: Float[np.ndarray, " N"],
    position: Float[np.ndarray, "N n"],
    simulated: Float[np.ndarray, "N n"] | None = None,
) -> PoseStrip | None:
    """Return the poses of an arm at instants spread over a motion; None if it has no extent.

    Args:
        plant: The arm.
        name: Name of the log.
        time: Its time [s].
        position: Positions of the free joints [rad or m].
        simulated: Simulated ones beside them; left out if they diverge.
    """
    rows = np.unique(np.linspace(0, len(time) - 1, _FRAMES).round().astype(int))
    places = places_of(plant, np.asarray(position)[rows])
    if np.ptp(places, axis=(0, 1)).max() < _LEAST:
        return None
    beside = None if simulated is None else simulated[rows]
    if beside is not None and not np.all(np.isfinite(beside)):
        beside = None
    return PoseStrip(
        name=name,
        time=np.asarray(time)[rows],
        bones=bones_of(plant),
        measured=places,
        simulated=None if beside is None else places_of(plant, beside),
        up=_up(plant),
    )


def bones_of(plant: LinkTree) -> tuple[tuple[int, int], ...]:
    """Return the lines of a stick figure: pairs of rows of `places_of`."""
    parents = plant.tree.parents
    tips = _tips(plant)
    return (
        *((parent + 1, link + 1) for link, parent in enumerate(parents)),
        *((link + 1, len(parents) + 1 + k) for k, link in enumerate(tips)),
    )


def places_of(plant: LinkTree, q: Float[np.ndarray, "time n"]) -> Float[np.ndarray, "time points 3"]:
    """Return the places of the base, of all links' origins, and of the last links' centres of mass [m].

    Args:
        plant: The arm; its masses place the ends of the last links, which have no further joint.
        q: Positions of its free joints [rad or m].
    """
    frames = jax.vmap(lambda now: plant.geometry.frames(plant.of_links(now)))
    axes, origins = (np.asarray(x) for x in frames(jnp.asarray(q)))

    turned: list[np.ndarray] = []
    placed: list[np.ndarray] = []
    for link, parent in enumerate(plant.tree.parents):
        at = np.broadcast_to(np.eye(3), (len(q), 3, 3)) if parent < 0 else turned[parent]
        start = np.zeros((len(q), 3)) if parent < 0 else placed[parent]
        turned.append(at @ axes[:, link])
        placed.append(start + np.einsum("tij,tj->ti", at, origins[:, link]))
    ends = [placed[k] + turned[k] @ _centre(plant, k) for k in _tips(plant)]
    return np.stack([np.zeros((len(q), 3)), *placed, *ends], axis=1)


def _tips(plant: LinkTree) -> list[int]:
    """Return the links on which no further one hangs."""
    parents = plant.tree.parents
    return [link for link in range(len(parents)) if link not in parents]


def _centre(plant: LinkTree, link: int) -> Float[np.ndarray, " 3"]:
    moments = [float(np.asarray(getattr(plant, f"first_moment_{axis}"))[link]) for axis in "xyz"]
    mass = float(np.asarray(plant.mass)[link])
    return np.array(moments) / mass if mass > 0 else np.zeros(3)


def _up(plant: LinkTree) -> Float[np.ndarray, " 3"]:
    """Return the direction against gravity; the base's z axis without any."""
    gravity = np.asarray(plant.gravity_vector, dtype=float)
    size = float(np.linalg.norm(gravity))
    return -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])
