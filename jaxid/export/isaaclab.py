"""An actuator configuration for Isaac Lab: gains, limits, friction and rotors of the joints."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxid.export.exported import ExportedFile, JointLaws, notes_of_case, rotors_of, shown
from jaxid.export.plain import identifier

# Effects that a joint of Isaac Lab has, with their parameter.
_LAWS = {
    "viscous_friction": "coefficient",
    "back_emf_damping": "coefficient",
    "coulomb_friction": "level",
    "static_friction": "level",
    "added_mass": "mass",
    "saturation": "limit",
    "input_delay": "delay",
}

_FILE = '''\
"""Actuators of {title} for Isaac Lab: ArticulationCfg(..., actuators=ACTUATORS).

Written by jaxid {version} from a result. Units: rad, m, s, N m, N. Frictions are efforts, as Isaac Sim has
them from 5.0 on. Masses and inertias are those of the robot's file.
{remarks}"""

from isaaclab.actuators import {cls}

{delay}ACTUATORS = {{
    "{name}": {cls}(
        joint_names_expr={joints},
{entries}    ),
}}
'''


def export_isaaclab(model: Mapping[str, Any], stem: str, version: str, where: str) -> ExportedFile:
    """Write an actuator configuration for Isaac Lab.

    A position law `pd` gives stiffness and damping, in force at the joint; without one both are zero, and the
    joints take efforts. A delay asks for `DelayedPDActuatorCfg`, which counts it in steps of physics.

    Args:
        model: `model` of result.json.
        stem: Name of the file without its suffix.
        version: That of jaxid.
        where: The result, for messages.

    Source:
        Fields of `isaaclab.actuators.ActuatorBaseCfg` in Isaac Lab 2.3.
    """
    laws = JointLaws.of(model, _LAWS, ())
    notes = [f"{shown(model['effects'][k])} has no place in an actuator of Isaac Lab" for k in laws.lost]
    notes += notes_of_case(model)
    names, drives = model["joints"], model.get("drives") or {"joints": [], "gain": [], "controller": None}
    gain, limits, delays = {}, {}, {}
    for joint, factor in zip(drives["joints"], drives["gain"], strict=True):
        gain[names[joint - 1]] = float(factor)
    law = drives["controller"]
    kp, kd = _gains(law, gain, notes)
    if law is not None and law.get("limit") is not None:
        limits = {n: x * abs(gain[n]) for n, x in _by_drive(law["limit"], gain).items()}
    if law is not None and law.get("delay") is not None:
        delays = _by_drive(law["delay"], gain)
    for name, values in zip(names, laws.values, strict=True):
        if "saturation" in values:
            limits[name] = min(values["saturation"], limits.get(name, np.inf))
        if "input_delay" in values:
            delays[name] = delays.get(name, 0.0) + values["input_delay"]
    rotors = rotors_of(model)
    rotors = np.zeros(len(names)) if rotors is None else rotors

    def of_joints(*kinds: str) -> dict[str, float]:
        sums = [sum(values.get(kind, 0.0) for kind in kinds) for values in laws.values]
        return dict(zip(names, sums, strict=True))

    armature = {n: float(r) + x for (n, x), r in zip(of_joints("added_mass").items(), rotors, strict=True)}
    delayed = any(delays.values())
    entries: dict[str, dict[str, float]] = {"stiffness": kp, "damping": kd}
    if limits:
        entries["effort_limit" if delayed else "effort_limit_sim"] = limits
    entries["armature"] = armature
    entries["friction"] = of_joints("coulomb_friction", "static_friction")
    entries["dynamic_friction"] = of_joints("coulomb_friction")
    entries["viscous_friction"] = of_joints("viscous_friction", "back_emf_damping")
    lines = "".join(f"        {key}={_literal(values)},\n" for key, values in entries.items())
    delay = ""
    if delayed:
        if len(set(delays.values())) > 1 or len(delays) < len(gain):
            notes.append("delays differ by joint, and an actuator group has one: their mean is written")
        mean = float(np.mean(list(delays.values())))
        period = float((law or {}).get("period") or 0.005)
        delay = f"# Time step of the physics [s], to be the simulation's.\nPHYSICS_DT = {period!r}\n\n"
        lines += "".join(f"        {end}_delay=round({mean!r} / PHYSICS_DT),\n" for end in ("min", "max"))
    text = _FILE.format(
        title=stem.replace('"', "'"),
        version=version,
        remarks="".join(f"\nNot in it: {note}.\n" for note in notes).replace('"""', "'''"),
        cls="DelayedPDActuatorCfg" if delayed else "ImplicitActuatorCfg",
        delay=delay,
        name=identifier(stem),
        joints=repr([re.escape(name) for name in names]),
        entries=lines,
    )
    return ExportedFile(text.encode(), tuple(names), tuple(notes), laws.lost)


def _gains(
    law: Mapping[str, Any] | None, gain: Mapping[str, float], notes: list[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return stiffness and damping of the drives [force at the joint], zero without a law that has them."""
    none = dict.fromkeys(gain, 0.0)
    if law is None:
        return none, none
    kind = law["kind"]
    if kind not in ("pd", "pid", "cascade_pd"):
        notes.append(f"a controller of kind '{kind}' is no position servo: stiffness and damping are zero")
        return none, none
    kp, kd = _by_drive(law["kp"], gain), _by_drive(law["kv" if kind == "cascade_pd" else "kd"], gain)
    if kind == "cascade_pd":
        kp = {name: value * kd[name] for name, value in kp.items()}
    if kind == "pid" and np.any(np.asarray(law["ki"])):
        notes.append("the integral of the position error (ki) has no place in an actuator of Isaac Lab")
    if law.get("derivative", "error") == "error" and kind != "cascade_pd":
        notes.append("damping acts on the velocity error: give the wanted velocity as velocity target")
    return {n: v * gain[n] for n, v in kp.items()}, {n: v * gain[n] for n, v in kd.items()}


def _by_drive(value: Any, gain: Mapping[str, float]) -> dict[str, float]:
    """Return a value of the control law by the joint of each drive."""
    values = np.broadcast_to(np.asarray(value, dtype=float), (len(gain),))
    return dict(zip(gain, values.tolist(), strict=True))


def _literal(values: Mapping[str, float]) -> str:
    # Isaac Lab takes names for regular expressions.
    entries = ", ".join(f"{re.escape(name)!r}: {value!r}" for name, value in values.items())
    return f"{{{entries}}}"
