"""The dominant-inertia method: what one joint's inertia in many configurations tells of an arm's links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxid.arms.base_parameters import (
    BaseParameters,
    grouped,
    inertial_regressor,
    random_states,
    standard_parameters,
    standard_places,
)
from jaxid.errors import InputError, suggest
from jaxid.model.plant import Plant
from jaxid.numerics.precision import held, named_directions

# Singular values below this part of the largest are rounding: configurations known to ten digits.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class DominantInertias:
    """Parameters of the links from one joint's inertia in several configurations.

    Args:
        base: The sums of unknown parameters that this joint's inertia depends on.
        theta: Their values, in the units of those that stand for them; NaN where nothing tells.
        std: Their standard deviations, from what the fit leaves; NaN where it leaves nothing to judge by.
        residual: Measured less fitted inertia, by configuration [kg m^2 or kg].
        condition: Largest over smallest singular value of the columns, normed, of what is told.
        unidentifiable: Combinations that these configurations do not tell.
    """

    base: BaseParameters
    theta: Float[np.ndarray, " base"]
    std: Float[np.ndarray, " base"]
    residual: Float[np.ndarray, " w"]
    condition: float
    unidentifiable: list[dict[str, float]]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that stand for the sums."""
        return self.base.chosen_names


def of_swing(
    stiffness: float | Float[np.ndarray, "..."], period: float | Float[np.ndarray, "..."]
) -> float | Float[np.ndarray, "..."]:
    """Inertia of what swings without damping against a controller's stiffness, K_p T^2 / 4 pi^2.

    Args:
        stiffness: K_p [N m/rad or N/m].
        period: T [s].

    Source:
        "PA-10 traineeship", (4.11).
    """
    return stiffness * period**2 / (4 * np.pi**2)


def inertia_regressor(
    plant: Plant, joint: int, configurations: Float[np.ndarray, "w n"]
) -> Float[np.ndarray, "w standard"]:
    """Derivative of a joint's own inertia d_ii(q) in `standard_parameters`, by configuration.

    Args:
        plant: The plant.
        joint: Which, counted from 1.
        configurations: Positions of all joints [rad or m].

    Source:
        "PA-10 traineeship", (4.12): these are its f_k, here by differentiation of the plant's balance.
    """
    q = np.asarray(configurations, dtype=np.float64)
    push = np.broadcast_to(np.eye(plant.joints)[joint - 1], q.shape)
    pushed, still = (np.asarray(inertial_regressor(plant, q, 0 * q, a)) for a in (push, 0 * q))
    return (pushed - still)[:, joint - 1]


def from_dominant_inertias(
    plant: Plant,
    joint: int,
    configurations: Float[np.ndarray, "w n"],
    measured: Float[np.ndarray, " w"],
    known: Sequence[str] = (),
) -> DominantInertias:
    """Solve stacked measurements of one joint's inertia for the parameters of the links it moves.

    What is known is subtracted, what is left is solved by least squares (the pseudo-inverse). Unknown
    parameters of which the joint's inertia depends on a sum only are solved as that sum.

    Args:
        plant: The plant, with the values of what is known; the others do not matter.
        joint: The joint that moved while all others were locked, counted from 1.
        configurations: Positions of all joints, (w, n) [rad or m].
        measured: Its inertia in each [kg m^2; kg, where it slides], as of `of_swing`.
        known: Names of parameters whose values are known ("mass[1]", or "mass" for that of every link).

    Returns:
        The sums, and which combinations of them these configurations do not tell.

    Raises:
        InputError: If there is no such joint or parameter, shapes do not fit, an inertia is not a positive
            number, or none depends on anything unknown.

    Source:
        "PA-10 traineeship", (4.13)-(4.17). There the configurations must tell all; here what they do not
        is named.
    """
    places, values = standard_places(plant), standard_parameters(plant)[1]
    names = standard_parameters(plant)[0]
    q, inertia = (np.asarray(x, dtype=np.float64) for x in (configurations, measured))
    _check(plant, joint, q, inertia, known, names)
    left = [k for k, (name, _) in enumerate(places) if not {name, names[k]} & set(known)]
    given = [k for k in range(len(places)) if k not in left]
    at_random = random_states(plant, 3 * len(places), np.random.default_rng(0))[0]
    columns = inertia_regressor(plant, joint, at_random)[:, left]
    if not np.any(columns):
        raise InputError(
            f"the inertia of joint {joint} depends on nothing that is unknown",
            hint="take a joint before it, or leave names out of known",
        )
    base = grouped(columns, tuple(places[k] for k in left))
    whole = inertia_regressor(plant, joint, q)
    rest = inertia - whole[:, given] @ values[given]
    # A function of the angles that is nothing here, but for rounding, must not be scaled up to one.
    norm = np.linalg.norm(columns[:, list(base.chosen)], axis=0)
    own = whole[:, left][:, list(base.chosen)] / norm
    here = np.linalg.norm(own, axis=0)
    here[here <= _ROUNDING] = 1.0
    norm = norm * here
    u, s, vt = np.linalg.svd(own / here)
    rank = int(np.sum(s > _ROUNDING * s[0]))
    seen, blind = vt[:rank].T, vt[rank:].T
    scaled = seen @ ((u[:, :rank].T @ rest) / s[:rank])
    theta, residual = scaled / norm, rest - own / here @ scaled
    free = len(q) - rank
    scatter = np.sqrt(residual @ residual / free) if free else np.nan
    std = scatter * np.linalg.norm(seen / s[:rank], axis=1) / norm
    theta[held(blind)], std[held(blind)] = np.nan, np.nan
    untold = named_directions(base.chosen_names, blind)
    return DominantInertias(base, theta, std, residual, float(s[0] / s[rank - 1]), untold)


def _check(
    plant: Plant, joint: int, q: np.ndarray, inertia: np.ndarray, known: Sequence[str], names: Sequence[str]
) -> None:
    if not 1 <= joint <= plant.joints:
        raise InputError(f"joint is {joint}", hint=f"the plant has joints 1 to {plant.joints}")
    if q.ndim != 2 or q.shape[1] != plant.joints or not len(q):
        hint = f"give a row of {plant.joints} positions for each"
        raise InputError(f"configurations have the shape {q.shape}", hint=hint)
    if inertia.shape != q.shape[:1]:
        hint = "give one for each"
        raise InputError(f"{inertia.size} inertias for {len(q)} configurations", hint=hint)
    bad = np.flatnonzero(~(np.isfinite(inertia) & (inertia > 0)))
    if bad.size:
        hint = "leave its row out of both: a joint that sticks has no period"
        raise InputError(f"the inertia of configuration {bad[0] + 1} is {inertia[bad[0]]} kg m^2", hint=hint)
    plain = {n.partition("[")[0] for n in names}
    wrong = [n for n in known if n not in names and n not in plain]
    if wrong:
        raise InputError(f"{wrong[0]} is none of the plant's parameters", hint=suggest(wrong[0], names))
