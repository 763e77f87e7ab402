"""Logs that are readable and still make no sense: each fault found, sound logs left alone."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.logs.log import Log, read_log
from jaxid.logs.rough_inertia import correlation, implied_inertia, smooth
from jaxid.logs.soundness import Finding, check_log, plausible_inertia, raise_on_error
from jaxid.logs.units_check import ratio_findings
from truth.axis.stepper import Loop, Machine, Sensor, simulate

INERTIA, VISCOUS, COULOMB = 12.0, 30.0, 8.0
GAIN = 4.0


def axis_log(seed: int = 0, **changes) -> Log:
    """An axis with friction in closed form: the force is computed from the motion."""
    t = np.arange(4000) / 1000.0
    w = 2 * np.pi * np.array([0.8, 1.9, 3.1])
    a = np.array([0.05, 0.03, -0.02])
    q = np.sin(np.outer(t, w)) @ a
    v = np.cos(np.outer(t, w)) @ (a * w)
    acceleration = -np.sin(np.outer(t, w)) @ (a * w**2)
    force = INERTIA * acceleration + VISCOUS * v + COULOMB * np.sign(v)
    noise = np.random.default_rng(seed)
    q_measured = q + 2e-6 * noise.standard_normal(t.size)
    u = (force + 0.5 * noise.standard_normal(t.size)) / GAIN
    fields = {"time": t, "position": q_measured, "force": u, "velocity": v, "reference": q}
    return Log(**{**fields, **changes})


def scaled(log: Log, **factors: float) -> Log:
    return dataclasses.replace(log, **{name: factor * getattr(log, name) for name, factor in factors.items()})


def found(log: Log, severity: str, match: str, **kwargs) -> Finding:
    """The one finding of this severity whose line holds the words."""
    hits = [f for f in check_log(log, **kwargs) if f.severity == severity and match in str(f)]
    assert len(hits) == 1, [str(f) for f in check_log(log, **kwargs)]
    assert hits[0].hint
    return hits[0]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("motion", ["linear", "rotary"])
def test_a_sound_log_raises_nothing(seed, motion):
    log = axis_log(seed)
    assert check_log(log, motion=motion, command_limit=100.0) == []
    for guess in (INERTIA / 20, INERTIA, 20 * INERTIA):
        assert plausible_inertia(log, guess, GAIN, motion="linear") is None


def test_first_error_is_raised_with_the_number_of_others():
    warning = Finding("warning", "w", "here", "mend it")
    raise_on_error([warning])
    error = Finding("error", "what", "log.csv, position", "mend")
    with pytest.raises(InputError, match=r"^log.csv, position: what; mend$"):
        raise_on_error([warning, error])
    with pytest.raises(InputError, match=r"and 1 more error"):
        raise_on_error([error, error])


# Nothing moves, nothing pushes


def test_position_that_never_changes():
    found(axis_log(position=np.full(4000, 0.2)), "error", "nothing moves: the position is 0.2")


def test_position_within_a_few_counts():
    counts = np.random.default_rng(0).integers(0, 3, 4000) * 1e-6
    found(axis_log(position=counts), "error", "only 3 values, 1e-06 apart")


def test_position_that_is_noise():
    noise = 1e-6 * np.random.default_rng(0).standard_normal(4000)
    found(axis_log(position=0.2 + noise), "error", "nothing moves: the position is noise")


def test_one_joint_of_two_at_rest_is_a_warning():
    moving = axis_log().position[:, 0]
    both = np.stack([moving, np.zeros(4000)], axis=1)
    log = Log(time=axis_log().time, position=both, force=axis_log().force)
    assert "joint 2" in found(log, "warning", "does not move").where


def test_force_zero_or_constant():
    found(axis_log(force=np.zeros(4000)), "error", "force is zero throughout")
    found(axis_log(force=np.full(4000, 2.5)), "error", "force is constant (2.5)")
    one = np.stack([axis_log().force[:, 0], np.ones(4000)], axis=1)
    assert "force 2" in found(axis_log(force=one), "warning", "constant at 1").where


def test_saturation():
    u = axis_log().force[:, 0]
    low = np.quantile(np.abs(u), 0.3)
    deep = np.clip(u, -low, low)
    found(axis_log(force=deep), "error", "saturated: |u| =")
    found(axis_log(force=deep), "error", "in 70 % of the rows", command_limit=low)
    edge = np.quantile(np.abs(u), 0.8)
    clipped = axis_log(force=np.clip(u, -edge, edge))
    found(clipped, "warning", "in 20 % of the rows", command_limit=edge)
    assert not [f for f in check_log(clipped) if "saturated" in f.what], "a limit nobody gave"


def test_a_step_from_rest_is_no_saturation():
    """A trace begins before its step; behind it the force is constant, which a transient may have."""
    step = np.where(np.arange(4000) < 300, 0.0, 0.35)
    fault = found(axis_log(force=step), "error", "the force is one step, from 0 to 0.35")
    assert fault.hint == "select the rows behind it: rows = [300, 4000] in [log]"


def test_a_binary_excitation_is_no_saturation():
    bits = np.where(np.random.default_rng(0).random(4000) > 0.5, 2.0, -2.0)
    assert all(f.severity == "warning" for f in check_log(axis_log(force=bits)))


def test_coarse_encoder_is_told_with_its_resolution():
    q = np.round(axis_log().position / 1e-3) * 1e-3
    found(axis_log(position=q, velocity=None), "warning", "steps of 0.001")
    fine = np.round(axis_log().position / 1e-5) * 1e-5
    assert check_log(axis_log(position=fine)) == []


@pytest.mark.parametrize("stated", [False, True])
def test_a_resolution_that_the_case_states_is_not_asked_for(stated):
    log = axis_log()
    coarse = dataclasses.replace(log, position=1e-3 * np.round(log.position / 1e-3))
    told = found(coarse, "warning", "quantised", resolution_stated=stated)
    assert ("give sensor.position_resolution" in told.hint) == (not stated)


# Units


@pytest.mark.parametrize(
    ("motion", "factors", "text"),
    [
        ("linear", {"position": 1e3, "reference": 1e3}, "position looks like millimetres"),
        ("linear", {"velocity": 1e3}, "velocity looks like mm/s"),
        ("linear", {"time": 1e3}, "time like milliseconds"),
        ("linear", {"time": 1e6}, "time looks like microseconds"),
        ("rotary", {"position": 57.29578, "reference": 57.29578}, "position looks like degrees"),
        ("rotary", {"velocity": 57.29578}, "velocity looks like degrees/s"),
        ("rotary", {"velocity": 9.549297}, "revolutions per minute"),
    ],
)
def test_velocity_and_position_disagree(motion, factors, text):
    finding = found(scaled(axis_log(), **factors), "error", text, motion=motion)
    assert "velocity of joint 1" in finding.where


def test_velocity_of_the_wrong_sign_or_column():
    found(scaled(axis_log(), velocity=-1.0), "error", "opposite sign")
    found(axis_log(velocity=axis_log().position), "warning", "not the derivative")
    found(scaled(axis_log(), velocity=2.0), "warning", "2 times the derivative")


@pytest.mark.parametrize(
    ("motion", "factor", "text"),
    [
        ("linear", 1e3, "reference looks like millimetres"),
        ("linear", 1e-3, "position looks like millimetres"),
        ("rotary", 57.29578, "reference looks like degrees"),
    ],
)
def test_reference_and_position_disagree(motion, factor, text):
    found(scaled(axis_log(), reference=factor), "error", text, motion=motion)


def test_reference_by_an_unusual_factor_is_a_warning():
    found(scaled(axis_log(), reference=5.0), "warning", "which should be 1")


@pytest.mark.parametrize(("force", "severity"), [(0.0, "error"), (1.0, "warning")])
def test_a_reference_behind_a_gear_says_how_the_position_is_brought_to_it(force, severity):
    """A ratio of 50 is not that of degrees to radians, 57.3; without a force the reference is what drives."""
    log = dataclasses.replace(scaled(axis_log(), reference=0.02), force=force * axis_log().force)
    [finding] = ratio_findings(log, "rotary", "log")
    assert (finding.severity, "which should be 1" in finding.what) == (severity, True)
    assert 'units = { position = "0.02 rad", reference = "rad" }' in finding.hint


def test_a_reference_of_the_opposite_sign_is_refused():
    finding = found(scaled(axis_log(), reference=-1.0), "error", "moves against the position")
    assert "sign = { reference = -1 }" in finding.hint


def test_a_reference_with_another_zero_is_a_warning():
    log = axis_log()
    far = dataclasses.replace(log, position=log.position + 0.45 * np.ptp(log.position), velocity=None)
    assert "by [log] offset" in found(far, "warning", "from the reference that it follows").hint
    near = dataclasses.replace(log, position=log.position + 0.25 * np.ptp(log.position), velocity=None)
    assert check_log(near) == []


def test_magnitudes():
    bare = axis_log(velocity=None, reference=None)
    found(scaled(bare, position=1e3), "warning", "position looks like millimetres")
    found(scaled(bare, position=1e6), "error", "position looks like micrometres")
    found(scaled(bare, time=1001.5), "warning", "time looks like milliseconds")
    found(scaled(bare, time=1e3), "error", "time looks like milliseconds")
    found(scaled(bare, time=2e4), "error", "sampling period is 20 s")
    found(scaled(bare, position=3e4), "warning", "position looks like degrees", motion="rotary")
    counts = np.round(bare.position * 1e5)
    found(dataclasses.replace(bare, position=counts), "error", "encoder counts", motion="rotary")


def test_foreign_units_leave_magnitudes_alone():
    volts = scaled(axis_log(velocity=None, reference=None), position=1e3)
    assert check_log(volts, units={"position": "V", "force": "V"}) == []


# Inertia by its order of magnitude


def test_implied_inertia_is_near_the_truth():
    log = axis_log()
    value = implied_inertia(GAIN * log.force[:, 0], log.position[:, 0], log.period)
    # Noise of 2 um twice differentiated is 5 m/s^2: only the longer windows are near.
    assert value == pytest.approx(INERTIA, rel=0.1)


def test_a_spring_that_a_controller_makes_is_no_inertia():
    """Let go against K_p q, all of the command is a spring: the machine's own law explains it as well."""
    friction = {"viscous_friction": {"coefficient": 1.7}, "coulomb_friction": {"level": 3.7}}
    loop = Loop("friction_compensation", kp=235.0, viscous=1.7, reference=np.zeros(900))
    made = simulate(
        Machine(1.35, friction),
        loop,
        Sensor(position_noise=1e-7, force_noise=0.2),
        rate=1e3,
        duration=0.9,
        initial_position=0.1,
    )
    log = Log(made["t"], made["position"], made["force"], source="swing.csv")
    for guess in (1.35, 0.7, 5.0):
        assert plausible_inertia(log, guess, motion="rotary") is None


