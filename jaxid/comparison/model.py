"""Models of several logs: which unknowns they share, and which effects act in which of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.discovery.candidates import Candidate

# Sets of logs, by their numbers; those of one set have one value.
Partition = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Unknown:
    """An unknown number of a model.

    Args:
        index: Its place in the superset's vector.
        logs: Numbers of the logs in which it holds.
    """

    index: int
    logs: tuple[int, ...]


@dataclass(frozen=True)
class Change:
    """A change that lets a model explain more: a parameter with more than one value, or an effect.

    Args:
        label: Name of the parameter, or kind and place of the effect.
        logs: Numbers of the logs in which the effect acts, or in which the parameter gets a value of its own.
        index: Index of the parameter in the superset's vector; None for an effect.
        apart: Whether each of the logs gets its own value, or all of them one.
        effect: The effect; None for a parameter.
        count: Number of logs.
    """

    label: str
    logs: tuple[int, ...]
    count: int
    index: int | None = None
    apart: bool = True
    effect: Candidate | None = None

    @property
    def alike(self) -> bool:
        """True if the change holds in all logs alike, and so is no difference between them."""
        return self.effect is not None and len(self.logs) == self.count

    @property
    def unknowns(self) -> int:
        """Number of unknowns that the change adds."""
        if self.effect is not None:
            return len(self.effect.index)
        return len(self.logs) if self.apart else 1

    @property
    def place(self) -> tuple:
        """Key that is the same for changes of one parameter, or of one effect at one place."""
        if self.effect is not None:
            return ("effect", self.effect.kind, self.effect.port)
        return ("parameter", self.index)


@dataclass(frozen=True)
class Model:
    """A model of several logs.

    Args:
        theta: Unknowns of the superset as they hold in each log, (logs, p).
        base: Indices of the unknowns of the case.
        changes: Changes beside one set of values for all logs, in the order in which they were made.
        held: Indices of unknowns of the case that keep their value in the first log, where nothing known
            gives the logs a scale; they may differ in the others.
    """

    theta: Float[np.ndarray, "logs p"]
    base: tuple[int, ...]
    changes: tuple[Change, ...] = ()
    held: tuple[int, ...] = ()

    @property
    def effects(self) -> tuple[Change, ...]:
        """Effects that were added."""
        return tuple(c for c in self.changes if c.effect is not None)

    @property
    def differences(self) -> tuple[Change, ...]:
        """Changes by which the logs differ."""
        return tuple(c for c in self.changes if not c.alike)

    @property
    def unknowns(self) -> list[Unknown]:
        """All fitted numbers: those of the case, then those of the effects."""
        out = [Unknown(i, logs) for i in self.base for logs in self.partition(i)]
        out += [Unknown(i, logs) for i in self.held for logs in self.partition(i) if 0 not in logs]
        for c in self.effects:
            assert c.effect is not None, "an effect"
            out += [Unknown(int(i), c.logs) for i in c.effect.index]
        return out

    @property
    def fixed(self) -> list[Unknown]:
        """Numbers that would be fitted if something gave the logs a scale."""
        return [Unknown(i, logs) for i in self.held for logs in self.partition(i) if 0 in logs]

    def partition(self, index: int) -> Partition:
        """Return the sets of logs with one value of an unknown of the case."""
        count = len(self.theta)
        sets: list[tuple[int, ...]] = [tuple(range(count))]
        for c in self.changes:
            if c.index == index:
                sets = _refined(sets, c)
        return tuple(sets)

    def fitted_in(self, log: int) -> list[int]:
        """Return the indices of the unknowns that hold in a log."""
        return [u.index for u in self.unknowns if log in u.logs]

    def effects_in(self, log: int) -> list[Candidate]:
        """Return the added effects that act in a log."""
        return [c.effect for c in self.effects if c.effect is not None and log in c.logs]

    def values(self) -> Float[np.ndarray, " u"]:
        """Return the values of all fitted numbers."""
        return np.array([self.theta[u.logs[0], u.index] for u in self.unknowns])

    def at(self, values: Float[np.ndarray, " u"]) -> Model:
        """Return the model with other values of its fitted numbers."""
        theta = self.theta.copy()
        for u, value in zip(self.unknowns, values, strict=True):
            theta[list(u.logs), u.index] = value
        return replace(self, theta=theta)

    def with_change(self, change: Change, start: Float[np.ndarray, " k"] | None = None) -> Model:
        """Return the model with one more change.

        Args:
            change: The change.
            start: Values of the effect from which a fit starts; None for a parameter.
        """
        theta = self.theta.copy()
        if change.effect is not None:
            theta[np.ix_(np.array(change.logs), change.effect.index)] = start
        return replace(self, theta=theta, changes=(*self.changes, change))

    def without(self, change: Change) -> Model:
        """Return the model without one of its changes, the others as they are."""
        theta = self.theta.copy()
        if change.effect is not None:
            theta[np.ix_(np.array(change.logs), change.effect.index)] = change.effect.neutral
        out = replace(self, theta=theta, changes=tuple(c for c in self.changes if c is not change))
        if change.index is not None:
            for logs in out.partition(change.index):
                values = theta[list(logs), change.index]
                keeps = 0 in logs and change.index in self.held
                out.theta[list(logs), change.index] = values[0] if keeps else np.mean(values)
        return out


def _refined(sets: Sequence[tuple[int, ...]], change: Change) -> list[tuple[int, ...]]:
    """Return sets of logs after some logs got a value of their own."""
    out = []
    for logs in sets:
        rest = tuple(k for k in logs if k not in change.logs)
        some = tuple(k for k in logs if k in change.logs)
        out += [(k,) for k in some] if change.apart else [some] if some else []
        if rest:
            out.insert(len(out) - (len(some) if change.apart else bool(some)), rest)
    return out


def parameter_changes(
    model: Model, names: Sequence[str], comparable: Sequence[int], logs: int
) -> list[Change]:
    """Return the ways in which the parameters of a model may differ more between the logs.

    Of several logs each may differ alone from the first, and all from each other.

    Args:
        model: The model.
        names: Names of the unknowns of the superset.
        comparable: Indices of the unknowns that may differ.
        logs: Number of logs.
    """
    out = []
    for i in comparable:
        sets = model.partition(i)
        ways = [(k,) for s in sets if len(s) > 1 for k in (s if len(s) > 2 else s[1:])]
        out += [Change(names[i], way, logs, index=i) for way in ways]
        if len(sets) == 1 and logs > 2:
            out.append(Change(names[i], tuple(range(1, logs)), logs, index=i))
    return out


def effect_changes(effects: Sequence[Candidate], model: Model, logs: int) -> list[Change]:
    """Return the effects that a model may get: in one log only, or in all logs alike.

    An effect that the model has already, in any log, is none of them.
    """
    present = {c.place for c in model.effects}
    out = []
    for effect in effects:
        # The first log is the base: of two equal explanations the one by another log comes first.
        ways = [(k,) for k in range(logs - 1, -1, -1)] + [tuple(range(logs))]
        changes = [Change(effect.label, way, logs, effect=effect) for way in ways]
        out += [c for c in changes if c.place not in present]
    return out
