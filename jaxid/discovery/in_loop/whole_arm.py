"""Check of what was found at the joints of an arm, each alone, by a fit of the whole arm.

A joint alone has the forces of the links along another motion than its own. What these forces get wrong may
look like an effect. In the loop of the whole arm they are right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from jaxid.discovery.in_loop.unforced import open_joints
from jaxid.discovery.result import Discovery
from jaxid.estimators.apart.whole import whole_steps, why_not_whole
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.several.parts import parts_of
from jaxid.gap import gaps
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
    parts = parts_of(session)
    if why_not_whole(session.machine, parts, None):
        return None
    progress("fitting the declared model to the whole arm")
    stated, demands = session.case.output_error, session.case.identification
    options = {"minimiser": stated.minimiser, "hessian": demands.hessian}
    fit = run_alone(whole_steps(session.machine, parts, start=start.theta, **options))
    if not fit.converged:
        return None
    return fit, open_joints(session, fit.machine, gaps(fit.machine, session.fits))


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
