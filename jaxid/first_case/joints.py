"""The joints that a first case is of: those of an arm's file, or the one that moves most."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxid.case.urdf import Urdf
from jaxid.errors import InputError
from jaxid.first_case.columns import Chosen, Column
from jaxid.first_case.words import meaning_of

NO_FORCE_HINT = "log the torque or the current of the drives with its sign, and name it so"


def of_arm(chosen: Chosen, arm: Urdf, urdf: str, where: str) -> Chosen:
    """Return the columns of an arm's joints, in their order."""
    keys = [" ".join(meaning_of(name).joint) for name in arm.names]
    if all(keys) and len(set(keys)) == len(keys) and set(keys) <= set(chosen.joints):
        at = [chosen.joints.index(key) for key in keys]
        said = f"columns belong to the joints of {Path(urdf).name} by their names"
        left = [f"'{joint}'" for joint in chosen.joints if joint not in keys]
        said += f"; those of {', '.join(left)} are no joints up to that tip" if left else ""
    elif len(chosen.joints) == len(arm.names):
        at = list(range(len(arm.names)))
        said = f"columns belong to the joints {', '.join(arm.names)} of {Path(urdf).name} in this order"
    else:
        listed = ", ".join(f"'{j}'" for j in chosen.joints)
        hint = "name the tip whose joints the log has by --tip, or rename the columns"
        raise InputError(
            f"columns of {listed}, and {Path(urdf).name} moves {', '.join(arm.names)}", where=where, hint=hint
        )

    def picked(columns: tuple[Column, ...]) -> tuple[Column, ...]:
        return tuple(columns[k] for k in at) if columns else ()

    return replace(
        chosen,
        position=picked(chosen.position),
        velocity=picked(chosen.velocity),
        force=picked(chosen.force),
        reference=picked(chosen.reference),
        joints=arm.names,
        said=(*chosen.said, said),
    )


def need_forces(chosen: Chosen, where: str) -> None:
    """Refuse a log of several joints with neither a force nor a reference."""
    if not chosen.force and not chosen.reference:
        raise InputError(no_force(chosen), where=where, hint=NO_FORCE_HINT)


def no_force(chosen: Chosen) -> str:
    """Return in words why a log has no force."""
    reasons = [line for line in chosen.said if line.startswith("'") and "passed over" in line]
    why = f" ({reasons[0]})" if reasons else ""
    return f"no column is a force with a sign{why}"


def most_moved(chosen: Chosen) -> Chosen:
    """Return the columns of the joint with the longest way, with a question for a model of all."""
    columns = chosen.position or chosen.velocity
    ways = [float(np.abs(np.diff(c.values)).sum()) for c in columns]
    joint = int(np.argmax(ways))
    name = columns[joint].name
    said = f"the log has {len(columns)} joints: the case is of that of '{name}' alone, which moves most"
    question = "a model of all joints? jaxid init LOG --urdf FILE --tip LINK; alone, coupling counts as noise"
    one = chosen.only(joint)
    return replace(one, said=(*one.said, said), questions={**one.questions, "joints": question})
