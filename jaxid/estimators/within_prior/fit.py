"""Output error under a prior, in the directions that a log identifies.

A short log does not identify all unknowns. If they were all fitted, they would run away along flat
directions of the cost, and take identifiable ones with them. Here each guess is the centre of a prior with a
stated relative width. Combinations of unknowns that the log identifies better than the prior are fitted; the
others move only as far as prior and log together make more probable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.estimators.common.best_bodies import NEAREST, nearest_bodies
from jaxid.estimators.common.minimisers import Minimiser, minimiser_of
from jaxid.estimators.common.profile import need_names
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.several.parts import Part, by_log
from jaxid.estimators.several.weights import disagreement
from jaxid.estimators.simulated_output import choose_numerics, kept_delay, notes_of
from jaxid.estimators.within_prior.evaluations import BLOCK, DRAWS, linearise, precompile_residuals_at
from jaxid.estimators.within_prior.multistart import (
    fit_from_many_starts,
    likeliest_prior_draws,
    random_starts,
)
from jaxid.estimators.within_prior.posterior import (
    laplace_covariance,
    maximum_a_posteriori,
    negative_log_posterior,
    posterior_second_moment,
    restarted_maximum_a_posteriori,
)
from jaxid.estimators.within_prior.precision import (
    SubspacePrecision,
    add_profiles,
    cost_hessian,
    information_root,
    parameter_precision,
    precision_of_directions,
    profiles_of,
    rows_of,
    with_prior,
)
from jaxid.estimators.within_prior.problem import Problem
from jaxid.estimators.within_prior.quantisation import (
    fit_with_quantisation,
    omits_quantisation,
    precompile_quantised,
    quantised_residuals,
)
from jaxid.estimators.within_prior.subspace import (
    KEPT_STD,
    SubspaceFit,
    fit_in_subspace,
    identifiable_directions,
)
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics.full_hessian import hessian_covariance
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import FULL_HESSIAN, LAPLACE, POSTERIOR, Precision, hessian_notes
from jaxid.numerics.rows import Rows
from jaxid.simulation.replay import Numerics

# Number of random points from which the fit restarts if no direction is identifiable at the guesses.
_RESTARTS = 3
# A simulation without quantisation represents the loop if quantisation moves the output by at most this
# fraction of its variance.
_REPRESENTED = 0.1


def within_prior_steps(
    machine: Machine,
    log: Log | Sequence[Part],
    *,
    prior: float,
    on: str = "position",
    starts: int = 1,
    others: Sequence[np.ndarray] = (),
    hessian: bool = False,
    profile: bool = False,
    profile_of: Sequence[str] = (),
    numerics: Numerics | None = None,
    widths: Mapping[str, float] | None = None,
    begin: np.ndarray | None = None,
    drawn: bool = True,
    minimiser: str | Minimiser | None = None,
) -> Steps[Estimate]:
    """Fit the identifiable combinations of the unknowns in the loop, and leave the others to the prior.

    Args:
        machine: The machine; its controller closes the loop, which begins at rest. If links must be those of
            real bodies, the fit is without this demand and ends at the nearest such bodies.
        log: The log to fit, or the parts of several. Each column of each of them counts over its spread.
        prior: Relative standard deviation of the guesses.
        on: Output that is compared: "position", "force" or "both". For the latter two the loop is simulated
            without quantisation of the readings: the count of a simulated reading is random for a coarse
            encoder, and the cost with quantisation has many narrow local minima.
        starts: Number of starts within `prior` of the guesses, to check that they reach the same optimum.
        others: More starts, each as values of the unknowns, (p,).
        hessian: Take the curvature from the full Hessian in place of Gauss-Newton's.
        profile: Add profile likelihoods of the fitted directions.
        profile_of: Names of the unknowns whose profile likelihood is added.
        numerics: Integration settings; chosen from machine and log if absent.
        widths: Standard deviations of single guesses, by name; of the logarithm for positive unknowns.
        begin: Start of the fit, as values of the unknowns; absent: the best of many points about the guesses.
        drawn: Sample the posterior, and simulate encoder quantisation. Without it standard deviations are
            those of Laplace's approximation for a loop without quantisation, in a fraction of the time.
        minimiser: Name in `jaxid.estimators.common.minimisers.MINIMISERS`, or a solver of optimistix, for the
            descents from one start; absent: jaxid's Levenberg-Marquardt.

    Returns:
        The estimate. Standard deviations include what remains of the prior along other directions, and its
        effect on the fitted ones; `details["directions"]` has the combinations and their standard deviations.

    Raises:
        InputError: If the loop cannot be simulated, or a guess is zero; if quantisation would be drawn for
            several logs.

    Source:
        Precision: Bogdan and Abba, (12)-(27), with the residual's colour in place of white noise.
        (27) lacks the inverse of B: 100 (sigma^2 diag B^-1)^(1/2) / theta.
    """
    need_names(profile_of, machine.parameters.names)
    parts = [Part.alone(machine, log)] if isinstance(log, Log) else list(log)
    chosen = [numerics or choose_numerics(part.machine, part.log) for part in parts]
    numerics = replace(chosen[0], substeps=max(each.substeps for each in chosen))
    problem = _problem(machine, parts, prior, on, numerics, widths)
    problem = replace(problem, minimiser=minimiser_of(minimiser))
    quantised = omits_quantisation(machine, problem)
    if problem.logs and drawn and quantised:
        raise InputError(
            "the quantisation of the readings is drawn for one log, and there are several",
            where="within_prior",
            hint='set drawn = false, or on = "position"',
        )

    given = [problem.prior.inward(problem.padded(t)) for t in others]
    first = None if begin is None else problem.prior.inward(problem.padded(begin))
    fit, precision, multistart = yield from _search(machine, problem, first, starts, given, drawn)

    # Hessian and profiles are of the loop without quantisation.
    exact = precision is not None and not (drawn and quantised)
    notes = [
        *notes_of(parts[0].machine, numerics, parts[0].log, on, minimiser),
        f"{fit.count} directions of {len(problem.places)} unknowns fitted, the others are left to the prior",
    ]
    if precision is not None and exact and hessian:
        precision = yield from _with_full_hessian(fit, precision)
    whole, stated = parameter_precision(machine, fit, precision)
    if exact or precision is None:
        notes += hessian_notes(whole, hessian)
    details: dict[str, Any] = {"directions": stated}

    if exact and profile:
        notes += yield from add_profiles(fit, fit.problem.noise(fit.minimum, fit.count), stated)
    if exact and profile_of:
        details["profiles"], remarks = yield from profiles_of(machine, fit, whole, profile_of)
        notes += remarks
    if quantised:
        asked = {"full Hessian": hessian, "profiles": profile or profile_of}
        notes += _quantisation_notes(drawn, precision is not None, [name for name in asked if asked[name]])

    if problem.logs and precision is not None:
        logs = rows_of(fit)
        notes += disagreement(logs, fit.count)
        details |= by_log(parts, _facts_by_log(fit, logs))
    details |= multistart | kept_delay(machine, numerics)
    estimate = _estimate(machine, fit, whole, tuple(notes), details)
    if not machine.parameters.bodies or not np.all(np.isfinite(estimate.theta)):
        return estimate
    return _at_bodies(estimate, machine, information_root(fit, precision))


def _at_bodies(estimate: Estimate, machine: Machine, root: np.ndarray) -> Estimate:
    """Return an estimate at the nearest real bodies.

    Args:
        estimate: Estimate without the demand.
        machine: The machine that was fitted, whose links must be those of real bodies.
        root: R, with R'R the information on the unknowns by log and prior, (p, p).
    """
    theta, found = nearest_bodies(machine.parameters, root, estimate.theta)
    message = estimate.message if found else "the search for the nearest real bodies did not converge"
    return replace(
        estimate,
        machine=machine.with_estimate(theta),
        theta=theta,
        converged=estimate.converged and found,
        message=message,
        notes=(*estimate.notes, f"{NEAREST}; criterion and residual are those before"),
    )


def _facts_by_log(fit: SubspaceFit, logs: Sequence[Rows]) -> list[dict[str, Any]]:
    """Return the number of samples of each log and, if one column counts, the noise of it."""
    entries = []
    for fitted, rows in zip(logs, fit.problem.slices, strict=True):
        entry: dict[str, Any] = {"samples": int(fitted.counts.sum())}
        weights = fit.problem.weight[rows][0]
        if np.sum(weights > 0) == 1:
            entry["noise"] = float(fitted.equivalent_variance() ** 0.5 / weights.max())
        entries.append(entry)
    return entries


def _problem(
    machine: Machine,
    parts: Sequence[Part],
    prior: float,
    on: str,
    numerics: Numerics,
    widths: Mapping[str, float] | None,
) -> Problem:
    """Set up the fit of one log or of several; see `within_prior_steps`."""
    if len(parts) == 1:
        return Problem.of(machine, parts[0].log, prior, on, numerics, widths)
    logs = [
        (part.name, Problem.of(part.machine, part.log, prior, on, numerics, widths), part.index)
        for part in parts
    ]
    return Problem.joint(machine, prior, logs, widths)


def _quantisation_notes(drawn: bool, identifiable: bool, more: Sequence[str]) -> list[str]:
    """Return the notes about a loop with quantised readings.

    Args:
        drawn: Whether quantisation was simulated.
        identifiable: Whether any direction is identifiable.
        more: Other forms of the precision that were asked for.
    """
    if not drawn:
        return ["drawn = false: values and standard deviations leave out the quantisation of the readings"]
    if not identifiable:
        return []
    notes = [
        "the mean effect of the quantisation of the readings was removed; criterion and residual are those "
        "of the fit before that"
    ]
    if more:
        verb = "was" if len(more) == 1 and more[0] == "full Hessian" else "were"
        notes.append(
            f"{' and '.join(more)} {verb} not computed: the readings are rounded, and the cost of a loop "
            "with rounded readings has steps in place of a curvature; the covariance comes from simulated "
            "rounding"
        )
    return notes


def _estimate(
    machine: Machine,
    fit: SubspaceFit,
    precision: Precision,
    notes: tuple[str, ...],
    details: dict[str, Any],
) -> Estimate:
    """Build the estimate from a fit and its precision."""
    problem, minimum = fit.problem, fit.minimum
    theta = np.asarray(problem.prior.outward(fit.point))[: len(problem.places)]
    e, counts = np.asarray(minimum.residual).reshape(problem.measured.shape), problem.weight > 0
    message = "converged" if fit.settled else "the fit within the prior did not converge"
    if not fit.settled and not (np.isfinite(float(minimum.cost)) and np.all(np.isfinite(minimum.jacobian))):
        message = "the simulation is not finite at the end of the fit"
    of_cost = {"criterion_percent": problem.criterion(minimum), "effective_parameters": fit.effective}
    return Estimate(
        method="within_prior",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=fit.settled,
        message=message,
        residual=np.where(counts, e / np.where(counts, problem.weight, 1.0), np.nan),
        samples=int(counts.sum()),
        steps=fit.evaluations,
        notes=notes,
        details=details | of_cost,
    )


def _with_full_hessian(fit: SubspaceFit, precision: SubspacePrecision) -> Steps[SubspacePrecision]:
    """Return the precision by the full Hessian of the negative log-posterior, if it is positive definite."""
    z, noise = np.asarray(fit.minimum.theta), fit.problem.noise(fit.minimum, fit.count)
    args = (fit.problem.residual, fit.problem.sharpnesses[-1], fit.vectors, z)
    full = np.asarray((yield SolveRequest(cost_hessian, args))) / noise**2 + np.eye(z.size)
    jacobian = np.asarray(fit.minimum.jacobian) / noise
    normal = jacobian.T @ jacobian + np.eye(z.size)
    covariance, curvature = hessian_covariance(normal, normal, full)
    precision = replace(precision, curvature=curvature)
    if covariance is None:
        return precision
    whitened = fit.vectors @ covariance @ fit.vectors.T
    of_hessian = with_prior(fit, precision_of_directions(fit), whitened, FULL_HESSIAN)
    return replace(of_hessian, curvature=curvature)


def _search(
    machine: Machine,
    problem: Problem,
    first: np.ndarray | None,
    starts: int,
    given: Sequence[np.ndarray],
    drawn: bool,
) -> Steps[tuple[SubspaceFit, SubspacePrecision | None, dict[str, Any]]]:
    """Search for the optimum from all starts.

    Args:
        machine: The machine to fit.
        problem: The problem to fit.
        first: Start in whitened coordinates; None: the best of many points about the guesses.
        starts: Number of random starts.
        given: More starts, in whitened coordinates.
        drawn: Sample the posterior, and simulate quantisation.

    Returns:
        The fit; its precision, None if no direction is identifiable; and the details of the multistart.
    """
    if drawn or first is None:
        yield precompile_residuals_at(problem)
    most = problem.prior.base.size
    if omits_quantisation(machine, problem):
        # Quantisation leaves few directions identifiable in the end, and the others with many local minima.
        most = BLOCK
        if drawn:
            yield precompile_quantised(machine, problem)

    start = np.zeros(problem.prior.base.size) if first is None else first
    fit = yield from fit_in_subspace(problem, start, most, search_start=first is None)
    multistart: dict[str, Any] = {}
    if starts > 1 or given:
        points = np.array([*given, *random_starts(problem, starts)])
        fit, multistart = yield from fit_from_many_starts(fit, points, most)

    fit, precision = yield from _posterior_fit(machine, fit, drawn)
    if precision is None and not multistart:
        # A machine that sticks at the guesses or close to them gives no gradient there.
        fit = yield from _restarted(fit, drawn)
        fit, precision = yield from _posterior_fit(machine, fit, drawn)
    return fit, precision, multistart


def _restarted(fit: SubspaceFit, drawn: bool) -> Steps[SubspaceFit]:
    """Fit from a few likely points too and return the most probable of all fits.

    Points at which the simulation is not finite are skipped, and so is the given fit if its own is not.
    """
    problem, best = fit.problem, fit
    for w in (yield from likeliest_prior_draws(problem, _RESTARTS)):
        here = yield from linearise(problem, problem.sharpnesses[-1], w)
        if not np.all(np.isfinite(here.jacobian)):
            continue
        if not np.all(np.isfinite(best.minimum.jacobian)):
            best = fit = SubspaceFit(
                problem=problem,
                vectors=np.eye(w.size),
                count=0,
                minimum=here,
                evaluations=fit.evaluations,
                settled=False,
            )
        noise = best.noise
        fit = yield from _maximum_a_posteriori_fit(fit, w, drawn)
        best = min(best, fit, key=lambda f: negative_log_posterior(noise, f.minimum, f.point))
    return replace(best, evaluations=fit.evaluations)


def expected_covariance_steps(
    machine: Machine, problem: Problem, noise: Float[np.ndarray, " k"]
) -> Steps[Float[np.ndarray, "q q"]]:
    """Predict the posterior covariance for a loop with quantised readings, simulated at the guesses.

    Args:
        machine: The machine, whose sensor quantises.
        problem: The problem to be fitted, with a measured output of zero.
        noise: Standard deviation of the sensor noise beside quantisation, by column, over the weight, (k,).

    Returns:
        Covariance of all unknowns in whitened coordinates, (q, q). It is the prior's if nothing is
        identifiable, or if quantisation moves the loop so far that a fit without it does not converge.
    """
    rng, guesses = np.random.default_rng(0), np.zeros((DRAWS, problem.prior.base.size))
    # A residual is the measured output less the simulated one, and the measured output is zero.
    exact = -(yield from quantised_residuals(machine, problem, np.random.default_rng(4)))[0]
    exact = exact.reshape(problem.measured.shape)
    log = exact + noise * rng.standard_normal(exact.shape)
    problem = replace(problem, measured=log / problem.weight)

    minimum = yield from linearise(problem, problem.sharpnesses[-1], guesses[0])
    without = log - np.asarray(minimum.residual).reshape(log.shape)
    if np.any(np.var(exact - without, axis=0) > _REPRESENTED * np.var(without, axis=0)):
        return np.eye(len(guesses[0]))

    jacobian = np.asarray(minimum.jacobian)
    vectors, count = identifiable_directions(jacobian / problem.noise(minimum, 0), 0)
    minimum = replace(minimum, theta=vectors.T @ guesses[0], jacobian=jacobian @ vectors)
    if count:
        fit = SubspaceFit(
            problem=problem, vectors=vectors, count=count, minimum=minimum, evaluations=1, settled=True
        )
        _, precision = yield from fit_with_quantisation(machine, fit)
        if precision is not None and precision.whitened_covariance is not None:
            return precision.whitened_covariance
    return np.eye(len(vectors))


def _posterior_fit(
    machine: Machine, fit: SubspaceFit, drawn: bool
) -> Steps[tuple[SubspaceFit, SubspacePrecision | None]]:
    """Move a fit to the maximum a posteriori and compute the precision of its directions there.

    Args:
        machine: The machine to fit.
        fit: The fit in the subspace.
        drawn: Sample the posterior, and simulate quantisation; else take Laplace's approximation.
    """
    if not np.all(np.isfinite(fit.minimum.jacobian)):
        return fit, None
    fit = yield from _maximum_a_posteriori_fit(fit, fit.point, drawn)
    if not fit.count:
        return fit, None
    if drawn and omits_quantisation(machine, fit.problem):
        return (yield from fit_with_quantisation(machine, fit))

    if drawn:
        covariance, best = yield from posterior_second_moment(fit, fit.noise)
        if np.any(best != fit.point):
            # The descent ended in a local minimum that is not the best.
            fit = yield from _maximum_a_posteriori_fit(fit, best, drawn)
            covariance, _ = yield from posterior_second_moment(fit, fit.noise)
    else:
        covariance = laplace_covariance(fit, fit.noise)
    kind = POSTERIOR if drawn else LAPLACE

    while fit.count:
        precision = with_prior(fit, precision_of_directions(fit), covariance, kind)
        kept = precision.std <= KEPT_STD
        if np.all(kept):
            return fit, precision
        # Directions that coloured noise leaves too uncertain go behind those that are kept.
        order = np.argsort(~np.append(kept, np.zeros(len(covariance) - fit.count, bool)), kind="stable")
        fit = _in_directions(fit, fit.vectors[:, order], int(kept.sum()))
    return fit, None


def _maximum_a_posteriori_fit(
    fit: SubspaceFit, w: Float[np.ndarray, " q"], drawn: bool
) -> Steps[SubspaceFit]:
    """Descend from a point to the maximum a posteriori, and recompute the identifiable directions there."""
    noise = fit.problem.noise(fit.minimum, fit.count)
    descend = restarted_maximum_a_posteriori if drawn else maximum_a_posteriori
    w, here, settled = yield from descend(fit.problem, noise, w)
    vectors, count = identifiable_directions(np.asarray(here.jacobian) / noise, fit.count)
    moved = SubspaceFit(
        problem=fit.problem,
        vectors=np.eye(len(w)),
        count=count,
        minimum=here,
        evaluations=fit.evaluations + int(here.steps),
        settled=settled,
    )
    return _in_directions(moved, vectors, count)


def _in_directions(fit: SubspaceFit, vectors: np.ndarray, count: int) -> SubspaceFit:
    """Return the fit at the same point in other directions, the first `count` of which are fitted."""
    turn = vectors.T @ fit.vectors
    minimum = fit.minimum
    minimum = replace(minimum, theta=turn @ minimum.theta, jacobian=np.asarray(minimum.jacobian) @ turn.T)
    return replace(fit, vectors=vectors, count=count, minimum=minimum)
