"""Gains of an arm's drives whose currents are logged: those of all joints beside the first, as unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from jaxid.first_case.section import Section


def with_gains(
    sections: Sequence[Section],
    gains: Mapping[int, float],
    first: int,
    unit: str,
    unseen: Sequence[int] = (),
) -> list[Section]:
    """Return the sections of a robot's case with an unknown gain for some of its drives.

    Without a torque constant the forces are in the unit of the log, such as ampere, and one of them need not
    be the same torque at each joint.

    Args:
        sections: Sections of the case, without gains.
        gains: Guesses of the gains by joint, 0-based.
        first: Joint in whose unit all forces are, 0-based.
        unit: Unit of the logged forces, for comments.
        unseen: Joints whose gain the log does not show, 0-based.
    """
    added = [_section(joint, gain) for joint, gain in gains.items()]
    if added:
        joint = first + 1
        added[0].assumed.append(
            f"one {unit} need not be the same torque at each joint: actuator_gain is the torque at its joint "
            f"over that at joint {joint}, and all results are in {unit} of joint {joint}"
        )
        if unseen:
            listed = ", ".join(str(k + 1) for k in unseen)
            added[0].assumed.append(
                f"the log does not show the gain of joint(s) {listed}: it counts as 1; see that the sign of "
                "the force is right there"
            )
        added[0].questions.append(
            f"how large is the torque of one {unit} at joint {joint}? State it as gain = ... in [actuator], "
            "for all joints, and take units out of [plant]: results are then in N m"
        )
    return [*sections, *added]


def _section(joint: int, gain: float) -> Section:
    keys = {"kind": "actuator_gain", "joint": joint + 1, "gain": {"guess": float(f"{gain:.3g}")}}
    return Section("[[effects]]", keys)
