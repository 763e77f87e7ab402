"""Everything that `check` says first of how a log was read, and the statements that settle it."""

import tomllib

import numpy as np
import pytest

from jaxid.commands.check import check
from jaxid.errors import InputError
from jaxid.logs.log import read_log
from jaxid.logs.readers.table import Assumed
from jaxid.logs.seen import sights_of, statement_of
from tests.support.cli_setup import recorded
from tests.support.written_logs import COLUMNS, signals, write_csv


def lines(path, columns=COLUMNS) -> list[str]:
    return [str(sight) for sight in sights_of(read_log(path, columns))]


def test_a_plain_log_shows_its_rate_only(tmp_path):
    assert lines(write_csv(tmp_path / "log.csv", signals())) == [
        "time: 200 samples, one every 1 ms (1000 Hz), even to 1 %"
    ]


def test_separator_decimals_and_units(tmp_path):
    rows = [f"{k};{0.1 * np.sin(k):.4f};{np.cos(k):.4f}".replace(".", ",") for k in range(100)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["Gerät 7", "t [ms];q [mm];u", *rows]))
    assert lines(path) == [
        "time: 100 samples, one every 1 ms (1000 Hz), even to 1 %",
        'time: time is in ms (the file states it): say `units = { time = "ms" }`',
        'units: position is in mm (the file states it): say `units = { position = "mm" }`',
        'text: the semicolon parts the header\'s cells: say `separator = ";"`',
        'text: a comma stands before the decimals: say `decimal = ","`',
        "text: 1 line(s) above the header are no data, the first is 'Gerät 7'",
    ]
    stated = {**COLUMNS, "units": {"time": "ms", "position": "mm"}, "separator": ";", "decimal": ","}
    assert lines(path, stated)[1:] == [
        "time: time is converted from ms, as [log] units states",
        "units: position is converted from mm, as [log] units states",
        "text: 1 line(s) above the header are no data, the first is 'Gerät 7'",
    ]


def test_jitter_doubled_and_missing_stamps(tmp_path):
    log = signals(400)
    log["t"] = log["t"] + np.random.default_rng(0).uniform(-2e-4, 2e-4, 400)
    log["t"][100] = log["t"][99]
    # With the doubled stamp a fourth sample is missing.
    kept = np.delete(np.arange(400), [200, 201, 202])
    said = lines(write_csv(tmp_path / "log.csv", {name: x[kept] for name, x in log.items()}))
    assert said[0].endswith("after resampling")
    assert any("1 row(s) have the time of the row before, first row 100" in line for line in said)
    assert any("steps are off the period" in line and "4 sample(s) are missing" in line for line in said)
    assert any(line.startswith("time: resampled to ") and "say `resample = " in line for line in said)


def test_a_gap_and_the_stretch_that_is_used(tmp_path):
    log = signals(600)
    log["t"][200:] += 1.0
    said = lines(write_csv(tmp_path / "log.csv", log))
    assert any("1 gap(s)" in line and line.endswith("say `rows = [200, 600]`") for line in said)


def test_turns_that_are_joined(tmp_path):
    log = signals(2000)
    log["q"] = np.mod(20 * log["t"], 2 * np.pi)
    said = lines(write_csv(tmp_path / "log.csv", log), {**COLUMNS, "unwrap": True})
    assert (
        said[1]
        == "wrap: the position of joint 1 jumps by 2 pi in 6 row(s): joined: say `unwrap = 6.28318531`"
    )
    assert len(lines(tmp_path / "log.csv", {**COLUMNS, "unwrap": 2 * np.pi})) == 1


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("units.force", "A"),
        ("separator", "\t"),
        ("resample", 200.0),
        ("resample_method", "linear"),
        ("rows", [3, 90]),
        ("unwrap", 360.0),
        ("episode", 0),
    ],
)
def test_a_statement_is_toml_that_sets_the_value(setting, value):
    key, _, quantity = setting.partition(".")
    said = tomllib.loads(statement_of(Assumed(setting, value, "")))[key]
    assert (said[quantity] if quantity else said) == value
    assert statement_of(Assumed("doubled_rows", 3, "")) == ""


CASE = {
    "plant": {"kind": "axis", "parameters": {"inertia": {"guess": 60.0}}},
    "effects": [{"kind": "coulomb_friction", "level": {"guess": 10.0}}],
    "actuator": {"gain": 35.15},
    "log": {"time": "t", "position": "q", "force": "u"},
}


def test_check_says_it_first_and_writes_it(tmp_path):
    result = check(CASE, recorded())
    begin = "time: 2000 samples, one every 2 ms (500 Hz), even to 1 %\nthe log is sound\n"
    assert str(result).startswith(begin)
    text = "2000 samples, one every 2 ms (500 Hz), even to 1 %"
    assert result.json()["seen"] == [{"about": "time", "text": text, "say": None}]


def test_a_doubt_on_units_stands_before_the_verdict():
    log = recorded()
    log["v"] = 1.7 * np.gradient(log["q"], log["t"])
    text = str(check({**CASE, "log": {**CASE["log"], "velocity": "v"}}, log))
    doubt, verdict = text.index("units: velocity is 1.7"), text.index("the log is sound")
    assert doubt < verdict
    assert text.count("velocity is 1.7") == 1


def test_a_refusal_says_all_that_is_wrong():
    log = recorded()
    log["ref"] = 1e3 * log["ref"]
    log["v"] = 1e3 * np.gradient(log["q"], log["t"])
    case = {**CASE, "log": {**CASE["log"], "velocity": "v", "reference": "ref"}}
    with pytest.raises(InputError, match="velocity looks like mm/s") as caught:
        check(case, log)
    assert "and 1 more error: reference of joint 1: the reference is" in str(caught.value)
    assert 'units = { reference = "mm" }' in str(caught.value)
