"""Figures of the five-bar robot: errors by law, estimates in time, friction against velocity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from experiments.five_bar_robot import PERIOD, Ran

UNITS = {
    "coulomb_friction": "N m",
    "viscous_friction": "N m s/rad",
    "quadratic_drag": "N m s²/rad²",
    "cubic_friction": "N m s³/rad³",
    "actuator_gain": "1",
}


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
                    ax.plot(
                        times,
                        ran.estimates[:, k],
                        style,
                        color=f"C{int(joint) - 1}",
                        label=f"joint {joint}, {state}",
                    )
            final = ran.estimates[-1, [n.startswith(kind + "[") for n in names]]
            low, high = ax.get_ylim() if style == "--" else (np.inf, -np.inf)
            spread = max(np.ptp(final), 0.3 * np.abs(final).max(), 1e-3)
            ax.set_ylim(min(low, final.min() - spread), max(high, final.max() + spread))
            ax.set_ylabel(f"{kind}\n[{UNITS[kind]}]")
    axes[0].legend(loc="upper right", ncols=2, fontsize="small")
    axes[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def frictions(path: Path, clouds: dict[str, tuple[np.ndarray, np.ndarray]], curve: Callable) -> None:
    """Friction against velocity (figures 6 and 12).

    Args:
        path: Where to.
        clouds: By name velocities and friction, (time, 2) each.
        curve: True friction of both joints at some velocities above zero.
    """
    v = np.linspace(0.02, 3.6, 100)
    figure, axes = plt.subplots(1, 2, figsize=(9, 4), sharey=True, layout="constrained")
    for k, ax in enumerate(axes):
        for (name, (speed, friction)), color in zip(clouds.items(), ("C0", "C3"), strict=True):
            ax.plot(speed[:, k], friction[:, k], ".", ms=1.5, alpha=0.4, color=color, label=name)
        for side in (-1, 1):
            label = "true, cold" if side > 0 else None
            ax.plot(side * v, side * curve(v)[:, k], ":", color="black", label=label)
        ax.set_xlabel(f"velocity of joint {k + 1} [rad/s]")
    axes[0].set_ylabel("friction [N m]")
    axes[0].legend(markerscale=6)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def torques(path: Path, time: np.ndarray, measured: np.ndarray, predicted: np.ndarray) -> None:
    """Torque of the motors at the joints, and what dynamics and friction found say (figure 7)."""
    figure, axes = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
    for k, ax in enumerate(axes):
        ax.plot(time, measured[:, k], color="C0", label="given")
        ax.plot(time, predicted[:, k], color="C3", lw=0.9, label="dynamics and friction, as found")
        ax.set_ylabel(f"torque of joint {k + 1} [N m]")
    axes[0].legend(loc="upper right")
    axes[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def workspace(
    path: Path, polygon: np.ndarray, paths: list[np.ndarray], tool: Callable, period: float
) -> None:
    """Condition of the robot, the polygon of targets and some motions, by joints and by tool (figure 4).

    Args:
        path: Where to.
        polygon: Corners [rad], (corners, 2).
        paths: Joint positions of motions [rad], (time, 2) each.
        tool: Position of the tool [m] at joint positions, (k, 2) from (k, 2), and the condition index, (k,).
        period: Of the paths [s].
    """
    sides = np.meshgrid(np.linspace(0.6, 3.2, 200), np.linspace(-0.2, 2.4, 200))
    grid = np.stack(sides, -1).reshape(-1, 2)
    at, index = tool(grid)
    good = np.isfinite(index)
    figure, axes = plt.subplots(1, 2, figsize=(12, 6), layout="constrained")
    edge = np.concatenate([polygon, polygon[:1]])
    edge = np.concatenate([np.linspace(a, b, 30) for a, b in zip(edge[:-1], edge[1:], strict=True)])
    for ax, where in zip(axes, (lambda q: q, lambda q: tool(q)[0]), strict=True):
        corners = np.where(good[:, None], where(grid), 0.0).reshape(*sides[0].shape, 2)
        index_of = np.ma.masked_invalid(index.reshape(sides[0].shape))
        shown = ax.contourf(*np.moveaxis(corners, -1, 0), index_of, 20, cmap="Reds", vmin=0, vmax=1)
        ax.plot(*where(edge).T, color="black")
        for q in paths:
            x = where(q)
            speed = np.linalg.norm(np.gradient(x, period, axis=0), axis=1)
            line = ax.scatter(*x.T, c=speed, s=3, cmap="Blues", vmin=0, linewidths=0)
        unit = "rad/s" if ax is axes[0] else "m/s"
        figure.colorbar(line, ax=ax, label=f"speed [{unit}]", location="bottom", shrink=0.8)
        figure.colorbar(shown, ax=ax, label="condition index", shrink=0.8)
    axes[0].set(xlabel="joint 1 [rad]", ylabel="joint 2 [rad]")
    axes[1].set(xlabel="x of the tool [m]", ylabel="y of the tool [m]", aspect="equal")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def bars(path: Path, groups: dict[str, dict[str, np.ndarray]], label: str) -> None:
    """Draw a bar for each name and joint, a panel for each group (figures 5, 8, 9 and 11)."""
    size = (4.5 * len(groups), 3.6)
    figure, axes = plt.subplots(1, len(groups), figsize=size, layout="constrained", squeeze=False)
    for ax, (group, values) in zip(axes[0], groups.items(), strict=True):
        places = np.arange(len(values))
        for k in range(2):
            ax.bar(places + 0.4 * (k - 0.5), [v[k] for v in values.values()], 0.38, label=f"joint {k + 1}")
        ax.set_xticks(places, list(values))
        ax.set(title=group, ylabel=label)
    axes[0][0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
