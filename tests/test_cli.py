"""The command line: what it takes, what it refuses, what it writes over, how it ends."""

import functools
import io
import os
import shlex
import subprocess
import sys

import numpy as np
import pytest
from cli_setup import TRUTH, place, recorded, run, text

from jaxid import cli
from jaxid.effects import EFFECTS
from jaxid.estimators import METHODS
from jaxid.plants import PLANTS

COMMANDS = ("demo", "plants", "effects", "simulate", "check", "identify", "discover")
SIMULATED = """
[reference]
kind = "trapezoid"
targets = [0.05, 0.2, 0.1, 0.0]
speed = 0.15
acceleration = 1.0
[simulation]
duration = 4.0
sample_rate = 500.0
"""


@pytest.fixture(scope="module")
def sound():
    return recorded()


@pytest.fixture
def files(tmp_path, sound):
    return place(tmp_path / "in", sound)


def held(folder):
    """Every file below a folder with its content."""
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def refused(capsys, folder, *argv, told):
    """Exit status 2, one line on stderr, nothing on stdout, nothing written."""
    before, entries = held(folder), sorted(folder.rglob("*"))
    ran = run(capsys, *argv)
    assert ran.status == 2, ran.err
    assert ran.out == ""
    assert ran.err.startswith("jaxid: ")
    assert ran.err.endswith("\n")
    assert ran.err.count("\n") == 1
    assert told in ran.err
    assert sorted(folder.rglob("*")) == entries
    assert held(folder) == before
    return ran.err


# What there is


def test_help_of_every_command(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--help"])
    top = capsys.readouterr().out
    for command in COMMANDS:
        assert f"\n    {command} " in top
        with pytest.raises(SystemExit, match="0"):
            cli.main([command, "--help"])
        shown = capsys.readouterr().out
        assert f"usage: jaxid {command}" in shown
        assert "-h, --help" in shown
        assert ("--quiet" in shown) == (command not in ("plants", "effects"))


def test_plants_and_effects_with_parameters_and_units(capsys):
    for command, registry in (("plants", PLANTS), ("effects", EFFECTS)):
        ran = run(capsys, command)
        assert (ran.status, ran.err) == (0, "")
        first = [line.split()[0] for line in ran.out.splitlines() if not line.startswith(" ")]
        assert set(registry) < {*first}
    lines = [line.split() for line in ran.out.splitlines()]
    assert ["coefficient", ">=", "0", "N", "s/m", "N", "m", "s/rad"] in [row[:8] for row in lines]
    assert ["period", ">", "0", "m", "rad"] in [row[:5] for row in lines]


def test_methods_are_those_there_are():
    assert set(cli.METHODS) == set(METHODS)


# Faults of the command itself


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("", "the following arguments are required: COMMAND; see jaxid --help"),
        ("identfy a b", "invalid choice: 'identfy'"),
        ("identify", "required: CASE.toml, LOG; see jaxid identify --help"),
        ("check a b --colour", "unrecognized arguments: --colour"),
        ("discover a b --max-effects two", "invalid int value: 'two'"),
        ("discover a b --max-effects -1", "--max-effects is -1; give zero or more"),
        ("simulate a -o b.csv --seed -1", "--seed is -1; give zero or more"),
        ("simulate a -o b.npz", "the log is written as CSV; end its name in .csv"),
        ("simulate a -o nowhere/b.csv", "has no such folder; make the folder first"),
        ("simulate a -o folder.csv", "folder.csv: is a folder"),
        ("identify a b --method output", "choose one of output_error, inverse_dynamics, algebraic"),
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
        ('force = "u"', "", "'force' is missing"),
        ("[plant]", "[plant", "case.toml"),
        ("{ guess = ", "{ min = 1000.0, guess = ", "case.toml"),
    ],
)
def test_faults_of_the_case(tmp_path, sound, capsys, old, new, told):
    case, log = place(tmp_path / "in", sound, text().replace(old, new, 1))
    refused(capsys, tmp_path, "identify", case, log, "-o", tmp_path / "out", told=told)


def test_a_case_without_unknowns_has_nothing_to_identify(tmp_path, sound, capsys):
    known = "\n".join(
        line.replace("{ guess = ", "").replace(" }", "") for line in text().splitlines()
    )
    case, log = place(tmp_path / "in", sound, known)
    refused(capsys, tmp_path, "identify", case, log, told="nothing is unknown")


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


def _mostly_at_rest(log):
    """Long at rest, then a move of a few samples."""
    rest = {k: np.full(2000, v[0]) + (k == "u") * 1e-3 * np.arange(2000) % 0.7
            for k, v in log.items()}
    both = {k: np.concatenate([rest[k], v[:60]]) for k, v in log.items()}
    return both | {"t": np.arange(len(both["t"])) / 500.0}


