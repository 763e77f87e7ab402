"""Minimal models for the measured signals: their coefficients as functions of a plant.

A model is a set of rows, each a sum of coefficients times derivatives of measured signals that equals a
force. Whether a coefficient is zero, known or unknown is found from the plant at a few random values of its
unknowns.

Source:
    Janot, Gautier, Jubien and Vandanjon, "Experimental joint stiffness identification depending on
    measurements availability", (1), (6), (7), (13); the algebra here is exact where (8) to (13) move the
    load's friction to the motor.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.minimal.matrices import LinearBalance, linear_balance
from jaxid.estimators.minimal.polynomials import Matrix, adjugate, determinant, product, scaled, total
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Parameters, scatter

# Signals of which rows consist, in this order.
SIGNALS = ("position", "acceleration", "force", "sign", "one")
# A coefficient below this, relative to the terms that it sums, is zero.
_NOTHING = 1e-9
# Random values of the unknowns, enough for coefficients that are bilinear in them.
_DRAWS = 3


@dataclass(frozen=True)
class Term:
    """A derivative of a signal in a row.

    Args:
        row: Index of the row of the model.
        signal: One of `SIGNALS`; "force" is on the side of the motion, with its sign changed.
        index: Index of the joint or drive.
        order: Order of the derivative.
    """

    row: int
    signal: str
    index: int
    order: int


@dataclass(frozen=True)
class Form:
    """The form of a model, by the measured signals.

    Args:
        name: Name of the form in results.
        equation: Number of the equation in the paper.
        hidden: Indices of the joints whose position is not measured.
        accelerated: Whether their acceleration is measured.
        printed: Whether the rigid row is as the paper prints it, without the hidden joints.
    """

    name: str
    equation: str
    hidden: tuple[int, ...] = ()
    accelerated: bool = False
    printed: bool = False


def form_of(joints: int, measured: tuple[bool, ...], accelerated: bool, printed: bool = False) -> Form:
    """Choose the form of the model for a log.

    Args:
        joints: Number of joints.
        measured: Whether the position of each joint is measured.
        accelerated: Whether the acceleration of the other joints is measured.
        printed: Whether to take the model with an acceleration as the paper prints it.
    """
    hidden = tuple(i for i in range(joints) if not measured[i])
    if joints == 1:
        return Form("rigid", "(1)")
    if not hidden:
        return Form("positions", "(6)")
    if not accelerated:
        return Form("motor_position", "(13)", hidden)
    name, equation = "load_acceleration", "(7), third row corrected"
    if printed:
        name, equation = "load_acceleration_printed", "(7) as printed"
    return Form(name, equation, hidden, True, printed)


def _rows(balance: LinearBalance, form: Form, sign: float = -1.0) -> dict[str, Matrix]:
    """Return the coefficients of a model by signal, (orders, rows, index); `sign` as in `determinant`."""
    parts = {
        "position": balance.motion,
        "force": balance.force[None],
        "sign": balance.sign[None],
        "one": balance.constant[None, :, None],
    }
    if not form.hidden:
        return parts
    # Away from rest a hidden joint moves in the direction of the one before it.
    parts["sign"] = _regrouped_signs(parts["sign"], form.hidden)
    if form.accelerated:
        return _with_acceleration(parts, form)
    return _eliminated(parts, form.hidden, sign)


def _regrouped_signs(a: Matrix, hidden: tuple[int, ...]) -> Matrix:
    """Move the friction of hidden joints to the measured joints whose direction they share."""
    rest = tuple(i for i in range(a.shape[2]) if i not in hidden)
    out = jnp.asarray(a)
    for i in hidden:
        out = out.at[:, :, neighbour(i, rest)].add(out[:, :, i]).at[:, :, i].set(0.0)
    return out


def _eliminated(parts: dict[str, Matrix], hidden: tuple[int, ...], sign: float) -> dict[str, Matrix]:
    """Return the rows of the measured joints, from which the hidden joints are eliminated by their rows.

    The Schur complement of the hidden joints, times the determinant of their block.
    """
    n = parts["position"].shape[1]
    inner, rest = _places(hidden), _places(tuple(i for i in range(n) if i not in hidden))
    block = parts["position"][:, inner][:, :, inner]
    divisor = determinant(block, sign)
    through = product(parts["position"][:, rest][:, :, inner], adjugate(block, sign))
    out = {}
    for name, a in parts.items():
        a = a[:, :, rest] if name == "position" else a
        kept, moved = scaled(divisor, a[:, rest]), product(through, a[:, inner])
        out[name] = total(kept, sign * moved)
    # The derivatives of constants, and of signs away from rest, are zero.
    return {k: v[:1] if k in ("sign", "one") else v for k, v in out.items()}


def _with_acceleration(parts: dict[str, Matrix], form: Form) -> dict[str, Matrix]:
    """Return all rows differentiated twice, and their sum without derivatives, in which springs cancel.

    In the sum hidden joints move with the velocity of the measured joints nearest to them.
    """
    motion, hidden = parts["position"], _places(form.hidden)
    n = motion.shape[1]
    rest = tuple(i for i in range(n) if i not in form.hidden)

    def twice(a: Matrix) -> Array:
        return jnp.pad(a, ((2, 0), (0, 0), (0, 0)))

    def summed(a: Matrix) -> Array:
        return jnp.sum(a, axis=1, keepdims=True)

    def none(a: Matrix) -> Array:
        return jnp.zeros((1, n, a.shape[2]))

    # The rigid row: the hidden joints' inertia times their acceleration, and their damping times the velocity
    # of the measured joints.
    rigid = summed(motion)
    known = jnp.asarray(rigid[:, :, _places(rest)])
    pushed = rigid[2:, :, hidden]
    if form.printed:
        pushed = jnp.zeros_like(pushed)
    else:
        carriers = [rest.index(neighbour(i, rest)) for i in form.hidden]
        for k, i in zip(carriers, form.hidden, strict=True):
            known = known.at[1, 0, k].add(rigid[1, 0, i])

    return {
        "position": jnp.concatenate([twice(motion[:, :, _places(rest)]), _lengthened(known, 5)], axis=1),
        "acceleration": jnp.concatenate([motion[:, :, hidden], _lengthened(pushed, 3)], axis=1),
        "force": jnp.concatenate([twice(parts["force"]), _lengthened(summed(parts["force"]), 3)], axis=1),
        "sign": jnp.concatenate([none(parts["sign"]), summed(parts["sign"])], axis=1),
        "one": jnp.concatenate([none(parts["one"]), summed(parts["one"])], axis=1),
    }


def _lengthened(a: Matrix, orders: int) -> Matrix:
    """Return a matrix of polynomials padded by zeros to a number of orders."""
    return jnp.pad(a, ((0, orders - len(a)), (0, 0), (0, 0)))


def _places(joints: tuple[int, ...]) -> Array:
    return jnp.asarray(joints, dtype=int)


def neighbour(joint: int, measured: tuple[int, ...]) -> int:
    """Return the measured joint that stands for a hidden one: the nearest."""
    return min(measured, key=lambda i: abs(i - joint))


def rigid_rows_hold(plant: Plant) -> bool:
    """Tell whether springs cancel in the sum of all rows, as the model with an acceleration needs."""
    stiffness = np.asarray(eqx.filter_jit(linear_balance)(plant).motion[0])
    return bool(np.all(np.abs(stiffness.sum(axis=0)) <= _NOTHING * np.abs(stiffness).sum(axis=0)))


def _flat(plant: Plant, form: Form, magnitude: bool = False) -> Float[Array, " all"]:
    """Return all coefficients of a model; with `magnitude`, the size of the terms that each sums."""
    balance = linear_balance(plant)
    if magnitude:
        balance = jax.tree.map(jnp.abs, balance)
    rows = _rows(balance, form, 1.0 if magnitude else -1.0)
    return jnp.concatenate([rows[name].ravel() for name in SIGNALS if name in rows])


def _terms(plant: Plant, form: Form) -> list[Term]:
    """Return the term of each coefficient of a model."""
    shapes = jax.eval_shape(lambda p: _rows(linear_balance(p), form), plant)
    joints = {
        "position": tuple(i for i in range(plant.joints) if i not in form.hidden),
        "acceleration": form.hidden,
    }
    terms = []
    for name in SIGNALS:
        if name not in shapes:
            continue
        orders, rows, width = shapes[name].shape
        index = joints.get(name, tuple(range(width)))
        terms += [
            Term(r, name, index[j], k) for k in range(orders) for r in range(rows) for j in range(width)
        ]
    return terms


@dataclass(frozen=True)
class Structure:
    """The nonzero coefficients of a model; hashable, so that compiled code can depend on it.

    Args:
        form: Form of the model.
        rows: Number of rows.
        leading: Force of the lowest order in each row, by which the row is divided: index among all
            coefficients, and term; None: the row has no force.
        unknown: Coefficients that depend on the unknowns: index among all, and term.
        known: The other coefficients, beside the leading ones: index among all, and term.
    """

    form: Form
    rows: int
    leading: tuple[tuple[int, Term] | None, ...]
    unknown: tuple[tuple[int, Term], ...]
    known: tuple[tuple[int, Term], ...]

    def coefficients(self, plant: Plant) -> Float[Array, " terms"]:
        """Return the unknown coefficients of a plant, each over its row's leading one; differentiable."""
        values, one = _flat(plant, self.form), jnp.ones(())
        divisors = [one if k is None else values[k[0]] for k in self.leading]
        return jnp.stack([values[k] / divisors[t.row] for k, t in self.unknown])


