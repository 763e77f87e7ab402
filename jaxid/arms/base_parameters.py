"""Base parameters: the combinations of a plant's inertial parameters that its forces identify."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.effect import carries_force
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant

# A column counts as dependent if its remainder beside the chosen ones is below this part of it. Chosen:
# columns of real arms differ by 1e-3 and more (a squared length of 3 cm), rounding is 1e-14.
_DEPENDENT = 1e-9
# States for each unknown and row. Chosen: one random state would be enough for general position.
_STATES = 3


@dataclass(frozen=True)
class BaseParameters:
    """The base parameters of a plant.

    Args:
        standard: Standard parameters: field of the plant, and entry from 0 (None for a single number).
        chosen: Indices of those that represent a base parameter; the others are regrouped into these.
        mapping: Matrix from standard to base parameters, (base, standard): base = mapping @ standard.
        singular_values: Singular values of the regressor on the random states, its columns of norm one, the
            largest first; None if the base parameters come from rules.
    """

    standard: tuple[tuple[str, int | None], ...]
    chosen: tuple[int, ...]
    mapping: Float[np.ndarray, "base standard"]
    singular_values: Float[np.ndarray, " standard"] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the standard parameters, as in results: "mass[1]"."""
        return tuple(_name(place) for place in self.standard)

    @property
    def chosen_names(self) -> tuple[str, ...]:
        """Names of the standard parameters that represent a base parameter."""
        return tuple(self.names[k] for k in self.chosen)

    @property
    def places(self) -> tuple[tuple[str, int | None], ...]:
        """Field of the plant and entry of those that represent a base parameter."""
        return tuple(self.standard[k] for k in self.chosen)

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Names of the standard parameters that no force depends on."""
        return tuple(n for n, column in zip(self.names, self.mapping.T, strict=True) if not np.any(column))

    def of(self, plant: Plant) -> Float[np.ndarray, " base"]:
        """Compute the base parameters of a plant of this structure, in the units of their representatives."""
        return self.mapping @ _values(plant, self.standard)

    def text(self, digits: int = 6) -> list[str]:
        """Write each base parameter as a sum of standard ones, one line each."""
        lines = []
        for k, row in zip(self.chosen, self.mapping, strict=True):
            terms = [
                f"{self.names[j]}" if v == 1 else f"{v:+.{digits}g} {self.names[j]}"
                for j, v in enumerate(row)
                if v != 0 and j != k
            ]
            lines.append(" ".join([self.names[k], *(t if t[0] in "+-" else f"+ {t}" for t in terms)]))
        return lines


def standard_parameters(plant: Plant) -> tuple[tuple[str, ...], Float[np.ndarray, " standard"]]:
    """Return names and values of all parameters of a plant that carry force, from the base to the tip."""
    places = standard_places(plant)
    return tuple(_name(place) for place in places), _values(plant, places)


def _name(place: tuple[str, int | None]) -> str:
    """Return the name of a parameter in results; entries count from 1."""
    name, k = place
    return name if k is None else f"{name}[{k + 1}]"


def _values(plant: Plant, places: Iterable[tuple[str, int | None]]) -> Float[np.ndarray, " standard"]:
    """Return the values of some parameters of a plant."""
    values = [(np.asarray(getattr(plant, name)), k) for name, k in places]
    return np.asarray([v if k is None else v[k] for v, k in values], dtype=np.float64)


def standard_places(plant: Plant) -> tuple[tuple[str, int | None], ...]:
    """List field and entry of each such parameter; those to be regrouped come last in their joint."""
    infos = {
        name: info
        for name, info in parameters_of(type(plant)).items()
        if carries_force(info) and getattr(plant, name) is not None
    }
    last = getattr(plant, "regrouped", ())
    order = [*(n for n in infos if n not in last), *(n for n in last if n in infos)]
    single = [(name, None) for name in order if infos[name].more is None]
    # A list may have more entries than the plant has joints.
    counts = {name: np.shape(getattr(plant, name))[0] for name in infos if infos[name].more is not None}
    longest = max(counts.values(), default=0)
    listed = ((name, k) for k in range(longest) for name in order if name in counts and k < counts[name])
    return (*single, *listed)


def inertial_regressor(
    plant: Plant, q: Float[Array, "time n"], qd: Float[Array, "time n"], qdd: Float[Array, "time n"]
) -> Float[Array, "time n standard"]:
    """Differentiate M qdd + h in the `standard_parameters`, at every state.

    Args:
        plant: The plant; `inertial` must be linear in these parameters.
        q, qd, qdd: States, (time, n) [rad or m, and per s and s^2].
    """
    return _regressor(plant, standard_places(plant), jnp.asarray(q), jnp.asarray(qd), jnp.asarray(qdd))


@eqx.filter_jit
def _regressor(plant: Plant, places: tuple, q: Array, qd: Array, qdd: Array) -> Array:
    """Differentiate the inertial force by field, and stack the columns of the given entries."""
    names = list(dict.fromkeys(name for name, _ in places))

    def force(values: list[Array]) -> Array:
        moved = eqx.tree_at(lambda p: [getattr(p, n) for n in names], plant, values)
        return jax.vmap(moved.inertial)(q, qd, qdd)

    columns = jax.jacfwd(force)([jnp.asarray(getattr(plant, n)) for n in names])
    by_name = dict(zip(names, columns, strict=True))
    return jnp.stack([by_name[n] if k is None else by_name[n][..., k] for n, k in places], axis=-1)


def base_parameters(
    plant: Plant, seed: int = 0, keep: Sequence[str] = (), known: Sequence[str] = ()
) -> BaseParameters:
    """Find the base parameters of a plant by the rank of its regressor on random states.

    Columns are taken in order from the base to the tip, and omitted if they are linear combinations of those
    taken before. For an arm the result is that of the rules of Gautier and Khalil.

    Args:
        plant: The plant; the values of its parameters do not matter, its geometry does.
        seed: Seed of the random states.
        keep: Names to take before all others, so that they represent a base parameter if they can.
        known: Names of parameters with known values ("mass[1]", or "mass" for all links): the base parameters
            are then combinations of the others alone.

    Returns:
        The base parameters.

    Raises:
        ValueError: If a name is not a parameter of the plant or is in both `keep` and `known`, or if rank and
            choice disagree: then the geometry has a length or an angle that is nearly, but not exactly, zero.

    Source:
        Gautier (1991), J. Robotic Systems 8(4), for the choice by QR; Khalil & Dombre (2002), chapter 9.
    """
    places = standard_places(plant)
    names = [_name(place) for place in places]
    wrong = [n for n in (*keep, *known) if n not in names and (n in keep or n not in dict(places))]
    if wrong:
        raise ValueError(f"{wrong[0]} is not a parameter of the plant: {', '.join(names)}.")
    both = [n for n in keep if {n, n.partition("[")[0]} & set(known)]
    if both:
        raise ValueError(f"{both[0]} is in keep and in known; remove it from one of them.")

    states = random_states(plant, _STATES * len(names), np.random.default_rng(seed))
    columns = np.asarray(inertial_regressor(plant, *states)).reshape(-1, len(names))
    unknown = [k for k, (name, _) in enumerate(places) if not {name, names[k]} & set(known)]
    order = [*keep, *(names[k] for k in unknown if names[k] not in keep)]
    return grouped(columns[:, unknown], tuple(places[k] for k in unknown), order)


def grouped(
    columns: Float[np.ndarray, "rows standard"],
    places: tuple[tuple[str, int | None], ...],
    order: Sequence[str] = (),
) -> BaseParameters:
    """Find the combinations of parameters that a linear model identifies.

    Args:
        columns: Derivatives of the model in the parameters, on random states.
        places: Field of the plant, and entry, of each parameter.
        order: Names of the parameters, preferred representatives first; default the given order.

    Raises:
        ValueError: If rank and choice disagree.
    """
    names = [_name(place) for place in places]
    norm = np.linalg.norm(columns, axis=0)
    norm[norm <= _DEPENDENT * norm.max()] = np.inf
    scaled = columns / norm

    # The rank of all columns must agree with the number that is chosen one by one.
    triangle = np.abs(np.diagonal(scipy.linalg.qr(scaled, mode="r", pivoting=True)[0]))
    rank = int(np.sum(triangle > _DEPENDENT))
    chosen = tuple(sorted(independent(scaled, [names.index(n) for n in order or names])))
    if len(chosen) != rank:
        raise ValueError(
            f"{len(chosen)} columns are independent one by one, {rank} together: a length or an angle of the "
            "geometry is nearly zero; write it as zero, or angles in more digits."
        )

    mapping = np.linalg.lstsq(scaled[:, chosen], scaled, rcond=None)[0] * norm[list(chosen), None] ** -1
    mapping = mapping * np.where(np.isinf(norm), 0.0, norm)
    return BaseParameters(places, chosen, tidied(mapping), np.linalg.svd(scaled, compute_uv=False))


def tidied(mapping: Float[np.ndarray, "base standard"]) -> Float[np.ndarray, "base standard"]:
    """Round entries of a mapping that are nearly zero or a whole number, such as that of 2 d m Z over d."""
    mapping = np.where(np.abs(mapping) < 1e-10 * np.abs(mapping).max(), 0.0, mapping)
    whole = np.round(mapping)
    return np.where(np.abs(mapping - whole) < 1e-10, whole, mapping)


def random_states(plant: Plant, count: int, rng: np.random.Generator) -> Float[np.ndarray, "3 count n"]:
    """Draw possible positions, half a turn or half a metre to each side, and their derivatives."""
    states = rng.uniform(-1.0, 1.0, (3, count, plant.joints))
    turns = np.asarray([plant.motion(k) == "rotary" for k in range(plant.joints)])
    states[0] *= np.where(turns, np.pi, 0.5)
    while (impossible := plant.impossible(states[0])) is not None:
        states[0, impossible[0]] = plant.any_motion(rng)[0]
    return states


def independent(columns: Float[np.ndarray, "rows standard"], order: Sequence[int]) -> list[int]:
    """Choose columns, of norm one or zero, that are independent of those before, by Gram-Schmidt, twice."""
    basis, chosen = np.zeros((len(columns), 0)), []
    for k in order:
        remainder = columns[:, k] - basis @ (basis.T @ columns[:, k])
        remainder = remainder - basis @ (basis.T @ remainder)
        size = np.linalg.norm(remainder)
        if size > _DEPENDENT:
            basis = np.column_stack([basis, remainder / size])
            chosen = [*chosen, k]
    return chosen
