"""The command line: what there is, what it writes over, how it ends."""

import functools
import io
import os
import subprocess
import sys
import tomllib

import numpy as np
import pytest

import jaxid
from jaxid import cli, names
from jaxid._progress import Durations, progress, time_left
from jaxid.effects import EFFECTS
from jaxid.plants import PLANTS
from tests.support.cli_setup import TRUTH, held, place, recorded, refused, run, text

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


def test_alone_it_greets_with_three_examples(capsys):
    assert cli.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines if line.startswith("  jaxid ")] == [
        ["jaxid", "demo"],
        ["jaxid", "init"],
        ["jaxid", "identify"],
    ]


def test_every_help_ends_with_examples_of_its_command(capsys):
    parsers = cli.build_parser()._subparsers._group_actions[0].choices
    assert {"report", "plot", "effects", *COMMANDS} <= set(parsers)
    for name, parser in parsers.items():
        shown = parser.format_help()
        examples = shown.partition("\nexamples:\n")[2].splitlines()
        assert examples, name
        for line in examples:
            # Each example is one that the command accepts.
            words = line.split(">")[0].split()
            assert words[:2] == ["jaxid", name]
            assert cli.build_parser().parse_args(words[1:]).command == name
    assert all(f"{m} " in parsers["identify"].format_help() for m in names.METHODS)


def test_one_effect_with_formula_curve_and_snippet(tmp_path, capsys):
    for kind in EFFECTS:
        ran = run(capsys, "effects", kind)
        assert (ran.status, ran.err) == (0, "")
        assert ran.out.startswith(f"{kind}: ")
        # The snippet is a part of a case that loads.
        given = tomllib.loads(ran.out.partition("In a case:\n")[2])
        assert given["effects"][0]["kind"] == kind
        plant = "flexible_axis" if EFFECTS[kind].with_springs else "axis"
        motion = "rotary" if EFFECTS[kind].of_rotary else "linear"
        inertias = {
            "axis": ["inertia"],
            "flexible_axis": ["motor_inertia", "load_inertia", "stiffness", "damping"],
        }
        values = {name: 1.0 for name in inertias[plant]}
        if EFFECTS[kind].controller_field is not None:
            given |= {"controller": {"kind": "pd", "kp": 1.0, "kd": 1.0}}
        jaxid.load_case({"plant": {"kind": plant, "motion": motion, "parameters": values}, **given})
    shown = run(capsys, "effects", "cogging").out
    assert "−amplitude · cos(2π · q / period + phase)" in shown
    assert shown.count("●") > 60
    picture = tmp_path / "cogging.png"
    assert run(capsys, "effects", "cogging", "-o", picture).status == 0
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert "did you mean 'cogging'?" in run(capsys, "effects", "coging").err


def test_plants_and_effects_with_parameters_and_units(capsys):
    for command, registry in (("plants", PLANTS), ("effects", EFFECTS)):
        ran = run(capsys, command)
        assert (ran.status, ran.err) == (0, "")
        first = [line.split()[0] for line in ran.out.splitlines() if not line.startswith(" ")]
        assert set(registry) < {*first}
    lines = [line.split() for line in ran.out.splitlines()]
    assert ["coefficient", ">=", "0", "N", "s/m", "N", "m", "s/rad"] in [row[:8] for row in lines]
    assert ["period", ">", "0", "m", "rad"] in [row[:5] for row in lines]


def test_every_method_has_a_line_that_says_when_to_take_it(capsys):
    assert cli.main(["methods"]) == 0
    table, several = capsys.readouterr().out.split("\n\n")
    lines = table.splitlines()
    assert tuple(line.split()[0] for line in lines) == names.METHODS
    assert all(name in several for name in names.SEVERAL_LOGS)
    assert all(len(line.split()) > 4 for line in lines)


def test_help_lists_every_method_output_and_solver(capsys):
    with pytest.raises(SystemExit):
        cli.main(["identify", "--help"])
    text = "".join(capsys.readouterr().out.split())
    assert ",".join(names.METHODS) in text
    assert ",".join(names.OUTPUTS) in text
    assert ",".join(names.SOLVERS) in text


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

    monkeypatch.setattr("jaxid.commands.check.check", stopped)
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


def test_the_time_left_is_that_of_the_last_run(tmp_path, monkeypatch):
    durations = Durations(tmp_path / "durations.json")
    assert durations.expected(["identify", "a"]) is None
    durations.remember(["identify", "a"], 20.0)
    durations.remember(["identify", "b"], 1.0)
    assert durations.expected(["identify", "a"]) == 20.0
    assert durations.expected(["identify", "b"]) is None
    assert time_left(5.0, 20.0) == "about 15 s left"
    assert time_left(5.0, 605.0) == "about 10 min left"
    assert time_left(25.0, 20.0) == "longer than last time"
    (tmp_path / "durations.json").write_text("damaged")
    assert durations.expected(["identify", "a"]) is None

    # A command draws what the last one took.
    durations.remember(["check"], 20.0)
    monkeypatch.setattr(Durations, "of_user", lambda: durations)
    monkeypatch.setattr(sys, "stderr", _Terminal())
    with progress(["check"], shown=True) as show:
        show("checking")
    assert "checking" in sys.stderr.getvalue()
    assert "about 20 s left" in sys.stderr.getvalue()


ENTRY = [sys.executable, "-c", "from jaxid.cli import entry; entry()"]


def test_a_piped_process_prints_its_result_alone(tmp_path, files):
    before = held(files[0].parent)
    argv = [*ENTRY, "check", *map(str, files), "-o", str(tmp_path / "out")]
    ended = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "\nthe log is sound\n" in ended.stdout
    assert held(files[0].parent) == before


def test_a_reader_who_leaves_loses_no_result(tmp_path, files):
    reading, writing = os.pipe()
    os.close(reading)
    argv = [*ENTRY, "check", *map(str, files), "-o", str(tmp_path / "out")]
    ended = subprocess.run(argv, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (1, "")
    assert (tmp_path / "out" / "check.json").exists()


def test_a_reader_who_leaves_is_no_accident():
    reading, writing = os.pipe()
    os.close(reading)
    ended = subprocess.run([*ENTRY, "plants"], stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (1, "")
