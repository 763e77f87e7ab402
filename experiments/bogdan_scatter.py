"""Monte-Carlo runs of the micropositioning stage: what intervals hold, and the criterion over the truth's."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.bogdan_logs import apart, case_of, logs_of, studied
from experiments.common import Table
from truth.chain import stages

# Of `scatter` and its like: data set, encoder, its count, whether the screw is rigid.
ROWS = (
    (1, "500 counts", stages.COUNT, True),
    (2, "500 counts", stages.COUNT, True),
    (2, "exact", 0.0, True),
    (1, "500 counts", stages.COUNT, False),
    (1, "exact", 0.0, True),
)
COLUMNS = [
    "converged",
    "told",
    "criterion %",
    "over truth's",
    "1 - effective/n",
    "never above",
    "in 1.96 sigma",
    "in 3 sigma",
]


def _cells(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the cells of many runs, under `COLUMNS`; the criterion is compared with that of the truth."""
    off = np.abs(np.concatenate([r["off"] for r in rows]))
    mean = lambda key: np.mean([r[key] for r in rows])
    # A stage far off the guesses may not simulate with the steps that those ask for: then there is none.
    ratio = np.array([r["ratio"] for r in rows if np.isfinite(r["ratio"])])
    return [
        f"{mean('converged'):.0%}",
        f"{off.size / len(rows):.2f}",
        f"{mean('percent'):.2f}",
        f"{ratio.mean():.3f}",
        f"{1 - mean('effective') / 100:.3f}",
        f"{np.mean(ratio <= 1):.1%}",
        f"{np.mean(off < 1.96):.1%}",
        f"{np.mean(off < 3):.1%}",
    ]


def _scatter(folder: Path, runs: int, words: str, drawn: bool, **guesses: bool) -> None:
    """Criterion and coverage; by data set, encoder and screw.

    "less probable": how often the truth is that, its guesses counted in, which is what a fit within a prior
    minimises.
    """
    table = Table(
        f"{runs} runs a row, guesses {words}: what is fitted against its sigma",
        ["data", "encoder", "screw", *COLUMNS, "less probable"],
    )
    start = time.perf_counter()
    for data, name, resolution, rigid in ROWS:
        seeds = [1000 + k if drawn else None for k in range(runs)]
        cases = [
            case_of(folder, f"scatter{seed or ''}", data, guess=seed, resolution=resolution, **guesses)
            for seed in seeds
        ]
        logs, starts = logs_of(data, runs, rigid=rigid, resolution=resolution)
        _, rows = studied(cases, logs, starts, stages.TRUTH[data])
        less_probable = "" if resolution else f"{np.mean([r['nats'] >= 0 for r in rows]):.1%}"
        table.row(str(data), name, "rigid" if rigid else "elastic", *_cells(rows), less_probable)
        print(f"  {', '.join(table.rows[-1])} ({time.perf_counter() - start:.0f} s)", flush=True)
    table.show(time.perf_counter() - start)


def scatter(folder: Path, runs: int) -> None:
    """Guesses off by what their prior says: half of it, as a factor, in the mean square."""
    _scatter(folder, runs, "off as the prior says", True, believed=True)


def within(folder: Path, runs: int) -> None:
    """Guesses drawn up to 50 % off: nearer than the prior says."""
    _scatter(folder, runs, "up to 50 % off", True)


def nearest(folder: Path, runs: int) -> None:
    """Guesses at the truth."""
    _scatter(folder, runs, "at the truth", False)


def elastic(folder: Path, runs: int) -> None:
    """Fit logs of the elastic screw, with it in the model; the table has no encoder."""
    _elastic(folder, "elastic", [stages.TRUTH[1]] * runs, range(1000, 1000 + runs))


def calibrated(folder: Path, runs: int) -> None:
    """Fit logs of stages drawn about the table as the prior says, with the table as guesses.

    Intervals of a fit within a prior promise what they hold of all stages that the prior takes for likely. Of
    one stage, of which all that its logs do not tell is the same in each, they may hold more or less. Stages
    that do not move are refused.
    """
    table = Table(f"{runs} stages drawn as the prior says, 500 counts, rigid", ["data", "refused", *COLUMNS])
    start = time.perf_counter()
    for data in (1, 2):
        truths = [stages.believed(k, data=data) for k in range(1000, 1000 + runs)]
        logs, begins = logs_of(data, runs, truths=truths)
        _, rows = studied(case_of(folder, f"calibrated{data}", data), logs, begins, truths)
        table.row(str(data), str(runs - len(rows)), *_cells(rows))
        print(f"  {', '.join(table.rows[-1])} ({time.perf_counter() - start:.0f} s)", flush=True)
    table.show(time.perf_counter() - start)
    _elastic(folder, "calibrated", [stages.believed(k) for k in range(1000, 1000 + runs)], [None] * runs)


def _elastic(
    folder: Path, name: str, truths: Sequence[Mapping[str, float]], seeds: Sequence[int | None]
) -> None:
    """Fits of the elastic stage: what is true of each, and what its guesses are drawn by; None: the table.

    Every run is a line of a file as it ends, and is not run again. Nothing tells which code wrote a line:
    after a change of it the file is to be removed.
    """
    start, runs = time.perf_counter(), len(truths)
    logs, begins = logs_of(1, runs, rigid=False, truths=truths)
    cases = [
        case_of(folder, f"{name}{seed or ''}", 1, guess=seed, believed=True, coupling="elastic", load=False)
        for seed in seeds
    ]
    ended = apart(folder / f"{name}.jsonl", cases, logs, begins, truths)
    found = [r for r in ended if "refused" not in r]
    table = Table(
        f"{runs} runs of data 1, 500 counts, the elastic screw in the model, {runs - len(found)} refused",
        COLUMNS,
    )
    table.row(*_cells(found))
    table.show(time.perf_counter() - start)
