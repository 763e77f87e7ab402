"""The dominant-inertia method: parameters of links from one joint's inertia in many configurations."""

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
from jaxid.numerics.directions import held, named_directions

# Singular values below this part of the largest are rounding: configurations known to ten digits.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class DominantInertias:
    """Parameters of the links from one joint's inertia in several configurations.

    Args:
        base: Combinations of unknown parameters on which this joint's inertia depends.
        theta: Their values, in the units of their representatives; NaN if not identifiable.
        std: Their standard deviations, from the residual; NaN without degrees of freedom.
        residual: Measured minus fitted inertia, by configuration [kg m^2 or kg].
        condition: Ratio of the largest to the smallest singular value of the identifiable part, with columns
            of norm one.
        unidentifiable: Combinations that these configurations do not identify.
    """

    base: BaseParameters
    theta: Float[np.ndarray, " base"]
    std: Float[np.ndarray, " base"]
    residual: Float[np.ndarray, " w"]
    condition: float
    unidentifiable: list[dict[str, float]]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that represent the combinations."""
        return self.base.chosen_names


def of_swing(
    stiffness: float | Float[np.ndarray, "..."], period: float | Float[np.ndarray, "..."]
) -> float | Float[np.ndarray, "..."]:
    """Compute the inertia of an undamped swing against a controller's stiffness, K_p T^2 / 4 pi^2.

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
    """Differentiate a joint's inertia d_ii(q) in the `standard_parameters`, by configuration.

    Args:
        plant: The plant.
        joint: Number of the joint, counted from 1.
        configurations: Positions of all joints, (w, n) [rad or m].

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
    """Solve stacked measurements of one joint's inertia for the parameters of the links that it moves.

    The known part is subtracted, and the rest is solved by least squares (the pseudo-inverse). If the inertia
    depends on a combination of unknown parameters only, that combination is solved for.

    Args:
        plant: The plant, with the values of known parameters; the others do not matter.
        joint: The joint that moved while all others were locked, counted from 1.
        configurations: Positions of all joints, (w, n) [rad or m].
        measured: Inertia of the joint in each configuration [kg m^2; kg for a prismatic joint], for instance
            by `of_swing`.
        known: Names of parameters with known values ("mass[1]", or "mass" for all links).

    Returns:
        The combinations, and those of them that these configurations do not identify.

    Raises:
        InputError: If there is no such joint or parameter, if shapes do not fit, if an inertia is not a
            positive number, or if none depends on an unknown.

    Source:
        "PA-10 traineeship", (4.13)-(4.17). There the configurations must identify all; here combinations that
        they do not identify are named.
    """
    places = standard_places(plant)
    names, values = standard_parameters(plant)
    q, inertia = (np.asarray(x, dtype=np.float64) for x in (configurations, measured))
    _check(plant, joint, q, inertia, known, names)

    # The combinations on which the inertia depends, from random positions.
    unknown = [k for k, (name, _) in enumerate(places) if not {name, names[k]} & set(known)]
    given = [k for k in range(len(places)) if k not in unknown]
    at_random = random_states(plant, 3 * len(places), np.random.default_rng(0))[0]
    columns = inertia_regressor(plant, joint, at_random)[:, unknown]
    if not np.any(columns):
        raise InputError(
            f"the inertia of joint {joint} does not depend on an unknown parameter",
            hint="take a joint before it, or remove names from known",
        )
    base = grouped(columns, tuple(places[k] for k in unknown))

    whole = inertia_regressor(plant, joint, q)
    rest = inertia - whole[:, given] @ values[given]
    # A column that is zero in these configurations, except for rounding, must not be scaled to norm one.
    norm = np.linalg.norm(columns[:, list(base.chosen)], axis=0)
    regressor = whole[:, unknown][:, list(base.chosen)] / norm
    here = np.linalg.norm(regressor, axis=0)
    here[here <= _ROUNDING] = 1.0
    norm = norm * here

    u, s, vt = np.linalg.svd(regressor / here)
    rank = int(np.sum(s > _ROUNDING * s[0]))
    identifiable, null_space = vt[:rank].T, vt[rank:].T
    scaled = identifiable @ ((u[:, :rank].T @ rest) / s[:rank])
    theta = scaled / norm
    residual = rest - regressor / here @ scaled

    free = len(q) - rank
    scatter = np.sqrt(residual @ residual / free) if free else np.nan
    std = scatter * np.linalg.norm(identifiable / s[:rank], axis=1) / norm
    theta[held(null_space)], std[held(null_space)] = np.nan, np.nan
    return DominantInertias(
        base=base,
        theta=theta,
        std=std,
        residual=residual,
        condition=float(s[0] / s[rank - 1]),
        unidentifiable=named_directions(base.chosen_names, null_space),
    )


def _check(
    plant: Plant, joint: int, q: np.ndarray, inertia: np.ndarray, known: Sequence[str], names: Sequence[str]
) -> None:
    """Refuse measurements with a wrong joint, shape, value or name."""
    if not 1 <= joint <= plant.joints:
        raise InputError(f"joint is {joint}", hint=f"the plant has joints 1 to {plant.joints}")
    if q.ndim != 2 or q.shape[1] != plant.joints or not len(q):
        hint = f"give a row of {plant.joints} positions for each configuration"
        raise InputError(f"configurations have the shape {q.shape}", hint=hint)
    if inertia.shape != q.shape[:1]:
        hint = "give one inertia for each configuration"
        raise InputError(f"{inertia.size} inertias for {len(q)} configurations", hint=hint)
    bad = np.flatnonzero(~(np.isfinite(inertia) & (inertia > 0)))
    if bad.size:
        hint = "remove its row from both arrays: a joint that sticks has no period"
        raise InputError(f"the inertia of configuration {bad[0] + 1} is {inertia[bad[0]]} kg m^2", hint=hint)
    plain = {n.partition("[")[0] for n in names}
    wrong = [n for n in known if n not in names and n not in plain]
    if wrong:
        raise InputError(f"{wrong[0]} is not a parameter of the plant", hint=suggest(wrong[0], names))
