"""Every file of a suite of invalid TOML is refused in one line that names the file and the place."""

import os
from pathlib import Path

import pytest

from jaxid.cli import main

DATA = os.environ.get("JAXID_DATA")
FOLDER = Path(DATA or "") / "toml_invalid"
# A command that reads nothing else, one that reads a log, and one that would write.
COMMANDS = (["check", "log.csv"], ["identify", "log.csv", "-o", "out"], ["simulate", "-o", "new.csv"])


@pytest.mark.skipif(not DATA, reason="JAXID_DATA is not set: no invalid TOML files")
def test_each_is_one_line(tmp_path, capsys, monkeypatch):
    files = sorted(FOLDER.glob("*.toml"))
    assert len(files) >= 509
    monkeypatch.chdir(tmp_path)
    wrong = {}
    for k, path in enumerate(files):
        command, *rest = COMMANDS[k % len(COMMANDS)]
        status = main([command, str(path), *rest])
        out, err = capsys.readouterr()
        line = err.startswith(f"jaxid: {path}: is not ") and err.endswith("\n") and err.count("\n") == 1
        if not (status == 2 and out == "" and line and "; " in err):
            wrong[path.name] = (status, out, err)
    assert not wrong
    assert list(tmp_path.iterdir()) == []
