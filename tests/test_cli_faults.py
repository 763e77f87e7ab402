"""What the command line refuses: exit status 2, one line that tells the mend, nothing written."""

import shlex

import numpy as np
import pytest

from tests.support.cli_setup import place, recorded, refused, text


@pytest.fixture(scope="module")
def sound():
    return recorded()


@pytest.fixture
def files(tmp_path, sound):
    return place(tmp_path / "in", sound)


# Faults of the command itself


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (
            "check a.csv b.toml",
            "a.csv: is a log, in the place of the case; the case comes first: jaxid check",
        ),
        (
            "identify a.csv",
            "a.csv: is a log, in the place of the case; the case comes first; jaxid init a.csv",
        ),
        ("report nowhere", "nowhere: is no result; name result.json or discovery.json"),
        ("plot nowhere forces", "nowhere: is no result"),
        ("plot nowhere force", "plot 'force' is not known; did you mean 'forces'?"),
        ("plot nowhere forces -o a.gif", "suffix '.gif' is no picture; end it in .png, .svg or .pdf"),
        ("effects viscous", "effect 'viscous' is not known"),
        ("identfy a b", "invalid choice: 'identfy'"),
        ("identify", "required: CASE.toml, LOG; see jaxid identify --help"),
        ("check a.toml b.csv c.csv --colour", "unrecognized arguments: --colour"),
        ("check a b --colour", "unrecognized arguments: --colour"),
        ("discover a b --max-effects two", "invalid int value: 'two'"),
        ("discover a b --max-effects -1", "--max-effects is -1; give zero or more"),
        ("simulate a -o b.csv --seed -1", "--seed is -1; give zero or more"),
        ("simulate a -o b.npz", "the log is written as CSV; end its name in .csv"),
        ("simulate a -o nowhere/b.csv", "has no such folder; make the folder first"),
        ("simulate a -o folder.csv", "folder.csv: is a folder"),
        ("identify a b --method output", "choose one of output_error, prediction_error, within_prior"),
        ("identify a b --solver tsit6", "solver 'tsit6' is not known; did you mean 'tsit5'?"),
        (
            "identify a b --solver tsit5 --method algebraic",
            "goes only with output_error and within_prior; leave out",
        ),
        ("check a b -o file", "file: is a file, not a folder; choose another -o"),
        ("check a b -o file/deeper/still", "file: is a file, not a folder; choose another -o"),
    ],
)
def test_a_wrong_command_is_told_in_one_line(tmp_path, capsys, monkeypatch, line, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder.csv").mkdir()
    refused(capsys, tmp_path, *shlex.split(line), told=told)


# Faults of the case


@pytest.mark.parametrize("command", ["check", "identify", "discover"])
def test_missing_case(tmp_path, files, capsys, command):
    case, log = files
    case.unlink()
    refused(capsys, tmp_path, command, case, log, "-o", tmp_path / "out", told="case.toml: ")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("inertia =", "inertai =", "did you mean 'inertia'?"),
        ("viscous_friction", "viscous_fricton", "did you mean 'viscous_friction'?"),
        ("[sensor]", "[sensors]", "did you mean 'sensor'?"),
        ('force = "u"', 'force = "volts"', "volts"),
        ("[plant]", "[plant", "case.toml"),
        ("{ guess = ", "{ min = 1000.0, guess = ", "case.toml"),
    ],
)
def test_faults_of_the_case(tmp_path, sound, capsys, old, new, told):
    case, log = place(tmp_path / "in", sound, text().replace(old, new, 1))
    refused(capsys, tmp_path, "identify", case, log, "-o", tmp_path / "out", told=told)


def test_a_case_without_unknowns_has_nothing_to_identify(tmp_path, sound, capsys):
    known = "\n".join(line.replace("{ guess = ", "").replace(" }", "") for line in text().splitlines())
    case, log = place(tmp_path / "in", sound, known)
    refused(capsys, tmp_path, "identify", case, log, told="no parameter is unknown")


def test_simulate_needs_to_know_what(tmp_path, files, capsys):
    argv = ("simulate", files[0], "-o", tmp_path / "new.csv")
    refused(capsys, tmp_path, *argv, told="[simulation] has no duration; add")


# Faults of the log


def _spoilt(log, name, rows, value):
    column = log[name].copy()
    column[rows] = value
    return log | {name: column}


def _without(log, rows):
    return {name: np.delete(column, rows) for name, column in log.items()}


def _in_millimetres(log):
    return log | {"q": 1e3 * log["q"], "ref": 1e3 * log["ref"]}


FAULTS = {
    "missing column": (lambda g: {k: v for k, v in g.items() if k != "u"}, "'u'"),
    "NaN": (lambda g: _spoilt(g, "q", 700, np.nan), "the first is row 700 (NaN)"),
    "time backwards": (lambda g: _spoilt(g, "t", 700, 0.1), "row 700"),
    "gaps": (lambda g: _without(_without(g, slice(40, 300)), slice(80, None)), "is too short: 40 samples"),
    "too short": (lambda g: _without(g, slice(40, None)), "is too short: 40 samples"),
    "nothing moves": (lambda g: _spoilt(g, "q", slice(None), 0.2), "nothing moves"),
    "saturated": (lambda g: g | {"u": 10.0 * np.sign(g["u"])}, "the command is saturated"),
    "millimetres": (_in_millimetres, "position looks like millimetres"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_the_log(tmp_path, sound, capsys, fault):
    spoil, told = FAULTS[fault]
    case, log = place(tmp_path / "in", spoil(sound))
    refused(capsys, tmp_path, "check", case, log, "-o", tmp_path / "out", told=told)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("rest_velocity = 1.0", "only 0 samples move faster than the rest velocity 1; take a log"),
        ("decimation = 200", "too short: 2000 samples leave"),
        ("median = 2001", "median = 2001 takes 2001 samples, and the log has 2000"),
        ('derivatives = "parabolic"\nreach = 1000', "reach = 1000 takes 2001 samples"),
        ("median = 4", "median = 4 is even; it must be odd"),
    ],
)
def test_a_log_with_too_little_left(tmp_path, sound, capsys, line, told):
    case, log = place(tmp_path / "in", sound, text(more=f"[preprocess]\n{line}\n"))
    refused(capsys, tmp_path, "identify", case, log, "-o", tmp_path / "out", told=told)


def test_missing_log_and_missing_validation_log(tmp_path, files, capsys):
    case, log = files
    out, no_log = ("-o", tmp_path / "out"), log.with_name("lag.csv")
    refused(capsys, tmp_path, "check", case, no_log, *out, told="lag.csv: no such file")
    argv = ("identify", case, log, "--validate", no_log, *out)
    refused(capsys, tmp_path, *argv, told="lag.csv: no such file")
