"""The plant and the effects of a case, read against the classes that they name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jaxid.case.declared import EffectEntry, PlantEntry
from jaxid.case.links import LINKED, check_links, read_links, read_links_of_urdf, read_shafts
from jaxid.case.places import check_places, read_ports
from jaxid.case.schema import (
    Key,
    Reader,
    Spot,
    choice,
    count,
    flag,
    nearest,
    read_table,
    several,
    text,
    whole,
)
from jaxid.case.tables import PLANT
from jaxid.case.user_effect import user_effect
from jaxid.case.user_faults import check_action, is_user_class
from jaxid.case.user_file import names_a_file
from jaxid.case.user_plant import check_user_plant, user_plant
from jaxid.case.values import Value, read_value, read_values
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.model.effect import Effect
from jaxid.model.interface import PLACES
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.model.plant import Plant
from jaxid.model.units import Units
from jaxid.plants import PLANTS

# Of a plant whose lists say how many joints it has.
_MOST_JOINTS = 50


def read_kind(table: dict[str, Any], known: Any, spot: Spot) -> str:
    """The kind that a table names.

    Raises:
        InputError: If it is missing or unknown.
    """
    if "kind" not in table:
        raise spot.fault("'kind' is missing", f'add kind = "..."; there is: {", ".join(known)}')
    return choice(known)(table["kind"], spot.at("kind"))


def read_plant(table: dict[str, Any], file: str) -> PlantEntry:
    """Read [plant].

    Raises:
        InputError: If it states what the plant cannot have, or not what it must.
    """
    spot = Spot(file, "[plant]")
    kind = str(table.get("kind", ""))
    users = names_a_file(kind)
    if users:
        cls = user_plant(kind, Path(file).parent, spot.at("kind"))
    else:
        cls = PLANTS[read_kind(table, PLANTS, spot)]
    keys = {"kind": Key(lambda value, spot: value), **PLANT}
    if cls.linked:
        return _linked(table, cls, keys, spot)
    if cls.couplings:
        keys["coupling"] = Key(choice(tuple(cls.couplings)))
        if "coupling" in table:
            cls = cls.couplings[keys["coupling"].read(table["coupling"], spot.at("coupling"))]
    joints = _count_joints(table.get("parameters"), cls, spot)
    if "actuated" in cls.__dataclass_fields__:
        keys["actuated"] = Key(_actuated(joints))
    keys["parameters"] = Key(lambda v, s: _plant_parameters(v, cls, joints, file))
    given = read_table(table, keys, spot)
    if "parameters" not in given:
        needed = ", ".join(f"{name} = {_shape(info)}" for name, info in parameters_of(cls).items())
        raise spot.fault("'parameters' is missing", f"add [plant.parameters] with {needed}")
    motion = given.get("motion", cls.usual_motion or "linear")
    vertical = given.get("orientation") == "vertical"
    if vertical and motion == "rotary":
        hint = 'leave orientation out, or set motion = "linear"; an unbalanced load is an effect'
        raise spot.at("orientation").refuse("vertical", "does not go with a rotary plant", hint)
    units = Units(motion, **given.get("units", {}))
    entry = PlantEntry(
        cls,
        given["parameters"],
        units,
        vertical,
        given.get("gravity"),
        joints,
        given.get("actuated", cls.actuated),
    )
    if users:
        check_user_plant(entry, kind, spot.at("kind"))
    return entry


def _linked(table: dict[str, Any], cls: type[Plant], keys: dict[str, Key], spot: Spot) -> PlantEntry:
    """[plant] of an arm, which [[plant.links]] or a URDF file describe."""
    # Weight is a vector there, and acts whichever way the arm stands.
    own = {name: key for name, key in keys.items() if name not in ("orientation", "gravity")}
    given = read_table(table, {**own, **LINKED}, spot)
    names: tuple[str, ...] = ()
    if "urdf" in given:
        parameters, arm = read_links_of_urdf(given, cls, spot)
        geometry, names = arm.geometry, arm.names
    else:
        of_file = [name for name in ("tip", "unknown") if name in given]
        if of_file:
            raise spot.at(of_file[0]).fault("goes with urdf only", 'add urdf = "<its file>", or leave it out')
        check_links(table, spot)
        parameters, geometry = read_links(table["links"], cls, spot.file)
    options = {name: given[name] for name in ("gravity_vector",) if name in given}
    if "shafts" in table:
        options["shafts"] = read_shafts(table["shafts"], geometry, spot)
    units = Units(given.get("motion", cls.usual_motion), **given.get("units", {}))
    return PlantEntry(
        cls,
        parameters,
        units,
        False,
        None,
        len(geometry.joints),
        cls.actuated,
        {"geometry": geometry, **options},
        names,
    )


def _shape(info: ParameterInfo) -> str:
    """What a parameter looks like in a case."""
    return "{ guess = ... }" if info.more is None else "[{ guess = ... }, ...]"


def _count_joints(table: Any, cls: type[Plant], spot: Spot) -> int:
    """How many joints a plant has: as many as its lists tell, or as its class says."""
    if isinstance(cls.joints, int):
        return cls.joints
    name = next(n for n, info in parameters_of(cls).items() if info.more == 0)
    given = table.get(name) if isinstance(table, dict) else None
    if isinstance(given, dict):
        given = given.get("guess", given)
    if given is None:  # told as missing when the table is read
        return 1
    spot = Spot(spot.file, "[plant.parameters]", name)
    if not isinstance(given, list):
        raise spot.refuse(given, "is not a list", f"give a list, even of one: {name} = [...]")
    if not 1 <= len(given) <= _MOST_JOINTS:
        hint = f"a {cls.kind} has 1 to {_MOST_JOINTS}"
        raise spot.fault(f"has {count(len(given), 'entry', 'entries')}", hint)
    return len(given)


def _actuated(joints: int) -> Reader:
    def read(value: Any, spot: Spot) -> tuple[int, ...]:
        driven = several(whole(1))(value, spot)
        check_places(value, driven, joints, "joint", spot)
        return tuple(j - 1 for j in driven)

    return read


def _plant_parameters(
    table: Any, cls: type[Plant], joints: int, file: str
) -> dict[str, Value | tuple[Value, ...]]:
    def reader(info: ParameterInfo) -> Any:
        def read(value: Any, spot: Spot) -> Value | tuple[Value, ...]:
            if info.more is not None:
                return _plant_list(value, info, joints, spot, isinstance(cls.joints, int))
            if isinstance(value, list) and joints > 1:
                return read_values(value, info, joints, spot)
            return read_value(value, info, spot)

        return read

    keys = {
        name: Key(reader(info), f"{info.doc}; a number, or {{ guess = ... }}", not info.optional)
        for name, info in parameters_of(cls).items()
    }
    return read_table(table, keys, Spot(file, "[plant.parameters]"))


def _plant_list(
    value: Any, info: ParameterInfo, joints: int, spot: Spot, fixed: bool
) -> tuple[Value | tuple[Value, ...], ...]:
    """A list of the plant's: as long as it has joints, or longer by what the class says.

    Where every machine of a kind has as many joints (fixed) a fault tells what the entries are.
    """
    entries = joints + info.more
    whole_list = value if isinstance(value, list) else None
    if info.width is None and isinstance(value, dict) and isinstance(value.get("guess"), list):
        whole_list = value["guess"]
    beside = "" if info.more == 0 else f": {info.more} more than joints"
    beside = f": {info.doc}" if fixed else beside
    if whole_list is None:
        hint = f"give a list of {entries}{beside}"
        raise spot.refuse(value, "is not a list", hint)
    if len(whole_list) != entries:
        hint = f"give {count(entries, 'entry', 'entries')}{beside}"
        hint = hint if fixed else f"the plant has {count(joints, 'joint')}: {hint}"
        raise spot.fault(f"has {count(len(whole_list), 'entry', 'entries')}", hint)
    if info.width is not None:
        return tuple(_row(row, info, spot.entry(k)) for k, row in enumerate(whole_list, start=1))
    return read_values(value, info, entries, spot, "entry")


def _row(value: Any, info: ParameterInfo, spot: Spot) -> tuple[Value, ...]:
    """An entry of a list that is a list itself."""
    if not isinstance(value, list):
        raise spot.refuse(value, "is not a list", f"give {info.width} numbers: {info.doc}")
    return read_values(value, info, info.width, spot, "component")


def read_effects(tables: list, plant: PlantEntry, path: Path) -> tuple[EffectEntry, ...]:
    """Read [[effects]], in the order of the drive.

    Raises:
        InputError: If one is unknown, or states what it cannot have, or not what it must.
    """
    return tuple(_effect(table, k, plant, path) for k, table in enumerate(tables, start=1))


def _effect(table: dict[str, Any], index: int, plant: PlantEntry, path: Path) -> EffectEntry:
    spot = Spot(str(path), f"[[effects]] {index}")
    if names_a_file(table.get("kind", "")):
        cls = user_effect(str(table["kind"]), path.parent, spot.at("kind"))
    else:
        cls = EFFECTS[read_kind(table, EFFECTS, spot)]
    spot = Spot(str(path), f"[[effects]] {index} ({cls.kind})")
    infos = parameters_of(cls)
    _check_keys(table, cls, spot)
    ports, what = read_ports(table, cls, plant, spot)
    if "shared" in table and flag(table["shared"], spot.at("shared")) and len(ports) > 1:
        hint = "leave it out: each joint then has a value of its own"
        raise spot.at("shared").refuse(True, "is not available in this version", hint)
    for name, info in infos.items():
        if not info.optional and name not in table:
            raise spot.fault(f"'{name}' is missing", f"add {name}: {info.doc}; {_takes(cls)}")
    parameters = {
        name: read_values(table[name], info, len(ports), spot.at(name), what)
        for name, info in infos.items()
        if name in table
    }
    _check_together(cls, parameters, spot)
    return EffectEntry(cls, parameters, ports)


def read_search(table: Any, path: Path) -> dict[str, tuple]:
    """Read [discover]: `kinds` and `candidates` of effects that a search may name, where it has them.

    Raises:
        InputError: If a kind is unknown, or a candidate no class of a file, or in every search as it is.
    """

    def own(value: Any, spot: Spot) -> type[Effect]:
        kind = text(value, spot)
        if kind in EFFECTS and EFFECTS[kind].on_request:
            return EFFECTS[kind]
        if kind in EFFECTS:
            raise spot.refuse(kind, "takes part in every search", "leave it out")
        return user_effect(kind, path.parent, spot)

    keys = {
        "candidates": Key(several(own), 'a list such as ["my_effects.py:MyEffect"]'),
        "kinds": Key(several(choice(tuple(EFFECTS))), "what `jaxid effects` lists; default: all of it"),
    }
    return read_table(table, keys, Spot(str(path), "[discover]"))


def check_kinds(classes: Iterable[type[Effect]], file: str) -> None:
    """Refuse two own effects of one kind: results go by kind.

    Raises:
        InputError: If there are.
    """
    known: dict[str, type[Effect]] = {}
    for cls in classes:
        if known.setdefault(cls.kind, cls) is not cls:
            hint = "give one of them another kind"
            raise Spot(file).fault(f"two effects of your own are of kind '{cls.kind}'", hint)


def _check_keys(table: dict[str, Any], cls: type[Effect], spot: Spot) -> None:
    names, fields = list(parameters_of(cls)), {*cls.__dataclass_fields__} - {"port"}
    known = [*names, "kind", *PLACES, "shared"]
    for name in table:
        if name not in known:
            if name in fields:
                hint = f'write {name}: Array = parameter("force", "nonnegative", "what it is")'
                raise spot.fault(f"'{name}' is a field of the class that is not a parameter", hint)
            raise spot.fault(f"unknown key '{name}'", nearest(name, known, table))


def _takes(cls: type[Effect]) -> str:
    names = [n + (" (optional)" if i.optional else "") for n, i in parameters_of(cls).items()]
    return f"it takes {', '.join(names)}"


def _check_together(cls: type[Effect], parameters: dict[str, tuple[Value, ...]], spot: Spot) -> None:
    """Let the class judge which optional parameters go together."""
    try:
        effect = cls(**{name: values[0].guess for name, values in parameters.items()})
    except InputError:
        raise
    except Exception as error:
        if not is_user_class(cls) and not isinstance(error, (ValueError, TypeError)):
            raise
        text = " ".join(str(error).split()).rstrip(".")
        raise spot.fault(text or type(error).__name__, _takes(cls)) from error
    if is_user_class(cls):
        check_action(effect, f"{spot.file}, {spot.table}")
