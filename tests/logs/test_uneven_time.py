"""Time as logs have it: jitter, doubled and missing stamps, gaps, sensors of unequal rate; read, and said."""

import os
from pathlib import Path

import numpy as np
import pytest

from jaxid.logs.in_memory import as_log
from jaxid.logs.log import read_log
from jaxid.logs.resample import Readings, resampled
from tests.support.written_logs import COLUMNS, ROWS, edit, refuse, signals, write_csv


def words(log) -> dict:
    return {a.setting: a for a in log.assumed}


def at(t):
    """Return position and force of `signals` at any time."""
    return 0.1 * np.sin(20 * t), 3.0 * np.cos(20 * t + 0.3)


def test_even_stamps_are_not_touched():
    data = signals()
    log = as_log(data, COLUMNS)
    np.testing.assert_array_equal(log.position[:, 0], data["q"])
    assert log.assumed == ()


def test_jitter_is_resampled_at_the_mean_rate(tmp_path):
    t = signals()["t"] + np.random.default_rng(1).uniform(-2e-4, 2e-4, ROWS)
    q, u = at(t)
    log = read_log(write_csv(tmp_path / "log.csv", {"t": t, "q": q, "u": u}), COLUMNS)
    assert log.rate_hz == pytest.approx(1000.0, rel=5e-3)
    # A line between readings is off by h^2 / 8 times the curvature: (1.4 ms)^2 / 8 * 400 * 0.1.
    np.testing.assert_allclose(log.position[:, 0], at(log.time)[0], atol=1e-5)
    assert "off the period" in words(log)["uneven_time"].reason
    assert "of the noise of a reading" in words(log)["resample_method"].reason


@pytest.mark.parametrize(("method", "error"), [("linear", 1e-5), ("band_limited", 1e-8)])
def test_the_method_can_be_stated(method, error):
    t = signals()["t"] + np.random.default_rng(1).uniform(-2e-4, 2e-4, ROWS)
    q, u = at(t)
    log = as_log({"t": t, "q": q, "u": u}, {**COLUMNS, "resample": 800.0, "resample_method": method})
    assert log.rate_hz == pytest.approx(800.0)
    inner = slice(5, -5)
    np.testing.assert_allclose(log.position[inner, 0], at(log.time)[0][inner], atol=error)
    assert words(log)["resample_method"].value == method


def test_half_a_percent_of_jitter_and_a_single_loose_row_are_left_alone(tmp_path):
    data = signals()
    jitter = np.random.default_rng(1).uniform(-2.5e-6, 2.5e-6, ROWS)
    log = as_log({**data, "t": data["t"] + jitter}, COLUMNS)
    np.testing.assert_array_equal(log.position[:, 0], data["q"])
    data["t"][100] += 2e-4
    assert as_log(data, COLUMNS).samples == ROWS


def test_a_doubled_row_is_one_sample(tmp_path):
    data = signals()
    again = np.insert(np.arange(ROWS), 60, 59)
    path = write_csv(tmp_path / "log.csv", {name: v[again] for name, v in data.items()})
    log = read_log(path, COLUMNS)
    np.testing.assert_array_equal(log.position[:, 0], data["q"])
    assert "1 row(s) have the time of the row before, first row 60" in words(log)["doubled_rows"].reason


def test_readings_at_one_time_are_averaged():
    data = signals()
    data["t"][60] = data["t"][59]
    log = as_log(data, COLUMNS)
    k = int(np.argmin(np.abs(log.time - data["t"][59])))
    assert log.position[k, 0] == pytest.approx(data["q"][59:61].mean(), rel=1e-12)


def test_missing_samples_are_interpolated(tmp_path):
    keep = np.setdiff1d(np.arange(ROWS), [40, 41, 120])
    log = as_log({name: v[keep] for name, v in signals().items()}, COLUMNS)
    assert log.samples == ROWS
    # Across three periods a line is off by 9 h^2 / 8 times the curvature.
    np.testing.assert_allclose(log.position[:, 0], signals()["q"], atol=5e-5)
    assert "3 sample(s) are missing" in words(log)["uneven_time"].reason


def test_the_longest_stretch_between_gaps_is_used(tmp_path):
    data = signals()
    data["t"][150:] += 0.5
    log = read_log(write_csv(tmp_path / "log.csv", data), COLUMNS)
    assert log.rows == (0, 150)
    np.testing.assert_array_equal(log.position[:, 0], data["q"][:150])
    said = words(log)["rows"]
    assert said.value == [0, 150]
    assert "of 0.501 s after row 149" in said.reason
    assert "others are rows = [150, 200]" in said.reason


def test_a_long_first_step_is_cut_off():
    data = signals()
    data["t"][1:] += 0.004
    log = as_log(data, COLUMNS)
    assert log.rows == (1, ROWS)
    assert log.samples == ROWS - 1


