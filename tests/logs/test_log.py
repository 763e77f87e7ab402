"""Reading logs: every format gives the same numbers."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from scipy.io import savemat

from jaxid.errors import InputError
from jaxid.logs.log import Log, read_log
from tests.support.written_logs import COLUMNS, ROWS, edit, refuse, signals, write_csv


@pytest.fixture
def csv_file(tmp_path):
    return write_csv(tmp_path / "log.csv", signals())


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_csv_returns_every_digit(tmp_path, delimiter):
    data = signals()
    log = read_log(write_csv(tmp_path / "log.csv", data, delimiter), COLUMNS)
    np.testing.assert_array_equal(log.position[:, 0], data["q"])
    np.testing.assert_array_equal(log.force[:, 0], data["u"])
    assert log.samples == ROWS
    assert log.rows == (0, ROWS)
    assert log.rate_hz == pytest.approx(1000.0, rel=1e-12)
    assert log.hold == "zero_order"
    assert log.velocity is None


def test_csv_dialects_do_not_matter(tmp_path, csv_file):
    expected = read_log(csv_file, COLUMNS)
    lines = csv_file.read_text().splitlines()
    dressed = ["# a comment", '"t", q ,"u"', "", *lines[1:50], "# half way", *lines[50:]]
    path = tmp_path / "dressed.csv"
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(dressed).encode())
    log = read_log(path, COLUMNS)
    np.testing.assert_array_equal(log.position, expected.position)
    np.testing.assert_array_equal(log.time, expected.time)


def test_header_that_savetxt_commented_out(tmp_path):
    data = signals()
    path = tmp_path / "log.csv"
    np.savetxt(path, np.stack(list(data.values()), 1), delimiter=",", header="t,q,u", fmt="%.17g")
    np.testing.assert_array_equal(read_log(path, COLUMNS).position[:, 0], data["q"])


def test_other_formats_agree_with_csv(tmp_path, csv_file):
    data, expected = signals(), read_log(csv_file, COLUMNS)
    np.savez(tmp_path / "log.npz", t=data["t"], q=data["q"], u=data["u"])
    savemat(tmp_path / "log.mat", data)  # stores rows of shape (1, samples)
    for name in ("log.npz", "log.mat"):
        log = read_log(tmp_path / name, COLUMNS)
        np.testing.assert_array_equal(log.position, expected.position)
        np.testing.assert_array_equal(log.time, expected.time)


def test_parquet(tmp_path, csv_file):
    path = tmp_path / "log.parquet"
    parquet.write_table(pyarrow.table(signals()), path)
    log = read_log(path, {**COLUMNS, "rows": [10, 100]})
    expected = read_log(csv_file, {**COLUMNS, "rows": [10, 100]})
    np.testing.assert_array_equal(log.position, expected.position)
    refuse(path, {**COLUMNS, "force": "uu"}, match="no variable 'uu'; did you mean 'u'")


@pytest.mark.parametrize("transposed", [False, True])
def test_matrices_hold_all_joints(tmp_path, transposed):
    data = signals()
    both = np.stack([data["q"], 2 * data["q"]], axis=1)
    stored = both.T if transposed else both
    np.savez(tmp_path / "log.npz", t=data["t"], pos=stored, tau=stored)
    columns = {"time": "t", "position": "pos", "force": ["tau[1]", "tau[2]"]}
    log = read_log(tmp_path / "log.npz", columns, joints=2)
    np.testing.assert_array_equal(log.position, both)
    np.testing.assert_array_equal(log.force, both)
    columns["force"] = "tau[3]"
    refuse(tmp_path / "log.npz", columns, joints=2, match=r"no column 3; it has columns 1 to 2")


def test_rows_are_those_of_the_file_and_time_starts_where_they_do(csv_file):
    log = read_log(csv_file, {**COLUMNS, "rows": [50, 150]})
    assert log.rows == (50, 150)
    assert log.time[0] == 0.05
    np.testing.assert_array_equal(log.position[:, 0], signals()["q"][50:150])
    by_rate = read_log(csv_file, {"sample_rate": 1000.0, "position": "q", "force": "u", "rows": [50, 150]})
    np.testing.assert_allclose(by_rate.time, log.time, rtol=1e-15)


def test_rows_outside_the_range_may_be_broken(csv_file):
    edit(csv_file, 3, "0.003,oops,nan")
    assert read_log(csv_file, {**COLUMNS, "rows": [10, 100]}).samples == 90


def test_optional_columns_and_hold(tmp_path):
    data = {**signals(), "v": signals()["u"], "ref": signals()["q"], "T": 20 + signals()["t"]}
    path = write_csv(tmp_path / "log.csv", data)
    more = {"velocity": "v", "reference": "ref", "temperature": "T", "hold": "linear"}
    log = read_log(path, {**COLUMNS, **more})
    np.testing.assert_array_equal(log.velocity, data["v"][:, None])
    np.testing.assert_array_equal(log.temperature, data["T"][:, None])
    assert log.hold == "linear"


def test_arrays_are_frozen_copies():
    data = signals()
    log = Log(time=data["t"], position=data["q"], force=data["u"])
    assert log.position.shape == (ROWS, 1)
    with pytest.raises(ValueError, match="read-only"):
        log.position[0] = 1.0
    data["q"][0] = 7.0
    assert log.position[0, 0] == 0.0
    with pytest.raises(InputError, match="unequal lengths"):
        Log(time=data["t"], position=data["q"], force=data["u"][1:])
    with pytest.raises(InputError, match="hold = 'zero' is unknown"):
        Log(time=data["t"], position=data["q"], force=data["u"], hold="zero")


def test_rounded_time_stamps_are_no_jitter(tmp_path):
    # 610.35 Hz written to the millisecond: steps of 1 and 2 ms, 60 % off the period.
    data = signals(rate_hz=610.35)
    data["t"] = np.round(data["t"], 3)
    log = read_log(write_csv(tmp_path / "log.csv", data), COLUMNS)
    # The ends are rounded by at most half a millisecond of 326 ms.
    assert log.rate_hz == pytest.approx(610.35, rel=1e-3 / 0.326)
    assert np.ptp(np.diff(log.time)) < 1e-12
    # Six significant digits lose a tenth of a millisecond past ten seconds.
    data = signals(15000)
    path = write_csv(tmp_path / "digits.csv", data, digits="%.6g")
    assert read_log(path, COLUMNS).rate_hz == pytest.approx(1000.0, rel=1e-5)


def test_reading_is_quick(tmp_path):
    path = write_csv(tmp_path / "log.csv", signals(25000))
    seconds = []
    for _ in range(3):
        start = time.process_time()
        read_log(path, COLUMNS)
        seconds.append(time.process_time() - start)
    # Measured: 0.05 s. Time of the processor, since other tests run beside this one.
    assert min(seconds) < 0.2


def test_reading_does_not_wait_for_jax():
    code = (
        "import sys, jaxid.logs.soundness, jaxid.references;"
        "sys.exit('jax' in sys.modules or 'scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# Measured logs


@pytest.fixture(scope="module")
def measured():
    if not os.environ.get("JAXID_DATA"):
        pytest.skip("JAXID_DATA is unset: no measured logs here")
    return Path(os.environ["JAXID_DATA"])


def test_emps(measured):
    columns = {"time": "t", "position": "qm", "force": "vir", "reference": "qg"}
    log = read_log(measured / "emps" / "DATA_EMPS.mat", columns)
    assert log.samples == 24841
    assert log.period == pytest.approx(1e-3, rel=1e-9)


def test_silverbox(measured):
    columns = {"sample_rate": 1e7 / 2**14, "position": "V2", "force": "V1", "rows": [40650, 105712]}
    log = read_log(measured / "silverbox" / "SNLS80mV.mat", columns)
    assert log.position.shape == (65062, 1)
    assert log.time[0] == pytest.approx(40650 * 2**14 / 1e7, rel=1e-12)
