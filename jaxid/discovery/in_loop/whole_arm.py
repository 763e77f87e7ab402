"""Check of what was found at the joints of an arm, each alone, by a fit of the whole arm.

A joint alone has the forces of the links along another motion than its own. What these forces get wrong may
look like an effect. In the loop of the whole arm they are right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.discovery.in_loop.arm_search import ArmSearch
from jaxid.discovery.in_loop.unforced import open_joints
from jaxid.discovery.result import Discovery
from jaxid.discovery.score import Score
from jaxid.estimators.apart.whole import whole_steps, why_not_whole
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.several.parts import part_of, parts_of
from jaxid.gap import gaps
from jaxid.machine import Machine
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session


def declared_by_whole(
    session: Session, start: Estimate, progress: Callable[[str], None]
) -> tuple[Estimate, set[int]] | None:
    """Fit the declared model to the whole arm at once.

    Args:
        session: Case and logs of the arm.
        start: Fits of each joint alone, as one of the arm.
        progress: Called with a line of text.

    Returns:
        The fit, and the joints, from 0, at which it leaves more than noise; None if it would take too long,
        or did not converge.
    """
    if why_not_whole(session.machine, parts_of(session), None):
        return None
    progress("fitting the declared model to the whole arm")
    return _by_whole(session, session.machine, start.theta)


def without_unneeded(
    found: Mapping[int, Discovery], needed: set[int]
) -> tuple[dict[int, Discovery], tuple[str, ...]]:
    """Return the searches of joints without the effects of joints that the declared model explains.

    Args:
        found: Search of each joint.
        needed: The joints at which the declared model leaves more than noise of the whole arm.

    Returns:
        The searches, and a note on each effect that was left out.
    """
    out, notes = dict(found), []
    for joint, d in found.items():
        if joint in needed or not d.effects:
            continue
        out[joint] = replace(d, effects=(), rounds=d.rounds[:1], after=d.before, gaps_after=d.gaps_before)
        notes += [
            f"{e.kind}[{joint + 1}] was not added, at {e.score.evidence:.0f} nats for the joint alone: "
            "fitted to the whole arm at once, the declared model leaves no more than noise there"
            for e in d.effects
        ]
    return out, tuple(notes)


def with_fewest(
    arm: ArmSearch, found: Mapping[int, Discovery], progress: Callable[[str], None]
) -> tuple[dict[int, Discovery], Estimate | None, tuple[str, ...]]:
    """Fit the whole arm with what was found at its joints, without the effects that it does not need.

    Effects are left out one by one, the one with the least evidence first, if the arm with the others leaves
    no more than noise. The last one stays: the declared model was fitted before.

    Args:
        arm: The search.
        found: Search of each joint, of an arm whose declared model leaves more than noise.
        progress: Called with a line of text.

    Returns:
        The searches, the fit of the whole arm with what is left, and a note on each effect that was left out.
        The fit is None if none converged.
    """
    progress("fitting the whole arm with what was found")
    machine, start = arm.start_of_whole(found)
    whole = _by_whole(arm.session, machine, start)
    out, after, notes = dict(found), None if whole is None else whole[0], []
    tried: list[Score] = []
    while sum(len(d.effects) for d in out.values()) > 1:
        effects = [(e.score, joint, k) for joint, d in out.items() for k, e in enumerate(d.effects)]
        left = [entry for entry in effects if all(entry[0] is not score for score in tried)]
        if not left:
            break
        score, joint, k = min(left, key=lambda entry: entry[0].evidence)
        tried.append(score)
        name = f"{out[joint].effects[k].kind}[{joint + 1}]"
        progress(f"fitting the whole arm without {name}")
        less = arm.without(out, joint, k)
        machine, start = arm.start_of_whole(less)
        fitted = _by_whole(arm.session, machine, start)
        if fitted is None or fitted[1]:
            continue
        out, after = less, fitted[0]
        notes.append(
            f"{name} was not added, at {score.evidence:.0f} nats for the joint alone: fitted to the whole "
            "arm at once, the model with the other effects leaves no more than noise"
        )
    return out, after, tuple(notes)


def _by_whole(
    session: Session, machine: Machine, start: Float[np.ndarray, " p"]
) -> tuple[Estimate, set[int]] | None:
    """Fit a machine to the whole arm; return the fit and the joints at which it leaves more than noise.

    None if it does not converge.
    """
    stated, demands = session.case.output_error, session.case.identification
    options = {"minimiser": stated.minimiser, "hessian": demands.hessian}
    parts = [part_of(run, machine) for run in session.fits]
    fit = run_alone(whole_steps(machine, parts, start=start, **options))
    if not fit.converged:
        return None
    return fit, open_joints(session, fit.machine, gaps(fit.machine, session.fits))
