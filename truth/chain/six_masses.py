"""Six masses with Coulomb friction on the exact chain, from their values by the names of a case."""

from collections.abc import Mapping, Sequence

import numpy as np

from truth.chain.stepper import ChainMachine

# Accuracy that is asked of each kind of parameter, relative.
KINDS = {"mass": 0.01, "stiffness": 0.01, "damping": 0.05, "coulomb_friction": 0.05}


def machine(values: Mapping[str, float], actuated: Sequence[int] | None = None) -> ChainMachine:
    """Build the chain of these masses, springs, dampers and levels of Coulomb friction, in order of place."""
    of = lambda kind: [v for name, v in values.items() if name.startswith(kind)]
    levels = enumerate(of("coulomb_friction"), start=1)
    effects = {("coulomb_friction", k): {"level": v} for k, v in levels}
    return ChainMachine(of("mass"), of("damping"), of("stiffness"), effects, actuated)


def largest_errors(names: Sequence[str], theta: np.ndarray, true: Mapping[str, float]) -> dict[str, float]:
    """Return the largest relative error of each kind."""
    out = dict.fromkeys(KINDS, 0.0)
    for name, value in zip(names, theta, strict=True):
        kind = next(k for k in KINDS if name.startswith(k))
        out[kind] = max(out[kind], abs(value / true[name] - 1))
    return out
