"""Rows of the speed benchmark: two functions timed in turn, after a check that their results are equal."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

HEAD = (
    f"{'quantity':34s} {'compared with':35s} {'jaxid ms':>9s} {'other ms':>9s} {'ratio':>8s} "
    f"{'fastest':>8s} {'aim':>8s} {'differ':>9s}"
)


@dataclass
class Row:
    """One comparison.

    Args:
        quantity: Name of the computation.
        rival: Name of the alternative.
        jaxid, alternative: Medians [s].
        ratio: jaxid over alternative, of the medians.
        best: The same of the fastest runs, which other load on the machine affects least.
        difference: Largest difference of the results, relative to their size.
        aim: Target of the ratio; None: none.
    """

    quantity: str
    rival: str
    jaxid: float
    alternative: float
    ratio: float
    best: float
    difference: float
    aim: float | None = None

    @property
    def met(self) -> bool:
        """Check the aim by the fastest runs, because other load on the machine must not decide."""
        return self.aim is None or self.best <= self.aim


def timed(function: Callable) -> float:
    """Return the time of a call [s]."""
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def compare(
    quantity: str,
    ours: Callable,
    rival: str,
    theirs: Callable,
    aim: float | None,
    repeats: int,
    tolerance: float,
) -> Row:
    """Check that both compute the same, then time them in turn."""
    a, b = np.asarray(ours()), np.asarray(theirs())
    difference = float(np.abs(a - b).max() / np.abs(b).max())
    if not difference <= tolerance:
        raise SystemExit(f"{quantity}: {rival} differs by {difference:.1e}, over {tolerance:.0e}")
    times = np.array([(timed(ours), timed(theirs)) for _ in range(repeats)])
    (mine, other), (fast, rival_fast) = np.median(times, axis=0), times.min(axis=0)
    row = Row(
        quantity=quantity,
        rival=rival,
        jaxid=float(mine),
        alternative=float(other),
        ratio=float(mine / other),
        best=float(fast / rival_fast),
        difference=difference,
        aim=aim,
    )
    print(line(row), flush=True)
    return row


def line(row: Row) -> str:
    aim = "" if row.aim is None else f"{row.aim:.3g}"
    return (
        f"{row.quantity:34s} {row.rival:35s} {1e3 * row.jaxid:9.2f} {1e3 * row.alternative:9.2f} "
        f"{row.ratio:8.3g} {row.best:8.3g} {aim:>8s} {row.difference:9.1e}"
    )


def in_process(*words: str, **environment: str) -> tuple[float, str]:
    """Run a fresh Python in the checkout; return its wall time [s] and its output."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *words],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[1],
        env={**os.environ, **environment},
    )
    return time.perf_counter() - begin, done.stdout


def table(rows: list[Row]) -> list[str]:
    out = [
        "| quantity | compared with | ratio | of the fastest runs | aim | met | differ |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        aim, met = ("", "") if r.aim is None else (f"{r.aim:.3g}", "yes" if r.met else "no")
        out.append(
            f"| {r.quantity} | {r.rival} | {r.ratio:.3g} | {r.best:.3g} | {aim} | {met} "
            f"| {r.difference:.0e} |"
        )
    return out
