"""Physically consistent links, whose ten parameters are those of a real body, as an option of fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arms.pseudo_inertia import log_cholesky, pseudo_inertia
from jaxid.errors import InputError
from jaxid.estimators.estimate import Estimate
from jaxid.model.by_name import Place
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
        InputError: If a link is known in part, bounded by min or max, or its guess is no body; also if a log
            has some of its ten parameters for itself and shares others.
    """
    machine, where = session.machine, session.case.where
    if not machine.plant.linked:
        return session
    unknown, bodies = machine.parameters.free, []
    for link in range(len(bodies_of(machine.plant))):
        mine = {k: f for k, f in enumerate(unknown) if f.path[0] in TEN and f.index == link}
        place = f"{where}, link {link + 1}"
        if mine:
            _need_whole(session, link, [f.log for f in mine.values()], place)
        # A link whose parameters differ between logs is another body in each.
        for log in dict.fromkeys(f.log for f in mine.values()):
            indices = {str(f.path[0]): k for k, f in mine.items() if f.log == log}
            bodies.append(_body(link, indices, unknown, place))
    return session.with_machine(
        machine.with_plant(machine.plant, replace(machine.parameters, bodies=tuple(bodies)))
    )


def _need_whole(session: Session, link: int, logs: Sequence[str | None], where: str) -> None:
    """Refuse an unknown link of which a log has a part for itself, known or not.

    Args:
        session: Case and logs.
        link: Index of the link.
        logs: Log of each of its unknown parameters; None: that of all logs.
        where: Place of the link in the case.

    Raises:
        InputError: If a log does.
    """
    names = [run.name for run in session.fits if run.own and 0 < _known(run.own.plant, link) < len(TEN)]
    if None in logs and any(logs):
        names = [log for log in logs if log is not None]
    if names:
        what = f"{names[0]} has some of the link's ten parameters for itself and shares the others"
        hint = "set all ten, or name all ten in per_log: physically_consistent asks for whole bodies"
        raise InputError(what, where=where, hint=hint)


def _known(values: Mapping[Place, float], link: int) -> int:
    """Return how many of a link's ten parameters are among some values by their places."""
    return sum(((name,), link) in values for name in TEN)


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


def with_links(steps: Steps[Estimate], session: Session) -> Steps[Estimate]:
    """Run a fit and add the parameters of each link to its estimate, see `linked`."""
    return linked((yield from steps), session)


def linked(estimate: Estimate, session: Session) -> Estimate:
    """Return an estimate with the parameters of each link, identifiable or not.

    If the parameters of a link differ between logs, they stand among the results of each.
    """
    machine = estimate.machine
    if not machine.plant.linked:
        return estimate
    alone = "the log" if not session.more else "the logs"
    note = f"links are physically consistent; standard deviations are those of {alone} alone"
    details = dict(estimate.details)
    unknown = machine.parameters
    if any(f.log for f, linked in zip(unknown.free, unknown.in_bodies, strict=True) if linked):
        fits = details.get("fits", {})
        links = {run.name: {"links": links_of(run.machine(machine).plant)} for run in session.fits}
        details["fits"] = {name: {**fits.get(name, {}), **entry} for name, entry in links.items()}
    else:
        details["links"] = links_of(machine.plant)
    notes = estimate.notes if note in estimate.notes else (*estimate.notes, note)
    return replace(estimate, notes=notes, details=details)


def links_of(plant: Plant) -> list[dict[str, object]]:
    """Return each link's parameters, and the smallest eigenvalue of its pseudo-inertia over the largest.

    The ratio is NaN if a fit failed and left parameters that are not finite.
    """
    ten = bodies_of(plant)
    finite = np.all(np.isfinite(ten), axis=1)
    values = np.full((len(ten), 4), np.nan)
    values[finite] = np.linalg.eigvalsh(np.asarray(pseudo_inertia(jnp.asarray(ten[finite]))))
    return [
        {"mass": b[0], "first_moment": b[1:4], "inertia": b[4:], "eigenvalue_ratio": float(v[0] / v[-1])}
        for b, v in zip(ten.tolist(), values, strict=True)
    ]


def bodies_of(plant: Plant) -> Float[np.ndarray, "n 10"]:
    """Return the ten inertial parameters of every link, (n, 10)."""
    return np.stack([np.asarray(getattr(plant, name)) for name in TEN], axis=-1)
