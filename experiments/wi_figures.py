"""Figures of `wi_mimo_coulomb.py`."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from experiments.wi_loop import Driven
from truth.chain.six_masses import KINDS

UNITS = {"mass": "kg", "stiffness": "N/m", "damping": "N s/m", "coulomb_friction": "N"}
# End of the first instants, drawn on an axis of their own [s].
ONSET = 0.3


def estimates(path: Path, run: Driven, true: dict[str, float]) -> None:
    """Draw the on-line estimates until the controller switched, thick from the time that all are trusted."""
    values = list(true.values())
    kinds = [k for k in KINDS if any(n.startswith(k) for n in true)]
    told = run.told[1 : (run.live.switched or len(run.told)) + 1]
    t = 1e3 * run.log.time[1 : len(told) + 1]
    theta, trusted = (np.stack([getattr(x, what) for x in told]) for what in ("theta", "trusted"))
    # From the end backwards: trusted there, and ever since.
    good = np.logical_and.accumulate(trusted[::-1])[::-1]
    size = (8, 2.2 * len(kinds))
    figure, axes = plt.subplots(len(kinds), 1, figsize=size, sharex=True, layout="constrained")
    for ax, kind in zip(axes, kinds, strict=True):
        own = [k for k, name in enumerate(true) if name.startswith(kind)]
        for colour, k in enumerate(own):
            line, late = f"C{colour}", np.where(good[:, k], theta[:, k], np.nan)
            ax.plot(t, theta[:, k], line, lw=0.7)
            ax.plot(t, late, line, lw=2, label=f"{colour + 1}")
            ax.axhline(values[k], color=line, lw=0.7, ls=":")
        ax.set_ylim(0.0, 1.5 * max(values[k] for k in own))
        ax.set_ylabel(f"{kind.replace('coulomb_friction', 'friction')} [{UNITS[kind]}]")
    handles, labels = axes[kinds.index("stiffness")].get_legend_handles_labels()
    title = "mass or spring; thick: trusted for good, dotted: true"
    figure.legend(handles, labels, ncols=7, title=title, loc="outside upper center")
    axes[-1].set(xlim=(0.0, t[-1]), xlabel="time [ms]")
    _save(figure, path)


def tracking(path: Path, run: Driven) -> None:
    """Positions, their errors and the forces: of the first instants, and of the whole run."""
    figure, axes = plt.subplots(3, 2, figsize=(11, 8), sharex="col", layout="constrained")
    rows = {
        "position [mm]": 1e3 * run.position,
        "tracking error [mm]": 1e3 * (run.position - run.log.reference),
        "force [N]": run.log.force,
    }
    for pair, (words, signals) in zip(axes, rows.items(), strict=True):
        for ax, whole in zip(pair, (False, True), strict=True):
            shown = run.log.time <= (run.log.time[-1] if whole else ONSET)
            for k, x in enumerate(signals.T):
                ax.plot(run.log.time[shown], x[shown], label=f"{k + 1}", lw=1.2)
            ax.grid(alpha=0.3)
            if run.live.switched is not None and not whole:
                ax.axvline(run.live.switched * run.live.period, color="k", lw=0.8, ls=":")
        pair[0].set_ylabel(words)
    # After the first instants the error and the forces are far smaller than in them.
    for row, words in ((1, "tracking error [mm]"), (2, "force [N]")):
        late = rows[words][run.log.time > ONSET]
        room = 0.1 * np.ptp(late)
        axes[row, 1].set_ylim(late.min() - room, late.max() + room)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    title = "mass; dotted: the controller switches to what was found"
    figure.legend(handles, labels, ncols=6, title=title, loc="outside upper center")
    for ax, end in zip(axes[-1], (ONSET, len(run.log.time) * run.log.period), strict=True):
        ax.set(xlim=(0.0, end), xlabel="time [s]")
    _save(figure, path)


def noise(path: Path, lines: dict[str, dict], at: list[float], exact: dict[str, list[float]]) -> None:
    """Spread and bias of every method against noise, by kind of parameter.

    Args:
        path: Of the picture.
        lines: By method, (kind, "spread" or "bias") to its values over noise [%]; first a bound, of
            spread only.
        at: Noise [m].
        exact: Spread of `algebraic` on logs of the exact simulator, by kind [%].
    """
    figure, axes = plt.subplots(2, 2, figsize=(11, 8.5), sharex=True, sharey=True, layout="constrained")
    for ax, kind in zip(axes.flat, KINDS, strict=True):
        for colour, (name, values) in enumerate(lines.items()):
            if (kind, "bias") not in values:
                ax.loglog(at, values[kind, "spread"], "k:", label=name)
                continue
            ax.loglog(at, values[kind, "spread"], f"C{colour - 1}-o", ms=3, label=name)
            ax.loglog(at, values[kind, "bias"], f"C{colour - 1}--", lw=0.8)
        ax.loglog(at, exact[kind], "kx", ms=7, label="algebraic, exact simulator")
        ax.set(title=kind.replace("_", " "), ylim=(1e-4, 1e4))
        ax.grid(alpha=0.3)
    for ax in axes[1]:
        ax.set_xlabel("position noise, standard deviation [m]")
    for ax in axes[:, 0]:
        ax.set_ylabel("median over the parameters [% of true]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    title = "solid, crosses: spread; dashed: bias"
    figure.legend(handles, labels, ncols=4, title=title, loc="outside upper center")
    _save(figure, path)


def _save(figure: plt.Figure, path: Path) -> None:
    figure.savefig(path, dpi=130)
    plt.close(figure)
