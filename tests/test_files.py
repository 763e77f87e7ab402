"""Outputs are written whole or not at all: on a full disk, in a closed folder, and by a process that dies."""

import errno
import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

import jaxid
from jaxid.cli import main
from jaxid.errors import InputError, cause
from jaxid.experiment_design.along_reference import Excitation
from jaxid.experiment_design.in_loop import Design
from jaxid.files import write_results, write_together, write_whole
from tests.support.cli_setup import held, place, recorded, refused, text

# Of a folder in which nobody may make a file, root included.
NOWHERE = "/proc/self/jaxid"


@contextmanager
def full_disk(size: int = 10):
    """Let the system write no more than a few bytes to any file of this process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def fails(number):
    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    return fail


# One file, and several together


@pytest.mark.parametrize("function", ["os.fsync", "os.replace", "os.chmod", "tempfile.mkstemp"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EIO])
def test_a_failure_changes_nothing(tmp_path, monkeypatch, function, number):
    path, other = tmp_path / "result.json", tmp_path / "report.html"
    write_whole(path, "first")
    with monkeypatch.context() as patch:
        patch.setattr(function, fails(number))
        with pytest.raises(
            InputError, match=rf"cannot be written: {os.strerror(number)}; .*choose"
        ) as caught:
            write_together({other: "new", path: "second"})
    assert str(other) in str(caught.value)
    assert held(tmp_path) == {path: b"first"}
    write_together({other: "new", path: "second"})
    assert held(tmp_path) == {path: b"second", other: b"new"}


def test_a_disk_that_is_full_at_the_second_file_changes_neither(tmp_path):
    small, large = tmp_path / "a", tmp_path / "b"
    write_together({small: "old", large: "old"})
    with full_disk(), pytest.raises(InputError, match=f"{large}: cannot be written: File too large; free"):
        write_together({small: "new", large: "new" * 100})
    assert held(tmp_path) == {small: b"old", large: b"old"}


def test_a_folder_in_the_place_of_a_file_changes_neither(tmp_path):
    (tmp_path / "b").mkdir()
    with pytest.raises(InputError, match="b: cannot be written: is a folder"):
        write_together({tmp_path / "a": "new", tmp_path / "b": "new"})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b"]


def test_a_new_folder_goes_with_its_files(tmp_path):
    folder = tmp_path / "deep" / "er"
    with full_disk(), pytest.raises(InputError, match="cannot be"):
        write_results(folder, {"a": "new" * 100})
    assert list(tmp_path.iterdir()) == []
    # Nor is a file touched that was there before.
    folder.mkdir(parents=True)
    (folder / "mine").write_text("mine")
    with full_disk(), pytest.raises(InputError, match="cannot be"):
        write_results(folder, {"a": "new" * 100})
    assert held(tmp_path) == {folder / "mine": b"mine"}


KILLED = """
import os, signal, sys
from pathlib import Path
from jaxid import files

name, call = sys.argv[2], int(sys.argv[3])
real, calls = getattr(os, name), []

def kill(*args):
    calls.append(args)
    if len(calls) == call:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*args)

