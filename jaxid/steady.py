"""Tables of steady speeds and the forces that hold them: a session on one, and its least-squares fit.

Each row is a balance of forces without acceleration. Rows are independent of each other, so that no filter
and no colour of noise is involved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import equinox as eqx
import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

from jaxid.build import build_machine
from jaxid.case.case import Case
from jaxid.consistency.absent import position_dependent
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.estimators.common.shapes import shape_starts
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import linear_scale, solve_balance
from jaxid.logs.finding import Finding
from jaxid.logs.in_memory import LogLike
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared, Recipe
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.model.unknowns import label
from jaxid.numerics.directions import held, named_directions
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Precision
from jaxid.session import OpenedLog, Session
from jaxid.simulation.force_balance import ForceData, force_and_columns, sharpened

# A row at this part of the slowest speed would count as at rest: the smoothed sign is exact at every row.
_SLOWER = 0.1
# Eigenvalues of the scaled normal matrix below this part of the largest are rounding.
_ROUNDING = 1e-10
# Standard deviations, as a part of the force, beyond which a combination is not identifiable.
_UNIDENTIFIABLE = 0.5


def open_steady(case: Case, log: LogLike, validate: Sequence[LogLike], read: Callable[..., Log]) -> Session:
    """Open a case and its tables of steady speeds.

    Args:
        case: The case, whose [log] has kind = "steady".
        log: The table to fit, or its file.
        validate: Further tables, beside those of the case.
        read: Function that reads a table by the case, as sessions read their logs.

    Raises:
        InputError: If the machine is not one of steady speeds, or a table is unsound.
    """
    if case.controller is not None:
        hint = "leave [controller] out, or take a log over time"
        raise InputError('[controller] does not go with kind = "steady"', where=case.where, hint=hint)
    machine = build_machine(case, period=1.0)
    _need_steady(case, machine)
    fit = read(case, log)
    recipe = _recipe(fit)
    opened = [_opened("fit", fit, machine, recipe)]
    for entry in case.validations:
        table = read(case, fit.source if entry.log is None else entry.log, columns=entry.columns)
        opened.append(_opened(entry.name, table, machine, recipe))
    for extra in validate:
        table = read(case, extra, whole=True)
        name = Path(table.source).stem
        while name in {run.name for run in opened}:
            name += "'"
        opened.append(_opened(name, table, machine, recipe))
    counted = int(opened[0].data.moving.sum())
    if counted <= len(machine.parameters.free):
        hint = "measure more speeds, or state some of the unknowns"
        what = f"{counted} rows in motion for {len(machine.parameters.free)} unknowns"
        raise InputError(what, where=fit.source, hint=hint)
    return Session(case, machine, opened[0], tuple(opened[1:]), recipe, tuple(_findings(fit)), case)


def _need_steady(case: Case, machine: Machine) -> None:
    """Refuse a machine whose force at a steady speed is not one of the speed alone."""
    plant = machine.plant
    if plant.joints != 1:
        hint = "take a log over time"
        what = f'kind = "steady" goes with a machine of one joint, and the {plant.kind} has {plant.joints}'
        raise InputError(what, where=case.where, hint=hint)
    named = position_dependent(plant)
    hint = "leave it out, or take a log over time"
    if named:
        what = f'{named} acts by the position, which a log of kind = "steady" does not have'
        raise InputError(what, where=case.where, hint=hint)
    for effect in plant.effects:
        if type(effect).initial_state is not Effect.initial_state or effect.delays_command():
            name = label(plant, effect.kind, effect.port)
            what = f'{name} acts over time, which a log of kind = "steady" does not show'
            raise InputError(what, where=case.where, hint=hint)


def _recipe(log: Log) -> Recipe:
    """Return settings by which nothing is filtered."""
    speed = np.abs(log.readings_of_speed)
    slowest = np.min(speed[speed > 0], initial=np.inf)
    slowest = slowest if np.isfinite(slowest) else 1.0
    return Recipe(
        cutoff_hz=0.5,
        order=1,
        decimation=1,
        trim=0,
        rest_velocity=(float(_SLOWER * slowest),),
        align_hold=False,
        derivatives="central",
    )


def _opened(name: str, log: Log, machine: Machine, recipe: Recipe) -> OpenedLog:
    """Return a table as a prepared log, whose rows in motion count."""
    speed = log.readings_of_speed
    moving = speed != 0
    data = Prepared(
        q=np.zeros_like(speed),
        qd=speed,
        qdd=np.zeros_like(speed),
        force=log.force * machine.gain,
        period=1.0,
        hold=0.0,
        recipe=recipe,
        moving=moving,
        fitted=moving,
        kept=np.arange(log.samples),
    )
    return OpenedLog(name, log, data, None)


def _findings(log: Log) -> list[Finding]:
    """Return doubts about a table: a force that drives against its speed, and speeds of one direction."""
    speed, force = log.readings_of_speed, log.force
    findings = []
    power = float(np.sum(speed * force))
    if power < 0:
        what = "force times velocity is negative on the mean: friction would drive the machine"
        hint = "turn the sign of one column: sign = { force = -1 } in [log]"
        findings.append(Finding("warning", what, f"{log.source}, force", hint))
    if np.all(speed >= 0) or np.all(speed <= 0):
        what = "all speeds have one direction: a constant force and Coulomb friction are one number"
        findings.append(Finding("warning", what, f"{log.source}, velocity", "measure both directions"))
    return findings


def steady_fit(session: Session) -> Steps[Estimate]:
    """Fit the unknowns of a session on a table of steady speeds by weighted least squares.

    With a stated scatter each row counts by it; without one, by the number of its readings, and the scatter
    is that of the residual. The standard deviations are enlarged by Student's distribution for the few rows,
    so that 1.96 of them is a 95 % interval.

    Args:
        session: The session, of `open_steady`.

    Source:
        Seber & Lee (2003), Linear Regression Analysis, chapters 3 and 10.
    """
    machine, run = session.machine, session.fit
    data, rows = run.data, run.data.fitted
    weight, stated = _weights(machine, run.log)
    arrays = eqx.tree_at(lambda a: a.weight, ForceData.of(data, rows), rows * weight)
    plant = sharpened(machine.plant, data)
    transform, damping = linear_scale(machine)
    options = (transform, machine.parameters.bounds, damping)

    fits: list[Minimum] = []
    theta = machine.parameters.guess
    for at in [theta, *shape_starts(machine, theta)]:
        fit, _ = yield SolveRequest(solve_balance, (plant, machine.parameters.places, arrays, at, *options))
        fits.append(fit)
    fit = min(fits, key=lambda f: np.nan_to_num(float(f.cost), nan=np.inf))

    values = np.asarray(fit.theta)
    e = np.asarray(fit.residual).reshape(rows.shape)
    jacobian = np.asarray(fit.jacobian).reshape(*rows.shape, -1)
    size = float(np.linalg.norm((weight * data.force)[rows]))
    precision, notes = _precision(machine, values, e, jacobian, rows, size, stated=stated)

    converged = bool(fit.converged) and bool(np.all(np.isfinite(values)))
    return Estimate(
        method="inverse_dynamics",
        machine=machine.with_estimate(values),
        theta=values,
        precision=precision,
        converged=converged,
        message="converged" if converged else f"no convergence within {int(fit.steps)} steps",
        residual=np.where(rows, e / weight, np.nan),
        samples=int(rows.sum()),
        steps=int(fit.steps),
        notes=tuple(notes),
    )


def balance_rows(session: Session) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows p"]]:
    """Return weighted residual and Jacobian of a session's machine at the rows that count.

    Args:
        session: The session; its machine is at the values of interest.
    """
    machine, run = session.machine, session.fit
    weight, _ = _weights(machine, run.log)
    rows = run.data.fitted
    arrays = ForceData.of(run.data, rows)
    places, theta = machine.parameters.places, np.asarray(machine.parameters.guess)
    plant = sharpened(machine.plant, run.data)
    e, jacobian = (np.asarray(x) for x in force_and_columns(plant, places, arrays, theta))
    return (weight * e)[rows], (weight[..., None] * jacobian)[rows]


def _weights(machine: Machine, log: Log) -> tuple[Float[np.ndarray, "rows n"], bool]:
    """Return the weight of each row, and whether its inverse is a known standard deviation."""
    assert log.steady is not None, "a session of `open_steady` has a steady table"
    std, count = log.steady.std, log.steady.count
    if std is not None:
        return 1.0 / (std * np.abs(machine.gain)), True
    if count is None:
        return np.ones_like(log.force), False
    return np.sqrt(count / np.mean(count))[:, None] * np.ones_like(log.force), False


def _precision(
    machine: Machine,
    theta: np.ndarray,
    e: Float[np.ndarray, "rows n"],
    jacobian: Float[np.ndarray, "rows n p"],
    rows: Bool[np.ndarray, "rows n"],
    size: float,
    *,
    stated: bool,
) -> tuple[Precision, list[str]]:
    """Return the precision of a fit to independent rows, and how it was computed.

    Args:
        machine: The machine.
        theta: Estimates, (p,).
        e: Weighted residual.
        jacobian: Weighted Jacobian.
        rows: Mask of the rows that count.
        size: 2-norm of the weighted force.
        stated: Whether the weights are inverse standard deviations.
    """
    names, p = machine.parameters.names, len(theta)
    flat = jacobian[rows]
    scale = np.where(theta != 0, theta, 1.0)
    norm = np.linalg.norm(flat, axis=0)
    dead = norm * np.abs(scale) <= 1e-9 * size
    norm = np.where(dead, 1.0, norm)
    shapes = np.where(dead, 0.0, flat / norm)
    values, vectors = np.linalg.eigh(shapes.T @ shapes)
    blind = values < _ROUNDING * max(values[-1], 1e-300)

    freedom = max(int(rows.sum()) - int((~blind).sum()), 1)
    variance = float(np.sum(e[rows] ** 2)) / freedom
    notes = []
    if stated and variance <= 1.0:
        variance = 1.0
        notes.append("the standard deviations are those of the stated scatter of the rows")
    else:
        few = scipy.stats.t.ppf(0.975, freedom) / scipy.stats.norm.ppf(0.975)
        variance *= few**2
        beyond = "exceeds the stated scatter, and" if stated else "of the rows"
        notes.append(
            f"the residual {beyond} gives the standard deviations, {few:.2f} times as large for "
            f"{freedom} rows to spare"
        )

    spread = np.sqrt(variance / np.maximum(values, 1e-300))
    blind = blind | (spread > _UNIDENTIFIABLE * size)
    certain = vectors[:, ~blind]
    covariance = variance * (certain / values[~blind]) @ certain.T / np.outer(norm, norm)
    identifiable = ~held(vectors[:, blind]) if p else np.zeros(0, bool)
    covariance[~identifiable] = np.nan
    covariance[:, ~identifiable] = np.nan
    information = values / max(values[-1], 1e-300)
    precision = Precision(covariance, identifiable, named_directions(names, vectors[:, blind]), information)
    return precision, notes
