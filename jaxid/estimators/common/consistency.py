"""Physically consistent links, whose ten parameters are those of a real body, as an option of fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arms.pseudo_inertia import log_cholesky, pseudo_inertia
from jaxid.errors import InputError
from jaxid.estimators.estimate import Estimate
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Body, Free
from jaxid.names import TEN
from jaxid.numerics.lanes import Steps
from jaxid.session import Session

# Masses, and the extents of a body, stay within this factor of the guess: if the optimal body has no extent
# in some direction, the logarithm of this extent would diverge.
_RANGE = 1e3


def need_bodies(session: Session) -> Session:
    """Return the session with the unknown links of its arm restricted to parameters of real bodies.

    Other machines are returned unchanged; their inertias are positive anyway.

    Raises:
        InputError: If a link is known in part, bounded by min or max, or its guess is no body.
    """
    machine, where = session.machine, session.case.where
    if not machine.plant.linked:
        return session
    unknown, bodies = machine.parameters.free, []
    for link in range(len(bodies_of(machine.plant))):
        indices = {f.path[0]: k for k, f in enumerate(unknown) if f.path[0] in TEN and f.index == link}
        if indices:
            bodies.append(_body(link, indices, unknown, f"{where}, link {link + 1}"))
    return session.with_machine(
        machine.with_plant(machine.plant, replace(machine.parameters, bodies=tuple(bodies)))
    )


def _body(link: int, indices: dict[str, int], unknown: Sequence[Free], where: str) -> Body:
    known = [name for name in TEN if name not in indices]
    if known:
        hint = "let all ten be unknown and start at those of a body; base parameters alone are of none"
        raise InputError(
            f"{known[0]}[{link + 1}] is known and others are not, and physically_consistent "
            "asks for whole bodies",
            where=where,
            hint=hint,
        )

    places = tuple(indices[name] for name in TEN)
    bounded = [unknown[k].name for k in places if np.isfinite([unknown[k].lower, unknown[k].upper]).any()]
    if bounded:
        what = f"{bounded[0]} has min or max, which physically_consistent does not keep"
        raise InputError(what, where=where, hint="leave them out")

    ten = jnp.asarray([unknown[k].guess for k in places])
    least = float(np.linalg.eigvalsh(np.asarray(pseudo_inertia(ten)))[0])
    x = np.asarray(log_cholesky(ten))
    if not (least > 0 and np.all(np.isfinite(x))):
        what = f"its guess is no body: the least eigenvalue of its pseudo-inertia is {least:.3g}"
        hint = "start from mass, first_moment and inertia of a body: a rod, a ball"
        raise InputError(what, where=where, hint=hint)

    lower, upper = np.full(10, -np.inf), np.full(10, np.inf)
    # These coordinates are half the logarithm of the mass, and the logarithms of the extents.
    for coordinates, factor in (([0], 0.5), ([4, 5, 6], 1.0)):
        lower[coordinates] = x[coordinates] - factor * np.log(_RANGE)
        upper[coordinates] = x[coordinates] + factor * np.log(_RANGE)
    return Body(places, tuple(lower.tolist()), tuple(upper.tolist()))


def with_links(steps: Steps[Estimate]) -> Steps[Estimate]:
    """Run a fit and add the parameters of each link to its estimate, identifiable or not."""
    estimate = yield from steps
    if not estimate.machine.plant.linked:
        return estimate
    note = "links are physically consistent; standard deviations are those of the log alone"
    return replace(
        estimate,
        notes=(*estimate.notes, note),
        details={**estimate.details, "links": links_of(estimate.machine.plant)},
    )


def links_of(plant: Plant) -> list[dict[str, object]]:
    """Return each link's parameters, and the smallest eigenvalue of its pseudo-inertia over the largest."""
    ten = bodies_of(plant)
    values = np.linalg.eigvalsh(np.asarray(pseudo_inertia(jnp.asarray(ten))))
    return [
        {"mass": b[0], "first_moment": b[1:4], "inertia": b[4:], "eigenvalue_ratio": float(v[0] / v[-1])}
        for b, v in zip(ten.tolist(), values, strict=True)
    ]


def bodies_of(plant: Plant) -> Float[np.ndarray, "n 10"]:
    """Return the ten inertial parameters of every link, (n, 10)."""
    return np.stack([np.asarray(getattr(plant, name)) for name in TEN], axis=-1)
