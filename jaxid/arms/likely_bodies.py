"""Rigid bodies behind sums of their parameters, for an arm of which no file states any bodies."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arms.bodies import Bodies, LinkSums, are_bodies, fuller, links_of
from jaxid.arms.pseudo_inertia import pseudo_inertia, ten_parameters
from jaxid.plants.link_tree import LinkTree

# Least second moment of a body about its centre of mass, over its largest, for a simulator.
_THIN = 1e-9
# Radius of gyration of a body of which nothing is known, over the distance between its joints, and least mass
# of one over the largest.
_SPREAD, _LIGHT = 0.3, 1e-2
# Shortest distance between joints, over the reach of the arm, and reach of one without a length [m].
_SHORT, _POINT = 0.3, 0.3
# Weights of the distance from the first bodies, beside the squares of relative differences of the sums.
_WEIGHTS = 10.0 ** -np.arange(0, 13, 2)
# Newton steps for each weight, and halvings of one: a convex problem takes far fewer.
_STEPS, _HALVINGS = 50, 40
_ENOUGH = 1e-10


def likely_bodies(plant: LinkTree) -> Bodies:
    """Find bodies that move as the links of a plant do, of which nothing else is known.

    Links that are bodies of some extent themselves are returned as they are. Otherwise bodies of positive
    density are found whose sums, the base parameters, are those of the plant. Of all such bodies they are the
    nearest to first ones in the divergence tr X - log det X, with X the pseudo-inertia in units of the first
    one. A first body is the link itself if it is one, else a round one about its joint, as heavy as its
    parameters suggest. The problem is convex: if there are no such bodies, those that are returned have the
    nearest sums, and `error` says how near.

    Args:
        plant: The plant; its parameters may be base parameters, with zeros for the others. Its rotors are
            those seen at the joints, and stay.

    Source:
        Lee & Park (2018), IEEE RA-L 3(3), for the divergence between pseudo-inertias; Wensing, Kim & Slotine
        (2018), IEEE RA-L 3(1), for bodies as a convex set. Newton's method for barriers: Boyd & Vandenberghe
        (2004), Convex Optimization, chapters 10 and 11.
    """
    found = links_of(plant)
    rotors = np.zeros(plant.joints) if plant.rotor_inertia is None else np.asarray(plant.rotor_inertia)
    if all(_has_extent(body) for body in found):
        return Bodies(found, rotors, 0.0)

    first = _first_bodies(plant, found)
    asked, _ = LinkSums.of(replace(plant, effects=()), first, rotors)
    units = np.linalg.cholesky(np.asarray(pseudo_inertia(jnp.asarray(first))))
    # Ten parameters of each link from the ten coordinates of its X.
    shapes = units[:, None] @ _BASIS @ units[:, None].transpose(0, 1, 3, 2)
    into = np.asarray(ten_parameters(jnp.asarray(shapes))).transpose(0, 2, 1)
    whole = np.zeros((len(asked.wanted), len(found), 10))
    for column, (link, kind) in enumerate(zip(asked.links, asked.kinds, strict=True)):
        whole[:, link] += asked.mapping[:, column, None] * into[link, kind]
    whole = whole.reshape(len(whole), -1) / asked.size[:, None]

    x = _nearest(whole, asked.wanted / asked.size, len(found))
    error = float(np.abs(whole @ x - asked.wanted / asked.size).max(initial=0.0))
    links = (into @ x.reshape(-1, 10, 1))[..., 0]
    return Bodies(links, rotors, error)


def _has_extent(ten: Float[np.ndarray, " 10"]) -> bool:
    """Check that a simulator takes a body: it has a mass, and some extent in every direction."""
    if not ten[0] > 0:
        return False
    centre = ten[1:4] / ten[0]
    second = np.asarray(pseudo_inertia(jnp.asarray(ten)))[:3, :3] - ten[0] * np.outer(centre, centre)
    least, _, largest = np.linalg.eigvalsh(second)
    return bool(least > _THIN * largest)


def _first_bodies(plant: LinkTree, found: Float[np.ndarray, "links 10"]) -> Float[np.ndarray, "links 10"]:
    """Return bodies of the sizes and masses that the links of a plant suggest."""
    origins = np.asarray(plant.geometry.at_zero().origins)
    distances = np.linalg.norm(origins, axis=1)
    reach = float(distances.sum()) or _POINT
    lengths = np.full(len(found), _SHORT * reach)
    for link, parent in enumerate(plant.tree.parents):
        if parent >= 0:
            lengths[parent] = max(lengths[parent], distances[link])
    sizes = np.abs(found) / lengths[:, None] ** ([0] + [1] * 3 + [2] * 6)
    masses = sizes.max(axis=1)
    masses = np.maximum(masses, _LIGHT * (masses.max() or 1.0))

    out = np.zeros_like(found)
    out[:, 0] = masses
    out[:, [4, 7, 9]] = 2.0 * (masses * (_SPREAD * lengths) ** 2)[:, None]
    for link, body in enumerate(found):
        if body[0] > 0 and are_bodies(body[None]):
            out[link] = body if _has_extent(body) else fuller(body[None])[0]
    return out


def _basis() -> Float[np.ndarray, "10 4 4"]:
    """Return an orthonormal basis of the symmetric matrices."""
    out = []
    for i, j in zip(*np.triu_indices(4), strict=True):
        one = np.zeros((4, 4))
        one[i, j] = one[j, i] = 1.0 if i == j else np.sqrt(0.5)
        out.append(one)
    return np.array(out)


_BASIS = _basis()


def _nearest(
    mapping: Float[np.ndarray, "sums x"], wanted: Float[np.ndarray, " sums"], links: int
) -> Float[np.ndarray, " x"]:
    """Minimise tr X - log det X of all links under mapping x = wanted, or as near to that as can be."""
    x = np.tile(np.einsum("kii->k", _BASIS), links)
    for weight in _WEIGHTS:
        x = _minimum(x, mapping, wanted, weight)

    # The sums to the last digit, by steps of least size in the divergence's own metric.
    for _ in range(_STEPS):
        rest = wanted - mapping @ x
        if np.abs(rest).max(initial=0.0) < _ENOUGH * 1e-4:
            break
        try:
            spread = np.linalg.solve(_divergence(x)[2], mapping.T)
        except np.linalg.LinAlgError:
            break
        step = spread @ np.linalg.lstsq(mapping @ spread, rest, rcond=1e-12)[0]
        if not np.all(np.linalg.eigvalsh(_matrices(x + step)) > 0):
            break
        if np.abs(wanted - mapping @ (x + step)).max() >= np.abs(rest).max():
            break
        x = x + step
    return x


def _minimum(x: np.ndarray, mapping: np.ndarray, wanted: np.ndarray, weight: float) -> np.ndarray:
    """Minimise weight (tr X - log det X) + |mapping x - wanted|^2 / 2 by Newton's method."""

    def cost(at: np.ndarray) -> float:
        rest = mapping @ at - wanted
        return weight * _divergence(at)[0] + 0.5 * float(rest @ rest)

    now = cost(x)
    for _ in range(_STEPS):
        _, slope, curve = _divergence(x)
        slope = weight * slope + mapping.T @ (mapping @ x - wanted)
        try:
            step = -np.linalg.solve(weight * curve + mapping.T @ mapping, slope)
        except np.linalg.LinAlgError:
            # Singular by rounding, under a small weight: the values are then near enough.
            break
        fall = -float(slope @ step)
        if fall < 1e-12 * (abs(now) + weight):
            break
        for k in range(_HALVINGS):
            after = cost(x + step * 0.5**k)
            if after <= now - 0.1 * fall * 0.5**k:
                break
        else:
            break
        x, now = x + step * 0.5**k, after
    return x


def _matrices(x: np.ndarray) -> Float[np.ndarray, "links 4 4"]:
    return np.einsum("nk,kij->nij", x.reshape(-1, 10), _BASIS)


def _divergence(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return tr X - log det X of all links, infinite if one is no body; its slope and its curvature."""
    matrices = _matrices(x)
    values = np.linalg.eigvalsh(matrices)
    if not np.all(values > 0):
        return np.inf, x, np.eye(len(x))
    inverse = np.linalg.inv(matrices)
    value = float(values.sum() - np.log(values).sum())
    slope = np.einsum("kii->k", _BASIS)[None] - np.einsum("nij,kij->nk", inverse, _BASIS)
    sides = np.einsum("nij,kjl->nkil", inverse, _BASIS)
    blocks = np.einsum("nkil,nmli->nkm", sides, sides)
    curve = np.zeros((len(x), len(x)))
    for link, block in enumerate(blocks):
        curve[10 * link : 10 * link + 10, 10 * link : 10 * link + 10] = block
    return value, slope.ravel(), curve
