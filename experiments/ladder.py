"""The ladder of estimators against noise and sampling rate, on one axis in its loop.

Hypothesis: simulating (output error) needs neither derivatives nor filters and so beats inverse
dynamics where samples are few; where they are many, both are as good. Accepted where output error's RMS
error of the inertia is below inverse dynamics' at the lowest rate and highest noise.

Every number is that of `jaxid study experiments/cases/study.toml`; the loop runs at 1 kHz throughout. The
coverage of intervals and the basin of convergence need no script:

    jaxid study experiments/cases/coverage.toml -o results/coverage
    jaxid study experiments/cases/basin.toml -o results/basin

    python -m experiments.ladder [-o results/ladder]
"""

from __future__ import annotations

import sys
import time

import numpy as np

import jaxid
from experiments.common import Table, arguments, copied
from jaxid.results.report.study_plots import plot_errors


def main() -> int:
    args = arguments(__doc__, "results/ladder")
    folder = copied(args.o, ("study.toml",))
    begin, out = time.perf_counter(), folder / "study"
    result = jaxid.study(folder / "study.toml", folder=out, resume=(out / "study.json").exists())
    rows = result.summary
    plot_errors(rows).savefig(folder / "ladder.png", dpi=130)
    table = Table("RMS errors", ["estimator", "rate [Hz]", "noise", "parameter", "error [%]", "failed [%]"])
    for r in rows:
        error = f"{100 * r['rmse'] / r['true']:.3g}" if np.isfinite(r["rmse"]) else "-"
        setting = f"{r['sample_rate']:g}", f"{r['noise']:g}"
        table.row(r["estimator"], *setting, r["parameter"], error, f"{100 * r['failed']:.1f}")
    table.show(time.perf_counter() - begin)
    slowest, loudest = (max(rows, key=lambda r: s * r[k])[k] for k, s in (("sample_rate", -1), ("noise", 1)))
    hardest = [r for r in rows if (r["sample_rate"], r["noise"]) == (slowest, loudest)]
    worst = {r["estimator"]: r["rmse"] for r in hardest if r["parameter"] == "inertia"}
    accepted = worst["output_error"] < worst["inverse_dynamics"]
    print(f"hypothesis {'accepted' if accepted else 'rejected'}: {worst}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
