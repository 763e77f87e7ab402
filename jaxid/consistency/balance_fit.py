"""Least squares on the balance of forces, quick and rough: the base of every check before a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float, Int

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
# Largest natural logarithm of a rough gain of a drive over its guess: a factor of 20.
_FAR_GAIN = 3.0
# Singular value, as a part of the largest, below which a direction of a rough fit is not identifiable, and
# share of an unknown in it from which it is not either.
_BLIND, _SHARE = 1e-9, 1e-3
# Standard deviation of a gain, as a part of it, up to which a log shows it.
_SHOWN = 0.05


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
        gains: Joints whose drive has an unknown gain that the log shows, 0-based; see `rough_gains`.
    """

    unknowns: tuple[Free, ...]
    columns: Float[np.ndarray, "kept n p"]
    known: Float[np.ndarray, "kept n"]
    potential: Float[np.ndarray, "kept n c"]
    force: Float[np.ndarray, "kept n"]
    velocity: Float[np.ndarray, "kept n"]
    counts: Bool[np.ndarray, "kept n"]
    scale: Float[np.ndarray, " n"]
    gains: tuple[int, ...] = ()

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

    def with_gains(self) -> BalanceFit:
        """Return the balance with the declared forces of unknown gains among the undeclared forces.

        Model minus gain times force is linear in the gain. A gain at a guess that is some per cent off hides
        a shift of the force in time.
        """
        columns = np.zeros((*self.force.shape, len(self.gains)))
        for k, joint in enumerate(self.gains):
            columns[:, joint, k] = self.force[:, joint]
        return self.beside(columns)

    def under_force(self, force: Float[np.ndarray, "kept n"]) -> BalanceFit:
        """Return the balance under another declared force, through the same filter."""
        return replace(self, known=self.known + self.force - force, force=force)

    def beside(self, columns: Float[np.ndarray, "kept n k"]) -> BalanceFit:
        """Return the balance with more undeclared forces."""
        return replace(self, potential=np.concatenate([self.potential, columns], axis=2))

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


def with_rough_gains(machine: Machine, data: Prepared) -> Machine:
    """Return a machine with unknown gains of drives at a rough least-squares fit to a log.

    Joints of an arm push each other: if one gain is known, the log shows the others. All unknowns to which
    forces are in proportion follow, because their guesses may be in another unit than the force. A machine
    without unknown gains stays as it is, and so does one whose fitted gains are none, or far off.

    Args:
        machine: The machine.
        data: The prepared log.
    """
    if (rough := rough_gains(machine, data)) is None:
        return machine
    guess = np.asarray(machine.parameters.guess, dtype=np.float64)
    ratio = rough.gains / guess[rough.places]
    if not np.all(np.isfinite(rough.values)) or np.any(np.abs(np.log(np.maximum(ratio, 1e-300))) > _FAR_GAIN):
        return machine
    positive = np.array([f.sign == "positive" for f in machine.parameters.free])
    values = np.where(positive & (rough.values <= 0), guess, rough.values)
    return machine.with_estimate(np.clip(values, *machine.parameters.bounds))


class RoughGains(NamedTuple):
    """Rough gains of drives; see `rough_gains`.

    Args:
        places: Places of the gains among the unknowns, (k,).
        values: Values of all unknowns; those in proportion to which no force acts are the guesses, (p,).
        std: Standard deviations of the gains for a white residual, (k,); infinite for one that the log does
            not show.
    """

    places: np.ndarray
    values: np.ndarray
    std: np.ndarray

    @property
    def gains(self) -> np.ndarray:
        """Values of the gains, (k,)."""
        return self.values[self.places]

    @property
    def shown(self) -> Bool[np.ndarray, " k"]:
        """Mask of the gains that the log shows, (k,). Joints that do not push each other show none."""
        return (self.gains > 0) & (self.std < _SHOWN * self.gains)


