"""The joints that a first case is of: those of an arm's file, or the one that moves most."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.first_case.columns import Chosen, Column
from jaxid.first_case.words import meaning_of

NO_FORCE_HINT = "log the torque or the current of the drives with its sign, and name it so"
_OR_COMMANDS_HINT = (
    "log the torque or the current of the drives with its sign, or the commanded position of each joint, and "
    "name them by the joint, as elbow_torque or elbow_cmd"
)
_BY_JOINT_HINT = (
    "name each force by its joint, as elbow_torque; or write the case by hand, where actuated = [...] in "
    "[plant] lists the joints with a force"
)
_SOME_FORCES_HINT = (
    "name the robot's model by --mjcf or --urdf, which says what drives which joint; or write the case by "
    "hand, as of a motor and a load (flexible_axis) or of masses in a row (chain with actuated)"
)


def of_robot(
    chosen: Chosen,
    names: tuple[str, ...],
    actuated: Collection[str],
    file: str,
    where: str,
    *,
    to_tip: bool = False,
) -> Chosen:
    """Return the columns of a robot's joints, in their order: of all, or of those that the log names.

    Args:
        chosen: Columns of the log.
        names: Names of the robot's free joints.
        actuated: Names of those that are driven; empty: the file does not say which.
        file: The robot's file, for messages.
        where: The log, for messages.
        to_tip: Whether the names are those up to a tip, which the log must all have.

    Raises:
        InputError: If the joints of the log are not those of the robot.
    """
    # Columns may hold the names as they are, or their words.
    keys = [n if n in chosen.joints else " ".join(meaning_of(n).joint) for n in names]
    found = [k for k, key in enumerate(keys) if key and key in chosen.joints and keys.count(key) == 1]
    if to_tip or not found or len(found) == len(names) or len(chosen.joints) == len(names):
        picked = _of_joints(chosen, names, keys, file, where, " up to that tip" if to_tip else "")
    else:
        some, words = tuple(names[k] for k in found), [keys[k] for k in found]
        picked = _of_joints(chosen, some, words, file, where, "; the others are held at zero")
    return _with_forces_of_driven(picked, _words_of(picked, chosen), actuated, file)


def _words_of(picked: Chosen, chosen: Chosen) -> list[set[str]]:
    """Return the words that name each joint: those of the robot's file, and those of the log's columns."""
    before = chosen.position or chosen.velocity
    own = [
        next(k for k, c in enumerate(before) if c is column) for column in picked.position or picked.velocity
    ]
    return [
        {joint, " ".join(meaning_of(joint).joint), chosen.joints[k]} - {""}
        for joint, k in zip(picked.joints, own, strict=True)
    ]


def _with_forces_of_driven(
    chosen: Chosen, words: Sequence[set[str]], actuated: Collection[str], file: str
) -> Chosen:
    """Return the columns with the forces of the joints that are driven, if the others have none.

    They belong to the joints by their names, or in their order if there are as many and none names another
    joint. Of two joints of which the file does not say which is driven, a single force is that of the first,
    as of a pendulum on a cart.

    Args:
        chosen: Columns of the robot's joints.
        words: Words that name each joint.
        actuated: Names of the joints that the file says are driven; empty: it does not say.
        file: The robot's file, for messages.
    """
    loose, joints = chosen.loose_forces, chosen.joints
    driven = tuple(k for k, name in enumerate(joints) if name in actuated)
    if not loose or len(driven) == len(joints):
        return chosen
    named = [next((k for k, of in enumerate(words) if " ".join(c.meaning.joint) in of), None) for c in loose]
    unsure = [c for c, k in zip(loose, named, strict=True) if k is None and c.meaning.joint]
    if not actuated and len(loose) == 1 and len(joints) == 2 and not unsure:
        return _with_single_force(chosen, named[0] or 0, file)
    if not driven or unsure:
        return chosen
    if all(named.count(k) == 1 for k in driven):
        force = tuple(loose[named.index(k)] for k in driven)
    elif len(loose) == len(driven) and not any(k is not None for k in named):
        force = loose
    else:
        return chosen
    listed, columns = (", ".join(x) for x in ([joints[k] for k in driven], [f"'{c.name}'" for c in force]))
    said = f"only {listed} of {Path(file).name} {'has' if len(driven) == 1 else 'have'} an actuator"
    said += f": {columns} {'is its force' if len(driven) == 1 else 'are their forces'}"
    return replace(chosen, force=force, driven=driven, said=(*chosen.said, said))


def _with_single_force(chosen: Chosen, place: int, file: str) -> Chosen:
    """Return the columns with a single force as that of one joint."""
    [force], joint = chosen.loose_forces, chosen.joints[place]
    said = f"{Path(file).name} does not say which joints are driven: '{force.name}' is taken for the force "
    said += f"of {joint}, and no other joint has one"
    question = f'which joint does {force.name} drive? Name it in actuated, as actuated = ["{joint}"]'
    questions = {**chosen.questions, "actuated": question}
    return replace(chosen, force=(force,), driven=(place,), said=(*chosen.said, said), questions=questions)


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
        listed = ", ".join(f"'{c.name}'" for c in chosen.position or chosen.velocity)
        quantity = "position" if chosen.position else "velocity"
        columns = ", ".join(f"{name}_{quantity}" for name in names)
        hint = f"rename the columns by the joints, as {columns}"
        if file.endswith(".urdf"):
            hint = f"name the tip whose joints the log has by --tip, or {hint}"
        count = len(chosen.joints)
        raise InputError(
            f"{count} column{'s say' if count > 1 else ' says'} the {quantity} of a joint ({listed}), and "
            f"{Path(file).name} moves {', '.join(names)}",
            where=where,
            hint=hint,
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
        raise lacking_force(chosen, where)


def lacking_force(chosen: Chosen, where: str, *, of_robot: bool = False) -> InputError:
    """Return the error that a log has no force, or not one for each joint that needs one.

    Args:
        chosen: Columns of the log.
        where: The log, for messages.
        of_robot: Whether the joints are those of a robot's file.
    """
    hint = _OR_COMMANDS_HINT if of_robot else NO_FORCE_HINT
    if chosen.loose_forces:
        hint = _BY_JOINT_HINT if of_robot else _SOME_FORCES_HINT
    return InputError(no_force(chosen), where=where, hint=hint)


def no_force(chosen: Chosen) -> str:
    """Return in words why a log has no force, or not one for each joint."""
    if chosen.loose_forces:
        listed = ", ".join(f"'{c.name}'" for c in chosen.loose_forces)
        places = ", ".join(f"'{c.name}'" for c in chosen.position or chosen.velocity)
        return f"{len(chosen.joints)} joints move ({places}), and not each has a force: {listed}"
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
    question = "a model of all joints? jaxid init LOG --urdf FILE; alone, coupling counts as noise"
    one = chosen.only(joint)
    return replace(one, said=(*one.said, said), questions={**one.questions, "joints": question})
