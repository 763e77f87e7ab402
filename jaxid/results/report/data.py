"""The content of a report as plain arrays and numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True, eq=False)
class LogView:
    """One joint of one log, as it is drawn.

    It has two clocks: `time` is that of the log (N samples). `band_time` is that of the K samples that
    remain after decimation and the removal of rest, and so has gaps.

    Args:
        name: Name of the log in headings.
        time: The log's time [s], (N,).
        position_measured: Measured position, (N,).
        position_simulated_before: Position simulated with the declared model, (N,) or None.
        position_simulated_after: Position simulated with the final model, (N,) or None.
        band_time: Time of the samples that the force balance uses [s], (K,).
        velocity: Velocity at these samples, (K,).
        position: Position at these samples, (K,).
        force_measured: Force at the load at these samples, low-passed, (K,).
        residual_before: Force measured minus force of the declared model, (K,) or None.
        residual_after: Force measured minus force of the final model, (K,) or None.
        joint: Number of the joint, 0-based.
        drive_measured: Declared force of its drive as logged, (N,), if that is to be compared.
        drive_simulated: Declared force of its drive as the simulated loop commands it, (N,).
        units: Labels at this joint that differ from those of the page, by quantity.
        steady: Whether the rows are steady speeds, without a time.
    """

    name: str
    time: np.ndarray
    position_measured: np.ndarray
    position_simulated_before: np.ndarray | None
    position_simulated_after: np.ndarray | None
    band_time: np.ndarray
    velocity: np.ndarray
    position: np.ndarray
    force_measured: np.ndarray
    residual_before: np.ndarray | None = None
    residual_after: np.ndarray | None = None
    joint: int = 0
    drive_measured: np.ndarray | None = None
    drive_simulated: np.ndarray | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    steady: bool = False


@dataclass(frozen=True)
class CandidateScore:
    """The evidence of one candidate effect.

    Args:
        kind: Name of the effect, with its place if there are several.
        evidence: Gain in held-out log-likelihood [nats]; not finite if the fit failed.
        accepted: Whether the search added this candidate.
    """

    kind: str
    evidence: float
    accepted: bool = False


@dataclass(frozen=True)
class SearchStep:
    """One step of the search; the first is the refitted baseline.

    Args:
        added: Effect added in this step, or None.
        dropped: Effect taken out again in this step, or None.
        gap_fit: RMS force residual of the model after this step, on the fit log; that of the position
            of a log without a force.
        gap_validation: RMS force residual on the validation log, or None.
        candidates: Scores of all effects tried in this step.
        threshold: Evidence that an effect needs to be added [nats].
    """

    added: str | None
    dropped: str | None
    gap_fit: float
    gap_validation: float | None = None
    candidates: tuple[CandidateScore, ...] = ()
    threshold: float = 0.0


@dataclass(frozen=True)
class ParameterRow:
    """One parameter; `value` and `std` are None if it is not identifiable.

    `std_misspecified` is the deviation that holds for an incomplete model; None: not shown. `in_file` is the
    value in the robot's file; None: there is none.
    """

    name: str
    value: float | None
    std: float | None
    unit: str
    identifiable: bool = True
    std_misspecified: float | None = None
    in_file: float | None = None


class WherePlot(NamedTuple):
    """The force residual's mean over bins of one variable.

    Args:
        variable: Name of the variable, such as "velocity".
        unit: Unit of the variable.
        x: Middle of each bin, (B,).
        mean: Mean force residual in each bin, (B,).
        low: Lower edge of the mean's confidence band, (B,).
        high: Upper edge of that band, (B,).
    """

    variable: str
    unit: str
    x: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True, eq=False)
class HistoryView:
    """A recursive estimate over time.

    Args:
        time: Instants [s], (K,).
        names, units: Names and units of the parameters.
        value: Estimate so far, (K, p).
        std: Standard deviation of the estimate, (K, p); NaN before any data determine it.
        residual: Root mean square of the force residual so far, (K,).
    """

    time: np.ndarray
    names: Sequence[str]
    units: Sequence[str]
    value: np.ndarray
    std: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True, eq=False)
class ExperimentView:
    """A proposed experiment, as it is drawn.

    Args:
        text: The experiment and its expected evidence, or the reason why none is proposed.
        signal: "reference" or "input".
        unit: Unit of the signal, or of the command.
        time: Ticks [s], (N,).
        values: The signal by joint, (N, n); None if no experiment separates the effects.
        limits: Range of the signal by joint, (n, 2).
        speed: Largest speed by joint, drawn over the speed of a reference; None for an input.
    """

    text: str
    signal: str
    unit: str
    time: np.ndarray
    values: np.ndarray | None
    limits: np.ndarray
    speed: np.ndarray | None


@dataclass(frozen=True, eq=False)
class PoseStrip:
    """An arm at some instants of a log, as a stick figure.

    Args:
        name: Name of the log.
        time: Instants [s], (F,).
        bones: Pairs of points between which a line is drawn.
        measured: Places of the base, the joints and the ends by measured positions [m], (F, P, 3).
        simulated: The same by simulated positions; None without a simulation.
        up: Direction against gravity in the base's frame, (3,).
    """

    name: str
    time: np.ndarray
    bones: tuple[tuple[int, int], ...]
    measured: np.ndarray
    simulated: np.ndarray | None
    up: np.ndarray


@dataclass(frozen=True, eq=False)
class FrictionView:
    """The friction of one joint over its velocity.

    Args:
        name: Name of the log and joint in headings.
        joint: Number of the joint, 0-based.
        velocity: Increasing velocities, none of them zero, (G,).
        force: Force of the model against the motion, (G,).
        low, high: Ends of its 95 % band, (G,); None if it is not known.
        velocity_measured: Velocity at samples of the log, (K,); None without a force in the log.
        force_measured: Measured force less all of the model but friction, (K,).
        units: Labels at this joint that differ from those of the page, by quantity.
    """

    name: str
    joint: int
    velocity: np.ndarray
    force: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    velocity_measured: np.ndarray | None = None
    force_measured: np.ndarray | None = None
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Mark:
    """An effect in the drawing of the drive chain.

    Args:
        text: Name of the effect, with its places.
        found: Whether a search found it; declared if not.
    """

    text: str
    found: bool = False


@dataclass(frozen=True)
class ChainPart:
    """One part of the drive chain.

    Args:
        name: "controller", "drive", "transmission" or "load".
        lines: Facts on it, a few words each.
        marks: Effects that act on it.
    """

    name: str
    lines: tuple[str, ...] = ()
    marks: tuple[Mark, ...] = ()


def si_units() -> dict[str, str]:
    """Return the units of a linear axis, the default of a report."""
    return {"position": "m", "velocity": "m/s", "force": "N", "time": "s"}


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything that a report shows; `gap`, `effects` and `where` are the JSON results' objects.

    Args:
        title: Heading of the page.
        command: "identify" or "discover".
        case_name: Name of the case.
        log_name: Name of the log that was fitted.
        verdict: "found", "nothing_missing", "unexplained", or None for `identify`.
        gap: The `gap` object of the JSON result.
        parameters: The case's unknowns after the last fit.
        unidentifiable: `{"combination": {name: weight}}`, one for each.
        ratios: Rows of a table of ratios of unknowns without a scale, its head first; empty without one.
        effects: The effects that were found, in the order in which they were added.
        joints: Rows of a table of what was found at each joint of an arm, its head first; empty without one.
        where: The `where` object of the JSON result, or None.
        steps: The search, step by step.
        where_plot: The residual over the variable that `where` names, or None.
        experiments: Proposed experiments that would distinguish effects that the log cannot.
        views: The logs to draw: first the fitted one, then the validations.
        units: Labels of position, velocity, force and time.
        notes: Remarks, warnings, proposals; one sentence or more each.
        versions: Program names and versions.
        converged: Whether the solver converged; None if that is unknown.
        derived: Quantities derived from the parameters.
        coefficients: Rows of a minimal model's table, its head first; empty without one.
        statistics: Lines below it.
        within_prior: `directions`, `criterion_percent` and `starts` of the JSON result of a fit within a
            prior; None for any other.
        history: History of a recursive estimate; None for any other.
        precision: Content of the section on precision, see `jaxid.results.precision.precision_content`; None
            without parameters.
        findings: Sentences about the result, the most important first.
        model_complete: Whether the model leaves nothing but noise; None if that is not known.
        explains: Whether the model explains the log at all.
        identified: Whether the log determines at least one parameter.
        drifted: Whether the simulated position measures nothing, because an open-loop run drifts.
        misread: Whether a fault of the force's reading explains the log as well as what was found.
        facts: Pairs of a name and a text: machine, date, command, method, settings, log.
        chain: Parts of the drive chain, from the controller to the load.
        friction: Friction over velocity, by joint.
        poses: Poses of an arm along the fitted log; None for a machine without geometry.
    """

    title: str
    command: str
    case_name: str
    log_name: str
    verdict: str | None
    gap: Mapping
    parameters: tuple[ParameterRow, ...]
    unidentifiable: tuple[Mapping, ...] = ()
    ratios: tuple[tuple[str, ...], ...] = ()
    effects: tuple[Mapping, ...] = ()
    joints: tuple[Sequence[str], ...] = ()
    where: Mapping | None = None
    steps: tuple[SearchStep, ...] = ()
    where_plot: WherePlot | tuple | None = None
    experiments: tuple[ExperimentView, ...] = ()
    views: tuple[LogView, ...] = ()
    units: Mapping[str, str] = field(default_factory=si_units)
    notes: tuple[str, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    converged: bool | None = None
    derived: tuple[ParameterRow, ...] = ()
    coefficients: tuple[Sequence[str], ...] = ()
    statistics: tuple[str, ...] = ()
    within_prior: Mapping | None = None
    history: HistoryView | None = None
    precision: Mapping | None = None
    findings: tuple[str, ...] = ()
    model_complete: bool | None = None
    explains: bool = True
    identified: bool = True
    drifted: bool = False
    misread: bool = False
    facts: tuple[tuple[str, str], ...] = ()
    chain: tuple[ChainPart, ...] = ()
    friction: tuple[FrictionView, ...] = ()
    poses: PoseStrip | None = None
