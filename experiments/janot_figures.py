"""Pictures of the flexible axis's experiment."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt

_SHOWN = {
    "load_inertia": "load inertia",
    "stiffness": "stiffness",
    "coulomb_friction[1].level": "Coulomb friction, motor",
}


def resolution(path: Path, counts: list[int], errors: dict[tuple[str, str, int], dict[str, float]]) -> None:
    """Error by counts a revolution: a row a parameter, a column a set of sensors, a line a method."""
    sensors = list(dict.fromkeys(s for s, _, _ in errors))
    methods = list(dict.fromkeys(m for _, m, _ in errors))
    figure, axes = plt.subplots(
        len(_SHOWN), len(sensors), figsize=(10, 9), sharex=True, sharey="row", layout="constrained"
    )
    for row, (name, title) in zip(axes, _SHOWN.items(), strict=True):
        row[0].set_ylabel(f"error of {title} [%]")
        for axis, of in zip(row, sensors, strict=True):
            for k, method in enumerate(methods):
                points = [(c, errors.get((of, method, c), {}).get(name)) for c in counts]
                told = [(c, max(e, 1e-4)) for c, e in points if e is not None]
                if told:
                    axis.loglog(*zip(*told, strict=True), marker="osv^Dx"[k], color=f"C{k}", label=method)
            axis.grid(alpha=0.3)
    for axis, of in zip(axes[0], sensors, strict=True):
        axis.set_title(of)
    for axis in axes[-1]:
        axis.set_xlabel("encoder counts a revolution (5 mm)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
