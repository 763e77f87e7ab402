"""The kinds of plants, effects and control laws that a case may name, with their classes or without JAX.

Importing the classes imports JAX, which takes most of a second, and a case with a wrong key should not wait
for it. All that a case is checked against is therefore kept in `kinds.json` too: names, signs and dimensions
of parameters, and the places of a plant. The classes stay the source: `python -m jaxid.case.kinds` writes the
file from them, and a test compares the two.
"""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from jaxid.model.parameter import ParameterInfo, need_one

if TYPE_CHECKING:
    from jaxid.controllers import Controller
    from jaxid.model.effect import Effect
    from jaxid.model.plant import Plant
    from jaxid.plants.geometry import Geometry

FILE = Path(__file__).with_name("kinds.json")
# Attributes of the classes that a case is checked against.
_OF_PLANTS = ("linked", "usual_motion", "passives", "tools", "actuated")
_OF_EFFECTS = (
    "on_request",
    "without_force",
    "without_force_on_request",
    "break_away_level",
    "in_links",
    "adds_spring",
    "with_springs",
    "of_spring",
    "in_drive",
    "needs_drive",
    "controller_field",
    "any_direction",
    "alternatives",
    "title",
    "formula",
    "met",
    "part",
    "shown_at",
)
_OF_LAWS = ("of_machine", "sees_error")
# Numbers of places of a plant, which grow with its joints.
_COUNTS = ("bodies", "springs", "links")
# Depth at which the file holds a whole entry in one line: table, kind, part and field.
_DEPTH = 4
# Number of joints up to which a plant's places are compared with a straight line.
_MANY = 8


class NeedsClassesError(Exception):
    """A case cannot be checked further without the classes."""


@dataclass(frozen=True)
class Kinds:
    """The plants, effects and control laws that a case may name.

    Args:
        plants, effects, laws: Class, or its stand-in, by kind.
        loaded: Whether these are the classes themselves.
    """

    plants: Mapping[str, type[Plant]]
    effects: Mapping[str, type[Effect]]
    laws: Mapping[str, type[Controller]]
    loaded: bool

    def need_classes(self) -> None:
        """Stop a check that goes on with the classes only.

        Raises:
            NeedsClassesError: If these are stand-ins.
        """
        if not self.loaded:
            raise NeedsClassesError

    def geometry(self, rows: list[list]) -> Geometry:
        """Return the geometry of an arm from a row for each joint; each begins with the joint's kind."""
        if not self.loaded:
            return _Joints(tuple(row[0] for row in rows))  # pyright: ignore[reportReturnType]
        from jaxid.plants.denavit_hartenberg import DenavitHartenberg

        return DenavitHartenberg.of_rows(rows)


@dataclass(frozen=True)
class _Joints:
    """The kinds of the joints of an arm, which its shafts are checked against."""

    joints: tuple[str, ...]


def loaded_kinds() -> Kinds:
    """Return the classes, registered ones included."""
    from jaxid.controllers import CONTROLLERS
    from jaxid.effects import EFFECTS
    from jaxid.plants import PLANTS

    return Kinds(PLANTS, EFFECTS, CONTROLLERS, loaded=True)


@functools.cache
def declared_kinds() -> Kinds:
    """Return stand-ins for the classes of jaxid, which have all that a case is checked against."""
    content = json.loads(FILE.read_text(encoding="utf-8"))
    plants, effects, laws = (
        {kind: _stand_in(kind, declaration) for kind, declaration in content[table].items()}
        for table in ("plants", "effects", "laws")
    )
    return Kinds(plants, effects, laws, loaded=False)


def known_kinds() -> Kinds:
    """Return the classes if they are loaded already, else their stand-ins."""
    return loaded_kinds() if "jaxid.effects" in sys.modules else declared_kinds()


def names_a_file(kind: object) -> bool:
    """Check that a `kind` names a class in a file rather than one of the package."""
    return ":" in str(kind) or str(kind).endswith(".py")


def is_user_class(cls: type) -> bool:
    """Check that a class comes from outside of jaxid."""
    return not cls.__module__.startswith("jaxid.")


class _StandIn:
    """The part of a class that a case is checked against; an object of it refuses what the class refuses."""

    alternatives: ClassVar[tuple[str, ...]] = ()
    couplings: ClassVar[Mapping[str, type]] = {}

    def __init__(self, **given: Any):
        need_one(getattr(type(self), "kind"), self.alternatives, given)  # noqa: B009


