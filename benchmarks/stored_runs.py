"""Stored runs of a benchmark: a line of JSON each, with the commit of jaxid that made it."""

import json
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def read_runs(file: Path) -> list[dict[str, Any]]:
    """Return the records so far; a line that an interruption cut short is left out."""
    text = file.read_text() if file.exists() else ""
    return [json.loads(line) for line in text.split("\n")[:-1] if line.endswith("}")]


def append_runs(file: Path, records: Iterable[dict[str, Any]]) -> None:
    """Write records behind those of a file."""
    with file.open("a") as lines:
        lines.writelines(json.dumps(record) + "\n" for record in records)


def commit_of(root: Path) -> str:
    """Name the commit of a working tree, with `-dirty` if more of it was changed than results."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], capture_output=True, text=True, cwd=root, check=False
        ).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!benchmarks/results")
    return git("rev-parse", "--short=8", "HEAD") + ("-dirty" if changed else "")
