"""Least squares on the balance of forces, quick and rough: the base of every check before a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import Effect, carries_force
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Free
from jaxid.numerics.precision import Precision, assess
from jaxid.simulation.force_balance import ForceData, force_and_columns, measured_force, sharpened

# Stroke of a joint that turns [rad] beyond which its weight may act as sine and cosine.
_SWINGS = 0.3


@dataclass(frozen=True)
class BalanceFit:
    """The balance of forces along a log, linear in the unknowns that are forces; others are at their guess.

    Args:
        unknowns: Unknowns in proportion to which forces act, p of them.
        columns: Force of one unit of each unknown at the kept samples, (kept, n, p).
        known: Model without these unknowns, minus the declared force, (kept, n) [N or N m].
        potential: Forces that depend on position only and might act undeclared, (kept, n, c); see
            `_potential`.
        force: Declared force through the same filter, (kept, n); zero for a joint without a drive.
        velocity: Velocity at the kept samples, (kept, n).
        counts: Mask of the samples that count, (kept, n).
        scale: Size of the force of each joint without its part that depends on position only, (n,).
    """

    unknowns: tuple[Free, ...]
    columns: Float[np.ndarray, "kept n p"]
    known: Float[np.ndarray, "kept n"]
    potential: Float[np.ndarray, "kept n c"]
    force: Float[np.ndarray, "kept n"]
    velocity: Float[np.ndarray, "kept n"]
    counts: Bool[np.ndarray, "kept n"]
    scale: Float[np.ndarray, " n"]

    @property
    def names(self) -> list[str]:
        """Names of the unknowns, and of the undeclared forces."""
        return [f.name for f in self.unknowns] + [f"potential {k}" for k in range(self.potential.shape[2])]

    @property
    def finite(self) -> bool:
        """True if the balance exists at every sample that counts; it does not at some singular guesses."""
        parts = (self.columns, self.known, self.potential, self.force)
        return all(bool(np.all(np.isfinite(x[self.counts]))) for x in parts)

    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return columns and force to explain, at the samples that count, joints in parts of their force."""
        every = np.concatenate([self.columns, self.potential], axis=2) / self.scale[:, None]
        target = -self.known / self.scale
        return every[self.counts], target[self.counts]

    def fit(self, *, bounded: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the least-squares values, (p + c,), and the force residual, (kept, n).

        Args:
            bounded: Whether masses, frictions and the like must not be negative.
        """
        rows, target = self._rows()
        norm = np.linalg.norm(rows, axis=0)
        norm = np.where(norm > 0, norm, 1.0)
        # The triangular factor holds all that a least-squares fit takes from many rows.
        triangle = np.asarray(np.linalg.qr(np.column_stack([rows / norm, target]), mode="r"))
        small, right = triangle[: norm.size + 1, :-1], triangle[: norm.size + 1, -1]
        if bounded and len(self.unknowns):
            positive = [f.sign != "free" for f in self.unknowns] + [False] * self.potential.shape[2]
            lower = np.where(positive, 0.0, -np.inf)
            solved = scipy.optimize.lsq_linear(small, right, (lower, np.inf), method="bvls").x
        else:
            solved = np.linalg.lstsq(small, right, rcond=1e-10)[0]
        values = solved / norm
        return values, self.residual(values)

    def residual(self, values: np.ndarray) -> Float[np.ndarray, "kept n"]:
        """Return model minus declared force for values of the unknowns and undeclared forces, (kept, n)."""
        p = len(self.unknowns)
        return self.known + self.columns @ values[:p] + self.potential @ values[p:]

    def rms(self, residual: np.ndarray) -> Float[np.ndarray, " n"]:
        """Return the RMS of a residual at the samples that count, by joint."""
        samples = np.maximum(self.counts.sum(axis=0), 1)
        return np.sqrt(np.sum(np.where(self.counts, residual, 0.0) ** 2, axis=0) / samples)

    def precision(self, values: np.ndarray, residual: np.ndarray) -> Precision:
        """Return the precision of a fit without bounds, whose residual may be coloured."""
        jacobian = np.concatenate([self.columns, self.potential], axis=2) / self.scale[:, None]
        size = float(np.linalg.norm((self.force / self.scale)[self.counts]))
        return assess(
            self.names,
            jacobian,
            residual / self.scale,
            self.counts,
            size,
            np.where(values != 0, values, 1.0),
        )


def balance_fits(
    machine: Machine, data: Prepared, turned: Sequence[Sequence[int]] = ((),)
) -> list[BalanceFit]:
    """Return the balance along a prepared log, once for each choice of drives with a turned sign.

    Args:
        machine: The machine; unknowns that are no forces (a period, a delay) stay at their guess.
        data: The prepared log.
        turned: Drives whose force is taken with the opposite sign, 0-based, one list for each result.
    """
    plant, places = sharpened(machine.plant, data), machine.parameters.places
    theta = machine.parameters.guess
    linear = np.array([_is_force(machine.plant, f) for f in machine.parameters.free], dtype=bool)
    arrays = ForceData.of(data, data.fitted)
    drives = data.force.shape[1]

    def evaluate(sign: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        signed = eqx.tree_at(lambda a: a.force, arrays, data.force * sign)
        e, columns = force_and_columns(plant, places, signed, theta)
        columns = np.asarray(columns)[..., linear]
        return np.asarray(e) - columns @ np.asarray(theta)[linear], columns

    declared = evaluate(np.ones(drives))
    needed = sorted({k for drives in turned for k in drives})
    # Each drive acts on the balance independently of the others.
    changes = {k: evaluate(np.where(np.arange(drives) == k, -1.0, 1.0)) for k in needed}
    force = np.asarray(measured_force(plant, arrays))
    potential = _potential(machine, data)
    velocity = np.asarray(data.recipe.decimator(data.qd))
    typical = np.abs(declared[1] * np.asarray(theta)[linear]).max(axis=2, initial=0.0)
    scale = _scales(force, potential, typical, data.fitted)
    base = BalanceFit(
        unknowns=tuple(f for f, of in zip(machine.parameters.free, linear, strict=True) if of),
        columns=declared[1],
        known=declared[0],
        potential=potential,
        force=force,
        velocity=velocity,
        counts=data.fitted,
        scale=scale,
    )
    out = []
    for chosen in turned:
        known, columns = (
            of + sum((changes[k][i] - of for k in chosen), start=np.zeros(()))
            for i, of in enumerate(declared)
        )
        out.append(replace(base, known=known, columns=columns))
    return out


def _is_force(plant: Plant, free: Free) -> bool:
    """Check that forces are in proportion to an unknown, whatever the other unknowns are."""
    effect = None if free.effect is None else plant.effects[free.effect]
    owner = plant if effect is None else effect
    info: ParameterInfo | None = parameters_of(type(owner)).get(str(free.path[-1]))
    if info is None or not carries_force(info):
        return False
    return effect is None or (effect.adds_force and type(effect).initial_state is Effect.initial_state)


def _potential(machine: Machine, data: Prepared) -> np.ndarray:
    """Return forces that depend on the position of their joint alone: a polynomial, and a weight that turns.

    They do no net work over a cycle, so they cannot pass for friction; and an undeclared spring, in a motion
    below its resonance, does not pass for a negative inertia.
    """
    joints, filtered = data.q.shape[1], data.recipe.decimator
    blocks = []
    for j in range(joints):
        q = data.q[:, j]
        centred = (q - q.mean()) / max(float(np.ptp(q)), 1e-300)
        shapes = [np.ones_like(q), centred, centred**2, centred**3]
        motion = machine.plant.motion(j) or machine.units.motion
        if motion == "rotary" and np.ptp(q) > _SWINGS:
            shapes += [np.sin(q), np.cos(q)]
        columns = np.asarray(filtered(np.stack(shapes, axis=1)))
        block = np.zeros((len(columns), joints, columns.shape[1]))
        block[:, j] = columns
        blocks.append(block)
    return np.concatenate(blocks, axis=2)


def _scales(force: np.ndarray, potential: np.ndarray, model: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the RMS of the force of each joint without its part that depends on the position only.

    No force drives a passive joint: the largest term of the model at the guess stands for it.
    """
    out = np.ones(force.shape[1])
    for j in range(len(out)):
        rows, target, term = potential[counts[:, j], j], force[counts[:, j], j], model[counts[:, j], j]
        if not target.size:
            continue
        remainder = target - rows @ np.linalg.lstsq(rows, target, rcond=1e-10)[0]
        size = np.sqrt(np.mean(remainder**2))
        size = size if size > 0 else np.sqrt(np.mean(term**2))
        out[j] = size if size > 0 else 1.0
    return out
