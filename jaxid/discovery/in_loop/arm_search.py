"""State of a search of an arm joint by joint: fits and loads of the joints, and what was found at each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.discovery.candidates import Candidate
from jaxid.discovery.in_loop.afar import FEW
from jaxid.discovery.in_loop.unforced import (
    UNSEEN,
    explored_from,
    open_joints,
    verdict_without_effects,
    where_in_time,
)
from jaxid.discovery.result import Discovery, NamedEffect, Round
from jaxid.discovery.score import Score
from jaxid.errors import InputError
from jaxid.estimators.apart.joint import JointAlone, joints_alone
from jaxid.estimators.apart.loads import with_simulated_loads
from jaxid.estimators.apart.session import session_of_joint
from jaxid.estimators.apart.start import starts_beside
from jaxid.estimators.apart.steps import common_numerics, joint_fits, of_arm, side_by_side
from jaxid.estimators.effort import with_effort
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import output_error_steps
from jaxid.estimators.several.parts import Part, part_of, parts_of
from jaxid.gap import gaps, simulation_of_log
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.model.unknowns import free_effect, label
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session
from jaxid.simulation.sensor_noise import position_noise

# Most renewals of loads and fits before a search and after it.
_RENEWALS = 6
# Most searches of one joint, and the change by which other loads call for one, or a gain for another renewal
# [nats]: a third of what counts as visible in the benchmarks.
_SEARCHES, _NEWS = 3, 10.0
# Factor in RMS over the noise beyond which a fit is tried from other delays.
_FAR = 1.2


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
        return arm.settled({})[0]

    @property
    def by_excess(self) -> list[int]:
        """The joints that move, first the one whose fit leaves most over the noise of its encoder."""
        return sorted(self.declared, key=lambda joint: -self._excess(joint))

    def _excess(self, joint: int) -> float:
        """Return what the fit of a joint leaves over the noise of its encoder."""
        fit = self.declared[joint]
        floor = position_noise(fit.machine, self._alone(joint).parts[0].log)[0]
        return float(np.sqrt(_squares(fit) / max(fit.samples, 1))) / max(float(floor), 1e-300)

    def _alone(self, joint: int) -> JointAlone:
        return next(alone for alone in self.every if alone.joint == joint)

    def settled(self, found: Mapping[int, Discovery]) -> tuple[ArmSearch, dict[int, Discovery]]:
        """Return the arm and its searches with fits and loads renewed until they gain next to nothing.

        Args:
            found: Search of each joint that was searched.
        """
        arm, out = self, dict(found)
        for _ in range(_RENEWALS):
            arm, out, gained = arm.renewed(out)
            if gained < _NEWS:
                arm, gained = arm.at_other_delays(out)
            if gained < _NEWS:
                break
        return arm, out

    def at_other_delays(self, found: Mapping[int, Discovery]) -> tuple[ArmSearch, float]:
        """Return the arm with fits from other delays, where those leave less, and what they gain [nats].

        Args:
            found: Joints that were searched, which keep their fits.
        """
        declared, gained = dict(self.declared), 0.0
        for joint in (j for j in self.by_excess if j not in found and self._excess(j) > _FAR):
            alone = self._alone(joint).with_estimate(declared[joint].theta)
            starts = [alone.with_estimate(start) for start in starts_beside(alone)]
            old = declared[joint]
            best = min([old, *_refitted(self.session, starts)], key=_squares)
            if best is not old:
                gained += _gained(old, best)
                declared[joint] = best
        return replace(self, declared=declared), gained

    def renewed(self, found: Mapping[int, Discovery]) -> tuple[ArmSearch, dict[int, Discovery], float]:
        """Return the arm with the loads of its simulation, and refits of the joints that gain by them.

        Args:
            found: Search of each joint that was searched, whose effects are refitted.

        Returns:
            The arm, the searches, and the gain in log-likelihood [nats].
        """
        machine, names = _with_effects(self.session.machine, found)
        known = {**self.declared, **{joint: d.after for joint, d in found.items()}}
        joints = [
            _fuller(alone, machine, found, names).with_estimate(known[alone.joint].theta)
            for alone in self.every
            if alone.joint in known
        ]
        tried = self._with_loads(joints, found)
        gained, every = 0.0, {alone.joint: alone for alone in self.every}
        declared, out = dict(self.declared), dict(found)
        # A declared model that lacks less now may fit best in another valley: it starts anew.
        parted = [[a for a in tried if (a.joint in found) is done] for done in (False, True)]
        fits = [*_fitted(self.session, parted[0]), *_refitted(self.session, parted[1])]
        for alone, fit in zip([*parted[0], *parted[1]], fits, strict=True):
            joint, old = alone.joint, known[alone.joint]
            if not _squares(fit) < _squares(old):
                continue
            gained += _gained(old, fit)
            if joint in found:
                out[joint] = replace(found[joint], after=fit)
            else:
                declared[joint], every[joint] = fit, alone
        return replace(self, every=list(every.values()), declared=declared), out, gained

    def waiting(self, found: Mapping[int, Discovery], searches: Mapping[int, int]) -> list[int]:
        """Return the joints to search: new ones, or where a search ended at a spring, or with other loads.

        Args:
            found: Search of each joint that was searched.
            searches: How often each joint was searched.
        """
        new = [joint for joint in self.by_excess if joint not in found]
        # The first search of a joint ends at a spring: links behind it change the loads of all joints, and
        # the arm is simulated with it before the next one.
        new = new or [joint for joint in self.by_excess if searches[joint] == 1 and _has_spring(found[joint])]
        again = [joint for joint in self.by_excess if searches[joint] < _SEARCHES]
        if new or not again:
            return new
        now = self._with_loads([self._alone(joint) for joint in again], found)
        return [j for j, alone in zip(again, now, strict=True) if _moved(found[j], alone) > _NEWS]

    def reopened(self, joint: int, found: Mapping[int, Discovery]) -> ArmSearch:
        """Return the arm with a fit of the declared model of a joint under the loads of what was found.

        Args:
            joint: Its number, from 0.
            found: Search of each joint, with that of this one.
        """
        begun = self._alone(joint).with_estimate(self.declared[joint].theta)
        (alone,) = self._with_loads([begun], found)
        (fit,) = _fitted(self.session, [alone])
        every = [alone if a.joint == joint else a for a in self.every]
        return replace(self, every=every, declared={**self.declared, joint: fit})

    def _with_loads(self, joints: Sequence[JointAlone], found: Mapping[int, Discovery]) -> list[JointAlone]:
        """Return joints with the loads of the simulated arm, with what was found at some of its joints."""
        machine, theta = self.start_of_whole(found)
        return with_simulated_loads(joints, theta, [part_of(run, machine) for run in self.session.runs])

    def searched(
        self, joint: int, *, max_effects: int, progress: Callable[[str], None], to_spring: bool
    ) -> Discovery:
        """Search one joint alone, from the fit of the declared model.

        Args:
            joint: Its number, from 0.
            max_effects, progress: See `jaxid.discovery.in_loop.by_joint.explore_by_joint`.
            to_spring: See `explored_from`.
        """
        alone, before = self._alone(joint), self.declared[joint]
        own = session_of_joint(self.session, alone.with_estimate(before.theta))
        # The arm as a whole is judged at the end.
        return explored_from(
            own,
            before,
            max_effects=max_effects,
            progress=progress,
            effort=FEW,
            judged=False,
            to_spring=to_spring,
        )

    def without(self, found: Mapping[int, Discovery], joint: int, effect: int) -> dict[int, Discovery]:
        """Return the searches without one effect, with the other values of its joint refitted.

        Args:
            found: Search of each joint that was searched.
            joint: The joint, from 0.
            effect: Number of its effect, from 0.
        """
        d = found[joint]
        plant, parameters = d.session.machine.plant, d.session.machine.parameters
        known = dict(zip(d.after.names, d.after.theta.tolist(), strict=True))
        values = [known[name] for name in parameters.names]
        kept, added = [], []
        for k, (named, there) in enumerate(zip(d.effects, _added(d), strict=True)):
            if k == effect:
                continue
            plant, free = free_effect(plant, there, d.session.machine.units)
            parameters = parameters.extended(free)
            values += [known[name] for name in named.names]
            kept.append(replace(named, names=tuple(f.name for f in free)))
            added.append(named.score.candidate)
        machine = d.session.machine.with_plant(plant, parameters).with_estimate(np.array(values))
        rounds = [r for k, r in enumerate(d.rounds) if k == 0 or _adds_one_of(r, added)]
        less = replace(d, effects=tuple(kept), rounds=tuple(rounds), after=replace(d.after, machine=machine))

        out = {**found, joint: less}
        final, names = _with_effects(self.session.machine, out)
        alone = _fuller(self._alone(joint), final, out, names).with_estimate(np.array(values))
        (fit,) = _refitted(self.session, [alone])
        out[joint] = replace(less, after=fit)
        return out

    def start_of_whole(self, found: Mapping[int, Discovery]) -> tuple[Machine, Float[np.ndarray, " p"]]:
        """Return the arm with what was found at its joints, and the values of their fits, (p,)."""
        machine, names = _with_effects(self.session.machine, found)
        known = {**self.declared, **{joint: d.after for joint, d in found.items()}}
        theta = machine.parameters.guess
        for alone in (_fuller(one, machine, found, names) for one in self.every):
            if alone.joint in known:
                theta[alone.index] = alone.of_arm(known[alone.joint].theta)
        return machine, theta

    def together(
        self,
        found: Mapping[int, Discovery],
        *,
        before: Estimate | None = None,
        after: Estimate | None = None,
        notes: tuple[str, ...] = (),
    ) -> Discovery:
        """Return what was found at the joints as the discovery of the arm, simulated as a whole.

        Args:
            found: Search of each joint that was searched, as it came.
            before, after: Fits to the whole arm of the declared model and of that with what was found; None:
                those of the joints alone.
            notes: Remarks for a user.
        """
        session, machine = self.session, self.session.machine
        final, names = _with_effects(machine, found)
        known = {joint: found[joint].before if joint in found else e for joint, e in self.declared.items()}
        before = before or of_arm(machine, self.parts, self.every, known)
        known |= {joint: d.after for joint, d in found.items()}
        fuller = [_fuller(alone, final, found, names) for alone in self.every]
        after = after or of_arm(final, self.parts, fuller, known)
        after = replace(after, notes=(*after.notes, *notes))
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


def _refitted(session: Session, joints: Sequence[JointAlone]) -> list[Estimate]:
    """Return the fits of joints from their values, each alone."""
    demands = session.case.identification
    numerics = common_numerics(joints)
    fits = [
        output_error_steps(
            alone.machine,
            alone.parts,
            start=alone.machine.parameters.guess,
            numerics=numerics,
            minimiser=session.case.output_error.minimiser,
            hessian=demands.hessian,
        )
        for alone in joints
    ]
    return run_alone(side_by_side(fits))


def _moved(found: Discovery, alone: JointAlone) -> float:
    """Return half of the squares by which loads move a joint with what was found, over its noise [nats].

    Args:
        found: Its search, which had other loads.
        alone: The joint with the loads.
    """
    total = 0.0
    for run, part in zip(found.session.fits, alone.parts, strict=True):
        machine = run.machine(found.after.machine)
        loaded = replace(machine, load=part.machine.load, held_load=part.machine.held_load)
        before, after = (simulation_of_log(m, run.log) for m in (machine, loaded))
        if before is None or after is None:
            return np.inf
        change = (after.position - before.position) / position_noise(machine, run.log)
        total += 0.5 * float(np.sum(np.square(change)))
    return total if np.isfinite(total) else np.inf


def _gained(old: Estimate, new: Estimate) -> float:
    """Return what a fit gains in log-likelihood over an older one [nats]."""
    return 0.5 * new.samples * float(np.log(_squares(old) / max(_squares(new), 1e-300)))


def _squares(fit: Estimate) -> float:
    """Return the squared residual of a fit; infinite if it diverged."""
    # Readings that do not count, of a joint at rest, have no residual.
    counted = fit.residual[np.isfinite(fit.residual)]
    return float(np.sum(np.square(counted))) if counted.size == fit.samples else np.inf


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


def _adds_one_of(r: Round, added: Sequence[Candidate]) -> bool:
    """Check that a step of a search added one of some candidates."""
    return r.step.added is not None and any(r.step.added.candidate is c for c in added)


def _has_spring(d: Discovery) -> bool:
    """Check that a search added a spring."""
    return any(effect.adds_spring for effect in _added(d))


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
    machine = found[alone.joint].after.machine
    added = [final.parameters.names.index(name) for some in names[alone.joint] for name in some]
    index = np.concatenate([alone.index, np.array(added, int)])
    session = found[alone.joint].session
    parts, others = (
        tuple(part_of(run, machine) for run in some) for some in (session.fits, session.validations)
    )
    return replace(alone, machine=machine, parts=parts, others=others, index=index)


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