def rough_gains(machine: Machine, data: Prepared) -> RoughGains | None:
    """Fit the unknown gains of drives, and the unknowns in proportion to which forces act, to a log.

    Args:
        machine: The machine.
        data: The prepared log.

    Returns:
        The fit; None if no gain is unknown, or all are, so that nothing has a scale, or if the balance is
        not finite.
    """
    parameters, places = machine.parameters, _places_of_gains(machine, data)
    if places is None:
        return None
    gains = np.isin(np.arange(len(parameters.free)), places)
    fitted = gains | np.array([_is_force(machine.plant, f) for f in parameters.free], dtype=bool)
    plant, arrays = sharpened(machine.plant, data), ForceData.of(data, data.fitted)
    guess = np.asarray(parameters.guess, dtype=np.float64)
    e, columns = (np.asarray(x) for x in force_and_columns(plant, parameters.places, arrays, guess))

    # The residual is the model over the gain, minus the declared force: times the gain it is linear.
    declared = np.asarray(measured_force(plant, arrays))
    joints = [_joint_of(machine.plant, parameters.free[k]) for k in places]
    factor = np.ones(e.shape[1])
    factor[joints] = guess[places]
    columns = columns * factor[:, None]
    columns[..., places] = 0.0
    for joint, place in zip(joints, places, strict=True):
        columns[:, joint, place] = -declared[:, joint]
    known = (e + declared) * factor - columns[..., fitted & ~gains] @ guess[fitted & ~gains]
    free_of_gain = np.setdiff1d(np.arange(len(factor)), joints)
    known[:, free_of_gain] -= declared[:, free_of_gain]
    columns = columns[..., fitted]

    size = np.sqrt(np.mean(declared**2, axis=0))
    size = np.where(size > 0, size, 1.0)
    rows, target = (columns / size[:, None])[data.fitted], (-known / size)[data.fitted]
    norm = np.linalg.norm(rows, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    if len(target) < rows.shape[1] or not (np.all(np.isfinite(rows)) and np.all(np.isfinite(target))):
        return None
    left, strength, right = np.linalg.svd(rows / norm, full_matrices=False)
    seen = strength > _BLIND * strength[0]
    solved = right[seen].T @ ((left.T @ target)[seen] / strength[seen])
    variance = np.mean((rows / norm @ solved - target) ** 2)
    spread = np.sqrt(variance * np.sum((right[seen].T / strength[seen]) ** 2, axis=1))
    spread[np.any(np.abs(right[~seen]) > _SHARE, axis=0)] = np.inf

    values = guess.copy()
    values[fitted] = solved / norm
    of_gains = gains[fitted]
    return RoughGains(np.flatnonzero(gains), values, (spread / norm)[of_gains])


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
    linear = np.array([_is_force(machine.plant, f) for f in machine.parameters.free], dtype=bool)
    arrays = ForceData.of(data, data.fitted)
    drives = data.force.shape[1]
    theta = machine.parameters.guess

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
    rough = rough_gains(machine, data)
    gains = [] if rough is None else [machine.parameters.free[k] for k in rough.places[rough.shown]]
    base = BalanceFit(
        unknowns=tuple(f for f, of in zip(machine.parameters.free, linear, strict=True) if of),
        columns=declared[1],
        known=declared[0],
        potential=potential,
        force=force,
        velocity=velocity,
        counts=data.fitted,
        scale=scale,
        gains=tuple(_joint_of(machine.plant, gain) for gain in gains),
    )
    out = []
    for chosen in turned:
        known, columns = (
            of + sum((changes[k][i] - of for k in chosen), start=np.zeros(()))
            for i, of in enumerate(declared)
        )
        out.append(replace(base, known=known, columns=columns))
    return out


def _places_of_gains(machine: Machine, data: Prepared) -> Int[np.ndarray, " k"] | None:
    """Return the places of the unknown gains of drives that a log may show; None if there are none.

    If all gains are unknown, nothing has a scale.
    """
    free = machine.parameters.free
    places = np.array([k for k, f in enumerate(free) if _is_gain(machine.plant, f)], dtype=int)
    return places if 0 < len(places) < data.force.shape[1] else None


def _is_gain(plant: Plant, free: Free) -> bool:
    """Check that an unknown is the gain of a drive."""
    effect = None if free.effect is None else plant.effects[free.effect]
    return effect is not None and effect.drive_gain is not None and free.path[-1] == effect.drive_gain


def _joint_of(plant: Plant, free: Free) -> int:
    """Return the joint of an unknown of an effect, 0-based."""
    assert free.effect is not None, "a gain belongs to an effect"
    return int(plant.effects[free.effect].port)


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
