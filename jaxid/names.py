"""Names that users write: methods, outputs, solvers, holds and other choices, each list once.

It imports nothing, so that the command line can list them without loading JAX.
"""

# Estimators, in the order in which help texts list them; `jaxid.estimators.METHODS` has one entry for each.
METHODS = (
    "output_error",
    "prediction_error",
    "within_prior",
    "inverse_dynamics",
    "algebraic",
    "instrumental_variable",
    "didim",
    "power",
    "recursive",
    "algebraic_single_time",
    "algebraic_ratio",
    "algebraic_sign_changed",
    "algebraic_sign_unchanged",
    "minimal_model",
    "minimal_model_printed",
)
# When to take each method, for `jaxid methods`.
WHEN = {
    "output_error": "a simulated loop whose log is slower than it; break-away; an unknown reference",
    "prediction_error": "most logs, open loop or feedback, sensors stated or not; the usual default",
    "within_prior": "a short log and guesses of known precision",
    "inverse_dynamics": "arms, very long logs, a first estimate; needs a well chosen filter",
    "algebraic": "an online estimate by integrals, without derivatives",
    "instrumental_variable": "a loop with a noisy encoder, as a check of inverse dynamics",
    "didim": "a known loop with a poor encoder: force is fitted, the position only simulated",
    "power": "energy balances, without accelerations",
    "recursive": "parameters that change with time",
    "algebraic_single_time": "`algebraic` with one window: one equation per unknown",
    "algebraic_ratio": "`algebraic` with one window: ratios of integrals",
    "algebraic_sign_changed": "`algebraic` with one window, friction of a motion that reverses",
    "algebraic_sign_unchanged": "`algebraic` with one window, friction of a motion that does not reverse",
    "minimal_model": "a flexible joint of which only motor or load is measured",
    "minimal_model_printed": "`minimal_model` with the coefficients as published",
}
# Methods that fit several logs together.
SEVERAL_LOGS = (
    "output_error",
    "prediction_error",
    "inverse_dynamics",
    "algebraic",
    "power",
    "instrumental_variable",
    "didim",
    "recursive",
    "within_prior",
)
# Further entries of [study] estimators: the search, and the estimate of an adaptive controller.
DISCOVER, IN_LOOP = "discover", "in_loop"
# Methods that maximise a likelihood, so that it has a Hessian and profiles.
LIKELIHOOD_METHODS = ("output_error", "prediction_error", "within_prior")
# Methods that leave out rows in which the force is not known, and those that take no logged force if the
# control law is declared.
LEAVE_ROWS_OUT = ("prediction_error", "inverse_dynamics", "instrumental_variable", "didim", "recursive")
SIMULATE_THE_LOOP = ("output_error", "within_prior")
# Pictures that `jaxid plot` draws of a result, and the name of its table of signals.
SIGNALS = "signals"
PICTURES = (
    "forces",
    "residual",
    "scatter",
    "friction",
    "fit",
    "parameters",
    "history",
    "where",
    "candidates",
    "profiles",
    "motion",
)
# Signals of a simulated loop that output error compares with the log.
OUTPUTS = ("position", "force", "both")
# Methods that output error may take its start from.
STARTS = ("inverse_dynamics", "recursive", "guess")
# Solvers of diffrax by their classes: those with an error estimate that need one right-hand side.
SOLVERS = {
    "tsit5": "Tsit5",
    "dopri5": "Dopri5",
    "dopri8": "Dopri8",
    "bosh3": "Bosh3",
    "kvaerno3": "Kvaerno3",
    "kvaerno5": "Kvaerno5",
}
# Minimisers of output error: the default is jaxid's Levenberg-Marquardt; the solvers of optimistix here
# need only tolerances. Any other may be given from Python as an instance.
MINIMISERS = (
    "levenberg_marquardt",
    "optimistix.LevenbergMarquardt",
    "optimistix.IndirectLevenbergMarquardt",
    "optimistix.GaussNewton",
    "optimistix.Dogleg",
    "optimistix.BFGS",
    "optimistix.DFP",
    "optimistix.LBFGS",
    "optimistix.NonlinearCG",
    "optimistix.NelderMead",
)
# Methods of `jaxid.register_method`, which Python and [study] estimators of a case may then name.
USER_METHODS: list[str] = []
# Course of the command between two samples.
HOLDS = ("zero_order", "linear", "band_limited")
# Columns of a log beside time, position and force.
OPTIONAL_COLUMNS = (
    "velocity",
    "acceleration",
    "reference",
    "load_position",
    "load_acceleration",
    "temperature",
    "effort",
)
# Columns that only a table of steady speeds has.
STEADY_COLUMNS = ("scatter", "samples")
# Kinds of a log: samples over time, or a table of steady speeds.
LOG_KINDS = ("time", "steady")
# Ways to differentiate a position, see `jaxid.logs.prepare`.
DERIVATIVES = ("central", "spectral", "parabolic")
# Signals that the derivative gain of a PD law acts on.
LAW_DERIVATIVES = ("error", "velocity")
# Criteria by which `jaxid design` improves a trajectory.
CRITERIA = ("determinant", "condition")
MOTIONS = ("linear", "rotary")
ORIENTATIONS = ("horizontal", "vertical")
# Kinds of inertial sensors, and the axes that they may read.
INERTIAL_KINDS = ("gyroscope", "accelerometer")
AXES = ("x", "y", "z")
# Separators of text tables, in order of preference if a header has equally many of two (a blank stands for
# one or more of them), and decimal signs.
SEPARATORS = (";", "\t", ",", "|", " ")
DECIMALS = (".", ",")
# Quantities of a log that have units, or whose sign may be turned.
UNIT_OF = (
    "time",
    "position",
    "velocity",
    "acceleration",
    "force",
    "reference",
    "load_position",
    "load_acceleration",
)
SIGN_OF = UNIT_OF[1:]
# Quantities whose zero may be moved.
OFFSET_OF = ("position", "reference", "load_position")
# Quantities of a log that may have been logged late.
LATE_OF = ("force",)
# Sides of a gear at which an angle may be measured.
SIDES = ("load", "motor")
# Ways to resample: lines between readings, or cubic splines.
RESAMPLINGS = ("linear", "band_limited")
# Files of other programs that `export` writes, with the ends of their names.
TARGETS = {
    "mjcf": (".xml",),
    "urdf": (".urdf", ".xml"),
    "isaaclab": (".py",),
    "c": (".h",),
    "python": (".py",),
}
# Ends of the names of robot files, which commands take in place of a case, and the name of the case that they
# then write beside their results.
ROBOT_FILES = (".xml", ".mjcf", ".urdf")
FIRST_CASE = "first_case.toml"
# Names of ports in case files and results; ports of each kind count from 1.
PLACES = ("joint", "spring", "shaft", "passive", "tool")
# Kinds of the joints of an arm.
JOINTS = ("revolute", "prismatic")
# Inertial parameters of a link, in the order of the fields of an arm.
TEN = (
    "mass",
    "first_moment_x",
    "first_moment_y",
    "first_moment_z",
    "inertia_xx",
    "inertia_xy",
    "inertia_xz",
    "inertia_yy",
    "inertia_yz",
    "inertia_zz",
)
