"""JSON Schema of `comparison.json`."""

from __future__ import annotations

from typing import Any

from jaxid.case.json_schema import DRAFT
from jaxid.names import PLACES

_NUMBER = {"type": "number"}
_MAYBE = {"type": ["number", "null"]}
_WORD = {"type": "string"}
_WORDS = {"type": "array", "items": _WORD}
_BY_JOINT = {"anyOf": [_MAYBE, {"type": "array", "items": _MAYBE}]}
_VALUE = {
    "type": "object",
    "description": "a value, its standard deviation (null: not determined) and its unit",
    "properties": {"value": _NUMBER, "std": _MAYBE, "unit": _WORD},
    "required": ["value", "std", "unit"],
    "additionalProperties": False,
}
_PLACED = {place: {"type": "integer", "minimum": 1} for place in PLACES}
_EITHER = [{"required": ["parameter"]}, {"required": ["kind"]}]
_RIVAL = {
    "type": "object",
    "description": "another change that explains the logs equally well",
    "properties": {"parameter": _WORD, "kind": _WORD, "logs": _WORDS, **_PLACED, "evidence": _NUMBER},
    "required": ["evidence"],
    "oneOf": _EITHER,
    "additionalProperties": False,
}
_DIFFERENCE = {
    "type": "object",
    "description": "a parameter that differs, or an effect (kind) that acts in some of the logs only",
    "properties": {
        "parameter": {**_WORD, "description": "name of a parameter with a value of its own in each log"},
        "kind": {**_WORD, "description": "kind of an effect that acts in some of the logs only"},
        **_PLACED,
        "by_log": {
            "type": "object",
            "description": "by the name of the log: the value of the parameter; of an effect its "
            "parameters, and null where it does not act",
            "additionalProperties": {
                "anyOf": [
                    _VALUE,
                    {"type": "object", "additionalProperties": _VALUE},
                    {"type": "null"},
                ]
            },
        },
        "evidence": {**_NUMBER, "description": "gain in held-out log-likelihood [nats]"},
        "threshold": {
            **_NUMBER,
            "description": "evidence that noise alone exceeds once in a thousand comparisons [nats]",
        },
        "false_alarm": {
            **_NUMBER,
            "minimum": 0,
            "maximum": 1,
            "description": "probability that noise alone reaches the evidence with any change",
        },
        "alternatives": {"type": "array", "items": _RIVAL},
    },
    "required": ["by_log", "evidence", "threshold", "false_alarm", "alternatives"],
    "oneOf": _EITHER,
    "additionalProperties": False,
}
_GAP = {
    "type": "object",
    "properties": {"shared": _BY_JOINT, "explained": _BY_JOINT, "noise_floor": _BY_JOINT},
    "required": ["shared", "explained", "noise_floor"],
    "additionalProperties": False,
}
_PROPERTIES = {
    "verdict": {"enum": ["same", "differs", "unexplained"]},
    "logs": {**_WORDS, "minItems": 2, "description": "names of the logs, the base first"},
    "differences": {"type": "array", "items": _DIFFERENCE},
    "why": {"type": ["string", "null"], "description": "what differs if nothing known explains it"},
    "alike": {**_WORDS, "description": "effects that the case lacks in all logs alike"},
    "tried": {"type": "integer", "description": "number of changes that were compared"},
    "threshold": {**_MAYBE, "description": "that of the first differences; null if nothing may differ"},
    "false_alarm": {**_NUMBER, "description": "rate of false alarms at the threshold"},
    "parameters": {"type": "object", "additionalProperties": _VALUE},
    "gap": {
        "type": "object",
        "description": "RMS of the force or position that the model leaves unexplained, by log",
        "properties": {
            "quantity": {"enum": ["force", "position"], "description": "what was compared"},
            "unit": {"anyOf": [_WORD, _WORDS]},
            "logs": {"type": "object", "additionalProperties": _GAP},
        },
        "required": ["quantity", "unit", "logs"],
    },
    "preprocess": {"type": "object"},
    "versions": {"type": "object", "additionalProperties": _WORD},
    "notes": _WORDS,
}


def comparison_schema() -> dict[str, Any]:
    """Return the JSON Schema of comparison.json, draft 2020-12."""
    return {
        "$schema": DRAFT,
        "title": "jaxid comparison",
        "description": "what `jaxid compare` writes",
        "type": "object",
        "properties": _PROPERTIES,
        "required": ["verdict", "logs", "differences", "gap"],
    }