def _stand_in(kind: str, declaration: Mapping[str, Any]) -> Any:
    names: dict[str, Any] = {"kind": kind, "__doc__": declaration["doc"], "__module__": __name__}
    names |= {name: _tuple_of(value) for name, value in declaration["attributes"].items()}
    names |= {
        name: staticmethod(functools.partial(_count, *line))
        for name, line in declaration.get("counts", {}).items()
    }
    if "joints" in declaration:
        joints = declaration["joints"]
        names["joints"] = property() if joints is None else joints
    variants = declaration.get("couplings", {})
    names["couplings"] = {name: _stand_in(kind, variant) for name, variant in variants.items()}
    columns = [(name, *_field(entry)) for name, entry in declaration["fields"].items()]
    return make_dataclass(
        kind, columns, bases=(_StandIn,), namespace=names, init=False, repr=False, eq=False, kw_only=True
    )


def _field(entry: Mapping[str, Any]) -> tuple[Any, Any]:
    metadata = {"parameter": ParameterInfo(**entry["parameter"])} if "parameter" in entry else {}
    declared = field(metadata=metadata) if entry.get("required") else field(default=None, metadata=metadata)
    return (bool if entry.get("flag") else object), declared


def _tuple_of(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _count(at_none: int, per_joint: int, joints: int) -> int:
    return at_none + per_joint * joints


def declarations() -> dict[str, Any]:
    """Return the content of `kinds.json` from the classes."""
    kinds = loaded_kinds()
    return {
        "plants": {kind: _plant(cls) for kind, cls in kinds.plants.items()},
        "effects": {kind: _effect(cls) for kind, cls in kinds.effects.items()},
        "laws": {kind: _declaration(cls, _OF_LAWS) for kind, cls in kinds.laws.items()},
    }


def _plant(cls: Any, *, variant: bool = False) -> dict[str, Any]:
    joints = cls.joints if isinstance(cls.joints, int) else None
    counts = {name: _line(getattr(cls, name), joints) for name in _COUNTS}
    out = _declaration(cls, _OF_PLANTS) | {"joints": joints, "counts": counts}
    if cls.couplings and not variant:
        out["couplings"] = {name: _plant(c, variant=True) for name, c in cls.couplings.items()}
    return out


def _line(count: Callable[[int], int], joints: int | None) -> tuple[int, int]:
    """Return a number of places without joints, and for each joint.

    Raises:
        ValueError: If it is no straight line.
    """
    if joints is not None:
        return count(joints), 0
    first, each = count(1), count(2) - count(1)
    if any(count(n) != first + (n - 1) * each for n in range(1, _MANY)):
        raise ValueError(f"{count.__qualname__} does not grow in proportion to the joints")
    return first - each, each


def _effect(cls: type[Effect]) -> dict[str, Any]:
    checks = [c.__name__ for c in cls.__mro__ if "__check_init__" in vars(c)]
    if checks != ["Effect"]:
        raise TypeError(f"{checks[0]}.__check_init__ is unknown to `jaxid.case.kinds`; state `alternatives`")
    return _declaration(cls, _OF_EFFECTS)


def _declaration(cls: Any, attributes: tuple[str, ...]) -> dict[str, Any]:
    return {
        "doc": (cls.__doc__ or "").strip().split("\n", 1)[0],
        "attributes": {name: getattr(cls, name) for name in attributes},
        "fields": {f.name: _entry(f) for f in fields(cls)},
    }


def _entry(f: Any) -> dict[str, Any]:
    """Return a field as `_field` reads it; entries at their defaults are left out."""
    out: dict[str, Any] = {}
    if f.default is MISSING and f.default_factory is MISSING:
        out["required"] = True
    if f.type in (bool, "bool"):
        out["flag"] = True
    if "parameter" in f.metadata:
        info = f.metadata["parameter"]
        default = {i.name: i.default for i in fields(ParameterInfo)}
        out["parameter"] = {k: v for k, v in vars(info).items() if v != default[k]}
    return out


def text_of(content: Mapping[str, Any]) -> str:
    """Return the text of `kinds.json`, with a line for each field, so that changes are seen line by line."""
    return _text(content, 0) + "\n"


def _text(value: Any, depth: int) -> str:
    if not isinstance(value, Mapping) or depth == _DEPTH or not value:
        return json.dumps(value, ensure_ascii=False)
    inner = " " * (depth + 1)
    entries = [f"{inner}{json.dumps(key)}: {_text(entry, depth + 1)}" for key, entry in value.items()]
    return "{\n" + ",\n".join(entries) + "\n" + " " * depth + "}"


if __name__ == "__main__":
    FILE.write_text(text_of(declarations()), encoding="utf-8")
