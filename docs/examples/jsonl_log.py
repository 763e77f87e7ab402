"""A file format: logs as JSON lines, one object for each sample.

Run as `python jsonl_log.py identify CASE.toml LOG.jsonl`, it is jaxid's command line with this format.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from jaxid.errors import InputError, suggest
from jaxid.logs.readers import register_reader
from jaxid.logs.readers.rows import Rows, resolve_rows


def read_jsonl(path: Path, names: list[str], rows: Rows | None) -> tuple[dict[str, np.ndarray], Rows]:
    """Read columns of a file of JSON lines.

    Args:
        path: The file; it exists and is not empty.
        names: Columns wanted, as the case names them.
        rows: First row and end, 0-based and half open; None: all rows.

    Returns:
        Each column of shape (samples, 1), and the rows that were read.

    Raises:
        InputError: If a line is no JSON object, or lacks a column, or holds something else than a number.
    """
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except UnicodeDecodeError as error:
        raise InputError("is not text in UTF-8", where=str(path), hint="export the log again") from error
    first, end = resolve_rows(rows, len(lines), path)

    columns = np.empty((len(names), end - first))
    for k, line in enumerate(lines[first:end]):
        where = f"{path}, row {first + k} (0-based)"
        try:
            sample = json.loads(line)
        except ValueError as error:
            raise InputError(f"is not JSON ({error})", where=where, hint="is the file cut off?") from error
        if not isinstance(sample, dict):
            raise InputError("is not a JSON object", where=where, hint='write {"t": 0.0, "q": 1.0, "u": 0.5}')
        for i, name in enumerate(names):
            if name not in sample:
                raise InputError(f"has no '{name}'", where=where, hint=suggest(name, sample))
            value = sample[name]
            if not isinstance(value, (int, float)) or isinstance(value, bool):
                hint = "correct or remove the row, or leave it out with rows = [first, end]"
                raise InputError(f"'{name}' is {value!r}, which is not a number", where=where, hint=hint)
            columns[i, k] = value
    return {name: columns[i][:, None] for i, name in enumerate(names)}, (first, end)


register_reader(".jsonl", read_jsonl)

if __name__ == "__main__":
    from jaxid.cli import entry

    entry()