setattr(os, name, kill)
folder = Path(sys.argv[1])
files.write_together({folder / "a": "new" * 1000, folder / "b": "new" * 1000})
"""


@pytest.mark.parametrize(
    ("name", "call", "new"),
    [("fsync", 1, []), ("fsync", 2, []), ("replace", 1, []), ("replace", 2, ["a"])],
)
def test_a_killed_process_writes_no_file_in_part(tmp_path, name, call, new):
    files = {tmp_path / "a": "old", tmp_path / "b": "old"}
    write_together(files)
    command = [sys.executable, "-c", KILLED, str(tmp_path), name, str(call)]
    assert subprocess.run(command).returncode == -signal.SIGKILL
    for path in files:
        assert path.read_text() == ("new" * 1000 if path.name in new else "old")
    # The next writer removes its parts, but not those of a writer that is still at it.
    write_together(files)
    assert held(tmp_path) == {path: b"old" for path in files}


def test_the_part_of_another_writer_stays(tmp_path, monkeypatch):
    path, replace = tmp_path / "a", os.replace

    def meanwhile(source, target):
        monkeypatch.setattr("os.replace", replace)
        write_whole(path, "other")
        assert path.read_text() == "other"
        replace(source, target)

    monkeypatch.setattr("os.replace", meanwhile)
    write_whole(path, "mine")
    assert held(tmp_path) == {path: b"mine"}


# Every command that writes

SIMULATED = """
[reference]
kind = "trapezoid"
start = 0.0
targets = [0.1, 0.0]
speed = 0.12
acceleration = 0.8
[simulation]
duration = 1.0
sample_rate = 500.0
[study]
estimators = ["inverse_dynamics"]
runs = 2
chunk = 1
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A result of each command, made once: the tests are about its writing."""
    case, log = place(tmp_path_factory.mktemp("in"), recorded(), text(more=SIMULATED))
    designed = SimpleNamespace(csv=lambda: "t,reference\n" + "0.0,0.0\n" * 20)
    return {
        "check": jaxid.check(case, log),
        "identify": jaxid.identify(case, log, method="inverse_dynamics"),
        "discover": jaxid.discover(case, log, max_effects=0),
        "study": jaxid.study(case),
        "simulate": jaxid.simulate(case),
        "design": SimpleNamespace(save=lambda path: Design.save(designed, path), time=[], signal=""),
        "design of an arm": SimpleNamespace(
            save=lambda path: Excitation.save(designed, path), time=[], signal=""
        ),
    }


FAULTS = {
    "full": lambda patch: full_disk(),
    "no space to flush": lambda patch: patch.setattr("os.fsync", fails(errno.ENOSPC)),
    "not replaced": lambda patch: patch.setattr("os.replace", fails(errno.EROFS)),
    "no file may be made": lambda patch: patch.setattr("tempfile.mkstemp", fails(errno.EACCES)),
}
WRITERS = ["check", "identify", "discover", "simulate", "design", "design of an arm"]


def of_command(results, monkeypatch, writer):
    """Let a command return the result of its kind; return its arguments."""
    command, result = writer.split()[0], results[writer]
    case = results["check"].session.case.path
    monkeypatch.setattr(f"jaxid.commands.{command}.{command}", lambda *args, **options: result)
    to_file = command in ("simulate", "design")
    logs = [] if to_file else [case.parent / "log.csv"]
    return [command, case, *logs, "-o"], "new.csv" if to_file else "out"


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("writer", WRITERS)
def test_what_cannot_be_written_is_one_line(results, tmp_path, capsys, monkeypatch, writer, fault):
    argv, name = of_command(results, monkeypatch, writer)
    target = tmp_path / name
    with monkeypatch.context() as patch, FAULTS[fault](patch) or SimpleContext():
        status = main([*map(str, argv), str(target)])
    err = capsys.readouterr().err
    assert status == 2
    assert err.startswith(f"jaxid: {target}")
    assert err.count("\n") == 1
    assert "cannot be" in err
    assert list(tmp_path.iterdir()) == []
    # The same command does it once there is room.
    assert main([*map(str, argv), str(target)]) == 0
    assert target.exists()


class SimpleContext:
    def __enter__(self): ...

    def __exit__(self, *_): ...


@pytest.mark.parametrize("writer", WRITERS[:3])
def test_a_full_disk_leaves_the_earlier_results(results, tmp_path, capsys, monkeypatch, writer):
    argv, name = of_command(results, monkeypatch, writer)
    folder = tmp_path / name
    assert main([*map(str, argv), str(folder)]) == 0
    before = held(folder)
    with full_disk():
        assert main([*map(str, argv), str(folder)]) == 2
    assert held(folder) == before


@pytest.mark.parametrize("writer", WRITERS)
def test_a_folder_where_none_can_be_made(results, tmp_path, capsys, monkeypatch, writer):
    argv, name = of_command(results, monkeypatch, writer)
    assert main([*map(str, argv), f"{NOWHERE}/{name}"]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"jaxid: {NOWHERE}/{name}: ")
    assert err.count("\n") == 1


def test_a_study_goes_on_after_a_full_disk(results, tmp_path, capsys):
    case, out = results["check"].session.case.path, tmp_path / "out"
    argv = ["study", str(case), "-o", str(out), "--quiet"]
    with full_disk():
        assert main(argv) == 2
    assert list(tmp_path.iterdir()) == []

    # Room for the manifest and for no chunk.
    jaxid.study(case, folder=tmp_path / "whole")
    room = (tmp_path / "whole" / "study.json").stat().st_size
    chunk = (tmp_path / "whole" / "chunks" / "000001.npz").stat().st_size
    assert room < chunk
    capsys.readouterr()
    with full_disk(room):
        assert main(argv) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert f"{out}/chunks/" in err
    assert "cannot be written" in err
    assert {p.name for p in out.rglob("*")} == {".jaxid", "study.json", "chunks"}

    # Room for the chunks and not for the results.
    with full_disk(chunk):
        assert main([*argv, "--resume"]) == 2
    chunks = {"000000.npz", "000001.npz"}
    assert {p.name for p in out.rglob("*")} == {".jaxid", "study.json", "chunks", *chunks}
    assert main([*argv, "--resume"]) == 0
    assert (out / "study.nc").read_bytes() == (tmp_path / "whole" / "study.nc").read_bytes()


def test_a_terminal_that_cannot_be_written_to_is_one_line(results):
    """The environment's fault, not the input's: status 1, as README states."""
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "jaxid.cli", "effects"]
        ran = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert ran.returncode == 1
    assert ran.stderr == "jaxid: [Errno 28] No space left on device\n"


def test_refused_before_the_work(results, tmp_path, capsys):
    case = results["check"].session.case.path
    (tmp_path / "file").write_text("mine")
    argv = ("identify", case, case.parent / "log.csv", "-o", tmp_path / "file" / "out")
    refused(capsys, tmp_path, *argv, told="is a file, not a folder")
    assert np.isfinite(results["identify"].parameters["inertia"].value)


def test_an_error_repeats_no_more_than_a_line_of_a_library():
    assert cause(ValueError("a\nb")) == "a b"
    assert cause(KeyError()) == "KeyError"
    assert len(cause(ValueError("x" * 5000))) == 200
