"""Logs that cannot be read: every fault is one clear line with its hint."""

import sys
from pathlib import Path

import numpy as np
import pytest

from jaxid.errors import suggest
from jaxid.logs.log import read_log
from tests.support.written_logs import COLUMNS, ROWS, edit, refuse, signals, write_csv


@pytest.fixture
def csv_file(tmp_path):
    return write_csv(tmp_path / "log.csv", signals())


# The file


def test_missing_file_names_its_neighbours(csv_file):
    refuse(csv_file.with_name("lag.csv"), match=r"lag\.csv: no such file; .*log\.csv")


def test_folder_is_no_log(tmp_path):
    (tmp_path / "log.csv").mkdir()
    refuse(tmp_path / "log.csv", match="is not a file")


def test_unreadable_file(csv_file, monkeypatch):
    def denied(self, *args):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", denied)
    refuse(csv_file, match="cannot be read .*Permission denied.*; check the permissions of the file")


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment\n", "t,q,u\n", "t,q,u\n# none\n"])
def test_empty_file(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    refuse(path, match="is empty")


def test_unknown_suffix(tmp_path):
    (tmp_path / "log.doc").write_bytes(b"x")
    refuse(tmp_path / "log.doc", match=r"unknown suffix '.doc'; use one of .csv, .txt.*or say format")


def test_binary_file_called_csv(tmp_path):
    (tmp_path / "log.csv").write_bytes(b"\x00\x01\x02")
    refuse(tmp_path / "log.csv", match="is not a text file")


def test_no_header(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("0,1,2\n1,2,3\n")
    refuse(path, match="no header row.*; add a first row")


def test_parquet_without_pyarrow_says_so(tmp_path, monkeypatch):
    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    refuse(tmp_path / "log.parquet", match="pip install pyarrow")


@pytest.mark.parametrize("suffix", ["npz", "mat", "parquet"])
def test_garbage(tmp_path, suffix):
    path = tmp_path / f"log.{suffix}"
    path.write_bytes(b"this is no such file, whatever it is called" * 10)
    refuse(path, match="cannot be read")


def test_pickles_are_refused(tmp_path):
    np.savez(tmp_path / "log.npz", t=np.array([{"a": 1}] * 60, dtype=object), q=1, u=1)
    refuse(tmp_path / "log.npz", match=r"variable 't': is not numeric \(object\); .*plain array")


# Columns and cells


def test_missing_column_suggests_the_nearest(tmp_path):
    data = dict(zip(["time", "pos", "Torque"], signals().values(), strict=True))
    path = write_csv(tmp_path / "log.csv", data)
    columns = {"time": "time", "position": "pos", "force": "torque"}
    refuse(path, columns, match="no column 'torque'; did you mean 'Torque'. there is: time, pos, T")
    np.savez(tmp_path / "log.npz", pos=data["pos"], Torque=data["Torque"])
    columns = {"sample_rate": 1.0, "position": "pos", "force": "torque"}
    refuse(tmp_path / "log.npz", columns, match="no variable 'torque'; did you mean 'Torque'")


def test_doubled_column(tmp_path, csv_file):
    csv_file.write_text(csv_file.read_text().replace("t,q,u", "t,q,q", 1))
    refuse(csv_file, {**COLUMNS, "force": "q"}, match="same column")
    refuse(csv_file, {"time": "t", "position": "q", "force": "t"}, match="same column")
    refuse(csv_file, {"sample_rate": 1.0, "position": "q", "force": "t"}, match="2 columns 'q'")


def test_cell_that_is_no_number(csv_file):
    refuse(edit(csv_file, 7, "0.007,n/a,1"), match=r"column 'q', row 7 .*'n/a' is not a number; ")


def test_short_row(csv_file):
    refuse(edit(csv_file, 7, "0.007"), match="row 7 has 1 cells, the header 3; give one cell for each column")


def test_decimal_commas_between_commas(csv_file):
    refuse(edit(csv_file, 7, "0,007,1,2,3"), match="row 7 has 5 cells, the header 3; .*point")


def test_text_in_an_array_file(tmp_path):
    data = signals()
    np.savez(tmp_path / "log.npz", t=data["t"], q=data["q"], u=np.array(["a"] * ROWS))
    refuse(tmp_path / "log.npz", match="variable 'u': is not numeric")


@pytest.mark.parametrize(("text", "kind"), [("nan", "NaN"), ("-inf", "infinite")])
def test_not_finite(csv_file, text, kind):
    edit(edit(csv_file, 9, f"0.009,1,{text}"), 12, f"0.012,1,{text}")
    refuse(csv_file, match=rf"column 'u': 2 row\(s\).*first is row 9 \({kind}\); exclude")


def test_unequal_lengths(tmp_path):
    data = signals()
    np.savez(tmp_path / "log.npz", t=data["t"], q=data["q"], u=data["u"][:-3])
    refuse(tmp_path / "log.npz", match="unequal lengths: 't' 200, 'q' 200, 'u' 197")


def test_number_of_joints(tmp_path):
    data = {**signals(), "q2": signals()["u"]}
    path = write_csv(tmp_path / "log.csv", data)
    refuse(path, joints=2, match=r"position = \['q'\]: 1 column\(s\), expected 2; name one")
    one_driven = {**COLUMNS, "position": ["q", "q2"]}
    assert read_log(path, one_driven, joints=2).force.shape == (ROWS, 1)
    assert read_log(path, one_driven, joints=None).position.shape == (ROWS, 2)


# Time and rows


@pytest.mark.parametrize(
    ("row", "value", "match"),
    [
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


def test_rate_and_time_must_agree(csv_file):
    columns = {**COLUMNS, "sample_rate": 1.0}
    refuse(csv_file, columns, match="time column gives 1000 Hz, but sample_rate is 1 Hz.*in seconds")


def test_rows_out_of_range(csv_file):
    refuse(csv_file, {**COLUMNS, "rows": [0, 201]}, match="out of range; the file has 200 rows")


def test_too_short(csv_file):
    refuse(csv_file, {**COLUMNS, "rows": [0, 49]}, match="too short: 49 samples; at least 50")


# The table itself


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"time": None}, "neither time nor sample_rate"),
        ({"position": None}, "'position' is missing; add position"),
        ({"forse": "u"}, "unknown key 'forse'; there is: time, sample_rate, position, force"),
        ({"hold": "zero-order"}, "hold = \"zero-order\" is unknown; did you mean 'zero_order'"),
        ({"sample_rate": -1.0}, "sample_rate = -1.0 is not positive; it must be > 0"),
        ({"rows": [-5, 100]}, r"rows = \[-5, 100\] is not a range of rows"),
        ({"rows": [100, 100]}, r"rows = \[100, 100\] is not a range of rows"),
        ({"rows": [150, 20]}, r"rows = \[150, 20\] is not a range of rows"),
        ({"rows": [0.5, 7]}, "rows = .* is not a range of rows"),
        ({"rows": 7}, "rows = 7 is not a range of rows"),
        ({"force": 3}, "force = 3 names no column; give the name of a column"),
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
