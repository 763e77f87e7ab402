"""Identification by a minimal model: least squares for its coefficients, and the parameters from these.

The coefficients chi are fitted by ordinary least squares, as published. The parameters are then fitted to the
coefficients, a small weighted least-squares problem.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

from jaxid.arrays import Array
from jaxid.dynamics.frequencies import natural_frequencies
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.minimal.basis import basis_of
from jaxid.estimators.minimal.columns import Regression, regression_of
from jaxid.estimators.minimal.filtering import Spectrum, choose_filtering, spectrum_of
from jaxid.estimators.minimal.matrices import LinearBalance, delays_command, linear_balance, require_linear
from jaxid.estimators.minimal.models import Form, form_of, rigid_rows_hold, structure_of
from jaxid.estimators.minimal.read_back import Model, constraint_steps, read_back
from jaxid.estimators.minimal.report import minimal_json, minimal_notes
from jaxid.estimators.minimal.statistics import Constraint, MinimalFit, least_squares
from jaxid.logs.prepare import Recipe
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Parameters, scatter
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Precision, assess
from jaxid.simulation.sensor_noise import force_noise

if TYPE_CHECKING:
    from jaxid.session import Session

# The band follows the estimated natural frequencies until they change by less than this fraction; passes at
# most.
_SETTLED = 0.1
_PASSES = 4
# Pairs of simulated noise for the shift of the coefficients by noise of the force, and the part of itself by
# which one may move: about 1 % where the values held, 14 % and more where the resonance was lost.
_PAIRS, _BIASED = 2, 0.05
# Least number of samples per coefficient.
_A_COEFFICIENT = 5


@eqx.filter_jit
def _linear_balance(plant: Plant, places: tuple, theta: Array) -> LinearBalance:
    return linear_balance(scatter(places, plant, theta))


def minimal_model_steps(
    session: Session, printed: bool = False, weight: float | None = None
) -> Steps[Estimate]:
    """Identify the unknowns by the minimal model for the measured signals.

    Args:
        session: Case and log, with motor and load position, load acceleration and motor position, or motor
            position alone.
        printed: Take the model with an acceleration as the paper prints it.
        weight: Weight of its rows that were differentiated twice, over that of the row of forces [s^2].
            Absent: 1 as printed, else the value at which both are of equal size at the resonance.

    Returns:
        The estimate; `details["minimal"]` has coefficients, statistics and the test of the constraint.

    Raises:
        InputError: If the plant is not linear away from rest, the log is not suitable, or too few samples
            remain.

    Source:
        Janot, Gautier, Jubien and Vandanjon, "Experimental joint stiffness identification depending on
        measurements availability".
    """
    plant, parameters = session.machine.plant, session.machine.parameters
    form = _form(session, printed)
    model = _model(plant, parameters, form, session, session.case.where)

    # The band depends on the natural frequencies, and these on the estimate.
    coefficients, theta, solved = model.guess, parameters.guess, None
    now = natural_frequencies(plant, parameters.places, theta).hz
    for k in range(_PASSES):
        natural = now
        solved = yield from _solved_steps(session, model, coefficients, theta, natural, weight)
        theta = solved.theta
        coefficients = model.basis.constant + model.basis.spread @ solved.chi
        now = natural_frequencies(plant, parameters.places, theta).hz
        moved = np.abs(now / natural - 1) if natural.size else np.zeros(1)
        # At the guesses the reversals of a hidden joint are not known: it needs a second pass.
        settled = moved.max() < _SETTLED or session.case.preprocess.cutoff_hz is not None
        if k >= bool(form.hidden) and settled:
            break
    assert solved is not None, "there is at least one pass"

    constraint = yield from constraint_steps(plant, parameters, model, solved.fit, theta, solved.slopes)
    return _estimate(session, model, solved, constraint, _hidden_by_noise(session, model, solved))


def _hidden_by_noise(session: Session, model: Model, solved: _Solved) -> str:
    """Return why noise of the force biases a fit as far that its values mean nothing; empty if it does not.

    Where joints without an encoder were eliminated, derivatives of the force are among the columns, and least
    squares is biased by their noise. As much noise again, simulated, moves the coefficients about as far once
    more; pairs of opposite noise cancel in first order.

    Args:
        session: Case and log.
        model: The model.
        solved: Its fit, whose filters stay.

    Source:
        Cook & Stefanski (1994), JASA 89, simulation-extrapolation.
    """
    machine, log = session.machine, session.fit.log
    read = force_noise(machine, session.fit.data)
    if not (model.structure.form.hidden and np.any(read > 0)):
        return ""
    structure, basis, fit = model.structure, model.basis, solved.fit
    balance = _linear_balance(machine.plant, machine.parameters.places, solved.theta)
    rng, moved = np.random.default_rng(0), []
    for _ in range(_PAIRS):
        noise = read * rng.standard_normal(log.force.shape)
        for more in (noise, -noise):
            noisier = replace(log, force=log.force + more)
            data = regression_of(noisier, machine, structure, basis, model.known, solved.recipe, balance)
            moved.append(least_squares(basis.names, data, solved.weights).chi)

    shift = np.abs(np.mean(moved, axis=0) - fit.chi)
    part = np.divide(shift, np.abs(fit.chi), out=np.zeros_like(shift), where=fit.chi != 0)
    # A coefficient without a value moves by many times itself, within its standard deviation.
    part = np.where(fit.precision.identifiable & (shift > fit.precision.std), part, 0.0)
    worst = int(np.argmax(part))
    if part[worst] < _BIASED:
        return ""
    return (
        "noise of the force, which is in the differentiated columns, moves the coefficient "
        f"{basis.names[worst]} by {part[worst]:.0%}, so that the resonance of the joint without an encoder "
        "is not seen; use prediction_error or output_error, or a log with less noise"
    )


@dataclass(frozen=True)
class _Solved:
    """Coefficients and parameters, fitted with one choice of the filters.

    Args:
        data: The regression of the coefficients.
        weights: Weight of each of its rows, (rows,).
        fit: The fit of the coefficients.
        minimum: The fit of the parameters to them.
        chi: Coefficients at the parameters, (k,).
        slopes: Derivatives of these in the parameters, (k, p).
        recipe: Filters of the log.
        notes: Notes about the filters.
    """

    data: Regression
    weights: np.ndarray
    fit: MinimalFit
    minimum: Minimum
    chi: np.ndarray
    slopes: np.ndarray
    recipe: Recipe
    notes: tuple[str, ...]

    @property
    def theta(self) -> np.ndarray:
        """The parameters, (p,)."""
        return np.asarray(self.minimum.theta)


def _solved_steps(
    session: Session,
    model: Model,
    coefficients: np.ndarray,
    theta: np.ndarray,
    natural: np.ndarray,
    weight: float | None,
) -> Steps[_Solved]:
    """Filter the log, fit the coefficients, and fit the parameters to them.

    Args:
        session: Case and log.
        model: The model.
        coefficients: Coefficients by which the filters are chosen, (k,).
        theta: Parameters at which reversals of hidden joints are found, (p,).
        natural: Natural frequencies [Hz].
        weight: Weight of the rows that were differentiated twice; None: as `minimal_model_steps` says.

    Raises:
        InputError: If too few samples remain.
    """
    machine, log, stated = session.machine, session.fit.log, session.case.preprocess
    structure, basis, parameters = model.structure, model.basis, machine.parameters
    spectrum = spectrum_of(log, machine, structure, coefficients, model.known, natural, stated.median)
    recipe, notes = choose_filtering(log, stated, structure, spectrum)
    balance = _linear_balance(machine.plant, parameters.places, theta)
    data = regression_of(log, machine, structure, basis, model.known, recipe, balance)
    _require_samples(data, model, log.source)

    weights = _weights(structure.form, structure.rows, natural, weight)
    fit = least_squares(basis.names, data, weights)
    minimum, chi, slopes = yield SolveRequest(
        read_back,
        (
            machine.plant,
            parameters.places,
            structure,
            model.maps,
            fit.chi,
            fit.root,
            np.asarray(np.linalg.norm(fit.residual)),
            parameters.guess,
            Transform.of(parameters),
            parameters.bounds,
        ),
    )
    return _Solved(
        data=data,
        weights=weights,
        fit=fit,
        minimum=minimum,
        chi=np.asarray(chi),
        slopes=np.asarray(slopes),
        recipe=recipe,
        notes=notes,
    )


def filtering_of(session: Session, printed: bool = False) -> tuple[Spectrum, Recipe, tuple[str, ...]]:
    """Return the spectra of force and noise at a session's guesses, the recipe chosen by them, and notes.

    For a session at the estimate, `session.with_machine(estimate.machine)`, it is the recipe that was used.

    Args:
        session: Case and log.
        printed: Take the model with an acceleration as the paper prints it.

    Raises:
        InputError: If the plant or the log does not suit a minimal model.
    """
    machine, log = session.machine, session.fit.log
    form = _form(session, printed)
    model = _model(machine.plant, machine.parameters, form, session, session.case.where)
    natural = natural_frequencies(machine.plant, machine.parameters.places, machine.parameters.guess).hz
    stated = session.case.preprocess
    spectrum = spectrum_of(log, machine, model.structure, model.guess, model.known, natural, stated.median)
    return spectrum, *choose_filtering(log, stated, model.structure, spectrum)


def _form(session: Session, printed: bool) -> Form:
    """Choose the form of the model by the measured signals, and check that plant and log suit it.

    Raises:
        InputError: If they do not.
    """
    plant, log, where = session.machine.plant, session.fit.log, session.case.where
    require_linear(plant, where)
    if session.case.preprocess.derivatives == "parabolic":
        raise InputError(
            "[preprocess] derivatives = 'parabolic' filters each derivative differently, and a minimal model "
            "needs one filter for all of its columns",
            where=where,
            hint="leave it out, or use inverse_dynamics",
        )
    unknown = {f.path[1] for f in session.machine.parameters.free if f.path[0] == "effects"}
    if any(delays_command(e) and k in unknown for k, e in enumerate(plant.effects)):
        raise InputError(
            "a minimal model cannot have an unknown delay of the command",
            where=where,
            hint="declare the delay known, or use output_error",
        )

    accelerated = log.load_acceleration is not None
    form = form_of(plant.joints, log.measured, accelerated, printed)
    if printed and not form.accelerated:
        raise InputError(
            "minimal_model_printed needs the load's acceleration and the motor's position only",
            where=where,
            hint="name load_acceleration in [log] and leave out load_position, or use minimal_model",
        )
    columns = 0 if log.load_acceleration is None else log.load_acceleration.shape[1]
    if form.accelerated and columns != len(form.hidden):
        raise InputError(
            f"load_acceleration has {columns} columns, and the case needs {len(form.hidden)}",
            where=log.source,
            hint="name the column of the load's accelerometer",
        )
    if form.accelerated and not rigid_rows_hold(plant):
        raise InputError(
            "the model with an acceleration needs a machine without a spring to the ground",
            where=where,
            hint="leave out load_acceleration, or the spring",
        )
    return form


def _model(plant: Plant, parameters: Parameters, form: Form, session: Session, where: str) -> Model:
    """Build the model of a form.

    Raises:
        InputError: If the gain of the drive is unknown, or a row has no scale.
    """
    try:
        structure, samples = structure_of(plant, parameters, form)
    except ValueError as error:
        raise InputError(
            f"{error}, and then no other unknown has a scale",
            where=where,
            hint="declare actuator_gain known, or use output_error",
        ) from error

    # A row from which a joint was eliminated has no scale without a force.
    if form.hidden and not form.accelerated and None in structure.leading:
        raise InputError(
            "after elimination of the joints without an encoder, a row of the model has no force",
            where=where,
            hint="use inverse_dynamics or output_error",
        )
    basis = basis_of(structure, samples, parameters, session.machine.units)
    known, guess = (samples.of(w, structure.leading)[0][-1] for w in (structure.known, structure.unknown))
    return Model(structure, basis, known, guess)


def _require_samples(data: Regression, model: Model, source: str) -> None:
    """Check that enough samples remain for the coefficients of a model."""
    remaining = int(data.counts.sum())
    if remaining < _A_COEFFICIENT * len(model.basis.names):
        raise InputError(
            f"only {remaining} samples are beyond the reach of the filters from rest",
            where=source,
            hint="take a log with longer moves, lower rest_velocity, or raise cutoff_hz",
        )


def _weights(form: Form, rows: int, natural: np.ndarray, weight: float | None) -> np.ndarray:
    """Return the weight of each row; in a model with an acceleration the row of forces is the last."""
    if not form.accelerated:
        return np.ones(rows)
    if weight is None:
        weight = 1.0 if form.printed else float((2 * np.pi * natural.max()) ** -2)
    return np.append(np.full(rows - 1, weight), 1.0)


def _estimate(
    session: Session, model: Model, solved: _Solved, constraint: Constraint | None, hidden: str
) -> Estimate:
    """Build the estimate.

    Args:
        session: Case and log.
        model: The model that was fitted.
        solved: Its coefficients and parameters.
        constraint: Test of the coefficients against those of a plant, if there is one.
        hidden: Reason for which the values mean nothing; empty if there is none.
    """
    machine, parameters = session.machine, session.machine.parameters
    data, fit, minimum, theta = solved.data, solved.fit, solved.minimum, solved.theta

    # The residual of the model at the parameters, not at the free coefficients.
    w = np.where(data.counts[..., None], data.w * solved.weights[:, None], 0.0)
    residual = fit.residual + w @ (fit.chi - solved.chi)
    precision = assess(
        parameters.names, w @ solved.slopes, residual, data.counts, fit.size, np.where(theta != 0, theta, 1.0)
    )

    form = model.structure.form
    converged = bool(minimum.converged) and bool(np.all(np.isfinite(theta)))
    message = "solved" if converged else f"no convergence within {int(minimum.steps)} steps"
    if hidden:
        # What is left is one body: its values are sums of those of the joints.
        converged, message, precision = False, hidden, Precision.unknown(parameters.names)
    at = machine.with_estimate(theta)
    modes = _modes(at, precision.covariance)
    names = [n for n, t, low in zip(parameters.names, theta, parameters.bounds[0], strict=True) if t <= low]
    pressed = (f"at its bound: {', '.join(names)}",) if names else ()
    return Estimate(
        method="minimal_model_printed" if form.printed else "minimal_model",
        machine=at,
        theta=theta,
        precision=precision,
        converged=converged,
        message=message,
        residual=np.where(data.counts, residual, np.nan),
        samples=int(data.counts.any(axis=1).sum()),
        steps=int(minimum.steps),
        notes=(*solved.notes, *minimal_notes(form, fit, model.basis, constraint), *pressed),
        details={"minimal": minimal_json(form, fit, model.basis, constraint, modes, solved.recipe)},
    )


def _modes(machine: Machine, covariance: np.ndarray) -> dict[str, list[tuple[float, float]]]:
    """Return the natural frequencies of an estimate and their standard deviations [Hz]."""
    plant, parameters = machine.plant, machine.parameters
    out = {}
    for name, held in (("free", ()), ("motor_locked", plant.driven(plant.joints))):
        modes = natural_frequencies(plant, parameters.places, parameters.guess, held)
        out[name] = list(zip(modes.hz.tolist(), modes.std(covariance).tolist(), strict=True))
    return out
