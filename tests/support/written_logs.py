"""Small logs on disk, written by numpy alone, and what a refusal must look like."""

from pathlib import Path

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.logs.log import read_log

COLUMNS = {"time": "t", "position": "q", "force": "u"}
ROWS = 200


def signals(samples: int = ROWS, rate_hz: float = 1000.0) -> dict[str, np.ndarray]:
    t = np.arange(samples) / rate_hz
    return {"t": t, "q": 0.1 * np.sin(20 * t), "u": 3.0 * np.cos(20 * t + 0.3)}


def write_csv(path: Path, data: dict, delimiter: str = ",", digits: str = "%.17g") -> Path:
    rows = np.stack(list(data.values()), axis=1)
    header = delimiter.join(data)
    np.savetxt(path, rows, fmt=digits, delimiter=delimiter, header=header, comments="")
    return path


def edit(path: Path, row: int, line: str) -> Path:
    """Replace one row (0-based, below the header) of a CSV."""
    lines = path.read_text().splitlines()
    lines[row + 1] = line
    path.write_text("\n".join(lines) + "\n")
    return path


def refuse(path, columns=COLUMNS, *, match: str, **kwargs) -> None:
    with pytest.raises(InputError, match=match) as caught:
        read_log(path, columns, **kwargs)
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value), "the line ends with its hint"
