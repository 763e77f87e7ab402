"""Rigid bodies behind parameters that a log determines only in sums."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arms.base_by_rules import base_parameters_by_rules
from jaxid.arms.base_parameters import BaseParameters, base_parameters
from jaxid.arms.pseudo_inertia import log_cholesky, of_log_cholesky, pseudo_inertia
from jaxid.arrays import Array
from jaxid.names import TEN
from jaxid.plants.link_tree import LinkTree

# Sines of angles, and lengths [m], that count as zero: files state a right angle as 1.5708.
_ZERO = 1e-4
# Chosen: steps of a Newton method that ends within ten from a nearby start.
_STEPS = 100
# Size of a sum, over the largest of its kind, from which it counts by itself.
_SMALL = 1e-3
# Relative change of the sums at which the bodies count as found.
_CLOSE = 1e-10


def links_of(plant: LinkTree) -> Float[np.ndarray, "links 10"]:
    """Return the ten parameters of each link of a plant."""
    return np.stack([np.asarray(getattr(plant, name)) for name in TEN], axis=-1)


def about_centre(
    ten: Float[np.ndarray, " 10"],
) -> tuple[float, Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Return mass [kg], centre of mass [m] and inertia about that centre [kg m^2] of a body with a mass.

    Args:
        ten: Its ten parameters, in the order of `jaxid.names.TEN`, about the origin of its frame.

    Source:
        Steiner's theorem.
    """
    mass, centre = float(ten[0]), ten[1:4] / ten[0]
    xx, xy, xz, yy, yz, zz = ten[4:]
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return mass, centre, about_origin - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))


def are_bodies(ten: Float[np.ndarray, "links 10"]) -> bool:
    """Check that each link is one that a body can be, or without any mass and inertia."""
    least = np.linalg.eigvalsh(np.asarray(pseudo_inertia(jnp.asarray(ten))))
    return bool(np.all(least[:, 0] >= -1e-12 * np.abs(least[:, -1])))


@dataclass(frozen=True)
class Bodies:
    """Links and rotors that move as those of a result.

    Args:
        links: Ten parameters of each link, (links, 10).
        rotors: Inertia of each rotor, seen at its joint, (n,).
        error: Largest difference of a sum from that of the result, relative to its size.
    """

    links: Float[np.ndarray, "links 10"]
    rotors: Float[np.ndarray, " n"]
    error: float


def bodies_of(
    plant: LinkTree, start: Float[np.ndarray, "links 10"], rotors: Float[np.ndarray, " n"]
) -> Bodies:
    """Find bodies that move as the links of a plant do, near those of a file.

    Links that are bodies themselves are returned as they are. Otherwise each is a body of positive density
    whose sums, the base parameters, are those of the plant: Newton steps of least size in the log-Cholesky
    coordinates of the bodies, from the file's on. Rotors that are part of a sum stay those that the case
    states, or those of the file.

    Args:
        plant: The plant; its parameters may be base parameters, with zeros for the others. Its rotors are
            those seen at the joints.
        start: Parameters of the links of the file; links without mass keep theirs.
        rotors: Rotors of the file.

    Source:
        Rucker & Wensing (2022), IEEE RA-L 7(2), for the coordinates.
    """
    found = links_of(plant)
    own = np.zeros(plant.joints) if plant.rotor_inertia is None else np.asarray(plant.rotor_inertia)
    if are_bodies(found):
        return Bodies(found, own, 0.0)

    asked, final = LinkSums.of(plant, start, rotors)
    x = np.asarray(_coordinates(fuller(start[asked.heavy]))).ravel()
    asked = LinkSums(*map(jnp.asarray, asked))
    error = np.asarray(_rest(x, asked))
    for _ in range(_STEPS):
        if np.abs(error).max() < _CLOSE:
            break
        step = np.linalg.lstsq(np.asarray(_slope(x, asked)), -error, rcond=1e-10)[0]
        step *= min(1.0, 1.0 / np.abs(step).max())
        shorter = ((step * 0.5**k, np.asarray(_rest(x + step * 0.5**k, asked))) for k in range(20))
        better = next((s for s in shorter if np.linalg.norm(s[1]) < np.linalg.norm(error)), None)
        if better is None:
            break
        x, error = x + better[0], better[1]

    out = np.asarray(_links(jnp.asarray(x), asked)).copy()
    return Bodies(out, final, float(np.abs(error).max()))


