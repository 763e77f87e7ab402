"""Pictures of the flexible axis's experiment."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt


def resolution(path: Path, counts: list[int], errors: dict[tuple[str, int], dict[str, float]]) -> None:
    """Error of stiffness, load inertia and friction by counts a revolution, a line a method."""
    shown = {
        "motor_inertia": "motor inertia", "load_inertia": "load inertia", "stiffness": "stiffness",
        "coulomb_friction[1].level": "Coulomb friction, motor",
    }
    figure, axes = plt.subplots(2, 2, figsize=(10, 7), sharex=True, sharey=True, layout="constrained")
    names = list(dict.fromkeys(label for label, _ in errors))
    for axis, (name, title) in zip(axes.flat, shown.items(), strict=True):
        for k, label in enumerate(names):
            points = [(c, errors[label, c].get(name)) for c in counts]
            told = [(c, max(e, 1e-4)) for c, e in points if e is not None]
            if told:
                axis.loglog(*zip(*told, strict=True), marker="osv^Dx"[k % 6], color=f"C{k}", label=label)
        axis.set_title(title)
        axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("encoder counts a revolution (5 mm)")
    for axis in axes[:, 0]:
        axis.set_ylabel("error [%]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
