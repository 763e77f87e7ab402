"""The basis of a minimal model: the fewest independent numbers that determine its coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.minimal.models import MinimalSamples, Structure, Term
from jaxid.model.plant import Plant
from jaxid.model.units import Units
from jaxid.model.unknowns import Parameters

# A singular value below this, relative to the largest, is a rounding error.
_RANK = 1e-9


@dataclass(frozen=True)
class Basis:
    """The affine map c = constant + spread chi from the numbers chi to the unknown coefficients c.

    Args:
        names: Names of the numbers chi.
        units: Labels of their units.
        spread: Matrix of the map, (terms, chi).
        constant: Coefficients for chi of zero, (terms,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    spread: Float[np.ndarray, "terms chi"]
    constant: Float[np.ndarray, " terms"]

    @property
    def gather(self) -> Float[np.ndarray, "chi terms"]:
        """Matrix of the inverse map chi = gather (c - constant), (chi, terms)."""
        return np.linalg.pinv(self.spread)


def basis_of(structure: Structure, samples: MinimalSamples, parameters: Parameters, units: Units) -> Basis:
    """Find the basis of a model's unknown coefficients.

    If the coefficients are linear in the unknowns, the basis is the unknowns themselves, and unknowns with
    dependent columns are regrouped with the first. Else it is the coefficients. If rows share some of them,
    it is an independent set that spans the coefficients at a plant with offsets of zero.

    Args:
        structure: The structure of the model.
        samples: Its coefficients at several values of the unknowns.
        parameters: The unknowns.
        units: Units of the plant, for labels.

    Source:
        Mayeda, Yoshida and Osuka (1990), Gautier and Khalil (1990) for regrouping by columns.
    """
    guess = samples.guess
    values, slopes = samples.of(structure.unknown, structure.leading)
    entries = [_entry(t, structure) for _, t in structure.unknown]
    labels = [_label(t, structure, units) for _, t in structure.unknown]

    # Linear in the unknowns: the slopes are the same at all draws.
    if all(np.allclose(s, slopes[0], rtol=_RANK, atol=_RANK * np.abs(slopes[0]).max()) for s in slopes):
        kept, names = _regrouped(slopes[0], parameters.names)
        unit = tuple(parameters.free[k].unit for k in kept)
        return Basis(names, unit, slopes[0][:, kept], values[-1] - slopes[-1] @ guess)

    # Independent coefficients: they are the basis themselves.
    whole = np.concatenate([_unit_columns(s) for s in slopes[:-1]], axis=1)
    rank = np.linalg.matrix_rank(whole, tol=_RANK * np.linalg.norm(whole, 2))
    if rank == len(entries):
        return Basis(tuple(entries), tuple(labels), np.eye(rank), np.zeros(rank))

    # Dependent coefficients, at the plant with offsets of zero: unknowns scaled by their largest coefficient.
    reference, columns = values[-2], slopes[-2]
    largest = np.abs(columns).argmax(axis=0)
    size = np.abs(columns[largest, np.arange(len(guess))])
    kept, names = _regrouped(columns / np.where(size > 0, size, 1.0), parameters.names)
    if len(kept) == rank:
        plain = np.isclose(size[kept], 1.0)
        spread = columns[:, kept] / size[kept]
        constant = reference - spread @ (np.linalg.pinv(spread) @ reference)
        return Basis(
            tuple(n if p else entries[largest[k]] for n, p, k in zip(names, plain, kept, strict=True)),
            tuple(
                parameters.free[k].unit if p else labels[largest[k]] for p, k in zip(plain, kept, strict=True)
            ),
            spread,
            constant,
        )

    # Else some of the coefficients themselves.
    pivots = _regrouped(whole.T, entries)[0]
    spread = whole @ np.linalg.pinv(whole[pivots])
    constant = reference - spread @ reference[pivots]
    return Basis(tuple(entries[k] for k in pivots), tuple(labels[k] for k in pivots), spread, constant)


def _unit_columns(a: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(a, axis=0)
    return a / np.where(norm > 0, norm, 1.0)


def _regrouped(columns: np.ndarray, names: list[str]) -> tuple[list[int], tuple[str, ...]]:
    """Return the columns that are independent of those before them, and names for the regrouped ones.

    Args:
        columns: Columns of the unknowns, (terms, p).
        names: Names of the columns.

    Returns:
        Indices of the independent columns, and for each the sum of the names that depend on it.
    """
    kept: list[int] = []
    groups: list[list[tuple[float, str]]] = []
    for k, column in enumerate(columns.T):
        norm = np.linalg.norm(column)
        if norm == 0:
            continue
        share = np.zeros(0)
        independent = column
        if kept:
            share = np.linalg.lstsq(columns[:, kept], column, rcond=None)[0]
            independent = column - columns[:, kept] @ share
        if np.linalg.norm(independent) > _RANK * norm:
            kept.append(k)
            groups.append([(1.0, names[k])])
            continue
        for group, s in zip(groups, share, strict=True):
            if abs(s) > _RANK:
                group.append((float(s), names[k]))
    return kept, tuple(_sum(g) for g in groups)


def _sum(group: list[tuple[float, str]]) -> str:
    text = group[0][1]
    for factor, name in group[1:]:
        times = "" if np.isclose(abs(factor), 1.0) else f"{abs(factor):.3g} "
        text += f" {'-' if factor < 0 else '+'} {times}{name}"
    return text


def _entry(term: Term, structure: Structure) -> str:
    """Return the name of a coefficient, that of the paper for one row and one signal of a kind."""
    every = [t for _, t in structure.unknown]
    indices = {t.index for t in every if t.signal == term.signal and t.row == term.row}
    letter = {"position": "a", "acceleration": "d", "force": "b", "sign": "Fc", "one": "c"}[term.signal]
    order = "" if term.signal in ("sign", "one") else str(term.order)
    place = f"[{term.index + 1}]" if len(indices) > 1 else ""
    row = f", row {term.row + 1}" if structure.rows > 1 else ""
    return f"{letter}{order}{place}{row}"


def _label(term: Term, structure: Structure, units: Units) -> str:
    """Return the label of a coefficient's unit."""
    leading = structure.leading[term.row]
    power = term.order - (0 if leading is None else leading[1].order)
    if term.signal == "force":
        return _per(units, "1", power)
    if term.signal in ("sign", "one"):
        return units.label("force")
    power += 2 if term.signal == "acceleration" else 0
    return _per(units, "force/position", power)


def _per(units: Units, base: str, power: int) -> str:
    """Return the label of a unit times seconds to a power."""
    if power == 0:
        return units.label(base)
    over, _, under = base.partition("/")
    time = "time" if power == 1 else f"time{power}"
    over = time if over == "1" else f"{over}*{time}"
    return units.label(f"{over}/{under}" if under else over)


def chi_of(plant: Plant, structure: Structure, gather: Array, constant: Array) -> Float[Array, " chi"]:
    """Return the numbers chi of a plant, differentiable in its parameters.

    Args:
        plant: The plant.
        structure: The structure of the model.
        gather: Matrix from the coefficients to chi, (chi, terms).
        constant: Coefficients for chi of zero, (terms,).
    """
    return gather @ (structure.coefficients(plant) - constant)
