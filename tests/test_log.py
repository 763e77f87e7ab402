"""Reading logs: every format gives the same numbers, every fault one clear line."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from jaxid.errors import InputError, suggest
from jaxid.io.log import Log, read_log

COLUMNS = {"time": "t", "position": "q", "force": "u"}
ROWS = 200


def signals(samples: int = ROWS, rate_hz: float = 1000.0) -> dict[str, np.ndarray]:
    t = np.arange(samples) / rate_hz
    return {"t": t, "q": 0.1 * np.sin(20 * t), "u": 3.0 * np.cos(20 * t + 0.3)}


def write_csv(path: Path, data: dict, delimiter: str = ",", digits: str = "%.17g") -> Path:
    rows = np.stack(list(data.values()), axis=1)
    header = delimiter.join(data)
    np.savetxt(path, rows, fmt=digits, delimiter=delimiter, header=header, comments="")
    return path


def edit(path: Path, row: int, line: str) -> Path:
    """Replace one row (0-based, below the header) of a CSV."""
    lines = path.read_text().splitlines()
    lines[row + 1] = line
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def csv_file(tmp_path):
    return write_csv(tmp_path / "log.csv", signals())


def refuse(path, columns=COLUMNS, *, match: str, **kwargs) -> None:
    with pytest.raises(InputError, match=match) as caught:
        read_log(path, columns, **kwargs)
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value), "the line ends with its mend"


# What is read


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
    np.savez(tmp_path / "log.npz", **data)
    savemat(tmp_path / "log.mat", data)  # stores rows of shape (1, samples)
    for name in ("log.npz", "log.mat"):
        log = read_log(tmp_path / name, COLUMNS)
        np.testing.assert_array_equal(log.position, expected.position)
        np.testing.assert_array_equal(log.time, expected.time)


def test_parquet(tmp_path, csv_file):
    pyarrow = pytest.importorskip("pyarrow")
    import pyarrow.parquet

    path = tmp_path / "log.parquet"
    pyarrow.parquet.write_table(pyarrow.table(signals()), path)
    log = read_log(path, {**COLUMNS, "rows": [10, 100]})
    expected = read_log(csv_file, {**COLUMNS, "rows": [10, 100]})
    np.testing.assert_array_equal(log.position, expected.position)
    refuse(path, {**COLUMNS, "force": "uu"}, match="no variable 'uu'; did you mean 'u'")


def test_parquet_without_pyarrow_says_so(tmp_path, monkeypatch):
    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    refuse(tmp_path / "log.parquet", match="pip install pyarrow")


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
    by_rate = read_log(
        csv_file, {"sample_rate": 1000.0, "position": "q", "force": "u", "rows": [50, 150]}
    )
    np.testing.assert_allclose(by_rate.time, log.time, rtol=1e-15)


def test_rows_outside_the_range_may_be_broken(csv_file):
    edit(csv_file, 3, "0.003,oops,nan")
    assert read_log(csv_file, {**COLUMNS, "rows": [10, 100]}).samples == 90


def test_optional_columns_and_hold(tmp_path):
    data = {**signals(), "v": signals()["u"], "ref": signals()["q"], "T": 20 + signals()["t"]}
    path = write_csv(tmp_path / "log.csv", data)
    more = {"velocity": "v", "reference": "ref", "temperature": "T", "hold": "linear"}
    log = read_log(path, {**COLUMNS, **more})
    np.testing.assert_array_equal(log.velocity[:, 0], data["v"])
    np.testing.assert_array_equal(log.temperature[:, 0], data["T"])
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
        start = time.perf_counter()
        read_log(path, COLUMNS)
        seconds.append(time.perf_counter() - start)
    # 0.05 s where this was written; a row-by-row reader takes 0.3 s.
    assert min(seconds) < 0.2


def test_reading_does_not_wait_for_jax():
    code = (
        "import sys, jaxid.io.soundness, jaxid.references;"
        "sys.exit('jax' in sys.modules or 'scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# What is refused: the file


def test_missing_file_names_its_neighbours(csv_file):
    refuse(csv_file.with_name("lag.csv"), match=r"lag\.csv: no such file; .*log\.csv")


def test_folder_is_no_log(tmp_path):
    (tmp_path / "log.csv").mkdir()
    refuse(tmp_path / "log.csv", match="is not a file")


def test_unreadable_file(csv_file, monkeypatch):
    def denied(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", denied)
    refuse(csv_file, match="cannot be read .*Permission denied.*; check that it may be read")


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment\n", "t,q,u\n", "t,q,u\n# none\n"])
def test_empty_file(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    refuse(path, match="is empty")


def test_unknown_suffix(tmp_path):
    (tmp_path / "log.xlsx").write_bytes(b"x")
    refuse(tmp_path / "log.xlsx", match=r"unknown suffix '.xlsx'; use one of .csv, .npz")


def test_binary_file_called_csv(tmp_path):
    (tmp_path / "log.csv").write_bytes(b"\x00\x01\x02")
    refuse(tmp_path / "log.csv", match="is not a text file")


def test_no_header(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("0,1,2\n1,2,3\n")
    refuse(path, match="no header row.*; add a first row")


def test_matlab_73(tmp_path):
    path = tmp_path / "log.mat"
    # The 128 bytes with which MATLAB opens an HDF5 file: version 2.0.
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n" * 20)
    refuse(path, match="v7.3.*; in MATLAB: save")


@pytest.mark.parametrize("suffix", ["npz", "mat", "parquet"])
def test_garbage(tmp_path, suffix):
    path = tmp_path / f"log.{suffix}"
    path.write_bytes(b"this is no such file, whatever it is called" * 10)
    refuse(path, match="cannot be read")


def test_pickles_are_refused(tmp_path):
    np.savez(tmp_path / "log.npz", t=np.array([{"a": 1}] * 60, dtype=object), q=1, u=1)
    refuse(tmp_path / "log.npz", match="cannot be read.*plain arrays")


# What is refused: columns and cells


def test_missing_column_suggests_the_nearest(tmp_path):
    data = dict(zip(["time", "pos", "Torque"], signals().values(), strict=True))
    path = write_csv(tmp_path / "log.csv", data)
    columns = {"time": "time", "position": "pos", "force": "torque"}
    refuse(path, columns, match="no column 'torque'; did you mean 'Torque'. there is: time, pos, T")
    np.savez(tmp_path / "log.npz", **data)
    refuse(tmp_path / "log.npz", columns, match="no variable 'torque'; did you mean 'Torque'")


def test_doubled_column(tmp_path, csv_file):
    csv_file.write_text(csv_file.read_text().replace("t,q,u", "t,q,q", 1))
    refuse(csv_file, {**COLUMNS, "force": "q"}, match="same column")
    refuse(csv_file, {"time": "t", "position": "q", "force": "t"}, match="same column")
    refuse(csv_file, {"sample_rate": 1.0, "position": "q", "force": "t"}, match="2 columns 'q'")


def test_cell_that_is_no_number(csv_file):
    refuse(edit(csv_file, 7, "0.007,n/a,1"), match=r"column 'q', row 7 .*'n/a' is not a number; ")


def test_empty_cell_and_short_row(csv_file):
    refuse(edit(csv_file, 7, "0.007,,1"), match="column 'q', row 7 .*the cell is empty")
    refuse(edit(csv_file, 7, "0.007"), match="column 'q', row 7 .*the cell is empty")


def test_decimal_commas(tmp_path, csv_file):
    text = csv_file.read_text().replace(",", ";").replace(".", ",")
    (tmp_path / "comma.csv").write_text(text)
    refuse(tmp_path / "comma.csv", match="row 1 .*is not a number; write decimals with a point")
    refuse(edit(csv_file, 7, "0,007,1,2,3"), match="row 7 has 5 cells, the header 3; .*point")


def test_text_in_an_array_file(tmp_path):
    np.savez(tmp_path / "log.npz", **{**signals(), "u": np.array(["a"] * ROWS)})
    refuse(tmp_path / "log.npz", match="variable 'u': is not numeric")


@pytest.mark.parametrize(("text", "kind"), [("nan", "NaN"), ("-inf", "infinite")])
def test_not_finite(csv_file, text, kind):
    edit(edit(csv_file, 9, f"0.009,1,{text}"), 12, f"0.012,1,{text}")
    refuse(csv_file, match=rf"column 'u': 2 row\(s\).*first is row 9 \({kind}\); cut")


def test_unequal_lengths(tmp_path):
    data = signals()
    np.savez(tmp_path / "log.npz", t=data["t"], q=data["q"], u=data["u"][:-3])
    refuse(tmp_path / "log.npz", match="unequal lengths: 't' 200, 'q' 200, 'u' 197")


def test_number_of_joints(tmp_path):
    data = {**signals(), "q2": signals()["u"]}
    path = write_csv(tmp_path / "log.csv", data)
    refuse(path, joints=2, match=r"position = \['q'\]: 1 column\(s\) where 2 belong; name one")
    one_driven = {**COLUMNS, "position": ["q", "q2"]}
    assert read_log(path, one_driven, joints=2).force.shape == (ROWS, 1)
    assert read_log(path, one_driven, joints=None).position.shape == (ROWS, 2)


# What is refused: time and rows


@pytest.mark.parametrize(
    ("row", "value", "match"),
    [
        (60, 0.059, r"column 't': time repeats in row 60 \(0.059 s, then 0.059 s\)"),
        (60, 0.010, "time runs backwards in row 60"),
    ],
)
def test_time_must_run_forward(tmp_path, row, value, match):
    data = signals()
    data["t"][row] = value
    refuse(write_csv(tmp_path / "log.csv", data), match=match)


def test_time_with_too_few_digits(tmp_path):
    data = signals()
    data["t"] = np.round(data["t"], 2)
    refuse(write_csv(tmp_path / "log.csv", data), match="time repeats in 179 rows.*sample_rate")


def test_gap(tmp_path):
    data = signals()
    data["t"][150:] += 0.5
    path = write_csv(tmp_path / "log.csv", data)
    refuse(path, match=r"gap.*of 0.501 s after row 149 .*rows = \[0, 150\]")
    assert read_log(path, {**COLUMNS, "rows": [0, 150]}).samples == 150


def test_jitter(tmp_path):
    data = signals()
    jitter = np.random.default_rng(1).uniform(-2e-4, 2e-4, ROWS)
    path = write_csv(tmp_path / "log.csv", {**data, "t": data["t"] + jitter})
    refuse(path, match="not constant: .* by more than 1 %, the worst by .* %.*; resample")
    # Half a percent is what clocks do, and one loose row is not the log's fault.
    read_log(write_csv(path, {**data, "t": data["t"] + jitter / 80}), COLUMNS)
    data["t"][100] += 2e-4
    read_log(write_csv(path, data), COLUMNS)


def test_rate_and_time_must_agree(csv_file):
    columns = {**COLUMNS, "sample_rate": 1.0}
    refuse(csv_file, columns, match="time column says 1000 Hz, sample_rate says 1 Hz.*in seconds")


@pytest.mark.parametrize("rows", [[0, 201], [-5, 100], [100, 100], [150, 20]])
def test_rows_out_of_range(csv_file, rows):
    refuse(csv_file, {**COLUMNS, "rows": rows}, match="out of range; the file has 200 rows")


def test_too_short(csv_file):
    refuse(csv_file, {**COLUMNS, "rows": [0, 49]}, match="too short: 49 samples; at least 50")


# What is refused: the table itself


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"time": None}, "neither time nor sample_rate"),
        ({"position": None}, "'position' is missing; add position"),
        ({"forse": "u"}, "unknown key 'forse'; did you mean 'force'"),
        ({"hold": "zero-order"}, "hold = 'zero-order' is unknown; did you mean 'zero_order'"),
        ({"sample_rate": -1.0}, "sample_rate = -1.0 is not a rate"),
        ({"rows": [0.5, 7]}, "rows = .* is no range"),
        ({"rows": 7}, "rows = 7 is no range"),
        ({"force": 3}, "force = 3 names no column"),
        ({"force": ["u", "u"]}, "names a column twice"),
    ],
)
def test_table(csv_file, change, match):
    columns = {**COLUMNS, **change}
    columns = {key: value for key, value in columns.items() if value is not None}
    refuse(csv_file, columns, match=rf"^\[log\]: .*{match}")


def test_suggestions():
    assert suggest("postion", ["time", "position"]).startswith("did you mean 'position'?")
    assert suggest("xyz", ["time"]) == "there is: time"
    assert suggest("a", []) == "there are none"


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
