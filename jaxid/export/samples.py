"""Models drawn from the posterior of a result, each of them a machine that can exist."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.arms.bodies import are_bodies
from jaxid.case.tables import unknown_info
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.export.exported import ExportedFile
from jaxid.model.parameter import parameters_of
from jaxid.names import TEN
from jaxid.plants.link_tree import LinkTree

# Most draws for each model that is kept: of those that are written, and of those refused by their signs.
# A friction whose estimate is zero has the wrong sign in half of its draws.
_MOST, _MOST_SIGNS = 200, 20_000
_ENTRY = re.compile(r"(?P<name>.+)\[(?P<entry>\d+)\]$")


@dataclass(frozen=True)
class Drawn:
    """Models drawn from a posterior.

    Args:
        files: The files, one a model.
        refused: Draws that were no bodies, or had a value of the wrong sign, and were drawn again.
        fixed: Names of the unknowns that keep their estimate, since the log does not determine them.
    """

    files: tuple[ExportedFile, ...]
    refused: int
    fixed: tuple[str, ...]

    def __str__(self) -> str:
        text = f"{self.refused} draws were no machine that can exist, and were drawn again"
        kept = f"; {', '.join(self.fixed)} stay, since the log does not determine them" if self.fixed else ""
        return f"{text}{kept}"


def draw(
    content: Mapping[str, Any],
    count: int,
    seed: int,
    export: Callable[[Mapping[str, Any]], ExportedFile],
    where: str = "result",
) -> Drawn:
    """Draw models from the normal posterior of a result: its estimate and its covariance.

    Args:
        content: Content of result.json or discovery.json.
        count: Number of models.
        seed: Seed of the draws.
        export: Function that puts a model (`model` of a result) into a file.
        where: The result, for messages.

    Raises:
        InputError: If the result has no covariance, or hardly any draw is a machine that can exist.
    """
    names, matrix = _covariance(content, where)
    model = content["model"]
    places = [_place_of(model, name) for name in names]
    known = np.array([k for k, place in enumerate(places) if place is not None], dtype=int)
    spread = np.array(matrix, dtype=float)
    fixed = tuple(names[k] for k in known if not np.isfinite(spread[k, k]))
    known = np.array([k for k in known if np.isfinite(spread[k, k])], dtype=int)
    chosen = [place for k in known if (place := places[k]) is not None]
    values, vectors = np.linalg.eigh(spread[np.ix_(known, known)])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    mean = np.array([place.get(model) for place in chosen])
    rng, files, refused = np.random.default_rng(seed), list[ExportedFile](), 0
    # Sums of parameters are no bodies themselves: the export finds some that have these sums.
    written, whole = 0, _are_bodies(model)
    for theta in _draws(mean, root, rng):
        if len(files) == count:
            break
        if written == _MOST * count or refused > _MOST_SIGNS * count:
            what = f"of {refused + len(files)} draws {len(files)} are machines that can exist"
            hint = "identify with a better log, or with fewer unknowns"
            raise InputError(f"its posterior is too wide: {what}", where=where, hint=hint)
        if not all(_has_sign(place.sign, x) for place, x in zip(chosen, theta, strict=True)):
            refused += 1
            continue
        one = copy.deepcopy(model)
        for place, value in zip(chosen, theta, strict=True):
            place.put(one, float(value))
        if whole and not _are_bodies(one):
            refused += 1
            continue
        exported, written = export(one), written + 1
        if exported.real:
            files.append(exported)
        else:
            refused += 1
    return Drawn(tuple(files), refused, fixed)


def _are_bodies(model: Mapping[str, Any]) -> bool:
    return are_bodies(np.stack([np.array(model["parameters"][name]) for name in TEN], axis=-1))


def _covariance(content: Mapping[str, Any], where: str) -> tuple[list[str], list[list[float]]]:
    covariance = content.get("covariance") or {}
    names, matrix = covariance.get("names"), covariance.get("matrix")
    if not names or matrix is None:
        raise InputError("has no covariance to draw from", where=where, hint="run identify or discover again")
    return names, matrix


def _draws(mean: np.ndarray, root: np.ndarray, rng: np.random.Generator) -> Iterator[Float[np.ndarray, " p"]]:
    while True:
        yield mean + root @ rng.normal(size=root.shape[1])


def _has_sign(sign: str, value: float) -> bool:
    return sign == "free" or value > 0 or (sign == "nonnegative" and value == 0)


@dataclass(frozen=True)
class _Place:
    """The place of an unknown in `model` of a result.

    Args:
        path: Keys and indices to its container.
        key: Its key or index in there.
        sign: Sign that it must have.
    """

    path: tuple[str | int, ...]
    key: str | int
    sign: str

    def _container(self, model: Any) -> Any:
        for part in self.path:
            model = model[part]
        return model

    def get(self, model: Any) -> float:
        return float(self._container(model)[self.key])

    def put(self, model: Any, value: float) -> None:
        self._container(model)[self.key] = value


def _place_of(model: Mapping[str, Any], name: str) -> _Place | None:
    """Return the place of an unknown; None for one that is no part of the machine, such as a reference's."""
    found = _ENTRY.match(name)
    whole, entry = (found["name"], int(found["entry"]) - 1) if found else (name, 0)
    infos = parameters_of(LinkTree)
    if whole in infos:
        # A sum of parameters may have either sign, whatever its name.
        sign = infos[whole].sign if whole in ("rotor_inertia", "payload") else "free"
        return _Place(("parameters", whole), entry, sign)
    if whole.startswith("controller."):
        law = (model.get("drives") or {}).get("controller") or {}
        field = whole.removeprefix("controller.")
        if field not in law:
            return None
        sign = unknown_info(law["kind"], field).sign
        path = ("drives", "controller")
        return _Place((*path, field), entry, sign) if found else _Place(path, field, sign)
    for number, effect in enumerate(model["effects"]):
        kind, _, parameter = name.rpartition(".")
        if effect.get("name") == kind and parameter in effect["parameters"]:
            cls = EFFECTS.get(effect["kind"])
            sign = "free" if cls is None else parameters_of(cls)[parameter].sign
            return _Place(("effects", number, "parameters"), parameter, sign)
    return None
