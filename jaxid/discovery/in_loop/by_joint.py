"""Search for what an arm of servos lacks, joint by joint, in logs without a force.

The loop of a whole arm takes hours to search. In its own loop each joint is an axis, whose load is that of
the links along the motion of all joints (`jaxid.estimators.apart`): the measured one at first, and then that
of the simulated arm. Each is searched as an axis is (`jaxid.discovery.in_loop.unforced`), and what was found
is put together on the arm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxid.discovery.candidates import Candidate
from jaxid.discovery.in_loop.afar import FEW
from jaxid.discovery.in_loop.unforced import (
    UNSEEN,
    explored_from,
    open_joints,
    refitted,
    verdict_without_effects,
    where_in_time,
)
from jaxid.discovery.result import Discovery, NamedEffect, Round
from jaxid.discovery.score import Score
from jaxid.errors import InputError
from jaxid.estimators.apart.joint import JointAlone, joints_alone
from jaxid.estimators.apart.loads import with_simulated_loads
from jaxid.estimators.apart.session import session_of_joint
from jaxid.estimators.apart.steps import joint_fits, of_arm
from jaxid.estimators.effort import with_effort
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.several.parts import Part, part_of, parts_of
from jaxid.gap import gaps
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.model.unknowns import free_effect, label
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session
from jaxid.simulation.sensor_noise import position_noise

# Number of times that the loads are renewed before a search and after it: fits and loads come closer.
_RENEWALS = 2


def explore_by_joint(session: Session, *, max_effects: int, progress: Callable[[str], None]) -> Discovery:
    """Run `discover` for logs of an arm without a force, joint by joint.

    Args:
        session: Case and logs; the arm `jaxid.estimators.apart.joint.stands_apart`.
        max_effects: Largest number of effects to add at each joint.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If no joint moves, or the loop of one cannot be simulated.
    """
    progress("fitting the declared model, joint by joint")
    arm = ArmSearch.of(session)
    found: dict[int, Discovery] = {}
    # What is found at one joint changes the forces on the others: the joint that leaves most is the first.
    while left := [joint for joint in arm.by_excess if joint not in found]:
        joint, number = left[0], len(found) + 1
        at_joint = _prefixed(progress, f"{joint_words(session, joint)} ({number} of {len(arm.declared)})")
        found[joint] = arm.searched(joint, max_effects=max_effects, progress=at_joint)
        if found[joint].effects:
            at_joint("simulating the arm with what was found")
            for _ in range(_RENEWALS):
                found = arm.refined(found)
                arm = arm.renewed(found)
    progress("simulating the whole arm")
    return arm.together({joint: found[joint] for joint in sorted(found)})


@dataclass(frozen=True)
class ArmSearch:
    """A search of an arm joint by joint.

    Args:
        session: Case and logs of the arm.
        parts: The fitted logs.
        every: The joints with unknowns, each along the logs in which its command moves.
        declared: Fit of the declared model at each joint that moves.
    """

    session: Session
    parts: Sequence[Part]
    every: Sequence[JointAlone]
    declared: Mapping[int, Estimate]

    @classmethod
    def of(cls, session: Session) -> ArmSearch:
        """Fit the declared model to the logs of an arm.

        Raises:
            InputError: If no joint moves.
        """
        parts = parts_of(session)
        others = [part_of(run, session.machine) for run in session.validations]
        every = [a.in_motion if a.moves else a for a in joints_alone(session.machine, parts, others)]
        moving = [alone for alone in every if alone.moves]
        if not moving:
            hint = "name as reference the columns of the commands, in the order of the joints"
            raise InputError("no joint's command moves in the logs", where=session.case.where, hint=hint)
        fits = _fitted(session, moving)
        arm = cls(session, parts, every, {a.joint: fit for a, fit in zip(moving, fits, strict=True)})
        for _ in range(_RENEWALS):
            arm = arm.renewed({})
        return arm

    @property
    def by_excess(self) -> list[int]:
        """The joints that move, first the one whose fit leaves most over the noise of its encoder."""

        def excess(joint: int) -> float:
            fit = self.declared[joint]
            floor = position_noise(fit.machine, self._alone(joint).parts[0].log)[0]
            return float(np.sqrt(np.mean(np.square(fit.residual)))) / max(float(floor), 1e-300)

        return sorted(self.declared, key=lambda joint: -excess(joint))

    def _alone(self, joint: int) -> JointAlone:
        return next(alone for alone in self.every if alone.joint == joint)

    def renewed(self, found: Mapping[int, Discovery]) -> ArmSearch:
        """Return the arm with the loads of its simulation, and refits of joints to which these come closer.

        Args:
            found: Joints that were searched, which keep their fits.
        """
        open_ones = [a for a in self.every if a.joint in self.declared and a.joint not in found]
        if not open_ones:
            return self
        begun = [a.with_estimate(self.declared[a.joint].theta) for a in open_ones]
        tried = self._with_loads(begun, found)
        fits = dict(zip([a.joint for a in tried], _fitted(self.session, tried), strict=True))
        better = {a.joint: a for a in tried if _squares(fits[a.joint]) < _squares(self.declared[a.joint])}
        declared = {j: fits[j] if j in better else fit for j, fit in self.declared.items()}
        return replace(self, every=[better.get(a.joint, a) for a in self.every], declared=declared)

    def refined(self, found: Mapping[int, Discovery]) -> dict[int, Discovery]:
        """Return searches whose models are refitted with the loads of the arm that was found, if they gain.

        Args:
            found: Search of each joint.
        """
        machine, names = _with_effects(self.session.machine, found)
        joints = [_fuller(alone, machine, found, names) for alone in self.every if alone.joint in found]
        out = dict(found)
        for alone in self._with_loads(joints, found):
            own, d = session_of_joint(self.session, alone), found[alone.joint]
            fit = refitted(own, own.machine, None)
            if _squares(fit) < _squares(d.after):
                out[alone.joint] = replace(d, after=fit)
        return out

    def _with_loads(self, joints: Sequence[JointAlone], found: Mapping[int, Discovery]) -> list[JointAlone]:
        """Return joints with the loads of the simulated arm, with what was found at some of its joints."""
        machine, names = _with_effects(self.session.machine, found)
        known = {**self.declared, **{joint: d.after for joint, d in found.items()}}
        theta = machine.parameters.guess
        for alone in (_fuller(one, machine, found, names) for one in self.every):
            if alone.joint in known:
                theta[alone.index] = alone.of_arm(known[alone.joint].theta)
        return with_simulated_loads(joints, theta, [part_of(run, machine) for run in self.session.runs])

    def searched(self, joint: int, *, max_effects: int, progress: Callable[[str], None]) -> Discovery:
        """Search one joint alone, from the fit of the declared model.

        Args:
            joint: Its number, from 0.
            max_effects, progress: See `explore_by_joint`.
        """
        alone, before = self._alone(joint), self.declared[joint]
        own = session_of_joint(self.session, alone.with_estimate(before.theta))
        return explored_from(own, before, max_effects=max_effects, progress=progress, effort=FEW)

    def together(self, found: Mapping[int, Discovery]) -> Discovery:
        """Return what was found at the joints as the discovery of the arm, simulated as a whole.

        Args:
            found: Search of each joint that was searched, as it came.
        """
        session, machine = self.session, self.session.machine
        final, names = _with_effects(machine, found)
        known = {joint: found[joint].before if joint in found else e for joint, e in self.declared.items()}
        before = of_arm(machine, self.parts, self.every, known)
        known |= {joint: d.after for joint, d in found.items()}
        fuller = [_fuller(alone, final, found, names) for alone in self.every]
        after = of_arm(final, self.parts, fuller, known)
        joints = {joint: _at_joint(session, joint, d, names[joint]) for joint, d in found.items()}
        effects = tuple(effect for d in joints.values() for effect in d.effects)

        old = gaps(before.machine, session.runs)
        new = gaps(after.machine, session.runs) if effects else old
        # The loads of joints alone hold the noise of all encoders: what is left is judged by the whole arm.
        left = open_joints(session, after.machine, new)
        verdicts = {
            joint: "found" if d.effects else verdict_without_effects(joint in left)
            for joint, d in joints.items()
        }
        joints = {joint: replace(d, verdict=verdicts[joint]) for joint, d in joints.items()}
        verdict = _verdict(list(verdicts.values()))
        return Discovery(
            session=session,
            verdict=verdict,
            where=None if verdict == "nothing_missing" else where_in_time(session.fits, old),
            effects=effects,
            rounds=_rounds(joints, machine.plant.joints),
            before=before,
            after=with_effort(after, session, new, searched=True),
            gaps_before=old,
            gaps_after=new,
            noise_floor=np.full(machine.plant.joints, np.nan),
            unseen=UNSEEN,
            joints=joints,
        )


def _fitted(session: Session, joints: Sequence[JointAlone]) -> list[Estimate]:
    """Return the fits of joints, each alone."""
    stated, demands = session.case.output_error, session.case.identification
    return run_alone(joint_fits(joints, minimiser=stated.minimiser, hessian=demands.hessian))


def _squares(fit: Estimate) -> float:
    """Return the squared residual of a fit; infinite if it diverged."""
    total = float(np.sum(np.square(fit.residual)))
    return total if np.isfinite(total) else np.inf


def joint_words(session: Session, joint: int) -> str:
    """Return the number of a joint, with its name if a file has one."""
    names = session.case.plant.names
    return f"joint {joint + 1}, {names[joint]}" if names else f"joint {joint + 1}"


def _prefixed(progress: Callable[[str], None], head: str) -> Callable[[str], None]:
    return lambda text: progress(f"{head}: {text}")


def _with_effects(
    machine: Machine, found: Mapping[int, Discovery]
) -> tuple[Machine, dict[int, list[tuple[str, ...]]]]:
    """Return an arm with the effects that were found at its joints, and the names of their unknowns."""
    plant, parameters = machine.plant, machine.parameters
    names: dict[int, list[tuple[str, ...]]] = {}
    for joint, d in found.items():
        names[joint] = []
        for effect in _added(d):
            plant, free = free_effect(plant, replace(effect, port=joint), machine.units)
            parameters = parameters.extended(free)
            names[joint].append(tuple(f.name for f in free))
    return machine.with_plant(plant, parameters), names


def _added(d: Discovery) -> Sequence[Effect]:
    """Return the effects that a search of one joint added, at their values."""
    return d.after.machine.plant.effects[len(d.session.machine.plant.effects) :]


def _fuller(
    alone: JointAlone,
    final: Machine,
    found: Mapping[int, Discovery],
    names: dict[int, list[tuple[str, ...]]],
) -> JointAlone:
    """Return a joint with the unknowns that its search added."""
    if alone.joint not in found:
        return alone
    added = [final.parameters.names.index(name) for some in names[alone.joint] for name in some]
    index = np.concatenate([alone.index, np.array(added, int)])
    return replace(alone, machine=found[alone.joint].after.machine, index=index)


def _verdict(verdicts: Sequence[str]) -> str:
    """Return the verdict on an arm: what was found at any joint, or else what is open at any."""
    return next((v for v in ("found", "unexplained") if v in verdicts), "nothing_missing")


def _at_joint(session: Session, joint: int, d: Discovery, names: Sequence[tuple[str, ...]]) -> Discovery:
    """Return the search of a joint with the places that its effects have on the arm."""
    plant, known = session.machine.plant, {}

    def moved(c: Candidate) -> Candidate:
        # Results compare candidates by identity.
        if id(c) not in known:
            known[id(c)] = replace(c, port=joint, label=label(plant, c.kind, joint))
        return known[id(c)]

    def scored(score: Score) -> Score:
        return replace(score, candidate=moved(score.candidate))

    def effect(e: NamedEffect, own: tuple[str, ...]) -> NamedEffect:
        ties = tuple(map(scored, e.alternatives))
        at = label(plant, e.kind, joint)
        return replace(
            e, label=at, place=plant.place(joint), names=own, score=scored(e.score), alternatives=ties
        )

    def round_(r: Round) -> Round:
        step = r.step
        added = None if step.added is None else scored(step.added)
        dropped = None if step.dropped is None else moved(step.dropped)
        scores = tuple(map(scored, step.scores))
        return replace(r, step=replace(step, added=added, dropped=dropped, scores=scores))

    effects = tuple(effect(e, own) for e, own in zip(d.effects, names, strict=True))
    return replace(d, effects=effects, rounds=tuple(map(round_, d.rounds)))


def _rounds(joints: Mapping[int, Discovery], count: int) -> tuple[Round, ...]:
    """Return the steps of the searches one after the other, each with what all joints leave after it."""
    fit, validation = np.full(count, np.nan), np.full(count, np.nan)
    for joint, d in joints.items():
        fit[joint], validation[joint] = _left(d.rounds[0])
    first = next(iter(joints.values())).rounds[0]
    none = np.full(count, np.nan)

    def of_arm(r: Round) -> Round:
        beside = None if np.all(np.isnan(validation)) else validation.copy()
        force = None if beside is None else none
        return Round(r.step, none, force, fit.copy(), beside)

    out = [of_arm(first)]
    for joint, d in joints.items():
        for r in d.rounds[1:]:
            fit[joint], validation[joint] = _left(r)
            out.append(of_arm(r))
    return tuple(out)


def _left(r: Round) -> tuple[float, float]:
    """Return the RMS of the position that a step leaves at its joint, on fitted and on validation logs."""
    assert r.position_fit is not None, "a search without a force compares positions"
    others = r.position_validation
    return float(r.position_fit[0]), np.nan if others is None else float(others[0])
