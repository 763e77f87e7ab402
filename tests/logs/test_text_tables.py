"""Text tables as spreadsheets, drives and measuring programs write them."""

import csv
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas
import pytest

from jaxid.logs.log import read_log
from jaxid.logs.readers import read_table
from tests.support.written_logs import refuse

SAMPLES = 120
T = np.arange(SAMPLES) / 200
Q = np.round(1500 * np.sin(3 * T), 4)
U = np.round(-2.5 * np.cos(3 * T), 5)
COLUMNS = {"time": "t", "position": "q", "force": "u"}


def german(x: float, places: int = 5, grouped: bool = False) -> str:
    text = f"{x:,.{places}f}" if grouped else f"{x:.{places}f}"
    return text.translate(str.maketrans(",.", ".,"))


def table(sep=";", number=german, header="t;q;u", above=(), below=(), end="\n") -> str:
    rows = [sep.join(map(number, row)) for row in zip(T, Q, U, strict=True)]
    return end.join([*above, header.replace(";", sep), *below, *rows]) + end


def check(path: Path, content: str | bytes, columns=COLUMNS, scale: float = 1.0):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    log = read_log(path, columns)
    np.testing.assert_allclose(log.time - log.time[0], T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(log.position[:, 0], scale * Q, rtol=1e-15)
    np.testing.assert_allclose(log.force[:, 0], U, rtol=1e-15)
    return {a.setting: a.value for a in log.assumed}


@pytest.mark.parametrize("sep", [";", "\t", "|"])
def test_decimal_commas(tmp_path, sep):
    assumed = check(tmp_path / "log.csv", table(sep))
    assert assumed == {"separator": sep, "decimal": ","}


def test_decimal_commas_between_blanks(tmp_path):
    assumed = check(tmp_path / "log.dat", table("   "))
    assert assumed == {"separator": " ", "decimal": ","}


def test_columns_padded_with_blanks(tmp_path):
    lines = [f"{t:10.4f} {q:12.4f} {u:>10.5f}" for t, q, u in zip(T, Q, U, strict=True)]
    assert check(tmp_path / "log.txt", "\n".join(["      t        q         u", *lines])) == {
        "separator": " "
    }


@pytest.mark.parametrize(
    ("number", "thousands"),
    [
        (lambda x: german(x, grouped=True), "."),
        (lambda x: f"{x:,.5f}", ","),
        (lambda x: f"{x:,.5f}".replace(",", "'"), "'"),
        (lambda x: german(x, grouped=True).replace(".", "\u202f"), "\u202f"),
    ],
    ids=["German", "English", "Swiss", "French"],
)
def test_groups_of_three_digits(tmp_path, number, thousands):
    assert check(tmp_path / "log.csv", table(";", number))["thousands"] == thousands


def test_quoted_decimal_commas_between_commas(tmp_path):
    path = tmp_path / "log.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "q", "u"])
        writer.writerows([german(x) for x in row] for row in zip(T, Q, U, strict=True))
    assert check(path, path.read_bytes()) == {"decimal": ","}


def test_the_table_of_a_german_pandas(tmp_path):
    """A file that another program's writer made."""
    path = tmp_path / "log.csv"
    frame = pandas.DataFrame({"t": T, "q": Q, "u": U})
    frame.to_csv(path, sep=";", decimal=",", index=False, encoding="utf-16")
    assert check(path, path.read_bytes()) == {"separator": ";", "decimal": ","}


def test_units_below_the_header_and_metadata_above_it(tmp_path):
    above = ["Trace name: Axis1", "Start: 2024-03-01 12:00:00", ""]
    assumed = check(tmp_path / "log.csv", table(above=above, below=["s;mm;A"]), scale=1e-3)
    assert assumed["units.position"] == "mm"
    assert assumed["units.time"] == "s"
    assert assumed["header"] == 3
    assert assumed["rows_below_header"] == 1


def test_units_in_the_header_need_not_be_written_in_the_case(tmp_path):
    text = table(header="t [s];q (mm);u")
    for name in ("q", "q (mm)"):
        assumed = check(tmp_path / "log.csv", text, {**COLUMNS, "position": name}, scale=1e-3)
        assert assumed["units.position"] == "mm"
    assert check(tmp_path / "log.csv", text.encode("latin-1"), scale=1e-3)["units.position"] == "mm"


def test_an_unknown_unit_is_said_and_not_converted(tmp_path):
    assert check(tmp_path / "log.csv", table(header="t;q;u [raw]"))["units.force"] == "raw"


@pytest.mark.parametrize(
    "stamp",
    [
        lambda k: f"2024-02-29T23:59:59.{k * 5:03d}Z" if k < 200 else "",
        lambda k: f"2024-02-29 23:59:59.{k * 5:03d}",
        lambda k: f"29.02.2024 23:59:59,{k * 5:03d}",
        lambda k: f"23:59:59.{k * 5:03d}",
    ],
    ids=["ISO", "ISO with a blank", "German", "time of day"],
)
def test_stamps(tmp_path, stamp):
    rows = [f"{stamp(k)};{german(q)};{german(u)}" for k, (q, u) in enumerate(zip(Q, U, strict=True))]
    assert check(tmp_path / "log.csv", "\n".join(["t;q;u", *rows]))["column 't'"] == "stamps"


def test_stamps_go_past_midnight_and_a_leap_day(tmp_path):
    at = pandas.Timestamp("2024-02-28 23:59:59.700") + pandas.to_timedelta(T, unit="s")
    for name, texts in {
        "dated": at.astype(str),
        "of day": [a.time().isoformat("microseconds") for a in at],
    }.items():
        rows = [f"{t};{q};{u}" for t, q, u in zip(texts, Q, U, strict=True)]
        assert check(tmp_path / "log.csv", "\n".join(["t;q;u", *rows])), name


def test_a_stamp_of_another_form_is_named(tmp_path):
    rows = [f"2024-01-01T00:00:0{k / 200:.3f};{q};{u}" for k, (q, u) in enumerate(zip(Q, U, strict=True))]
    rows[70] = "yesterday;0;0"
    (tmp_path / "log.csv").write_text("\n".join(["t;q;u", *rows]))
    refuse(tmp_path / "log.csv", match=r"column 't', row 70 .*'yesterday' is no date or time of its form; ")


# Exports of drives: written by hand after published examples of the programs' files, not by the programs.


def test_a_twincat_scope(tmp_path):
    """Name rows and keys before each value, tabs, decimal commas, time in ms, and EOF as the last line."""
    keys = {
        "SymbolComment": "",
        "Data-Type": "REAL64",
        "SampleTime[ms]": "5",
        "VariableSize": "8",
        "SymbolBased": "True",
        "IndexGroup": "16448",
        "Port": "851",
        "ScaleFactor": "1",
        "Unit": "",
    }
    head = [
        "Name\tYT Scope Project",
        "File\tC:\\TwinCAT\\axis.svdx",
        "Starttime of export\t133539840000000000\t12:00:00",
        "Endtime of export\t133539840006000000\t12:00:01",
        "",
        "Name\tAxis1.ActPos\tName\tAxis1.ActCurrent",
        *(f"{key}\t{value}\t{key}\t{value}" for key, value in keys.items()),
        "",
    ]
    rows = [
        f"{1000 * t:.0f}\t{german(q)}\t{1000 * t:.0f}\t{german(u)}" for t, q, u in zip(T, Q, U, strict=True)
    ]
    columns = {
        "time": "Name",
        "position": "Axis1.ActPos",
        "force": "Axis1.ActCurrent",
        "units": {"time": "ms"},
    }
    assumed = check(tmp_path / "scope.csv", "\r\n".join([*head, *rows, "EOF", ""]), columns)
    assert assumed["rows_below_header"] == len(keys)
    assert assumed["decimal"] == ","


def test_channels_with_times_of_their_own(tmp_path):
    """A Scope with two groups: the current is recorded five times as often as the position."""
    fast = np.arange(5 * SAMPLES) / 1000
    slow = [f"{1000 * t:g}\t{q}\t" for t, q in zip(T, Q, strict=True)]
    slow += ["\t\t"] * (fast.size - SAMPLES)
    rows = [f"{left}{1000 * t:g}\t{t}" for left, t in zip(slow, fast, strict=True)]
    path = tmp_path / "scope.csv"
    path.write_text("\n".join(["Name\tq\tName\tu", *rows]))
    log = read_log(path, {"time": "Name", "position": "q", "force": "u", "units": {"time": "ms"}})
    assert log.rate_hz == pytest.approx(200.0)
    np.testing.assert_allclose(log.position[:, 0], Q, rtol=1e-12, atol=1e-9)
    # The mean of a ramp over a period about a sample is the ramp; the first period is cut to a millionth.
    np.testing.assert_allclose(log.force[:, 0], T, rtol=1e-9, atol=1e-8)
    assert {"time", "readings", "resample", "resample_method"} <= {a.setting for a in log.assumed}


def test_a_tia_trace(tmp_path):
    """Two lines of metadata, quoted names, a column of stamps beside the relative time."""
    head = [
        '"Trace";"Achse_1"',
        '"Geraet";"PLC_1 [CPU 1517TF]"',
        '"Zeit [ms]";"Zeitstempel";"Achse_1.ActualPosition [mm]";"Achse_1.Strom [A]"',
    ]
    rows = [
        f"{german(1000 * t, 3)};01.03.2024 12:00:00,{1000 * t:03.0f};{german(q)};{german(u)}"
        for t, q, u in zip(T, Q, U, strict=True)
    ]
    columns = {"time": "Zeit", "position": "Achse_1.ActualPosition", "force": "Achse_1.Strom"}
    assumed = check(tmp_path / "trace.csv", "\r\n".join([*head, *rows]), columns, scale=1e-3)
    assert assumed["units.time"] == "ms"


def test_a_labview_measurement(tmp_path):
    head = [
        "LabVIEW Measurement\t",
        "Writer_Version\t2",
        "Separator\tTab",
        "Decimal_Separator\t,",
        "***End_of_Header***\t",
        "",
        "Channels\t2\t\t",
        "Samples\t120\t120\t",
        "Y_Unit_Label\tmm\tA\t",
        "X_Dimension\tTime\tTime\t",
        "Delta_X\t0,005\t0,005\t",
        "***End_of_Header***\t\t\t",
        "X_Value\tq\tu\tComment",
    ]
    rows = [f"{german(t)}\t{german(q)}\t{german(u)}\t" for t, q, u in zip(T, Q, U, strict=True)]
    check(tmp_path / "log.lvm", "\n".join([*head, *rows]), {**COLUMNS, "time": "X_Value"})


# What is refused, and what can be stated


def test_three_decimals_may_be_thousands(tmp_path):
    rows = [f"{k / 200};{1 + k % 9},{k + 100:03d};{u}" for k, u in enumerate(U)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["t;q;u", *rows]))
    read = read_table(path, ["q"])
    assert read.columns["q"][0, 0] == 1.1
    assert "state decimal = '.'" in next(a.reason for a in read.assumed if a.setting == "decimal")
    assert read_log(path, {**COLUMNS, "decimal": "."}).position[0, 0] == 1100.0


