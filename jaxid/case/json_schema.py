"""JSON Schema of a case file, from the same keys that read it; editors complete and check by it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from jaxid.case.entries import actuated_key, coupling_key, parameter_keys, search_keys, unit_of
from jaxid.case.kinds import known_kinds
from jaxid.case.links import LINKED, SHAFT, link_keys
from jaxid.case.tables import PLANT, TOP, controller_keys, fit_keys, validation_keys
from jaxid.case.tree_keys import TREE, TREE_KIND
from jaxid.case.values import value_schema, values_schema
from jaxid.model.parameter import parameters_of
from jaxid.names import PLACES
from jaxid.references import REFERENCES
from jaxid.schema import Key, Keys, Reader, Spot, either, flag, keys_of, list_of, schema_of, text
from jaxid.settings import (
    Actuator,
    Algebraic,
    DesignTable,
    Identification,
    InertialSensor,
    LimitsTable,
    LogTable,
    OutputError,
    Preprocess,
    Recursive,
    SensorTable,
    SimulationTable,
    StudyTable,
    WithinPrior,
)

if TYPE_CHECKING:
    from jaxid.model.effect import Effect
    from jaxid.model.plant import Plant

DRAFT = "https://json-schema.org/draft/2020-12/schema"
# Tables whose keys do not depend on a kind.
_TABLES = {
    "actuator": Actuator,
    "preprocess": Preprocess,
    "identification": Identification,
    "algebraic": Algebraic,
    "output_error": OutputError,
    "within_prior": WithinPrior,
    "recursive": Recursive,
    "sensor": SensorTable,
    "limits": LimitsTable,
    "design": DesignTable,
    "simulation": SimulationTable,
    "study": StudyTable,
}
# Keys that go with another one only.
_WITH = {
    "output_error": ("prior", ("starts", "hessian", "profile", "drawn")),
    "preprocess": ("derivatives", ("reach",)),
}
# One place, or several; joints of an arm may go by their names.
_PLACE = either(
    {"type": "integer", "minimum": 1},
    text.schema,
    list_of(either({"type": "integer", "minimum": 1}, text.schema)),
)


def case_schema() -> dict[str, Any]:
    """Return the JSON Schema of a case file, draft 2020-12.

    It holds types, required keys, names, bounds and descriptions with units. Checks that span several tables
    (lengths of lists, keys that exclude each other) are made by `jaxid.case.case.load_case` alone.
    """
    kinds = known_kinds()
    tables = {name: schema_of(keys_of(cls), _doc(cls)) for name, cls in _TABLES.items()}
    for table, (name, others) in _WITH.items():
        tables[table]["dependentRequired"] = dict.fromkeys(others, [name])
    tables |= {
        "plant": _by_kind([variant for cls in kinds.plants.values() for variant in _plant(cls)]),
        "effects": {
            "type": "array",
            "items": _by_kind([*map(_effect, kinds.effects.values()), _user_effect()]),
        },
        "log": _log(),
        "controller": _by_kind([_kind(kind, controller_keys(kind, kinds)) for kind in kinds.laws]),
        "inertial_sensors": {
            "type": "array",
            "items": schema_of(keys_of(InertialSensor), _doc(InertialSensor)),
        },
        "fit": {"type": "array", "items": schema_of(fit_keys(), "a log that is fitted with others")},
        "validation": {"type": "array", "items": schema_of(validation_keys(), "a log to validate on")},
        "discover": schema_of(search_keys(Spot(""), kinds), "[discover]: effects that a search may name"),
        "reference": _signal("reference that the controller follows"),
        "input": _signal("command in open loop"),
    }
    return {
        "$schema": DRAFT,
        "title": "jaxid case",
        "description": "a machine, the columns of its logs, and the settings of every method",
        "type": "object",
        "properties": {name: tables[name] for name in TOP},
        "required": ["plant"],
        "additionalProperties": False,
    }


def _doc(cls: type) -> str:
    """Return the first line of a class's documentation."""
    return (cls.__doc__ or "").split("\n", 1)[0].rstrip(".")


def _by_kind(variants: list[dict[str, Any]]) -> dict[str, Any]:
    return {"type": "object", "required": ["kind"], "oneOf": variants}


def _kind(kind: str, keys: Keys, doc: str = "") -> dict[str, Any]:
    """Return the schema of a table of one kind."""
    return schema_of({**keys, "kind": Key(Reader(_unread, {"const": kind}), required=True)}, doc)


def _unread(value: Any, spot: Spot) -> Any:
    return value


