"""The ladder of estimators against noise and sampling rate, on one axis in its loop.

Hypothesis: simulating (output error) needs neither derivatives nor filters and so beats inverse
dynamics where samples are few; where they are many, both are as good. Accepted where output error's RMS
error of the inertia is below inverse dynamics' at the lowest rate and highest noise.

Every number is that of `jaxid study` on `study.toml` with its sample_rate changed; the loop runs at 1 kHz
throughout. The coverage of intervals and the basin of convergence need no script:

    jaxid study experiments/cases/coverage.toml -o results/coverage

    python experiments/ladder.py [-o results/ladder]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from common import Table, arguments, copied
from matplotlib.figure import Figure

import jaxid

RATES = (1000, 500, 200, 100)  # Hz
DASHES = ("-", "--", "-.", ":")
COLOURS = {"output_error": "#0072b2", "inverse_dynamics": "#d55e00", "algebraic": "#009e73"}


def studied(folder, rate: int) -> list[dict]:
    """Summary of the study at one rate, run or resumed."""
    text = (folder / "study.toml").read_text()
    case = folder / f"{rate}_hz.toml"
    case.write_text(text.replace("sample_rate = 1000.0", f"sample_rate = {rate}.0"))
    out = folder / f"{rate}_hz"
    result = jaxid.study(case, folder=out, resume=(out / "study.json").exists())
    print(f"{rate} Hz\n{result}\n")
    return [r | {"rate": rate} for r in result.summary]


def drawn(rows: list[dict]) -> Figure:
    """RMS error over truth against noise, a panel a parameter; the line's dashes are the rate."""
    names = list(dict.fromkeys(r["parameter"] for r in rows))
    figure = Figure(figsize=(4.2 * len(names), 4.4), layout="constrained")
    for ax, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        for rate, dash in zip(RATES, DASHES, strict=True):
            own = [r for r in rows if r["parameter"] == name and r["rate"] == rate]
            for estimator, colour in COLOURS.items():
                line = [r for r in own if r["estimator"] == estimator]
                values = [100 * r["rmse"] / r["true"] for r in line]
                label = f"{estimator}, {rate} Hz"
                ax.plot([r["noise"] for r in line], values, color=colour, ls=dash, marker=".", label=label)
        fast = [r for r in rows if r["parameter"] == name and r["rate"] == max(RATES)]
        bound = {r["noise"]: 100 * r["bound"] / r["true"] for r in fast}
        label = f"Cramér–Rao bound, {max(RATES)} Hz"
        ax.plot(list(bound), list(bound.values()), color="#222222", lw=1, label=label)
        ax.set(xscale="log", yscale="log", xlabel="noise, times the sensor's")
        ax.set_ylabel(f"{name}: RMS error [%]")
        ax.grid(color="#e6e6e6")
    where = {"loc": "outside lower center", "ncols": 5, "frameon": False, "fontsize": 7}
    figure.legend(*ax.get_legend_handles_labels(), **where)
    return figure


def main() -> int:
    args = arguments(__doc__, "results/ladder")
    folder = copied(args.o, ("study.toml",))
    begin = time.perf_counter()
    rows = [r for rate in RATES for r in studied(folder, rate)]
    drawn(rows).savefig(folder / "ladder.png", dpi=130)
    table = Table("RMS errors", ["estimator", "rate [Hz]", "noise", "parameter", "error [%]", "failed [%]"])
    for r in rows:
        error = f"{100 * r['rmse'] / r['true']:.3g}" if np.isfinite(r["rmse"]) else "-"
        noise, failed = f"{r['noise']:g}", f"{100 * r['failed']:.1f}"
        table.row(r["estimator"], r["rate"], noise, r["parameter"], error, failed)
    table.show(time.perf_counter() - begin)
    hardest = [r for r in rows if r["rate"] == min(RATES) and r["noise"] == 10.0]
    worst = {r["estimator"]: r["rmse"] for r in hardest if r["parameter"] == "inertia"}
    accepted = worst["output_error"] < worst["inverse_dynamics"]
    print(f"hypothesis {'accepted' if accepted else 'rejected'}: {worst}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