def test_implied_inertia_without_motion():
    still = np.zeros(1000)
    assert implied_inertia(np.ones(1000), still, 1e-3) is None


@pytest.mark.parametrize(
    ("motion", "factors", "severity", "text"),
    [
        ("linear", {"position": 1e3}, "error", "position looks like millimetres"),
        ("linear", {"position": 1e6}, "error", "position looks like micrometres"),
        ("linear", {"time": 1e3}, "error", "time looks like milliseconds"),
        ("linear", {"force": 1e3}, "warning", "force looks like thousandths"),
        ("rotary", {"position": 57.29578}, "warning", "position looks like degrees"),
    ],
)
def test_inertia_names_the_slip(motion, factors, severity, text):
    log = scaled(axis_log(), **factors)
    for guess in (INERTIA / 1.8, INERTIA, 1.8 * INERTIA):
        finding = plausible_inertia(log, guess, GAIN, motion=motion)
        assert finding is not None
        assert finding.severity == severity
        assert text in finding.what


def test_degrees_are_certain_once_the_angle_is_large():
    log = scaled(axis_log(), position=57.29578 * 5, force=5.0)
    finding = plausible_inertia(log, INERTIA, GAIN, motion="rotary")
    assert finding is not None
    assert finding.severity == "error"


def test_joints_without_a_force_of_their_own_are_left_alone():
    both = np.repeat(scaled(axis_log(), position=1e3).position, 2, axis=1)
    log = Log(time=axis_log().time, position=both, force=axis_log().force)
    assert plausible_inertia(log, [INERTIA, INERTIA], GAIN) is None


