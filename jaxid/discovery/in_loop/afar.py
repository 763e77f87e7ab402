"""Starts of fits far from where an incomplete model ends.

A model that lacks much may run far away from the truth, to where no candidate helps by itself, and where the
scales of force from which candidates start are those of another machine. Here a candidate and the unknowns of
the case start together, from points about the guesses.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxid.discovery import candidates as cand
from jaxid.discovery.in_loop.model_fit import STEPS, ModelFit

# Least points in simulation at each start of a candidate, and first steps of the fits that begin there.
_LEAST, _FIRST = 16, 6
# Factors on the strength of a candidate of either sign.
_FACTORS = (-1.0, -0.1, 0.1, 1.0)


@dataclass(frozen=True)
class Effort:
    """The number of starts that a candidate gets far from a model.

    Args:
        points: Points in simulation, of all its starts together.
        begun: Points from which fits begin.
        ended: Fits of them that go on to the end.
        ahead: Candidates of which so many fits go on; of the others one does.
        steps: Most steps with which they go on.
    """

    points: int = 512
    begun: int = 32
    ended: int = 8
    ahead: int = 5
    steps: int = STEPS


# MANY: about guesses of a user, which may be several times off. FEW: about values of a fit that began at
# those of a balance, which is linear in the unknowns.
MANY = Effort()
FEW = Effort(points=64, begun=8, ended=1, ahead=1, steps=12)


@dataclass(frozen=True)
class Afar:
    """Points about the guesses of a case.

    Args:
        points: Function of effects, all unknowns and a count that returns so many points and their centre,
            (count + 1, p): the unknowns of the case about its guesses, those of the effects about their
            values.
        starts: Function that returns the starts of candidates by kind and port, at the scales of a machine
            near the guesses.
        effort: The number of points and fits.
    """

    points: Callable[[Sequence[cand.Candidate], np.ndarray, int], np.ndarray]
    starts: Callable[[], dict[tuple[str, int], np.ndarray]]
    effort: Effort = MANY

    def begun(
        self,
        fit: ModelFit,
        added: Sequence[cand.Candidate],
        theta: Float[np.ndarray, " p"],
        moving: np.ndarray,
    ) -> tuple[Float[np.ndarray, "starts p"], Float[np.ndarray, " starts"]]:
        """Fit a model by a few steps from the best of many points, and return where the best fits are.

        The points differ in the start of the last effect. Their cost before the first step says little of the
        fit that begins there.

        Args:
            fit: The model.
            added: Its effects.
            theta: All unknowns, of which those of the effects before the last one are taken.
            moving: Indices of the unknowns to fit.

        Returns:
            All unknowns of each fit, best first, and its squared residual.
        """
        last = added[-1]
        starts = np.unique(self.starts().get((last.kind, last.port), last.starts), axis=0)
        free = fit.superset.machine.parameters.free
        signed = any(free[k].sign == "free" for k in last.index[last.amplitude])
        variants = list(itertools.product(starts, _FACTORS if signed else (1.0,)))
        # A power of two, as sequences of low discrepancy have it.
        count = 2 ** int(np.log2(max(self.effort.points / len(variants), _LEAST)))
        groups = []
        for start, factor in variants:
            at = theta.copy()
            at[last.index] = np.where(last.amplitude, factor, 1.0) * start
            groups.append(self.points(added, at, count))

        points = np.concatenate(groups)
        squares = fit.squares(points)
        group = np.repeat(np.arange(len(groups)), [len(g) for g in groups])
        order = np.argsort(squares, kind="stable")
        # Half of them the best of all, the others the best at each start.
        _, first = np.unique(group[order], return_index=True)
        begun = self.effort.begun
        chosen = [*order[: begun // 2], *order[np.sort(first)], *order[begun // 2 :]]
        ends, squares = fit.fit(points[list(dict.fromkeys(chosen))[:begun]], moving, steps=_FIRST)
        best = np.argsort(squares, kind="stable")[: self.effort.ended]
        return ends[best], squares[best]
