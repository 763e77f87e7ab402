"""Random tables, files that went wrong, and the two answers that a reader may give: the log, or one line."""

import resource
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from jaxid.errors import InputError
from jaxid.logs.in_memory import as_log
from jaxid.logs.log import Log
from jaxid.logs.readers.contents import contents_of
from tests.support.written_logs import COLUMNS

# Few in CI; `-m slow` takes many.
FEW = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
MANY = settings(FEW, max_examples=2000, derandomize=False)
# Chosen: the logs of these tests are of a few kB and read within 0.1 s, also on a machine that is busy.
MOST_MEMORY, MOST_SECONDS = 2**28, 20.0

NUMBERS = st.one_of(
    st.floats(-1e6, 1e6),
    st.floats(allow_nan=True, allow_infinity=True),
    st.integers(-(2**40), 2**40).map(float),
)
MOVED = st.floats(-1e3, 1e3)


@st.composite
def tables(draw, numbers=MOVED):
    """Draw time, position and force: sound but for what `numbers` brings."""
    rows, rate = draw(st.integers(50, 70)), draw(st.sampled_from([10.0, 500.0, 1000.0, 2**0.5]))
    column = st.lists(numbers, min_size=rows, max_size=rows)
    values = {"t": np.arange(rows) / rate, "q": np.array(draw(column)), "u": np.array(draw(column))}
    if draw(st.booleans()):
        with np.errstate(over="ignore"):
            values["u"] = values["u"].astype(np.float32)
    return values


def steady_table() -> dict[str, np.ndarray]:
    """Return a sound table, for files that are damaged afterwards."""
    return {"t": np.arange(60) / 500, "q": np.linspace(-0.7, 0.9, 60), "u": np.linspace(2.0, -1.0, 60)}


@st.composite
def damaged(draw, sound: bytes):
    """Draw a file with bytes of it changed, cut, repeated or put in."""
    content = bytearray(sound)
    for _ in range(draw(st.integers(1, 4))):
        if not content:
            break
        # Headers and directories stand at the ends.
        last = len(content) - 1
        k = draw(st.one_of(st.integers(0, last), st.integers(0, min(200, last))))
        k = last - k if draw(st.booleans()) else k
        kind = draw(st.sampled_from(["change", "cut", "repeat", "insert", "zero"]))
        if kind == "change":
            content[k] = draw(st.integers(0, 255))
        elif kind == "cut":
            del content[k : k + draw(st.sampled_from([1, 2, 100, len(content)]))]
        elif kind == "repeat":
            content[k:k] = content[k : k + 50]
        elif kind == "zero":
            content[k : k + 8] = bytes(8)
        else:
            content[k:k] = draw(st.binary(min_size=1, max_size=8))
    return bytes(content)


def outcome(source, columns: Mapping = COLUMNS) -> Log | None:
    """Return the log, or None if it is refused in one line; anything else fails.

    The columns of a file are listed too, as `init` does, or that is refused in one line.
    """
    if isinstance(source, Path):
        _answer(lambda: contents_of(source))
    log = _answer(lambda: as_log(source, columns))
    assert log is None or np.all(np.isfinite(np.column_stack([log.time, log.position, log.force])))
    return log


def _answer(read: Callable[[], Any]) -> Any:
    """Return what is read, or None if it is refused in one line, with little memory and time for it."""
    memory, start = _peak(), time.process_time()
    try:
        found, line = read(), ""
    except InputError as error:
        found, line = None, str(error)
    assert "\n" not in line
    assert len(line) < 1000
    assert _peak() - memory < MOST_MEMORY
    assert time.process_time() - start < MOST_SECONDS
    return found


def _peak() -> int:
    """Return the most memory that this process has taken so far [bytes]."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def in_file(content: bytes, suffix: str, columns: Mapping = COLUMNS) -> Log | None:
    """Return the outcome of a file with this content."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        path.write_bytes(content)
        return outcome(path, columns)


def same(log: Log | None, table, resolution: float = 1e-12) -> None:
    """Check that a log is the table, and refused only if a number of it is no reading.

    Args:
        log: The outcome of reading it.
        table: What was written.
        resolution: Difference of times that the format cannot tell [s].
    """
    sound = all(np.all(np.abs(np.nan_to_num(table[n], nan=np.inf)) <= 1e30) for n in ("q", "u"))
    assert (log is not None) == sound
    if log is not None:
        np.testing.assert_array_equal(log.position[:, 0], table["q"].astype(np.float64))
        np.testing.assert_array_equal(log.force[:, 0], table["u"].astype(np.float64))
        np.testing.assert_allclose(log.time, table["t"], rtol=1e-12, atol=resolution)