def test_an_empty_cell_is_no_reading(tmp_path):
    path = write_csv(tmp_path / "log.csv", signals())
    log = read_log(edit(path, 7, "0.007,,1"), COLUMNS)
    assert log.samples == ROWS
    assert log.position[7, 0] == pytest.approx((signals()["q"][6] + signals()["q"][8]) / 2, rel=1e-12)
    assert log.force[7, 0] == pytest.approx(1.0)
    assert "none in 1 of 200 rows" in words(log)["readings"].reason


def test_not_a_number_is_interpolated_on_request_only(tmp_path):
    path = write_csv(tmp_path / "log.csv", signals())
    edit(path, 7, "0.007,nan,1")
    refuse(path, match="1 row.s. are NaN or infinite, .*or set resample = <Hz> to interpolate across them")
    assert read_log(path, {**COLUMNS, "resample": 1000.0}).samples == ROWS
    edit(path, 7, "0.007,inf,1")
    refuse(path, {**COLUMNS, "resample": 1000.0}, match="infinite")


def test_a_column_without_readings_is_named(tmp_path):
    lines = [f"{k / 1000},,{k}" for k in range(ROWS)]
    (tmp_path / "log.csv").write_text("\n".join(["t,q,u", *lines]))
    refuse(tmp_path / "log.csv", match=r"position has 0 reading\(s\); check the column")


def test_sensors_of_unequal_rate(tmp_path):
    """Every row holds one sensor: 1 kHz, 200 Hz and 10 Hz, as a plot program exports."""
    rng = np.random.default_rng(0)
    times = {"q": np.arange(4000) / 1000, "u": 1e-4 + np.arange(800) / 200, "T": 2e-4 + np.arange(40) / 10}
    values = {"q": at(times["q"])[0] + rng.normal(0, 1e-3, 4000), "u": at(times["u"])[1], "T": times["T"]}
    rows = sorted((t, name, x) for name in times for t, x in zip(times[name], values[name], strict=True))
    cells = [
        f"{float(t)!r}," + ",".join(repr(float(x)) if n == name else "" for n in times) for t, name, x in rows
    ]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["t,q,u,T", *cells]))
    log = read_log(path, {**COLUMNS, "temperature": "T"})
    assert log.rate_hz == pytest.approx(200.0, rel=1e-6)
    # The mean of five readings has 0.45 of the noise of one (0.43 with halves of the outer ones).
    noise = log.position[:, 0] - at(log.time)[0]
    assert noise.std() == pytest.approx(0.45e-3, rel=0.1)
    # The force is read at 200 Hz and stays as it is; its sampling instants are those of the log.
    np.testing.assert_allclose(log.force[:, 0], at(log.time)[1], atol=3 * 400 * (5e-3) ** 2 / 8)
    np.testing.assert_allclose(log.temperature[:, 0], log.time, atol=1e-9)


# The operators


def white(kind_rate: float, method: str = "linear"):
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.5, 1.5, 20_000)) / 1000
    columns = {"position": [Readings(t, rng.standard_normal((t.size, 1)))]}
    _, made, said = resampled(columns, rate=kind_rate, period=1e-3, method=method, held=False, where="log")
    return made["position"][:, 0], said[-1].reason


@pytest.mark.parametrize("rate", [1000.0, 300.0])
def test_the_cost_that_is_said_is_the_cost(rate):
    """Another draw of noise has the scatter and the correlation that the words state."""
    made, said = white(rate)
    neighbours = np.corrcoef(made[1:], made[:-1])[0, 1]
    assert f"leaves {made.std():.1f}" in said
    stated = float(said.split("correlated by ")[1].split(",")[0])
    assert neighbours == pytest.approx(stated, abs=0.03)