@dataclass(frozen=True)
class MinimalSamples:
    """All coefficients of a model at several values of the unknowns.

    Args:
        values: The coefficients, (draws, all).
        slopes: Their derivatives in the unknowns, (draws, all, p).
        guess: Guesses of the unknowns, which are the last draw, (p,). The draw before has offsets of zero.
    """

    values: Float[np.ndarray, "draws all"]
    slopes: Float[np.ndarray, "draws all p"]
    guess: Float[np.ndarray, " p"]

    def of(
        self, wanted: tuple[tuple[int, Term], ...], leading: tuple[tuple[int, Term] | None, ...]
    ) -> tuple[Float[np.ndarray, "draws terms"], Float[np.ndarray, "draws terms p"]]:
        """Return some coefficients over their rows' leading ones, and the derivatives of these ratios.

        Args:
            wanted: Index among all coefficients, and term, of the coefficients to return.
            leading: Leading coefficient of each row.
        """
        places = [k for k, _ in wanted]
        values, slopes = self.values[:, places], self.slopes[:, places]
        for j, (_, t) in enumerate(wanted):
            lead = leading[t.row]
            if lead is not None:
                k = lead[0]
                values[:, j] /= self.values[:, k]
                slopes[:, j] -= values[:, j, None] * self.slopes[:, k]
                slopes[:, j] /= self.values[:, k, None]
        return values, slopes


