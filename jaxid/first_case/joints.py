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


def of_tree(chosen: Chosen, names: tuple[str, ...], file: str, where: str) -> Chosen:
    """Return the columns of a robot's joints, in their order: of all, or of those that the log names.

    Args:
        chosen: Columns of the log.
        names: Names of the robot's free joints.
        file: The robot's file, for messages.
        where: The log, for messages.

    Raises:
        InputError: If the joints of the log are not those of the robot.
    """
    # Columns may hold the names as they are, or their words.
    keys = [n if n in chosen.joints else " ".join(meaning_of(n).joint) for n in names]
    found = [k for k, key in enumerate(keys) if key and key in chosen.joints and keys.count(key) == 1]
    if not found or len(found) == len(names) or len(chosen.joints) == len(names):
        return _of_joints(chosen, names, keys, file, where, "")
    some = tuple(names[k] for k in found)
    return _of_joints(chosen, some, [keys[k] for k in found], file, where, "; the others are held at zero")


def of_arm(chosen: Chosen, arm: Urdf, urdf: str, where: str) -> Chosen:
    """Return the columns of an arm's joints, in their order."""
    keys = [" ".join(meaning_of(name).joint) for name in arm.names]
    return _of_joints(chosen, arm.names, keys, urdf, where, " up to that tip")


def _of_joints(
    chosen: Chosen, names: tuple[str, ...], keys: list[str], file: str, where: str, which: str
) -> Chosen:
    """Return the columns of some joints: by the words of their names, or in their order.

    Args:
        chosen: Columns of the log.
        names: Names of the joints.
        keys: The same by the words that columns have.
        file: The file of the robot.
        where: The log, for messages.
        which: Words on the joints, for messages.
    """
    if all(keys) and len(set(keys)) == len(keys) and set(keys) <= set(chosen.joints):
        at = [chosen.joints.index(key) for key in keys]
        said = f"columns belong to the joints of {Path(file).name} by their names"
        said += which if which.startswith(";") else ""
        left = [f"'{joint}'" for joint in chosen.joints if joint not in keys]
        of_which = "" if which.startswith(";") else which
        said += f"; those of {', '.join(left)} are no joints{of_which}" if left else ""
    elif len(chosen.joints) == len(names):
        at = list(range(len(names)))
        said = f"columns belong to the joints {', '.join(names)} of {Path(file).name} in this order"
    else:
        listed = ", ".join(f"'{j}'" for j in chosen.joints)
        hint = "rename the columns by the joints, or the joints by joints = [...] in a case"
        if which.startswith(" "):
            hint = "name the tip whose joints the log has by --tip, or rename the columns"
        raise InputError(
            f"columns of {listed}, and {Path(file).name} moves {', '.join(names)}", where=where, hint=hint
        )

    def picked(columns: tuple[Column, ...]) -> tuple[Column, ...]:
        return tuple(columns[k] for k in at) if columns else ()

    return replace(
        chosen,
        position=picked(chosen.position),
        velocity=picked(chosen.velocity),
        force=picked(chosen.force),
        reference=picked(chosen.reference),
        joints=names,
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
