"""Make the demo's two logs on the exact axis: a slide with a ripple that its case does not declare.

Run in the checkout: python -m truth.axis.demo_logs
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from truth.axis.machines import emps_like

FOLDER = Path(__file__).parents[2] / "jaxid" / "demo"
# The truth; the case declares neither the ripple nor these values.
HIDDEN = {"amplitude": 4.0, "period": 0.02, "phase": 0.7}


def demo_log(seed: int) -> dict[str, np.ndarray]:
    """Simulate one log of the demo at 1 kHz; return what a user would have recorded."""
    machine = emps_like(seed, duration=6.0).with_effect("cogging", **HIDDEN)
    return {k: v for k, v in machine.run().items() if k in ("t", "position", "force", "reference")}


def main() -> None:
    for seed, name in ((1, "log.csv"), (2, "validation.csv")):
        log = demo_log(seed)
        rows = zip(log["t"], log["position"], log["force"], log["reference"], strict=True)
        lines = [f"{t:.6g},{q:.8g},{u:.6g},{r:.8g}" for t, q, u, r in rows]
        (FOLDER / name).write_text("\n".join(["t,q,u,ref", *lines]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
