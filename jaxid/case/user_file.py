"""A class in a user's Python file, imported for the cases that name it.

It belongs to those cases: the registries of the package stay as they were.
"""

from __future__ import annotations

import importlib.util
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from jaxid.case.user_faults import USERS, one_line
from jaxid.effects import EFFECTS
from jaxid.errors import suggest
from jaxid.model.parameter import SIGNS, parameters_of
from jaxid.model.units import Units
from jaxid.plants import PLANTS
from jaxid.schema import Spot

T = TypeVar("T")

# Module and time of change by file: a case that is loaded twice gets the same class twice, so
# that nothing compiles anew, unless the file was edited in between.
_LOADED: dict[Path, tuple[int, ModuleType]] = {}


def class_of_file(
    kind: str,
    folder: Path,
    base: type[T],
    example: str,
    spot: Spot,
    check: Callable[[type[T]], None] = lambda cls: None,
) -> tuple[type[T], ModuleType]:
    """Import a user's class.

    Args:
        kind: "my_file.py:MyClass".
        folder: Folder from which relative paths start.
        base: Class that it must be derived from.
        example: How `kind` should look, for hints.
        spot: Place of the kind in the case.
        check: Function that checks the class before its kind is set, and raises if it is faulty.

    Returns:
        The class, whose `kind` is the text if it states none, and its module.

    Raises:
        InputError: If there is no such file or class, it does not import, or it is not derived from `base`.
    """
    file, _, name = kind.rpartition(":")
    path = (folder / file).resolve()
    if not file or path.suffix != ".py" or not name:
        raise spot.refuse(kind, "names no class in a file", f"write it as {example}")
    if not path.is_file():
        beside = sorted(p.name for p in folder.glob("*.py"))[:8]
        hint = f"paths start at the case's folder; there is: {', '.join(beside) or 'none'}"
        raise spot.refuse(kind, "names a file that does not exist", hint)
    module = _import(path, kind, spot)
    cls = getattr(module, name, None)
    if not (isinstance(cls, type) and issubclass(cls, base) and cls is not base):
        known = [n for n, c in vars(module).items() if is_defined_in(c, base, module)]
        missing = "is not there" if cls is None else f"is not a subclass of {base.__module__}.{base.__name__}"
        raise spot.refuse(kind, f": {name} {missing}", suggest(name, known))
    check(cls)
    if not hasattr(cls, "kind"):
        setattr(cls, "kind", kind)  # noqa: B010  # the base of a user's class declares it, `type[T]` does not
    return cls, module


def is_defined_in(thing: object, base: type, module: ModuleType) -> bool:
    """Check that an object is a class derived from `base` that a module itself defines."""
    return isinstance(thing, type) and issubclass(thing, base) and thing.__module__ == module.__name__


def check_kind(cls: type, base: type, module: ModuleType, registry: dict, kind: str, spot: Spot) -> None:
    """Refuse a kind that another class of the file or of the package has: results are named by kind.

    Raises:
        InputError: If there is such a class.
    """
    word = base.__name__.lower()
    same = [c for c in vars(module).values() if is_defined_in(c, base, module) and c is not cls]
    if any(getattr(c, "kind", None) == cls.kind for c in same):
        fault = f": another class of that file has its kind, {cls.kind}"
        raise spot.refuse(kind, fault, "each class has a kind of its own")
    if registry.get(cls.kind, cls) is not cls:
        fault = f"takes the name of {'an' if word[0] in 'aeiou' else 'a'} {word} there is: {cls.kind}"
        raise spot.refuse(kind, fault, "give the class another kind")


def check_parameters(cls: type, kind: str, spot: Spot) -> None:
    """Check signs and dimensions of a user's class.

    Raises:
        InputError: If one is unknown.
    """
    for name, info in parameters_of(cls).items():
        if info.sign not in SIGNS:
            fault = f": {name} has sign {info.sign!r}"
            raise spot.refuse(kind, fault, f"use one of {', '.join(SIGNS)}")
        try:
            Units().label(info.dimension)
        except (ValueError, KeyError) as error:
            hint = "use force, position, time, inertia with *, / and powers: force*time/position"
            raise spot.refuse(kind, f": {name} has dimension {info.dimension!r}", hint) from error


def _import(path: Path, kind: str, spot: Spot) -> ModuleType:
    changed = path.stat().st_mtime_ns
    if path in _LOADED and _LOADED[path][0] == changed:
        return _LOADED[path][1]

    name = f"{USERS}{path.stem}_{zlib.crc32(str(path).encode()):08x}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None, "the path ends in .py"
    assert spec.loader is not None, "the path is a file's"
    module = importlib.util.module_from_spec(spec)

    effects, plants = dict(EFFECTS), dict(PLANTS)
    sys.modules[name] = module
    # A command that refuses a file leaves nothing beside it.
    writes_none, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        sys.modules.pop(name, None)
        raise spot.refuse(
            kind, f"cannot be imported ({one_line(error, path)})", f"correct {path.name}"
        ) from error
    finally:
        sys.dont_write_bytecode = writes_none
        # The classes that the file registers belong to its case, not to every case.
        EFFECTS.clear()
        EFFECTS.update(effects)
        PLANTS.clear()
        PLANTS.update(plants)
    _LOADED[path] = (changed, module)
    return module
