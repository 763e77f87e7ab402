"""Friction that fades just above rest, tried where the starts from rest show a break-away friction.

Both delay a start. A search in forces leaves out the samples around a rest, in which they differ. The filter
of `prediction_error` takes samples much nearer to a rest: its likelihood separates the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery.at_rest.break_away import BreakAway, with_break_away
from jaxid.estimators.choice import choose_method
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.prediction_error import prediction_error
from jaxid.machine import Machine
from jaxid.model.unknowns import free_effect
from jaxid.session import Session
from jaxid.simulation.sensor_noise import force_noise

# Velocities at which the friction fades, from which fits start, as parts of the way from the slowest motion
# that counts to the typical one, on a logarithmic scale.
_STARTS = (0.25, 0.6)
# Least gain in log-likelihood over the model without it and over a break-away friction [nats], and standard
# deviations by which strength and velocity must differ from zero. `truth`'s lift of 60 kg: 923 nats with such
# a friction, of which a break-away friction imitates 156.
_EVIDENCE, _SURE = 50.0, 3.0
# Break-away frictions that are compared, as parts of that which the starts from rest show. The likelihood is
# rough in the level, as each start comes with one sample or the next: several must be tried.
_LEVELS = (0.7, 0.8, 0.9, 1.0)


@dataclass(frozen=True)
class Fading:
    """A friction that fades just above rest, and the fit with it.

    Args:
        estimate: The fit.
        candidate: The effect.
        names: Names of its unknowns.
        values: Their values.
        evidence: Gain in log-likelihood over the model without it [nats].
    """

    estimate: Estimate
    candidate: cand.Candidate
    names: tuple[str, ...]
    values: np.ndarray
    evidence: float


def fading_friction(
    session: Session, estimate: Estimate, superset: cand.CandidateModel, port: int, found: BreakAway
) -> Fading | None:
    """Fit a friction that fades just above rest at a joint, beside a model without it.

    Args:
        session: Case and log.
        estimate: The model without it.
        superset: Machine with all candidates.
        port: The joint.
        found: The break-away friction that the starts from rest show.

    Returns:
        The fit; None if `prediction_error` does not suit the log, if the case has such a friction already or
        does not search for one, or if the likelihood does not clearly prefer it to the break-away friction.
    """
    machine = estimate.machine
    rivals = [
        c
        for c in superset.candidates
        if c.port == port and cand.effect_of(superset, c).stribeck_velocity is not None
    ]
    declared = any(e.port == port and e.stribeck_velocity is not None for e in machine.plant.effects)
    method = choose_method(session.with_machine(machine)).method
    if not rivals or declared or session.more or method != "prediction_error":
        return None
    without = _fitted(session, machine, estimate.theta)
    if not without.converged:
        return None

    slow = session.fit.data.recipe.rest_velocity[port]
    usual = float(np.sqrt(np.mean(np.square(session.fit.data.qd[:, port]))))
    tried = []
    for c in rivals:
        for part in _STARTS:
            values = np.where(c.amplitude, found.level, slow * (usual / slow) ** part)
            tried.append(_with_friction(session, machine, without, superset, c, values))
    best = max(tried, key=lambda fading: fading.evidence if fading.estimate.converged else -np.inf)
    if not _is_clear(best):
        return None
    # A friction that fades imitates a break-away friction, and gains by that too.
    imitated = max(_gain_of_break_away(session, without, part * found.level, port) for part in _LEVELS)
    return best if best.evidence > imitated + _EVIDENCE else None


def _gain_of_break_away(session: Session, without: Estimate, level: float, port: int) -> float:
    """Return the gain in log-likelihood by a break-away friction of a known level [nats]."""
    plant = with_break_away(without.machine.plant, level, port)
    fit = _fitted(session, without.machine.with_plant(plant, without.machine.parameters), without.theta)
    return _gain(fit, without)


def _with_friction(
    session: Session,
    machine: Machine,
    without: Estimate,
    superset: cand.CandidateModel,
    c: cand.Candidate,
    values: np.ndarray,
) -> Fading:
    """Fit a model with a friction from a start."""
    plant, free = free_effect(machine.plant, cand.effect_at(superset, c, values), machine.units)
    wider = machine.with_plant(plant, machine.parameters.extended(free))
    fit = _fitted(session, wider, np.concatenate([without.theta, values]))
    return Fading(fit, c, tuple(f.name for f in free), fit.theta[-len(free) :], _gain(fit, without))


def _gain(fit: Estimate, without: Estimate) -> float:
    """Return the gain in log-likelihood of a fit over another one [nats]; minus infinity if it is unknown."""
    # Readings that a fit leaves out would count as likely.
    if not fit.converged or fit.samples != without.samples:
        return -np.inf
    return float(fit.details["log_likelihood"] - without.details["log_likelihood"])


def _fitted(session: Session, machine: Machine, start: Sequence[float] | np.ndarray) -> Estimate:
    run = session.fit
    return prediction_error(
        machine,
        run.log,
        start=np.asarray(start),
        rest_velocity=np.asarray(run.data.recipe.rest_velocity),
        command_noise=force_noise(machine, run.data),
        alone=True,
    )


def _is_clear(fading: Fading) -> bool:
    """Check that a fit converged, that its likelihood gained enough, and that its unknowns are not zero."""
    own = slice(-len(fading.values), None)
    std = fading.estimate.precision.std[own]
    known = fading.estimate.identifiable[own] & np.isfinite(std)
    clear = np.abs(fading.values) > _SURE * np.where(known, std, np.inf)
    return fading.estimate.converged and fading.evidence > _EVIDENCE and bool(np.all(clear))