# The arithmetic


def test_smooth_keeps_what_is_linear_and_its_length():
    ramp = 1e6 + 0.5 * np.arange(100.0)
    result = smooth(ramp, 8)
    assert result.size == 100 - 3 * 7
    # Three means of 8 shift a ramp by 3 * 3.5 samples; 1e6 leaves 1e-9 of rounding.
    np.testing.assert_allclose(result, ramp[: result.size] + 0.5 * 10.5, atol=1e-8)


def test_correlation():
    x = np.arange(10.0)
    assert correlation(x, -3 * x + 1) == pytest.approx(-1.0)
    assert correlation(x, np.ones(10)) == 0.0


# Measured logs


@pytest.fixture(scope="module")
def measured():
    if not os.environ.get("JAXID_DATA"):
        pytest.skip("JAXID_DATA is unset: no measured logs here")
    return Path(os.environ["JAXID_DATA"])


@pytest.mark.parametrize("name", ["DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"])
def test_emps_is_sound_and_its_slips_are_found(measured, name):
    columns = {"time": "t", "position": "qm", "force": "vir", "reference": "qg"}
    log = read_log(measured / "emps" / name, columns)
    assert check_log(log, command_limit=10.0) == []
    for guess in (8.0, 80.0, 800.0):
        assert plausible_inertia(log, guess, 35.15) is None
    slips = (("position", 1e3, "mill"), ("position", 1e6, "micro"), ("time", 1e3, "milliseconds"))
    for quantity, factor, text in slips:
        finding = plausible_inertia(scaled(log, **{quantity: factor}), 80.0, 35.15)
        assert finding is not None
        assert text in finding.what


