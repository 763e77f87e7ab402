"""Figures of the PA-10's first joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

Run = Mapping[str, np.ndarray]


def _saved(figure: plt.Figure, path: Path) -> None:
    figure.savefig(path, dpi=110)
    plt.close(figure)


def frictions(path: Path, logs: Mapping[int, tuple]) -> None:
    """Figures C.1 to C.5: torque against velocity, the truth and what was identified."""
    figure, all_axes = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
    for axes, (joint, (speed, torque, true, found)) in zip(all_axes.flat, logs.items(), strict=False):
        flat = np.concatenate([[False], np.diff(speed) == 0]) & (speed != 0)
        axes.plot(speed[flat][::10], torque[flat][::10], ".", color="0.75", ms=2, label="torque on plateaus")
        for values, style, label in ((true, "k", "true"), (found, "r--", "identified")):
            for side, (v, c) in ((1, values[:2]), (-1, values[2:])):
                x = np.array([0.01, 1.2])
                axes.plot(side * x, side * (c + v * x), style, label=label if side > 0 else None)
        axes.set(title=f"joint {joint}", xlabel="velocity [rad/s]", ylabel="torque [N m]")
    all_axes.flat[0].legend(fontsize=8)
    all_axes.flat[-1].set_visible(False)
    _saved(figure, path)


def velocities(path: Path, name: str, runs: Sequence[Run], fastest: float) -> None:
    """Figures 5.7, 5.14 and 5.15: velocity after the joint is let go."""
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for run in runs:
        v = np.where(np.maximum.accumulate(run["true_velocity"]) < fastest, run["true_velocity"], fastest)
        axes.plot(run["t"], v)
    axes.set(xlabel="time [s]", ylabel="velocity [rad/s]", ylim=(0, 1.25))
    axes.set_title(f"let go in situation {name}")
    _saved(figure, path)


def settled(path: Path, grid: np.ndarray, curves: Mapping[str, np.ndarray]) -> None:
    """Figures 5.12 and 5.13: velocity that remains against that at the start."""
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for (name, values), mark in zip(curves.items(), "osv^", strict=True):
        axes.plot(grid, values, mark + "-", label=name)
    axes.set(xlabel="velocity at the start [rad/s]", ylabel="velocity that remains [rad/s]")
    axes.legend()
    _saved(figure, path)


def angles(path: Path, runs: Sequence[Run]) -> None:
    """Figure 5.8: the angle from different starts."""
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for run in runs:
        axes.plot(run["t"], run["true_position"], lw=0.8, label=f"from {run['true_position'][0]:.2f} rad")
    axes.set(xlabel="time [s]", ylabel="angle [rad]")
    axes.legend()
    _saved(figure, path)


def dominant(path: Path, stiff: Sequence[float], curves: Mapping[str, np.ndarray]) -> None:
    """Figure 5.9: inertia from the period against K_p."""
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    for name, values in curves.items():
        axes.semilogx(stiff, values, "o-", label=name)
    axes.axhline(1.0, color="0.6", lw=0.8)
    axes.set(xlabel="K_p [N m/rad]", ylabel="inertia from the period over the true one")
    axes.legend(fontsize=8)
    _saved(figure, path)


def tracking(path: Path, time: np.ndarray, errors: Mapping[str, np.ndarray]) -> None:
    """Figure 5.6: tracking error with and without compensation."""
    figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    for name, e in errors.items():
        axes.plot(time, e, lw=0.8, label=name)
    axes.set(xlabel="time [s]", ylabel="tracking error [mrad]")
    axes.legend()
    _saved(figure, path)


def supplies(path: Path, runs: Mapping[tuple[float, float], Run], fastest: float) -> None:
    """Velocity and torque at either supply; what the joint's own limit of speed asks for."""
    figure, all_axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for (supply, limit), run in runs.items():
        if limit < 10.0:
            continue
        part = slice(0, 4000)
        all_axes[0].plot(run["t"][part], run["true_velocity"][part], lw=0.9, label=f"{supply:.0f} V")
        all_axes[1].plot(run["true_velocity"], run["true_force"], ".", ms=2, label=f"{supply:.0f} V")
    for side in (1, -1):
        all_axes[0].axhline(side * fastest, color="0.6", lw=0.8, label="its largest" if side > 0 else None)
    all_axes[0].set(xlabel="time [s]", ylabel="velocity [rad/s]")
    all_axes[1].set(xlabel="velocity [rad/s]", ylabel="torque of the drive [N m]")
    for axes in all_axes:
        axes.legend(fontsize=8)
    _saved(figure, path)