@eqx.filter_jit
def _sampled(plant: Plant, places: tuple, form: Form, draws: Array) -> tuple[Array, ...]:
    """Return all coefficients, their derivatives, the size of their terms, and the matrix B, by draw."""

    def at(theta: Array) -> tuple[Array, tuple[Array, ...]]:
        moved = scatter(places, plant, theta)
        values = _flat(moved, form)
        return values, (values, _flat(moved, form, True), linear_balance(moved).force)

    slopes, (values, size, force) = jax.vmap(jax.jacfwd(at, has_aux=True))(draws)
    return values, slopes, size, force


def structure_of(plant: Plant, parameters: Parameters, form: Form) -> tuple[Structure, MinimalSamples]:
    """Find from a plant which coefficients of a model are zero, known or unknown.

    Args:
        plant: The plant.
        parameters: Its unknowns.
        form: Form of the model.

    Returns:
        The structure, and the coefficients at several values of the unknowns.

    Raises:
        ValueError: If the gain of the drive is among the unknowns.
    """
    guess = parameters.guess
    scale = np.where(guess != 0, guess, 1.0)
    offset = np.array([f.sign == "free" for f in parameters.free])
    random = np.random.default_rng(0)
    draws = scale * np.exp(random.uniform(-1.0, 1.0, (_DRAWS, len(guess))))
    draws = np.concatenate([draws, [np.where(offset, 0.0, scale), guess]])

    terms = _terms(plant, form)
    values, slopes, size, force = (np.asarray(a) for a in _sampled(plant, parameters.places, form, draws))
    if np.any(force != force[0]):
        raise ValueError("the gain between the declared force and the joints is unknown")

    nonzero = np.any(np.abs(values) > _NOTHING * size, axis=0)
    rows = 1 + max(t.row for t in terms)
    leading = tuple(_leading(r, terms, nonzero) for r in range(rows))
    every = tuple((k, t) for k, t in enumerate(terms) if nonzero[k] and (k, t) not in leading)

    # A coefficient is unknown if its ratio to the leading one changes with the unknowns.
    samples = MinimalSamples(values, slopes, guess)
    ratios, steep = samples.of(every, leading)
    unknown = np.abs(steep * scale).max(axis=(0, 2), initial=0.0) > _NOTHING * np.abs(ratios).max(axis=0)
    return Structure(
        form=form,
        rows=rows,
        leading=leading,
        unknown=tuple(e for e, m in zip(every, unknown, strict=True) if m),
        known=tuple(e for e, m in zip(every, unknown, strict=True) if not m),
    ), samples


def _leading(row: int, terms: list[Term], nonzero: np.ndarray) -> tuple[int, Term] | None:
    """Return the force of lowest order in a row: index among all coefficients, and term."""
    forces = [
        (t.order, k, t) for k, t in enumerate(terms) if nonzero[k] and t.row == row and t.signal == "force"
    ]
    return None if not forces else min(forces, key=lambda f: f[:2])[1:]
