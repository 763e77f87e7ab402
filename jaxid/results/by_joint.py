"""What a search found at each joint of an arm: entries of discovery.json, and rows of a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jaxid.results.model_json import joint_name
from jaxid.results.report.first_page import values_words
from jaxid.results.report.numbers import ABSENT, is_number, plain, scaled_unit

if TYPE_CHECKING:
    from jaxid.discovery.result import Discovery

# What stands in place of an effect at a joint at which none was named.
_NONE_NAMED = {
    "nothing_missing": "nothing is missing",
    "unexplained": "none named, though more than noise is left",
    "at_rest": "its command does not move",
}
_MEASURES = ("before", "after", "noise_floor")
_HEAD = ("joint", "found", "evidence [nats]", "rivals")


def joints_json(result: Discovery, motion: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the entries `joints` of discovery.json, of a search joint by joint.

    Args:
        result: The search.
        motion: The object `gap.simulation`.
    """
    names = result.session.case.plant.names
    entries = []
    for k in range(result.session.machine.plant.joints):
        place, own = ("joint", k + 1), result.joints.get(k)
        entries.append(
            {
                "joint": k + 1,
                **joint_name(place, names),
                "verdict": "at_rest" if own is None else own.verdict,
                "effects": [e.kind for e in result.effects if e.place == place],
                "simulation": {
                    key: _at(motion[key], k) for key in ("unit", "before", "after", "noise_floor")
                },
            }
        )
    return entries


def joint_rows(content: Mapping[str, Any]) -> list[list[str]]:
    """Return a header, and a row for each effect and for each joint without one; empty without `joints`.

    Args:
        content: Content of discovery.json.
    """
    joints = content.get("joints")
    if not joints:
        return []
    errors = [joint["simulation"] for joint in joints]
    scales = {
        unit: scaled_unit(unit, [e[key] for e in errors for key in _MEASURES if e["unit"] == unit])
        for unit in dict.fromkeys(e["unit"] for e in errors)
    }
    same = len(scales) == 1
    units = f" [{next(iter(scales.values()))[1]}]" if same else ""
    head = [*_HEAD, f"simulated position: before{units}", "after", "noise"]
    rows = [head]
    for joint, error in zip(joints, errors, strict=True):
        scale, unit = scales[error["unit"]]
        sizes = [plain(error[key] / scale if is_number(error[key]) else None) for key in _MEASURES]
        if not same:
            sizes[0] += f" {unit}"
        name = " ".join(str(joint[key]) for key in ("joint", "joint_name") if key in joint)
        own = [_effect_cells(e) for e in content["effects"] if e.get("joint") == joint["joint"]]
        for number, cells in enumerate(own or [(_NONE_NAMED[joint["verdict"]], "", "")]):
            # Name and errors of a joint stand in its first row.
            rows.append([name, *cells, *sizes] if number == 0 else ["", *cells, "", "", ""])
    return rows


def _effect_cells(effect: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return an effect with its values, its evidence and its rivals as text."""
    values = values_words(effect["parameters"])
    rivals = ", ".join(a["kind"] for a in effect["alternatives"]) or ABSENT
    return f"{effect['kind']}: {values}", f"{effect['evidence']:.0f}", rivals


def _at(value: Any, joint: int) -> Any:
    """Return the entry of a joint in a list; what is no list holds for all joints."""
    return value[joint] if isinstance(value, list) else value