def test_two_decimal_signs_are_refused(tmp_path):
    lines = table().splitlines()
    lines[60] = "0.295;1.5;2.5"
    (tmp_path / "log.csv").write_text("\n".join(lines))
    refuse(
        tmp_path / "log.csv",
        match=r"column 't', row 59 .*'0.295' is not a number; write all decimals with one sign",
    )


def test_a_stated_separator_is_kept(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(table(",", lambda x: f"{x:.5f}"))
    assert read_log(path, {**COLUMNS, "separator": ","}).samples == SAMPLES
    refuse(path, {**COLUMNS, "separator": ";"}, match="has no column 't'")
    refuse(path, {**COLUMNS, "separator": "x"}, match='separator = "x" is unknown')


def test_rows_count_from_the_first_row_of_data(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(table(above=["# made by", "Axis;1"], below=["s;m;A"]))
    log = read_log(path, {**COLUMNS, "rows": [10, 90]})
    np.testing.assert_allclose(log.position[:, 0], Q[10:90], rtol=1e-15)
    assert log.rows == (10, 90)


@pytest.mark.parametrize("parts", [1, 7])
def test_parts_of_a_file_are_joined(tmp_path, monkeypatch, parts):
    text = table()
    monkeypatch.setattr("jaxid.logs.readers.csv_file._PART", len(text) // parts)
    check(tmp_path / "log.csv", text.removesuffix("\n"))
    check(tmp_path / "log.csv", table(end="\r\n"))
    check(tmp_path / "log.csv", table(end="\r"))


# Speed and memory

MEASURE = """
import sys, time
import numpy, jaxid.logs.log
from jaxid.logs.log import read_log
def peak():
    # The peak of getrusage is at least that of the process that started this one.
    [line] = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
    return 1024 * int(line.split()[1])
read_log(sys.argv[2], {"time": "t", "position": "q", "force": "u"})
before, start = peak(), time.perf_counter()
log = read_log(sys.argv[1], {"time": "t", "position": "q", "force": "u"})
print(time.perf_counter() - start, peak() - before, log.samples)
"""


@pytest.mark.slow
def test_a_million_rows(tmp_path):
    count = 1_000_000
    rng = np.random.default_rng(0)
    block = np.column_stack([np.arange(count) * 1e-3, rng.standard_normal((count, 3))])
    path, small = tmp_path / "large.csv", tmp_path / "small.csv"
    text = pandas.DataFrame(block, columns=["t", "q", "u", "r"])
    text.to_csv(path, index=False, float_format="%.6f")
    text[:1000].to_csv(small, index=False, float_format="%.6f")
    command = [sys.executable, "-c", MEASURE, str(path), str(small)]
    runs = [subprocess.run(command, check=True, capture_output=True, text=True).stdout for _ in range(2)]
    seconds, memory, samples = np.array([run.split() for run in runs], dtype=float).min(axis=0)
    assert samples == count
    # Measured: 1.1 s and 1.4 times the file (40 MB) on two cores.
    assert seconds < 2.0
    assert memory < 2 * os.path.getsize(path)


def test_reading_is_not_slowed_by_decimal_commas(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(
        "t;q;u\n" + "".join(f"{k / 1000:.3f};0,123456;-1,5\n".replace(".", ",") for k in range(50_000))
    )
    start = time.process_time()
    read_log(path, COLUMNS)
    # Measured: 0.06 s. Time of the processor, since other tests run beside this one.
    assert time.process_time() - start < 0.6
