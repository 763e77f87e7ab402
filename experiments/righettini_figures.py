"""Figures of the five-bar robot: errors by law, estimates in time, friction against velocity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from five_bar_robot import PERIOD, Ran

UNITS = {"coulomb_friction": "N m", "viscous_friction": "N m s/rad", "quadratic_drag": "N m s²/rad²",
         "cubic_friction": "N m s³/rad³", "actuator_gain": "1"}


def errors(path: Path, runs: dict[str, Ran], shown: float = 6.0) -> None:
    """Set points and joint errors by law (figure 10), each on its own scale."""
    figure, axes = plt.subplots(1 + len(runs), 1, figsize=(8, 9), sharex=True, layout="constrained")
    first = next(iter(runs.values()))
    some = slice(0, round(shown / PERIOD))
    axes[0].plot(first.time[some], first.live.reference[some])
    axes[0].set_ylabel("reference [rad]")
    axes[0].legend(["joint 1", "joint 2"], loc="upper right")
    for ax, (name, ran) in zip(axes[1:], runs.items(), strict=True):
        ax.plot(ran.time[some], 1e3 * ran.error[some])
        ax.set_ylabel(f"{name}\nerror [mrad]")
    axes[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def histories(path: Path, runs: dict[str, tuple[list[str], np.ndarray, Ran]]) -> None:
    """Estimates in time, cold and warm (figures 13 to 15)."""
    names = next(iter(runs.values()))[0]
    kinds = list(dict.fromkeys(n.partition("[")[0] for n in names))
    figure, axes = plt.subplots(len(kinds), 1, figsize=(8, 11), sharex=True, layout="constrained")
    for (state, (_, times, ran)), style in zip(runs.items(), ("-", "--"), strict=True):
        for ax, kind in zip(axes, kinds, strict=True):
            for k, n in enumerate(names):
                if n.startswith(kind + "["):
                    joint = n.partition("[")[2][0]
                    ax.plot(times, ran.estimates[:, k], style, color=f"C{int(joint) - 1}",
                            label=f"joint {joint}, {state}")
            final = ran.estimates[-1, [n.startswith(kind + "[") for n in names]]
            low, high = ax.get_ylim() if style == "--" else (np.inf, -np.inf)
            spread = max(np.ptp(final), 0.3 * np.abs(final).max(), 1e-3)
            ax.set_ylim(min(low, final.min() - spread), max(high, final.max() + spread))
            ax.set_ylabel(f"{kind}\n[{UNITS[kind]}]")
    axes[0].legend(loc="upper right", ncols=2, fontsize="small")
    axes[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def frictions(path: Path, runs: dict, found: Callable, true: Callable) -> None:
    """Friction against velocity, found and true, cold and warm (figures 6 and 12)."""
    v = np.linspace(0.02, 3.6, 100)
    figure, axes = plt.subplots(1, 2, figsize=(9, 4), sharey=True, layout="constrained")
    for (state, (names, _, ran)), color in zip(runs.items(), ("C0", "C3"), strict=True):
        last, exact = found(names, ran.estimates[-1], v), true(v, 1.0 if state == "cold" else 0.7)
        for k, ax in enumerate(axes):
            ax.plot(v, last[:, k], color=color, label=f"{state}, found")
            ax.plot(v, exact[:, k], ":", color="black", label=f"{state}, true")
            ax.set_xlabel(f"velocity of joint {k + 1} [rad/s]")
    axes[0].set_ylabel("friction [N m]")
    axes[0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