FAULTS = {
    "missing column": (lambda g: {k: v for k, v in g.items() if k != "u"}, "'u'"),
    "NaN": (lambda g: _spoilt(g, "q", 700, np.nan), "the first is row 700 (NaN)"),
    "time backwards": (lambda g: _spoilt(g, "t", 700, 0.1), "row 700"),
    "gap": (lambda g: _without(g, slice(700, 900)), "rows = [700, 1800]"),
    "too short": (lambda g: _without(g, slice(40, None)), "is too short: 40 samples"),
    "too short to filter": (lambda g: _without(g, slice(55, None)), "too short: 55 samples leave"),
    "nothing moves": (lambda g: _spoilt(g, "q", slice(None), 0.2), "nothing moves"),
    "saturated": (lambda g: g | {"u": 10.0 * np.sign(g["u"])}, "the command is saturated"),
    "millimetres": (lambda g: g | {"q": 1e3 * g["q"], "ref": 1e3 * g["ref"]}, "position looks like millimetres"),
    "not enough motion": (_mostly_at_rest, "samples move faster than the rest velocity"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_the_log(tmp_path, sound, capsys, fault):
    spoil, told = FAULTS[fault]
    case, log = place(tmp_path / "in", spoil(sound))
    refused(capsys, tmp_path, "check", case, log, "-o", tmp_path / "out", told=told)


def test_missing_log_and_missing_validation_log(tmp_path, files, capsys):
    case, log = files
    out, no_log = ("-o", tmp_path / "out"), log.with_name("lag.csv")
    refused(capsys, tmp_path, "check", case, no_log, *out, told="lag.csv: no such file")
    argv = ("identify", case, log, "--validate", no_log, *out)
    refused(capsys, tmp_path, *argv, told="lag.csv: no such file")


# What is written over


def test_results_are_written_over_only_where_jaxid_made_the_folder(tmp_path, files, capsys):
    own, users = tmp_path / "deep" / "own", tmp_path / "users"
    for _ in range(2):
        ran = run(capsys, "check", *files, folder=own)
        assert (ran.status, ran.err) == (0, "")
        assert f"wrote {own / 'check.json'}" in ran.out
    users.mkdir()
    (users / "check.json").write_text("mine")
    argv = ("check", *files, "-o", users)
    refused(capsys, tmp_path, *argv, told="holds check.json already; choose another -o")
    assert run(capsys, *argv, "--force").status == 0
    assert run(capsys, "check", *files).out in ran.out


def test_the_demo_leaves_a_case_of_the_users_alone(tmp_path, capsys):
    (tmp_path / "case.toml").write_text("mine")
    refused(capsys, tmp_path, "demo", "-o", tmp_path, told="holds case.toml already")


# How it ends


def test_simulated_logs_give_their_truth_back(tmp_path, capsys):
    case = text(more=SIMULATED)
    for name, value in TRUTH.items():
        key = name.rpartition(".")[2]
        case = case.replace(f"{key} = {{ ", f"{key} = {{ true = {value}, ")
    path, _ = place(tmp_path, {"t": np.zeros(2)}, case)
    logs = [tmp_path / f"{name}.csv" for name in ("one", "again", "other")]
    for log, seed in zip(logs, (3, 3, 4), strict=True):
        ran = run(capsys, "simulate", path, "-o", log, "--seed", seed)
        assert (ran.status, ran.err) == (0, "")
        assert ran.out == f"2000 samples at 500 Hz in {log}\n"
    one, again, other = (log.read_bytes() for log in logs)
    assert one == again
    assert one != other
    assert one.startswith(b"t,q,u,ref\n0.0,")
    refused(capsys, tmp_path, "simulate", path, "-o", logs[0], told="exists already; choose")
    assert run(capsys, "simulate", path, "-o", logs[2], "--seed", 3, "--force").status == 0
    assert logs[2].read_bytes() == one
    argv = ("identify", path, logs[0], "--method", "inverse_dynamics")
    found = run(capsys, *argv, folder=tmp_path / "out").json("result.json")["parameters"]
    for name, value in TRUTH.items():
        off = abs(found[name]["value"] - value)
        assert off < 5 * found[name]["std"], name
        assert off < 0.01 * value, name


def test_no_convergence_is_written_and_ends_with_1(tmp_path, sound, capsys, monkeypatch):
    from jaxid.estimators import inverse_dynamics

    solver = functools.partial(inverse_dynamics.levenberg_marquardt, max_steps=1)
    monkeypatch.setattr(inverse_dynamics, "levenberg_marquardt", solver)
    # Another length than everywhere else: what is compiled already holds the real solver.
    case, log = place(tmp_path / "in", {name: column[:1777] for name, column in sound.items()})
    argv = ("identify", case, log, "--method", "inverse_dynamics")
    ran = run(capsys, *argv, folder=tmp_path / "out")
    assert (ran.status, ran.err) == (1, "")
    assert ran.json("result.json")["converged"] is False
    assert "did not converge" in (tmp_path / "out" / "report.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (KeyboardInterrupt(), "jaxid: interrupted\n"),
        (OSError(28, "No space left on device"), "jaxid: [Errno 28] No space left on device\n"),
    ],
)
def test_what_stops_a_command_ends_with_1(tmp_path, files, capsys, monkeypatch, error, told):
    def stopped(*_, **__):
        raise error

    monkeypatch.setattr("jaxid.checks.check", stopped)
    ran = run(capsys, "check", *files, folder=tmp_path / "out")
    assert (ran.status, ran.err, ran.out) == (1, told, "")
    assert not (tmp_path / "out").exists()


class _Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_bar_on_a_terminal_and_none_when_quiet(files, monkeypatch):
    seen = []
    for quiet in ([], ["--quiet"]):
        monkeypatch.setattr(sys, "stderr", _Terminal())
        assert cli.main(["check", *map(str, files), *quiet]) == 0
        seen.append(sys.stderr.getvalue())
    assert "checking" in seen[0]
    assert seen[1] == ""


ENTRY = [sys.executable, "-c", "from jaxid.cli import entry; entry()"]


def test_a_piped_process_prints_its_result_alone(tmp_path, files):
    before = held(files[0].parent)
    argv = [*ENTRY, "check", *map(str, files), "-o", str(tmp_path / "out")]
    ended = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("the log is sound\n")
    assert held(files[0].parent) == before


def test_a_reader_who_leaves_is_no_accident():
    reading, writing = os.pipe()
    os.close(reading)
    ended = subprocess.run(
        [*ENTRY, "plants"], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (1, "")
