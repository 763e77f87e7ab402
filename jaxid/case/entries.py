"""The plant and the effects of a case, read against the classes that they name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, cast

from jaxid.case.declared import EffectEntry, PlantEntry
from jaxid.case.kinds import Kinds, is_user_class, names_a_file
from jaxid.case.links import LINKED, check_links, read_links, read_links_of_urdf, read_shafts
from jaxid.case.places import check_places, read_ports
from jaxid.case.tables import PLANT
from jaxid.case.tree_keys import TREE_KIND, read_tree_keys
from jaxid.case.values import Value, read_value, read_values, values_schema
from jaxid.errors import InputError
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.model.units import Units
from jaxid.names import MOTIONS, PLACES
from jaxid.schema import (
    Key,
    Reader,
    Spot,
    anything,
    choice,
    count,
    flag,
    is_list,
    list_of,
    nearest,
    read_table,
    several,
    text,
    whole,
)

if TYPE_CHECKING:
    from jaxid.model.effect import Effect
    from jaxid.model.plant import Plant

# Most joints of a plant whose lists give their number.
_MOST_JOINTS = 50


def read_kind(table: dict[str, Any], known: Any, spot: Spot) -> str:
    """Read the kind that a table names.

    Raises:
        InputError: If it is missing or unknown.
    """
    if "kind" not in table:
        raise spot.fault("'kind' is missing", f'add kind = "..."; there is: {", ".join(known)}')
    return choice(known)(table["kind"], spot.at("kind"))


def read_plant(table: dict[str, Any], root: Spot, kinds: Kinds) -> PlantEntry:
    """Read [plant].

    Raises:
        InputError: If it has a key or value that the plant cannot have, or lacks one.
        NeedsClassesError: If a file describes the plant, and the kinds are stand-ins.
    """
    spot = root.under("[plant]")
    kind = str(table.get("kind", ""))
    users = names_a_file(kind)
    if users:
        kinds.need_classes()
        from jaxid.case.user_plant import user_plant

        cls = user_plant(kind, root.folder, spot.at("kind"))
    else:
        cls = kinds.plants[read_kind(table, kinds.plants, spot)]
    keys = {"kind": Key(anything), **PLANT}
    if kind == TREE_KIND:
        given = read_tree_keys(table, keys, spot)
        kinds.need_classes()
        from jaxid.case.tree import read_tree

        return read_tree(given, table, spot)
    if cls.linked:
        return _linked(table, cls, keys, spot, kinds)
    if cls.couplings:
        keys["coupling"] = coupling_key(cls)
        if "coupling" in table:
            coupling = keys["coupling"].read(table["coupling"], spot.at("coupling"))
            cls = cast("type[Plant]", cls.couplings[coupling])
    joints = _count_joints(table.get("parameters"), cls, spot)
    if "actuated" in cls.__dataclass_fields__:
        keys["actuated"] = actuated_key(joints)
    keys["parameters"] = Key(Reader(lambda v, s: _plant_parameters(v, cls, joints, root)))
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
        cls=cls,
        parameters=given["parameters"],
        units=units,
        vertical=vertical,
        gravity=given.get("gravity"),
        joints=joints,
        actuated=given.get("actuated", cls.actuated),
    )
    if users:
        from jaxid.case.user_plant import check_user_plant

        check_user_plant(entry, kind, spot.at("kind"))
    return entry


def _linked(
    table: dict[str, Any], cls: type[Plant], keys: dict[str, Key], spot: Spot, kinds: Kinds
) -> PlantEntry:
    """Read [plant] of an arm, which [[plant.links]] or a URDF file describe."""
    # For an arm weight is a vector, and acts in every pose.
    taken = {name: key for name, key in keys.items() if name not in ("orientation", "gravity")}
    given = read_table(table, {**taken, **LINKED}, spot)
    names: tuple[str, ...] = ()
    if "urdf" in given:
        parameters, arm = read_links_of_urdf(given, cls, spot, kinds)
        geometry, names = arm.geometry, arm.names
    else:
        of_file = [name for name in ("tip", "unknown") if name in given]
        if of_file:
            raise spot.at(of_file[0]).fault("goes with urdf only", 'add urdf = "<its file>", or leave it out')
        check_links(table, spot)
        parameters, geometry = read_links(table["links"], cls, spot, kinds)

    options = {name: given[name] for name in ("gravity_vector",) if name in given}
    if "shafts" in table:
        options["shafts"] = read_shafts(table["shafts"], geometry, spot)
    units = Units(given.get("motion", cls.usual_motion), **given.get("units", {}))

    return PlantEntry(
        cls=cls,
        parameters=parameters,
        units=units,
        vertical=False,
        gravity=None,
        joints=len(geometry.joints),
        actuated=cls.actuated,
        options={"geometry": geometry, **options},
        names=names,
    )


def _shape(info: ParameterInfo) -> str:
    """Return the form of a parameter in a case, for hints."""
    return "{ guess = ... }" if info.more is None else "[{ guess = ... }, ...]"


def _count_joints(table: Any, cls: type[Plant], spot: Spot) -> int:
    """Count the joints of a plant: the entries of its lists, or the number of its class."""
    if isinstance(cls.joints, int):
        return cls.joints
    name = next(n for n, info in parameters_of(cls).items() if info.more == 0)
    given = table.get(name) if isinstance(table, dict) else None
    if isinstance(given, dict):
        given = given.get("guess", given)
    # An absent list is refused as missing when the table is read.
    if given is None:
        return 1
    spot = spot.under("[plant.parameters]").at(name)
    if not is_list(given):
        raise spot.refuse(given, "is not a list", f"give a list, even of one: {name} = [...]")
    if not 1 <= len(given) <= _MOST_JOINTS:
        hint = f"a {cls.kind} has 1 to {_MOST_JOINTS}"
        raise spot.fault(f"has {count(len(given), 'entry', 'entries')}", hint)
    return len(given)


def coupling_key(cls: type[Plant]) -> Key:
    """Return the key that chooses between the variants of a plant."""
    return Key(choice(tuple(cls.couplings)), "whether the coupling gives", default=next(iter(cls.couplings)))


def actuated_key(joints: int) -> Key:
    """Return the key that lists the driven joints."""

    def read(value: Any, spot: Spot) -> tuple[int, ...]:
        driven = several(whole(1))(value, spot)
        check_places(value, driven, joints, "joint", spot)
        return tuple(j - 1 for j in driven)

    return Key(Reader(read, several(whole(1)).schema), "driven joints, from 1", note="all")


def parameter_keys(cls: type[Plant], joints: int) -> dict[str, Key]:
    """Return the keys of [plant.parameters]."""
    fixed = isinstance(cls.joints, int)

    def key(info: ParameterInfo) -> Key:
        def read(value: Any, spot: Spot) -> Value | tuple[Value | tuple[Value, ...], ...]:
            if info.more is not None:
                return _plant_list(value, info, joints, spot, fixed)
            if is_list(value) and joints > 1:
                return read_values(value, info, joints, spot)
            return read_value(value, info, spot)

        doc = f"{info.doc}; a number" + ("" if info.known else ", or { guess = ... }")
        return Key(Reader(read, _parameter_schema(info)), doc, not info.optional, unit_of(info))

    return {name: key(info) for name, info in parameters_of(cls).items()}


def unit_of(info: ParameterInfo) -> str:
    """Return the unit of a parameter: of a linear machine, and of a rotary one if it differs."""
    units = [Units(motion).label(info.dimension, info.motion) for motion in MOTIONS]
    return " or ".join(dict.fromkeys(unit for unit in units if unit))


def _parameter_schema(info: ParameterInfo) -> dict[str, Any]:
    if info.more is None:
        return values_schema(info)
    if info.width is not None:
        return list_of(values_schema(info))
    lists = values_schema(info)["anyOf"][1:]
    return {"anyOf": lists}


def _plant_parameters(
    table: Any, cls: type[Plant], joints: int, root: Spot
) -> dict[str, Value | tuple[Value, ...]]:
    return read_table(table, parameter_keys(cls, joints), root.under("[plant.parameters]"))


def _plant_list(
    value: Any, info: ParameterInfo, joints: int, spot: Spot, fixed: bool
) -> tuple[Value | tuple[Value, ...], ...]:
    """Read a list of the plant, with one entry for each joint, or more if the class declares so.

    If every machine of a kind has the same number of joints (fixed), a fault names the entries.
    """
    assert info.more is not None, "only lists come here"
    entries = joints + info.more
    whole_list = value if is_list(value) else None
    if info.width is None and isinstance(value, dict) and is_list(value.get("guess")):
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
    """Read an entry of a list that is a list itself."""
    assert info.width is not None, "only lists of lists come here"
    if not is_list(value):
        raise spot.refuse(value, "is not a list", f"give {info.width} numbers: {info.doc}")
    return read_values(value, info, info.width, spot, "component")


def read_effects(tables: list, plant: PlantEntry, root: Spot, kinds: Kinds) -> tuple[EffectEntry, ...]:
    """Read [[effects]], in the order of the drive.

    Raises:
        InputError: If an effect is unknown, or has a key or value that it cannot have, or lacks one.
        NeedsClassesError: If an effect is a class in a file, and the kinds are stand-ins.
    """
    return tuple(_effect(table, k, plant, root, kinds) for k, table in enumerate(tables, start=1))


def _effect(table: dict[str, Any], index: int, plant: PlantEntry, root: Spot, kinds: Kinds) -> EffectEntry:
    spot = root.under(f"[[effects]] {index}")
    if names_a_file(table.get("kind", "")):
        kinds.need_classes()
        from jaxid.case.user_effect import user_effect

        cls = user_effect(str(table["kind"]), root.folder, spot.at("kind"))
    else:
        cls = kinds.effects[read_kind(table, kinds.effects, spot)]
    spot = root.under(f"[[effects]] {index} ({cls.kind})")
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


def read_search(table: Any, root: Spot, kinds: Kinds) -> tuple[tuple[type[Effect], ...], tuple[str, ...]]:
    """Read [discover].

    Returns:
        Effects that a search may name on request or from a user's file, and the kinds that it is limited to.

    Raises:
        InputError: If a kind is unknown, or a candidate is no class of a file, or takes part in every search.
        NeedsClassesError: If a candidate is a class in a file, and the kinds are stand-ins.
    """
    given = read_table(table, search_keys(root, kinds), root.under("[discover]"))
    return given.get("candidates", ()), given.get("kinds", ())


def search_keys(root: Spot, kinds: Kinds) -> dict[str, Key]:
    """Return the keys of [discover]."""
    effects = kinds.effects

    def candidate(value: Any, spot: Spot) -> type[Effect]:
        kind = text(value, spot)
        found = effects.get(kind)
        by_place = found and (found.in_links or found.adds_spring)  # on request at some machines
        if found and (by_place or found.on_request or found.without_force_on_request):
            return found
        if kind in effects:
            raise spot.refuse(kind, "takes part in every search", "leave it out")
        kinds.need_classes()
        from jaxid.case.user_effect import user_effect

        return user_effect(kind, root.folder, spot)

    return {
        "candidates": Key(
            several(Reader(candidate, text.schema)),
            'further effects that discover may name, a list such as ["my_effects.py:MyEffect"]',
            default=(),
        ),
        "kinds": Key(
            several(choice(tuple(effects))),
            "the only effects that discover may name, out of `jaxid effects`",
            note="all of them",
        ),
    }


def check_kinds(classes: Iterable[type[Effect]], root: Spot) -> None:
    """Refuse two user-defined effects of one kind: results go by kind.

    Raises:
        InputError: If there are two.
    """
    known: dict[str, type[Effect]] = {}
    for cls in classes:
        if known.setdefault(cls.kind, cls) is not cls:
            hint = "give one of them another kind"
            raise root.fault(f"two user-defined effects are of kind '{cls.kind}'", hint)


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
    guesses: dict[str, Any] = {name: values[0].guess for name, values in parameters.items()}
    try:
        effect = cls(**guesses)
    except InputError:
        raise
    except Exception as error:
        if not is_user_class(cls) and not isinstance(error, (ValueError, TypeError)):
            raise
        text = " ".join(str(error).split()).rstrip(".")
        raise spot.fault(text or type(error).__name__, _takes(cls)) from error
    if is_user_class(cls):
        from jaxid.case.user_faults import check_action

        check_action(effect, f"{spot.file}, {spot.table}")
