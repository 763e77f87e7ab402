"""Tables of a case as frozen dataclasses: one field for each key, with its default and its documentation.

A default of None means that the log, the machine or the method decides, as the documentation of the key says.
`[plant]`, `[[effects]]`, `[controller]` and `[reference]` depend on their kind and are read by `jaxid.case`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from jaxid.names import (
    AXES,
    CRITERIA,
    DECIMALS,
    DERIVATIVES,
    DISCOVER,
    HOLDS,
    IN_LOOP,
    INERTIAL_KINDS,
    LATE_OF,
    LOG_KINDS,
    METHODS,
    MINIMISERS,
    OFFSET_OF,
    OUTPUTS,
    RESAMPLINGS,
    SEPARATORS,
    SIDES,
    SIGN_OF,
    SOLVERS,
    STARTS,
    STEADY_COLUMNS,
    UNIT_OF,
    USER_METHODS,
)
from jaxid.schema import (
    Reader,
    Spot,
    by_drive,
    by_joint,
    by_quantity,
    choice,
    columns,
    flag,
    flag_or_positive,
    key,
    number,
    odd,
    read_settings,
    rows,
    several,
    sign,
    span,
    square_matrix,
    stretch,
    text,
    whole,
)

_COLUMN = "name of the column"
_VECTOR = several(number(), shortest=3, longest=3)
# Units of a velocity and of an acceleration, of joints that slide or turn.
_SPEED, _ACCELERATION = "m/s or rad/s", "m/s^2 or rad/s^2"
ByJoint = float | tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """[actuator]: the known path from the logged command to the forces of the joints."""

    gain: ByJoint = key(
        by_drive(number("nonzero")), "known force per unit of the logged command", default=1.0
    )
    torque_constant: ByJoint | None = key(
        by_drive(number("positive")), "torque of the motor per current", unit="N m/A", note="gain is stated"
    )
    gear_ratio: ByJoint | None = key(
        by_drive(number("nonzero")), "turns of the motor for one of the load or of the screw", note="1"
    )
    lead: ByJoint | None = key(
        by_drive(number("positive")), "way of a sliding joint for one turn of its screw", unit="m/rev"
    )
    efficiency: ByJoint | None = key(
        by_drive(number("positive")), "force behind the gear over that without losses", note="1"
    )
    resistance: ByJoint | None = key(
        by_drive(number("positive")),
        "resistance of the winding, for a logged voltage",
        unit="ohm",
    )
    back_emf: ByJoint | None = key(
        by_drive(number("nonnegative")),
        "voltage per speed of the motor",
        unit="V s/rad",
        note="torque_constant",
    )
    rated: ByJoint | None = key(by_drive(number("positive")), "current that is 100 %", unit="A")
    supply: ByJoint | None = key(by_drive(number("positive")), "voltage of a duty cycle of 100 %", unit="V")
    transmission: tuple[tuple[float, ...], ...] | None = key(
        square_matrix(),
        "R, rows of numbers, for logs of motors that move several joints: joint = R^-1 motor",
        note="the log is of the joints",
    )


@dataclass(frozen=True, kw_only=True)
class LogTable:
    """[log]: the columns of a log, and how it was sampled."""

    time: str | None = key(text, "name of the column with the time", unit="s", note="give sample_rate")
    sample_rate: float | None = key(number("positive"), "samples per second", unit="Hz", note="give time")
    position: str | tuple[str, ...] | None = key(
        columns(), f"{_COLUMN} of the position, one a joint", note="the integral of the velocity"
    )
    force: str | tuple[str, ...] | None = key(
        columns("drive"), f"{_COLUMN} of the command, one a drive", note="zero: a free swing"
    )
    hold: str | None = key(
        choice(HOLDS), "course of the command between samples", note="zero_order or linear, as the log shows"
    )
    units: Mapping[str, str | tuple[str, ...]] | None = key(
        by_quantity(text, UNIT_OF),
        "units of the columns, converted to SI: one for a quantity, or a list by column",
        note="SI, or as the file states",
    )
    sign: Mapping[str, float | tuple[float, ...]] | None = key(
        by_quantity(sign, SIGN_OF), "1 or -1 for a quantity, or a list by column: it is multiplied", note="1"
    )
    offset: Mapping[str, float | tuple[float, ...]] | None = key(
        by_quantity(number(), OFFSET_OF),
        "added to a quantity after its conversion, or a list by column: moves its zero",
        unit="position",
        note="0",
    )
    delay: Mapping[str, float | tuple[float, ...]] | None = key(
        by_quantity(number("positive"), LATE_OF),
        "time by which a quantity was logged after it acted, or a list by column: it is shifted back",
        unit="s",
        note="none",
    )
    lag: Mapping[str, float | tuple[float, ...]] | None = key(
        by_quantity(number("positive"), LATE_OF),
        "time constant of a first-order low-pass that a quantity was logged through, which is undone",
        unit="s",
        note="none",
    )
    counts_per_revolution: ByJoint | None = key(
        by_joint(number("positive")), "counts of the encoder in a turn", note="the unit count is not used"
    )
    position_at: str = key(
        choice(SIDES), "side of the gear at which angles of the log were measured", default=SIDES[0]
    )
    resample: float | None = key(
        number("positive"),
        "rate to which all columns are resampled",
        unit="Hz",
        note="uneven or unequal samples are, at the rate of the slowest column",
    )
    resample_method: str | None = key(
        choice(RESAMPLINGS), "lines or cubic splines between readings", note=RESAMPLINGS[0]
    )
    reference_hold: str | None = key(
        choice(HOLDS),
        "course of the reference between samples, for a log slower than its loop",
        note="chosen from the log",
    )
    unwrap: bool | float = key(
        flag_or_positive,
        "whether positions and references start anew after a turn, or the size of a turn",
        unit="position",
        default=False,
    )
    format: str | None = key(
        text, "format of the file, as csv or mcap, where its suffix does not say", note="by the suffix"
    )
    episode: int | None = key(whole(0), "episode of a LeRobot dataset", note="the only one")
    separator: str | None = key(
        choice(SEPARATORS), "sign between the cells of a text table", note="found in the file, and reported"
    )
    decimal: str | None = key(
        choice(DECIMALS), "decimal sign of a text table", note="found in the file, and reported"
    )
    rows: tuple[int, int] | tuple[tuple[int, int], ...] | None = key(
        rows, "first row and end, 0-based, half open; or a list of such stretches", note="all rows"
    )
    velocity: str | tuple[str, ...] | None = key(
        columns(), f"{_COLUMN} of the velocity, one a joint; beside a position only its unit is checked"
    )
    loop_velocity: str | tuple[str, ...] | None = key(
        columns(),
        f"{_COLUMN} of the velocity that the drive measures and its own loop uses, one a joint",
        note="the loop differences positions",
    )
    acceleration: str | tuple[str, ...] | None = key(
        columns(), f"{_COLUMN} of the acceleration, one a joint; no method uses it"
    )
    reference: str | tuple[str, ...] | None = key(
        columns("drive"), f"{_COLUMN} of the controller's reference, one a drive"
    )
    load_position: str | tuple[str, ...] | None = key(
        columns(), f"{_COLUMN} of the position behind an elastic coupling"
    )
    load_acceleration: str | tuple[str, ...] | None = key(
        columns(), f"{_COLUMN} of the acceleration behind an elastic coupling"
    )
    temperature: str | tuple[str, ...] | None = key(
        columns(), f"{_COLUMN} of a temperature; no method uses it"
    )
    effort: str | tuple[str, ...] | None = key(
        columns("drive"), f"{_COLUMN} of a current or load, one a drive, compared with the force after a fit"
    )
    effort_gain: ByJoint | None = key(
        by_drive(number("nonzero")),
        "effort over the force of the drive, where it is known",
        unit="unit of the effort per N or N m",
        note="compared only",
    )
    effort_unsigned: bool | None = key(
        flag, "whether the effort is a magnitude", note="true if no reading is below zero"
    )
    kind: str = key(
        choice(LOG_KINDS),
        "a log over time, or steady: a table of steady velocities and the forces that hold them",
        default=LOG_KINDS[0],
    )
    scatter: str | tuple[str, ...] | None = key(
        columns("drive"), f"{_COLUMN} of the standard deviation of the force; with kind = 'steady'"
    )
    samples: str | None = key(
        text, f"{_COLUMN} of the number of readings of which each row is the mean; with kind = 'steady'"
    )


@dataclass(frozen=True, kw_only=True)
class Preprocess:
    """[preprocess]: the filtering of a log; absent keys are chosen from the log, and reported."""

    cutoff_hz: float | None = key(
        number("positive"),
        "cut-off of the zero-phase low-pass",
        unit="Hz",
        note="chosen from the log's noise",
    )
    order: int | None = key(
        whole(1),
        "order of the low-pass, which is run twice",
        note="4; of minimal models the highest derivative's + 2",
    )
    decimation: int | None = key(whole(1), "one sample in so many is kept", note="as many as the band needs")
    trim: int | None = key(whole(0), "samples left out at each end, after decimation", note="a few periods")
    rest_velocity: ByJoint | None = key(
        by_joint(number("nonnegative")),
        "speed below which a sample counts as at rest",
        unit=_SPEED,
        note="five standard deviations of the velocity's noise",
    )
    align_hold: bool | None = key(
        flag,
        "whether a held command counts at the middle of its interval",
        note="false with a stated cutoff_hz, true without",
    )
    median: int | None = key(odd(3), "samples of the running median of the force", note="no median")
    derivatives: str | None = key(
        choice(DERIVATIVES),
        "how the position is differentiated",
        note="central with cutoff_hz, else spectral",
    )
    reach: int = key(whole(1), "samples on each side of a parabola", default=2)


@dataclass(frozen=True, kw_only=True)
class Identification:
    """[identification]: demands on the estimate, whatever the method."""

    physically_consistent: bool = key(
        flag, "whether the links of an arm must have parameters that rigid bodies can have", default=False
    )
    hessian: bool = key(
        flag,
        "whether the covariance uses the full Hessian, of a method that maximises a likelihood",
        default=False,
    )
    profile: tuple[str, ...] = key(
        several(text),
        "names of the unknowns whose profile likelihood is computed, by a method that maximises a likelihood",
        default=(),
    )
    per_log: tuple[str, ...] = key(
        several(text), "names of the unknowns that have a value of their own in each log", default=()
    )


@dataclass(frozen=True, kw_only=True)
class Algebraic:
    """[algebraic]: settings of the method algebraic and its forms."""

    window: tuple[float, float] | None = key(
        span(), "start and end of the one window", unit="s", note="many windows over the log"
    )


@dataclass(frozen=True, kw_only=True)
class WithinPrior:
    """[within_prior]: settings of the method within_prior, for logs too short for their unknowns."""

    prior: float = key(number("positive"), "relative standard deviation of the guesses", required=True)
    on: str = key(choice(OUTPUTS), "signal of the closed loop that is fitted", default="position")
    start: str = key(choice(STARTS), "guess; or a method whose estimate is one start more", default="guess")
    starts: int = key(whole(1), "number of starts drawn within the prior", default=1)
    hessian: bool = key(flag, "take the curvature of the cost in place of Gauss-Newton's", default=False)
    profile: bool = key(flag, "compute profile likelihoods of the fitted combinations", default=False)
    drawn: bool = key(flag, "sample the posterior, and simulate encoder rounding", default=True)
    solver: str | None = key(
        choice(SOLVERS),
        "solver of diffrax; dry friction is then smoothed",
        note="fixed steps, exact sticking",
    )
    minimiser: str | None = key(
        choice(MINIMISERS), "minimiser of the fit", note="jaxid's Levenberg-Marquardt"
    )


@dataclass(frozen=True, kw_only=True)
class OutputError:
    """[output_error]: settings of the method output_error.

    `prior` and the keys after it are an older spelling of [within_prior]: the method then fits within it.
    """

    on: str = key(choice(OUTPUTS), "signal of the closed loop that is fitted", default="position")
    start: str = key(
        choice(STARTS), "method whose estimate the fit starts from, or guess", default="inverse_dynamics"
    )
    solver: str | None = key(
        choice(SOLVERS),
        "solver of diffrax; dry friction is then smoothed",
        note="fixed steps, exact sticking",
    )
    minimiser: str | None = key(
        choice(MINIMISERS), "minimiser of the fit", note="jaxid's Levenberg-Marquardt"
    )
    prior: float | None = key(
        number("positive"), "older spelling of [within_prior] prior", note="an ordinary least-squares fit"
    )
    starts: int | None = key(whole(1), "older spelling of [within_prior] starts; with prior only")
    hessian: bool | None = key(flag, "older spelling of [within_prior] hessian; with prior only")
    profile: bool | None = key(flag, "older spelling of [within_prior] profile; with prior only")
    drawn: bool | None = key(flag, "older spelling of [within_prior] drawn; with prior only")


@dataclass(frozen=True, kw_only=True)
class Recursive:
    """[recursive]: settings of the method recursive; an adaptive controller has some of them too."""

    half_life: float | None = key(
        number("positive"),
        "time of motion after which a sample counts half",
        unit="s",
        note="nothing is forgotten",
    )
    regularization: float = key(
        number("positive"), "number of samples that the start counts as", default=1e-3
    )
    gate_velocity: ByJoint | None = key(
        by_joint(number("nonnegative")),
        "a joint's row counts if its speed exceeds this",
        unit=_SPEED,
        note="the rest velocity of [preprocess]",
    )
    gate_acceleration: ByJoint | None = key(
        by_joint(number("nonnegative")),
        "a joint's row also counts if its acceleration exceeds this",
        unit=_ACCELERATION,
        note="speed alone decides",
    )
    rows: str = key(choice(("full", "summed")), "one row a joint, or their sum", default="full")
    start: str = key(
        choice(("neutral", "guess")),
        "gains from one and forces of effects from zero, or all from the guesses",
        default="neutral",
    )
    instrument: str = key(
        choice(("none", "model")), "model: instruments without the noise of the torque", default="none"
    )
    restart: str | None = key(
        text, "result.json of an earlier run to go on from, relative to the case", note="a new run"
    )


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """A square wave that is added to the command of a loop."""

    level: float = key(number(), "height of the square wave, in units of the command", required=True)
    on: float = key(number("positive"), "time that it is on", unit="s", required=True)
    off: float = key(number("nonnegative"), "time that it is off in between", unit="s", required=True)
    start: float = key(number(), "time at which it first goes on", unit="s", default=0.0)


@dataclass(frozen=True, kw_only=True)
class SensorTable:
    """[sensor]: known errors of the measurement."""

    position_resolution: ByJoint | None = key(
        by_joint(number("positive")), "one count of the encoder", unit="position", note="no rounding"
    )
    position_noise: ByJoint | None = key(
        by_joint(number("nonnegative")), "standard deviation of a position", unit="position", note="not known"
    )
    velocity_noise: ByJoint | None = key(
        by_joint(number("positive")),
        "standard deviation of a velocity, of logs without a position",
        unit=_SPEED,
        note="estimated from the log",
    )
    force_noise: ByJoint | None = key(
        by_drive(number("nonnegative")),
        "standard deviation of the logged command",
        unit="units of the command",
        note="not known",
    )
    rate: float | None = key(
        number("positive"), "readings per second, held in between", unit="Hz", note="one a tick of the loop"
    )


@dataclass(frozen=True, kw_only=True)
class LimitsTable:
    """[limits]: bounds of an experiment; absent ones are as far as the log went."""

    stroke: tuple[float, float] | tuple[tuple[float, float], ...] | None = key(
        stretch(), "lowest and highest position", unit="position"
    )
    speed: ByJoint | None = key(by_joint(number("positive")), "largest speed", unit="position/s")
    force: ByJoint | None = key(by_drive(number("positive")), "largest command", unit="units of the command")


@dataclass(frozen=True, kw_only=True)
class DesignTable:
    """[design]: settings of an experiment along a reference."""

    criterion: str = key(
        choice(CRITERIA), "criterion that the trajectory is improved for", default=CRITERIA[0]
    )
    harmonics: int = key(whole(2), "harmonics of the Fourier series of each joint", default=5)
    base_frequency_hz: float | None = key(
        number("positive"), "frequency of the first harmonic", unit="Hz", note="one over the duration"
    )
    acceleration: ByJoint | None = key(
        by_joint(number("positive")), "largest acceleration", unit="position/s^2", note="no bound"
    )


@dataclass(frozen=True, kw_only=True)
class SimulationTable:
    """[simulation]: duration, sampling and start of a simulation."""

    duration: float | None = key(
        number("positive"), "duration; `simulate`, `study` and `design` need it", unit="s"
    )
    sample_rate: float | None = key(
        number("positive"), "samples per second; `simulate`, `study` and `design` need it", unit="Hz"
    )
    substeps: int = key(whole(1), "integration steps from one tick to the next", default=4)
    sharpness: float | None = key(
        number("positive"),
        "width of the smoothed sign of dry friction over the largest speed",
        note="dry friction sticks exactly",
    )
    initial_position: ByJoint = key(by_joint(number()), "position at the start", unit="position", default=0.0)
    initial_velocity: ByJoint = key(
        by_joint(number()), "velocity at the start", unit="position/s", default=0.0
    )


def _estimator(value: object, spot: Spot) -> str:
    """Read one of [study] estimators; methods may be registered after this module is imported."""
    return choice((*METHODS, *USER_METHODS, DISCOVER, IN_LOOP))(value, spot)


_ESTIMATOR = Reader(_estimator, choice((*METHODS, DISCOVER, IN_LOOP)).schema)


@dataclass(frozen=True, kw_only=True)
class StudyTable:
    """[study]: repetitions, noise and draws of a Monte-Carlo study."""

    estimators: tuple[str, ...] = key(
        several(_ESTIMATOR),
        "methods, discover, or in_loop: the estimate of an adaptive controller",
        default=("output_error",),
    )
    hidden: tuple[str, ...] = key(
        several(text), "kinds of effects that are simulated and not in the model", default=()
    )
    noise: tuple[float, ...] = key(
        several(number("nonnegative")), "factors of the noise in [sensor]", default=(1.0,)
    )
    sample_rate: tuple[float, ...] | None = key(
        several(number("positive")), "sampling rates to compare", unit="Hz", note="the simulation's"
    )
    position_resolution: tuple[float, ...] | None = key(
        several(number("positive")), "resolutions to compare", unit="position", note="the sensor's"
    )
    draw: float = key(number("nonnegative"), "relative spread of the true values", default=0.0)
    start_spread: float = key(number("nonnegative"), "relative spread of the guesses", default=0.0)
    runs: int = key(whole(1), "runs under each setting", default=100)
    chunk: int | None = key(whole(1), "runs that are solved together", note="as many as memory holds")


@dataclass(frozen=True, kw_only=True)
class InertialSensor:
    """One of [[inertial_sensors]]: a gyroscope or an accelerometer on a link of an arm."""

    kind: str = key(choice(INERTIAL_KINDS), " or ".join(INERTIAL_KINDS), required=True)
    link: int = key(whole(1), "link that carries it, counted from 1", required=True)
    noise: float = key(
        number("positive"), "standard deviation of a reading", unit="rad/s or m/s^2", required=True
    )
    axes: tuple[str, ...] = key(
        several(choice(AXES), longest=3), "axes of the sensor that it reads", default=AXES
    )
    position: tuple[float, ...] | None = key(
        _VECTOR, "position of an accelerometer in the frame of the link", unit="m", note="the frame's origin"
    )
    rotation: tuple[float, ...] | None = key(
        _VECTOR, "rotation vector from the link's axes to the sensor's", unit="rad", note="no rotation"
    )
    scale: ByJoint | None = key(by_joint(number("positive"), "axis"), "reading over quantity", note="1")
    bias: ByJoint | None = key(by_joint(number(), "axis"), "reading at rest", unit="rad/s or m/s^2", note="0")
    range: float | None = key(
        number("positive"), "largest absolute reading", unit="rad/s or m/s^2", note="no limit"
    )
    rate: float | None = key(
        number("positive"), "readings per second", unit="Hz", note="one a tick of the loop"
    )
    calibrated: bool = key(flag, "whether rotation, scale and bias are known to the loop", default=True)


_LOG = Spot("", "[log]")


def log_table(columns: LogTable | Mapping[str, Any], spot: Spot = _LOG) -> LogTable:
    """Read a [log] table.

    Args:
        columns: The table, checked already or as it stands in a case.
        spot: Position of the table, for messages.

    Raises:
        InputError: If a key is unknown, missing or impossible, or there is no time base.
    """
    if isinstance(columns, LogTable):
        return columns
    table = read_settings(LogTable, dict(columns), spot)
    _check_kind(table, dict(columns), spot)
    if table.kind == "steady":
        return table
    if table.time is None and table.sample_rate is None:
        hint = 'add time = "<name of the column>", or sample_rate = <Hz>'
        raise spot.fault("neither time nor sample_rate is given", hint)
    return table


# Keys that a table of steady speeds may have.
_STEADY_KEYS = (
    *("kind", "velocity", "force", *STEADY_COLUMNS),
    *("units", "sign", "position_at", "rows", "format", "separator", "decimal"),
    *("temperature", "counts_per_revolution"),
)


def _check_kind(table: LogTable, given: dict[str, Any], spot: Spot) -> None:
    """Refuse columns that the kind of the log does not have, or lacks."""
    if table.kind == "steady":
        for name in ("velocity", "force"):
            if name not in given:
                hint = f"add {name} = its column: a steady table has a velocity and the force that holds it"
                raise spot.fault(f"'{name}' is missing", hint)
        other = next((name for name in given if name not in _STEADY_KEYS), None)
        if other is not None:
            raise spot.at(other).fault('does not go with kind = "steady"', "leave it out, or remove kind")
        return
    other = next((name for name in STEADY_COLUMNS if name in given), None)
    if other is not None:
        raise spot.at(other).fault('goes with kind = "steady" only', "leave it out")
    if table.position is None and table.velocity is None and table.loop_velocity is None:
        hint = "add position: the name of its column; or velocity, where only the velocity was logged"
        raise spot.fault("'position' is missing", hint)