class LinkSums(NamedTuple):
    """Sums that bodies are to have.

    Args:
        start: Links of the file; heavy: indices of those that have mass.
        mapping, links, kinds: Factors of the parameters in each sum, and the link and kind of each.
        wanted, size: The sums, and the size by which each counts.
    """

    start: Any
    heavy: Any
    mapping: Any
    links: Any
    kinds: Any
    wanted: Any
    size: Any

    @classmethod
    def of(
        cls, plant: LinkTree, start: Float[np.ndarray, "links 10"], rotors: Float[np.ndarray, " n"]
    ) -> tuple[LinkSums, Float[np.ndarray, " n"]]:
        """Return the sums of a plant that its links have, and its rotors.

        A rotor that is part of a sum is the one that the case states, or else that of the file. The links
        have the rest of the sum.

        Args:
            plant: The plant, its rotors as seen at the joints.
            start: Links of the file.
            rotors: Rotors of the file.
        """
        found, sums = links_of(plant), _sums_of(plant)
        own = np.zeros(plant.joints) if plant.rotor_inertia is None else np.asarray(plant.rotor_inertia)
        columns = [k for k, (name, _) in enumerate(sums.standard) if name in TEN]
        turning = [k for k, (name, _) in enumerate(sums.standard) if name not in TEN]
        final = own.copy()
        for joint, column in enumerate(turning):
            # One value stands for an unknown sum, the others are zero: a second one is stated by the case.
            beside = _beside(sums, column, found)
            stated = own[joint] != 0 and beside.any()
            if not stated and not _alone(sums, column):
                final[joint] = rotors[joint]
        mapping = sums.mapping[:, columns]
        kinds = np.array([TEN.index(sums.standard[c][0]) for c in columns])
        links = np.array([sums.standard[c][1] for c in columns])
        wanted = mapping @ found[links, kinds] + sums.mapping[:, turning] @ (own - final)[: len(turning)]

        # A row counts by the size of its sum over the magnitudes of the file's bodies; one that is next to
        # nothing, such as the product of inertia of a symmetric link, by a part of the largest of its kind.
        size = np.abs(mapping) @ np.abs(start[links, kinds]) + np.abs(wanted)
        dimension = np.digitize(kinds[np.argmax(mapping != 0, axis=1)], [1, 4])
        largest = np.array([size[dimension == d].max() for d in dimension])
        size = np.maximum(size, _SMALL * largest)
        heavy = np.flatnonzero(start[:, 0] > 0)
        return cls(start, heavy, mapping, links, kinds, wanted, size), final


_coordinates = jax.jit(jax.vmap(log_cholesky))


@jax.jit
def _links(x: Array, asked: LinkSums) -> Array:
    """Return all links from the coordinates of those that have mass."""
    heavy = jax.vmap(of_log_cholesky)(x.reshape(-1, 10))
    return jnp.asarray(asked.start).at[asked.heavy].set(heavy)


@jax.jit
def _rest(x: Array, asked: LinkSums) -> Array:
    """Return the sums of bodies less those that are asked for, relative to their sizes."""
    return (asked.mapping @ _links(x, asked)[asked.links, asked.kinds] - asked.wanted) / asked.size


_slope = jax.jit(jax.jacfwd(_rest))


def _alone(sums: BaseParameters, column: int) -> bool:
    """Check that a parameter is a sum of itself alone."""
    rows = np.flatnonzero(sums.mapping[:, column])
    return rows.size == 1 and np.count_nonzero(sums.mapping[rows[0]]) == 1


def _beside(
    sums: BaseParameters, column: int, links: Float[np.ndarray, "links 10"]
) -> Float[np.ndarray, " values"]:
    """Return the values of links in the sums of which a parameter is part."""
    members = np.flatnonzero(np.any(sums.mapping[sums.mapping[:, column] != 0] != 0, axis=0))
    places = (sums.standard[k] for k in members)
    return np.array([links[link, TEN.index(name)] for name, link in places if name in TEN])


def _sums_of(plant: LinkTree) -> BaseParameters:
    """Return the base parameters of a plant."""
    if np.any(np.asarray(plant.gravity_vector)) and not plant.copies:
        return base_parameters_by_rules(plant, _ZERO)
    return base_parameters(plant)


def fuller(ten: Float[np.ndarray, "links 10"]) -> Float[np.ndarray, "links 10"]:
    """Return bodies with some extent in every direction, which have such coordinates."""
    out = ten.copy()
    for body in out:
        moments = np.linalg.eigvalsh(np.asarray(pseudo_inertia(jnp.asarray(body))))
        about = body[1:4] / body[0]
        # The second moments about the centre of mass may be zero, or slightly less, in files.
        second = np.asarray(pseudo_inertia(jnp.asarray(body)))[:3, :3] - body[0] * np.outer(about, about)
        values = np.linalg.eigvalsh(second)
        short = max(1e-4 * max(values[-1], 1e-8 * moments[-1]) - values[0], 0.0)
        body[[4, 7, 9]] += 2 * short
    return out
