"""The raw public logs, with the values that are true of them, published, or found independently."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import pi, sqrt
from pathlib import Path

import numpy as np

Values = Mapping[str, float]
FRICTION = ("inertia", "viscous_friction.coefficient", "coulomb_friction.level")
PENDULUM = ("inertia_zz[1]", "first_moment_x[1]", "coulomb_friction.level")


@dataclass(frozen=True)
class Row:
    """One log of the table.

    file: in the folder of data; truth: by parameter, in the units of the case that `init` writes; of: source
    of these values; derived: quantities to compare in place of parameters; made: writes the log from files
    of the data, for tables that stand in several files; search: whether `discover` is the third command.
    """

    file: str
    truth: Values
    of: str
    derived: Callable[[Values], Values] | None = None
    made: Callable[[Path, Path], None] | None = None
    search: bool = False


def friction(*values: float, names: tuple[str, ...] = FRICTION) -> dict[str, float]:
    return dict(zip(names, values, strict=True))


SIMULATED = "simulation, to some counts of the encoder"
FEEDFORWARD = friction(0.02, 0.12, 0.25)
TIME = friction(0.05, 0.15, 0.4)
SWING = friction(1.9e-4, 0.021 / 9.81, 4e-4, names=PENDULUM)
SO101 = (
    "backlash_detection chirp_sweep friction_gravity hold_under_gravity multisine prbs_excitation "
    "single_joint_elbow single_joint_rotation slow_precision step_response trapezoidal_profile wave_motion"
).split()
# Counts of 1440 a turn, and 255 steps of PWM for 12 V.
COUNT, STEP = 2 * pi / 1440, 12 / 255
PWM = friction(7.82e-3 / STEP * COUNT, 0.0240 / STEP * COUNT, 0.235 / STEP)
# N for a volt of the command.
EMPS_GAIN = 35.15065
EMPS = friction(95.109 / EMPS_GAIN, 203.50 / EMPS_GAIN, 20.39 / EMPS_GAIN)
# Fit of a plain simulation by scipy, without jaxid; mass times distance as built.
DFKI = friction(0.133, 0.260, 0.345, names=PENDULUM)
SILVERBOX_RATE = 1e7 / 2**14

# Friction of joint 4, which moves most, at its motor: the gear has 48 turns.
TX40_JOINT_4 = {"viscous_friction.coefficient": 1.11 / 48**2, "coulomb_friction.level": 2.48 / 48}


def resonance(values: Values) -> Values:
    """Read natural frequency and damping of the oscillator; `init` assumes 1000 samples a second."""
    inertia, stiffness = values["inertia"], values["linear_stiffness.coefficient"]
    damping = values["viscous_friction.coefficient"] / (2 * sqrt(inertia * stiffness))
    frequency = sqrt(stiffness / inertia) / (2 * pi) * SILVERBOX_RATE / 1000.0
    return {"natural frequency [Hz], at the true rate": frequency, "damping ratio": damping}


def tx40_table(data: Path, log: Path) -> None:
    """Join the two tables of the TX40, as a user would, with their time at 5 kHz; one sample in ten."""
    tables = [
        np.loadtxt(data / f"tx40/{n}.csv", delimiter=",", skiprows=1) for n in ("pos_read_data", "curr_data")
    ]
    time = np.arange(len(tables[0])) / 5000.0
    names = ["t", *(f"q{k}" for k in range(1, 7)), *(f"tau{k}" for k in range(1, 7))]
    rows = np.column_stack([time, *tables])[::10]
    np.savetxt(log, rows, delimiter=",", header=",".join(names), comments="", fmt="%.9g")


ROWS = (
    Row("field/decimal_comma.csv", {}, "not stated"),
    Row("field/empty_cells.csv", {}, "not stated"),
    Row("field/pwm_counts.csv", PWM, SIMULATED, search=True),
    Row("field/sign_good.csv", FEEDFORWARD, SIMULATED, search=True),
    Row("field/sign_flipped.csv", FEEDFORWARD, SIMULATED),
    Row("field/slow_log.csv", friction(0.03, 0.1, 0.3), SIMULATED),
    Row("field/swing_kick.csv", SWING, SIMULATED, search=True),
    Row("field/swing_no_torque.csv", SWING, SIMULATED),
    Row("field/swing_zero_torque.csv", SWING, SIMULATED),
    Row("field/target_and_position.csv", friction(0.12, 0.5, 0.6), SIMULATED),
    Row("field/test_dynamic-forward.csv", FEEDFORWARD, SIMULATED),
    Row("field/test_dynamic-reverse.csv", FEEDFORWARD, SIMULATED),
    Row("field/test_quasistatic-forward.csv", FEEDFORWARD, SIMULATED),
    Row("field/test_quasistatic-reverse.csv", FEEDFORWARD, SIMULATED),
    Row("field/time_seconds.csv", TIME, SIMULATED, search=True),
    Row("field/time_milliseconds.csv", TIME, SIMULATED),
    Row("field/time_microseconds.csv", TIME, SIMULATED),
    Row("field/time_ros_jitter.csv", TIME, SIMULATED),
    Row("field/time_irregular.csv", TIME, SIMULATED),
    Row("field/time_doubled.csv", TIME, SIMULATED),
    Row("field/time_gaps.csv", TIME, SIMULATED),
    Row("field/velocity_only.csv", FEEDFORWARD, SIMULATED),
    Row("field/velocity_table.csv", {}, "not stated"),
    Row("field/wrapped.csv", friction(6e-4, 1.2e-3, 0.008), SIMULATED),
    Row(
        "odri_motor/speed_test1.csv",
        {"inertia": 1.97e-4},
        "least squares with the ripple as a column",
        search=True,
    ),
    Row("odri_motor/acc_current.csv", {}, "not published"),
    Row("dfki_pendulum/pd.csv", DFKI, "fit of a simulation by scipy", search=True),
    Row("dfki_pendulum/swingup_1nm.csv", DFKI, "fit of a simulation by scipy, of pd.csv"),
    Row("emps/DATA_EMPS.mat", EMPS, "Janot et al. 2019", search=True),
    Row("emps/DATA_EMPS_PULSES.mat", EMPS, "Janot et al. 2019, of DATA_EMPS.mat"),
    Row(
        "silverbox/SNLS80mV.mat",
        {"natural frequency [Hz], at the true rate": 68.3, "damping ratio": 0.049},
        "Wigren and Schoukens 2013",
        resonance,
    ),
    Row("tx40/pos_read_data.csv", {}, "figaroh"),
    Row("tx40/curr_data.csv", {}, "figaroh"),
    Row("tx40/both, joined.csv", TX40_JOINT_4, "figaroh, of joint 4", made=tx40_table),
    *(Row(f"so101/{motion}.csv", {}, "none") for motion in SO101),
)