def test_a_held_force_keeps_its_impulse():
    """A command that is held between uneven instants: the integral over each period stays."""
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(0.5, 1.5, 400)) / 1000
    u = np.round(rng.uniform(-5, 5, t.size))
    columns = {"position": [Readings(t, t[:, None])], "force": [Readings(t, u[:, None])]}
    time, made, _ = resampled(columns, rate=250.0, period=1e-3, method="linear", held=True, where="log")
    fine = time[0] + np.arange(int((time[-1] - time[0]) * 1e6)) * 1e-6
    held = u[np.searchsorted(t, fine, side="right") - 1]
    expected = held[: held.size // 4000 * 4000].reshape(-1, 4000).mean(axis=1)
    # The sum is over microseconds, and a step of 10 within one is missed.
    np.testing.assert_allclose(made["force"][: expected.size, 0], expected, atol=10 * 1e-6 / 4e-3 * 8)


# Measured logs that were refused for their stamps (`field.md`)


@pytest.fixture(scope="module")
def measured():
    if not os.environ.get("JAXID_DATA"):
        pytest.skip("JAXID_DATA is unset: no measured logs here")
    return Path(os.environ["JAXID_DATA"])


MEASURED = {
    "odri_motor/speed_test1.csv": ({"time": "Time", "position": "Position", "force": "Iq"}, 30_000, 1000.0),
    "odri_motor/acc_current.csv": ({"time": "Time", "position": "Position", "force": "Iq"}, 26_999, 1000.0),
    "dfki_pendulum/pd.csv": ({"time": "time", "position": "position", "force": "torque"}, 1170, 299.9),
    "dfki_pendulum/swingup_1nm.csv": (
        {"time": "time", "position": "position", "force": "torque"},
        7999,
        200.0,
    ),
    "so101/multisine.csv": (
        {"time": "t_us", "position": "q1", "force": "load1", "units": {"time": "us"}},
        6000,
        49.85,
    ),
}


@pytest.mark.parametrize("name", MEASURED)
def test_measured_logs_are_read(measured, name):
    columns, samples, rate = MEASURED[name]
    log = read_log(measured / name, columns)
    assert log.samples == samples
    assert log.rate_hz == pytest.approx(rate, rel=1e-3)


FIELD = {
    "time_doubled.csv": (4000, "doubled_rows"),
    "time_gaps.csv": (1490, "rows"),
    "time_irregular.csv": (None, "uneven_time"),
    "time_ros_jitter.csv": (4000, "uneven_time"),
}


@pytest.mark.parametrize("name", FIELD)
def test_logs_of_the_field_are_read(measured, name):
    samples, said = FIELD[name]
    log = read_log(measured / "field" / name, {"time": "t", "position": "q", "force": "tau"})
    assert samples is None or log.samples == samples
    assert said in words(log)


def test_the_export_of_a_plot_program_is_read(measured):
    columns = {"time": "__time", "position": "/joint_states/joint1/position", "force": "/motor/torque"}
    log = read_log(measured / "field" / "empty_cells.csv", columns)
    assert log.rate_hz == pytest.approx(100.0)


def test_a_disturbance_keeps_its_times_in_a_resampled_log(tmp_path):
    """A column of a disturbance is held from the times of its rows on, not from those of the samples."""
    from jaxid.simulation.disturbance import disturbance_at

    data = signals()
    keep = np.setdiff1d(np.arange(ROWS), np.arange(50, 54))
    data = {**data, "d": (data["t"] >= 0.1).astype(float)}
    columns = {**COLUMNS, "time": "t", "units": {"time": "ms"}}
    path = write_csv(tmp_path / "log.csv", {n: v[keep] * (1e3 if n == "t" else 1) for n, v in data.items()})
    log = read_log(path, columns)
    assert log.samples == ROWS
    np.testing.assert_array_equal(disturbance_at("d", log.time, log)[:, 0], data["d"])


def servo_in_counts(jitter: float, *, stamped_when_read: bool) -> dict:
    """Return 1000 readings of 4096 counts a turn at 50 Hz, with the times that a host wrote down."""
    grid = 0.02 * np.arange(1000)
    late = jitter * np.random.default_rng(4).uniform(-1, 1, grid.size)
    at = grid + late if stamped_when_read else grid
    turns = 0.1 * np.sin(2 * np.pi * 0.5 * at) + 0.03 * np.sin(2 * np.pi * 1.7 * at)
    return {"t": grid + late, "q": np.round(4096 * turns), "u": np.cos(at)}


def test_rows_are_even_where_readings_do_not_follow_the_jitter_of_their_stamps():
    data = servo_in_counts(1e-3, stamped_when_read=False)
    log = as_log(data, COLUMNS)
    np.testing.assert_array_equal(log.position[:, 0], data["q"])
    assert log.period == pytest.approx(0.02, rel=1e-5)
    assert "resample" not in words(log)
    assert "follow -0.0" in words(log)["even_rows"].reason or "follow 0.0" in words(log)["even_rows"].reason


def test_rows_go_by_their_stamps_where_readings_follow_the_jitter_or_show_nothing():
    data = servo_in_counts(1e-3, stamped_when_read=True)
    assert "even_rows" not in words(as_log(data, COLUMNS))
    data = servo_in_counts(1e-3, stamped_when_read=False)
    data["q"] = np.round(data["q"] / 100)
    assert "even_rows" not in words(as_log(data, COLUMNS))


def test_a_stated_rate_goes_by_the_stamps():
    data = servo_in_counts(1e-3, stamped_when_read=False)
    assert "even_rows" not in words(as_log(data, {**COLUMNS, "resample": 50.0}))


def test_missing_samples_of_even_rows_are_filled_on_their_grid():
    data = servo_in_counts(1e-3, stamped_when_read=False)
    lost = [200, 201, 500]
    log = as_log({name: np.delete(column, lost) for name, column in data.items()}, COLUMNS)
    assert log.samples == 1000
    there = np.delete(np.arange(1000), [*lost])
    np.testing.assert_allclose(log.position[there, 0], data["q"][there], atol=0.1)