@pytest.mark.parametrize("rows", [[0, 131072], [40650, 105712], [100, 40575], [105712, 127400]])
def test_silverbox_is_sound(measured, rows):
    columns = {"sample_rate": 1e7 / 2**14, "position": "V2", "force": "V1", "rows": rows}
    log = read_log(measured / "silverbox" / "SNLS80mV.mat", columns)
    assert check_log(log, units={"position": "V", "force": "V"}) == []
    assert check_log(log) == [], "even where nobody said that these are volts"
    assert plausible_inertia(log, 1e-6, 1.0) is None


def test_tx40_is_sound(measured):
    folder = measured / "tx40"
    q, tau = (
        np.loadtxt(folder / name, delimiter=",", skiprows=1)
        for name in ("pos_read_data.csv", "curr_data.csv")
    )
    reduction = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    reduction[5, 4] = 32.0
    time = np.arange(len(q)) / 5000.0
    assert check_log(Log(time=time, position=q, force=tau), motion="rotary") == []
    joint_side = Log(time=time, position=q @ np.linalg.inv(reduction).T, force=tau @ reduction)
    assert check_log(joint_side, motion="rotary") == []
    # Chosen: what a guess for an arm of this size might be, at the joints.
    guess = [1.0, 1.0, 0.3, 0.1, 0.1, 0.05]
    assert plausible_inertia(joint_side, guess, motion="rotary") is None


def test_a_reference_belongs_to_the_joint_that_is_driven():
    """Of two joints only the second has a drive: its reference is not the first one's position."""
    log = axis_log()
    follower = np.column_stack([0.3 * log.position[:, 0], log.position[:, 0]])
    both = dataclasses.replace(log, position=follower, velocity=None)
    assert not [f for f in check_log(both, driven=[1]) if "reference" in f.what]
    assert [f.where for f in check_log(both) if "reference" in f.what] == [
        f"{both.source}, reference of joint 1"
    ]
