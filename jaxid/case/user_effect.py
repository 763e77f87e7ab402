"""User-defined effects: a class in a Python file beside the case.

It belongs to the cases that name it: the registry of all cases is left as it was.
"""

from __future__ import annotations

import importlib.util
import sys
import zlib
from pathlib import Path
from types import ModuleType

from jaxid.effects import EFFECTS
from jaxid.errors import suggest
from jaxid.model.effect import Effect
from jaxid.model.parameter import SIGNS, parameters_of
from jaxid.model.units import Units
from jaxid.schema import Spot

# Module and time of change by file: a case that is loaded twice gets the same class twice, so
# that nothing compiles anew, unless the file was edited in between.
_LOADED: dict[Path, tuple[int, ModuleType]] = {}


def user_effect(kind: str, folder: Path, spot: Spot) -> type[Effect]:
    """Import an effect.

    Args:
        kind: "my_effects.py:MyEffect".
        folder: Folder from which relative file names start.
        spot: Position of the kind in the case.

    Returns:
        The class; its `kind` is the text, if the class gives none.

    Raises:
        InputError: If there is no such file or class, it does not import, it is no effect, or its
            kind is that of another.
    """
    file, _, name = kind.rpartition(":")
    path = (folder / file).resolve()
    if not file or path.suffix != ".py" or not name:
        raise spot.refuse(kind, "names no class in a file", "write it as my_effects.py:MyEffect")
    if not path.is_file():
        beside = sorted(p.name for p in folder.glob("*.py"))[:8]
        hint = f"paths start at the case's folder; there is: {', '.join(beside) or 'none'}"
        raise spot.refuse(kind, "names a file that does not exist", hint)
    module = _import(path, kind, spot)
    cls = getattr(module, name, None)
    if not (isinstance(cls, type) and issubclass(cls, Effect) and cls is not Effect):
        known = [n for n, c in vars(module).items() if _is_effect_of(c, module)]
        what = "is not a subclass of jaxid.model.effect.Effect" if cls is not None else "is not there"
        raise spot.refuse(kind, f": {name} {what}", suggest(name, known))
    if not hasattr(cls, "kind"):
        cls.kind = kind
    _check_kind(cls, module, kind, spot)
    _check_class(cls, kind, spot)
    return cls


def _is_effect_of(thing: object, module: ModuleType) -> bool:
    return isinstance(thing, type) and issubclass(thing, Effect) and thing.__module__ == module.__name__


def _import(path: Path, kind: str, spot: Spot) -> ModuleType:
    changed = path.stat().st_mtime_ns
    if path in _LOADED and _LOADED[path][0] == changed:
        return _LOADED[path][1]
    name = f"jaxid_user_{path.stem}_{zlib.crc32(str(path).encode()):08x}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None, "a file that ends in .py always has a loader"
    assert spec.loader is not None, "a file that ends in .py always has a loader"
    module = importlib.util.module_from_spec(spec)
    before = dict(EFFECTS)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        sys.modules.pop(name, None)
        raise spot.refuse(
            kind, f"cannot be imported ({type(error).__name__}: {error})", f"correct {path.name}"
        ) from error
    finally:
        # Effects that it registers belong to its case, not to every case.
        EFFECTS.clear()
        EFFECTS.update(before)
    _LOADED[path] = (changed, module)
    return module


def _check_class(cls: type[Effect], kind: str, spot: Spot) -> None:
    """Faults that would only come up in the middle of a fit."""
    if cls.act is Effect.act:
        raise spot.refuse(kind, "has no method act", "define act(self, x, state) -> Action")
    for name, info in parameters_of(cls).items():
        if info.sign not in SIGNS:
            what = f": {name} has sign {info.sign!r}"
            raise spot.refuse(kind, what, f"use one of {', '.join(SIGNS)}")
        try:
            Units().label(info.dimension)
        except (ValueError, KeyError) as error:
            hint = "use force, position, time, inertia with *, / and powers: force*time/position"
            what = f": {name} has dimension {info.dimension!r}"
            raise spot.refuse(kind, what, hint) from error


def _check_kind(cls: type[Effect], module: ModuleType, kind: str, spot: Spot) -> None:
    """Results go by kind: it must be one class's."""
    same = [c for c in vars(module).values() if _is_effect_of(c, module) and c is not cls]
    if any(getattr(c, "kind", None) == cls.kind for c in same):
        what = f": another class of that file has its kind, {cls.kind}"
        raise spot.refuse(kind, what, "each class has a kind of its own")
    if EFFECTS.get(cls.kind, cls) is not cls:
        hint = "give the class another kind"
        raise spot.refuse(kind, f"takes the name of an effect there is: {cls.kind}", hint)
