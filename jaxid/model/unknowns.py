"""The unknown leaves of a plant, and their exchange with a vector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.model.units import Units

# Lower bound of a positive unknown, relative to its guess: it keeps a solver off zero, far below
# any value that a log can resolve.
_POSITIVE_FLOOR = 1e-9
# First steps of the paths of unknowns of the reference and of the controller, which belong to no plant.
REFERENCE, CONTROLLER = "reference", "controller"


@dataclass(frozen=True)
class Free:
    """One unknown number.

    Args:
        name: Name in results: `inertia`, `viscous_friction.coefficient`.
        path: Attributes and indices from the plant to the leaf.
        unit: Label of its unit.
        sign: Constraint "free", "nonnegative" or "positive".
        guess: Initial value of a fit.
        lower, upper: Bounds that the case states.
        index: Entry of the leaf if it is a list; row and entry if it is a list of lists.
        true: Value for simulation and studies, if it differs from the guess.
        log: Name of the log in which this value holds; None: it is that of all logs.
    """

    name: str
    path: tuple[str | int, ...]
    unit: str
    sign: str
    guess: float
    lower: float = -np.inf
    upper: float = np.inf
    index: int | tuple[int, int] | None = None
    true: float | None = None
    log: str | None = None

    @property
    def parameter(self) -> str:
        """Name of the parameter in results, without that of a log."""
        return self.name if self.log is None else self.name.removesuffix(of_log("", self.log))

    @property
    def effect(self) -> int | None:
        """Index of the effect that has the unknown; None for a parameter of the plant."""
        if self.path[0] != "effects":
            return None
        index = self.path[1]
        assert isinstance(index, int), "effects are a tuple"
        return index

    def get(self, plant: Plant) -> Array:
        """Return the leaf that holds this unknown."""
        return leaf(plant, self.path)


def of_log(name: str, log: str) -> str:
    """Return the name of an unknown that has a value of its own in a log."""
    return f"{name} @ {log}"


@dataclass(frozen=True)
class Body:
    """Unknowns that are the ten inertial parameters of a body, and are fitted as such.

    Args:
        places: Index of each among the unknowns, in the order of `jaxid.names.TEN`.
        lower, upper: Bounds on the coordinates of `jaxid.arms.pseudo_inertia.log_cholesky`.
    """

    places: tuple[int, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]


@dataclass(frozen=True)
class Parameters:
    """The unknowns of a plant, in a fixed order.

    Args:
        free: The unknowns, in their order.
        bodies: Groups of them that must be physically consistent.
    """

    free: tuple[Free, ...]
    bodies: tuple[Body, ...] = ()

    @property
    def names(self) -> list[str]:
        """Name of each unknown."""
        return [f.name for f in self.free]

    @property
    def guess(self) -> Float[np.ndarray, " p"]:
        """Initial values of a fit."""
        return np.asarray([f.guess for f in self.free], dtype=np.float64)

    @property
    def bounds(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """Lower and upper bounds: those of the user, and those that the signs demand."""
        return self.bounds_at(self.guess)

    def bounds_at(
        self, guess: Float[np.ndarray, "*starts p"]
    ) -> tuple[Float[np.ndarray, "*starts p"], Float[np.ndarray, "*starts p"]]:
        """Return the lower and upper bounds for other initial values, or for many sets of them."""
        floors = {"free": (-np.inf, 0.0), "nonnegative": (0.0, 0.0)}
        stated = [(f.lower, f.upper, *floors.get(f.sign, (0.0, _POSITIVE_FLOOR))) for f in self.free]
        lower, upper, floor, part = np.asarray(stated, dtype=np.float64).reshape(-1, 4).T
        lowest = np.maximum(lower, floor + part * np.abs(guess))
        return lowest, upper + np.zeros_like(lowest)

    def insert(self, plant: Plant, theta: Float[Array, " p"]) -> Plant:
        """Return the plant with the unknowns set."""
        return scatter(self.places, plant, theta)

    @property
    def places(self) -> tuple[tuple[tuple[str | int, ...], int | tuple[int, int] | None], ...]:
        """Path and index of each unknown: hashable, so that compiled code can depend on it."""
        return tuple((f.path, f.index) for f in self.free)

    def extract(self, plant: Plant) -> Float[Array, " p"]:
        """Return the values of the unknowns in a plant."""
        values = [f.get(plant) if f.index is None else f.get(plant)[f.index] for f in self.free]
        return jnp.asarray(values, dtype=jnp.float64)

    def with_guess(self, theta: Sequence[float]) -> Parameters:
        """Return the same unknowns with other initial values."""
        free = tuple(replace(f, guess=float(v)) for f, v in zip(self.free, theta, strict=True))
        return Parameters(free, self.bodies)

    def extended(self, more: Sequence[Free]) -> Parameters:
        """Return these unknowns and more behind them."""
        return Parameters((*self.free, *more), self.bodies)

    def chosen(self, kept: Sequence[int]) -> Parameters:
        """Return some of the unknowns by their indices, with the bodies that are among them as a whole."""
        new = {old: k for k, old in enumerate(kept)}
        bodies = tuple(
            replace(body, places=tuple(new[k] for k in body.places))
            for body in self.bodies
            if all(k in new for k in body.places)
        )
        return Parameters(tuple(self.free[k] for k in kept), bodies)

    @property
    def without_bodies(self) -> Parameters:
        """Unknowns without the demand on links, whose parameters may then have any sign."""
        linked = zip(self.free, self.in_bodies, strict=True)
        return Parameters(tuple(replace(f, sign="free") if inside else f for f, inside in linked))

    @property
    def in_bodies(self) -> Bool[np.ndarray, " p"]:
        """Mask of the unknowns that belong to a body."""
        return np.isin(np.arange(len(self.free)), [k for body in self.bodies for k in body.places])


def in_loop(path: tuple[str | int, ...]) -> bool:
    """Check that an unknown is one of the reference or of the controller."""
    return path[0] in (REFERENCE, CONTROLLER)


def leaf(plant: Plant, path: tuple[str | int, ...]) -> Array:
    """Return the leaf at the end of a path of attributes and indices."""
    node: Any = plant
    for step in path:
        node = node[step] if isinstance(step, int) else getattr(node, step)
    return node


def scatter(places: tuple, plant: Plant, theta: Float[Array, " p"]) -> Plant:
    """Return the plant with theta[k] at places[k], each a path and, if the leaf is a list, an index.

    Unknowns of a reference or a controller belong to no plant, and are skipped.
    """
    leaves, structure = jax.tree.flatten(plant)
    numbers = jax.tree.unflatten(structure, range(len(leaves)))
    for k, (path, index) in enumerate(places):
        if in_loop(path):
            continue
        at, value = leaf(numbers, path), theta[k]
        if isinstance(theta, np.ndarray):
            # Each array that JAX makes outside compiled code takes longer than all else here.
            leaves[at] = np.asarray(value) if index is None else _with_entry(leaves[at], index, value)
        else:
            leaves[at] = value if index is None else jnp.asarray(leaves[at]).at[index].set(value)
    return jax.tree.unflatten(structure, leaves)


def scatter_controller(places: tuple, controller: Any, theta: Float[Array, " p"]) -> Any:
    """Return the controller with theta[k] at each places[k] that is one of its unknowns."""
    for k, (path, index) in enumerate(places):
        if path[0] == CONTROLLER:
            name = str(path[1])
            now = getattr(controller, name)
            value = theta[k]
            if isinstance(theta, np.ndarray):
                value = np.asarray(value) if index is None else _with_entry(now, index, value)
            elif index is not None:
                value = jnp.asarray(now).at[index].set(value)
            controller = replace(controller, **{name: value})
    return controller


def _with_entry(values: Array, index: int | tuple[int, int], value: Array | float) -> np.ndarray:
    out = np.array(values)
    out[index] = value
    return out


def colours(enters: Bool[np.ndarray, "n p"]) -> tuple[int, ...]:
    """Assign numbers to the unknowns such that no two with the same number enter the same balance.

    Each takes the first number that is free in all balances that it enters.
    """
    taken: list[np.ndarray] = []
    out = []
    for rows in enters.T:
        k = next((k for k, t in enumerate(taken) if not np.any(t & rows)), len(taken))
        if k == len(taken):
            taken.append(np.zeros_like(rows))
        taken[k] = taken[k] | rows
        out.append(k)
    return tuple(out)


def seeds(colours: tuple[int, ...]) -> Float[np.ndarray, "p c"]:
    """Return the directions in which a derivative is taken, one for each colour."""
    out = np.zeros((len(colours), max(colours, default=-1) + 1))
    out[np.arange(len(colours)), list(colours)] = 1.0
    return out


def free_effect(
    plant: Plant, effect: Effect, units: Units, name: str | None = None
) -> tuple[Plant, list[Free]]:
    """Add an effect to a plant with all its parameters unknown, starting from their values."""
    name = name or effect_name(plant, effect)
    added = plant.with_effect(effect)
    position = len(plant.effects)
    free = [
        Free(
            name=f"{name}.{field}",
            path=("effects", position, field),
            unit=units.label(info.dimension, plant.motion(effect.port)),
            sign=info.sign,
            guess=float(getattr(effect, field)),
        )
        for field, info in parameters_of(type(effect)).items()
        if getattr(effect, field) is not None
    ]
    return added, free


def effect_name(plant: Plant, effect: Effect) -> str:
    """Return the key of an effect in results: kind and place, numbered if the plant already has one there."""
    same = sum(e.kind == effect.kind and e.port == effect.port for e in plant.effects)
    return label(plant, effect.kind, effect.port) + ("" if same == 0 else f"#{same + 1}")


def label(plant: Plant, kind: str, port: int) -> str:
    """Return a kind with its place, left out on a machine of one joint: `cogging[2]`, `[spring 3]`."""
    if not several_places(plant):
        return kind
    place, k = plant.place(port)
    return f"{kind}[{k}]" if place == "joint" else f"{kind}[{place} {k}]"


def several_places(plant: Plant) -> bool:
    """Check that effects need a place to be distinguished."""
    return plant.bodies(plant.joints) + plant.springs(plant.joints) > 1
