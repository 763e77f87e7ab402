"""Search for what an arm of servos lacks, joint by joint, in logs without a force.

The loop of a whole arm takes hours to search. In its own loop each joint is an axis, whose load is that of
the links along the motion of all joints (`jaxid.estimators.apart`): the measured one at first, and then that
of the simulated arm. Each is searched as an axis is (`jaxid.discovery.in_loop.unforced`), and what was found
is put together on the arm.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from jaxid.discovery.in_loop.arm_search import ArmSearch
from jaxid.discovery.in_loop.unforced import at_any_loop, at_loop, loop_of, with_chosen_loop
from jaxid.discovery.in_loop.whole_arm import declared_by_whole, with_fewest, without_unneeded
from jaxid.discovery.result import Discovery
from jaxid.estimators import steps_of
from jaxid.estimators.effort import with_effort
from jaxid.estimators.unforced import leaves_loop_open
from jaxid.gap import gaps
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session


def explore_by_joint(session: Session, *, max_effects: int, progress: Callable[[str], None]) -> Discovery:
    """Run `discover` for logs of an arm without a force, joint by joint.

    Args:
        session: Case and logs; the arm `jaxid.estimators.apart.joint.stands_apart`.
        max_effects: Largest number of effects to add at each joint.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If no joint moves, or the loop of one cannot be simulated.
    """
    if not leaves_loop_open(session):
        return _searched(session, max_effects, progress)

    progress("fitting the declared model at loops that the case allows")
    chosen = run_alone(steps_of("output_error", session))
    found = _searched(session.with_machine(at_loop(session.machine, chosen.machine)), max_effects, progress)
    if found.effects:
        # An incomplete model shows neither the law nor the rate of its loop.
        progress("fitting what was found at loops that the case allows")
        again = at_any_loop(session, found.after)
        if loop_of(again.machine) != loop_of(chosen.machine):
            chosen, at = again, session.with_machine(at_loop(session.machine, again.machine))
            found = _searched(at, max_effects, progress)
        elif again is not found.after:
            new = gaps(again.machine, session.runs)
            after = with_effort(again, session, new, searched=True)
            after = replace(after, notes=(*found.after.notes, *after.notes))
            found = replace(found, after=after, gaps_after=new)
    return with_chosen_loop(found, chosen)


def _searched(session: Session, max_effects: int, progress: Callable[[str], None]) -> Discovery:
    """Search an arm at the loop of its machine."""
    progress("fitting the declared model, joint by joint")
    arm = ArmSearch.of(session)
    found: dict[int, Discovery] = {}
    # What is found at one joint changes the forces on the others: the joint that leaves most is the first,
    # and a joint that these forces move by more than noise is searched again.
    searches = Counter[int]()
    while left := arm.waiting(found, searches):
        joint, before = left[0], found.get(left[0])
        number = f"again, {joint + 1}" if before else f"{len(found) + 1}"
        at_joint = _prefixed(progress, f"{joint_words(session, joint)} ({number} of {len(arm.declared)})")
        if before:
            arm = arm.reopened(joint, found)
        searches[joint] += 1
        first = searches[joint] == 1
        found[joint] = arm.searched(joint, max_effects=max_effects, progress=at_joint, to_spring=first)
        if found[joint].kinds != ([] if before is None else before.kinds):
            at_joint("simulating the arm with what was found")
            arm, found = arm.settled(found)
    progress("simulating the whole arm")
    found = {joint: found[joint] for joint in sorted(found)}
    together = arm.together(found)
    if together.verdict == "nothing_missing":
        return together
    checked = declared_by_whole(session, together.before, progress)
    if checked is None:
        return together
    whole, open_at = checked
    kept, notes = without_unneeded(found, open_at)
    if not any(d.effects for d in kept.values()):
        return arm.together(kept, before=whole, after=whole, notes=notes)
    kept, after, more = with_fewest(arm, kept, progress)
    return arm.together(kept, before=whole, after=after, notes=(*notes, *more))


def joint_words(session: Session, joint: int) -> str:
    """Return the number of a joint, with its name if a file has one."""
    names = session.case.plant.names
    return f"joint {joint + 1}, {names[joint]}" if names else f"joint {joint + 1}"


def _prefixed(progress: Callable[[str], None], head: str) -> Callable[[str], None]:
    return lambda text: progress(f"{head}: {text}")