def _plant(cls: type[Plant]) -> list[dict[str, Any]]:
    """Return the schemas of a plant: one for each of its couplings, or one."""
    if cls.kind == TREE_KIND:
        return [_robot(cls)]
    if cls.linked:
        return [_arm(cls)]
    if not cls.couplings:
        return [_kind(cls.kind, _plant_keys(cls), _doc(cls))]
    out = []
    for k, (coupling, variant) in enumerate(cls.couplings.items()):
        schema = _kind(
            cls.kind,
            {**_plant_keys(cast("type[Plant]", variant)), "coupling": coupling_key(cls)},
            _doc(variant),
        )
        schema["properties"]["coupling"] = {"const": coupling}
        # The first is the default, and need not be named.
        schema["required"] += ["coupling"] if k else []
        out.append(schema)
    return out


def _plant_keys(cls: type[Plant]) -> dict[str, Key]:
    parameters = Reader(_unread, schema_of(parameter_keys(cls, 1)))
    keys = {**PLANT, "parameters": Key(parameters, "parameters of the plant", True)}
    return keys | ({"actuated": actuated_key(1)} if "actuated" in cls.__dataclass_fields__ else {})


def _arm(cls: type[Plant]) -> dict[str, Any]:
    """Return the schema of an arm, which links or a URDF file describe."""
    taken = {name: key for name, key in PLANT.items() if name not in ("orientation", "gravity")}
    schema = _kind(cls.kind, {**taken, **LINKED}, _doc(cls))
    link = schema_of(link_keys(cls), "link, from the base to the tip")
    for angle in ("alpha", "theta"):
        link["properties"][f"{angle}_deg"] = {"type": "number", "description": f"{angle} in degrees"}
    link["required"].remove("alpha")
    link["oneOf"] = [{"required": ["alpha"]}, {"required": ["alpha_deg"]}]
    schema["properties"]["links"] = list_of(link)
    schema["properties"]["shafts"] = list_of(schema_of(SHAFT, "drive that turns with several joints"))
    schema["oneOf"] = [{"required": ["links"]}, {"required": ["urdf"]}]
    return schema


def _robot(cls: type[Plant]) -> dict[str, Any]:
    """Return the schema of a tree, which a URDF or MJCF file describes."""
    taken = {name: key for name, key in PLANT.items() if name not in ("orientation", "gravity")}
    schema = _kind(cls.kind, {**taken, **TREE}, _doc(cls))
    schema["properties"]["shafts"] = list_of(schema_of(SHAFT, "drive that turns with several joints"))
    parameters = {}
    for name, info in parameters_of(cls).items():
        value = value_schema(info)
        by_joint = {"type": "object", "additionalProperties": value}
        parameters[name] = Key(
            Reader(_unread, either(list_of(value), by_joint)), info.doc, unit=unit_of(info)
        )
    schema["properties"]["parameters"] = schema_of(parameters)
    schema["oneOf"] = [{"required": ["urdf"]}, {"required": ["mjcf"]}]
    return schema


def _effect(cls: type[Effect]) -> dict[str, Any]:
    keys = {
        name: Key(Reader(_unread, values_schema(info)), info.doc, not info.optional)
        for name, info in parameters_of(cls).items()
    }
    places = {name: Key(Reader(_unread, _PLACE), f"{name} that it acts on, from 1") for name in PLACES}
    shared = {"shared": Key(flag, "one value for all joints; not available in this version")}
    return _kind(cls.kind, {**keys, **places, **shared}, _doc(cls))


def _user_effect() -> dict[str, Any]:
    """Return the schema of a user-defined effect, whose parameters are those of its class."""
    kind = {"type": "string", "pattern": r":|\.py$", "description": "class in a file: my_effects.py:MyEffect"}
    return {"type": "object", "properties": {"kind": kind}, "required": ["kind"]}


def _log() -> dict[str, Any]:
    steady = {"properties": {"kind": {"const": "steady"}}, "required": ["kind", "velocity", "force"]}
    time_base = [{"required": ["time"]}, {"required": ["sample_rate"]}, steady]
    motion = [{"required": ["position"]}, {"required": ["velocity"]}, {"required": ["loop_velocity"]}]
    return {**schema_of(keys_of(LogTable), _doc(LogTable)), "oneOf": time_base, "anyOf": motion}


def _signal(doc: str) -> dict[str, Any]:
    """Return the schema of [reference] or [input]; an empty table counts as absent."""
    families = [family.schema for family in REFERENCES.values()]
    return {"type": "object", "description": doc, "oneOf": [{"maxProperties": 0}, *families]}
