"""Every registered effect: its force against the table, affinity, and its regressor column."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.residuals import residual_along
from jaxid.dynamics.rhs import State
from jaxid.effects import EFFECTS
from jaxid.model.smoothing import Smoothing
from jaxid.model.unknowns import scatter
from jaxid.numerics.filters import Decimator
from jaxid.plants import Axis
from jaxid.simulation.force_balance import ForceData, force_residual
from truth.axis.effect_forces import GRAVITY, MASS, ROWS, Instant, Row

each_row = pytest.mark.parametrize("row", ROWS.values(), ids=[*ROWS])
# Effects on the command leave the balance of forces as it is: see test_effects_in_loop.
OF_FORCE = {name: row for name, row in ROWS.items() if EFFECTS[row.kind].controller_field is None}
each_row_of_force = pytest.mark.parametrize("row", OF_FORCE.values(), ids=[*OF_FORCE])


def plant_of(effects: tuple, sharpness: float = 1e-3, **options) -> Axis:
    made = tuple(EFFECTS[kind](**values) for kind, values in effects)
    return Axis(MASS, effects=made, smoothing=Smoothing(sharpness), **options)


def places_of(row: Row) -> tuple:
    """Return the places of the parameters of the row's effect, which stands last."""
    return tuple((("effects", len(row.effects) - 1, name), None) for name in row.values)


def own_of(row: Row) -> tuple:
    last = None if row.own is None else jnp.asarray(row.own)
    return (*[None] * len(row.beside), last)


def instants(row: Row, count: int = 12) -> list[Instant]:
    """Random states with 0.05 m/s < |v| < 0.6 m/s, forces on both sides of the saturation."""
    random = np.random.default_rng(7)
    speed = random.uniform(0.05, 0.6, count) * random.choice([-1, 1], count)
    force = random.choice([-400.0, -90.0, 60.0, 300.0], count)
    rest = random.uniform([-0.1, -5, 0], [0.1, 5, 2], (count, 3))
    return [
        Instant(q, v, a, u, t, row.own or 0.0) for (q, a, t), v, u in zip(rest, speed, force, strict=True)
    ]


@eqx.filter_jit
def balance(plant: Axis, x: Instant, own: tuple):
    one = [jnp.asarray(s)[None] for s in (x.q, x.v, x.a, x.u)]
    return plant.balance(*one, jnp.asarray(x.t), own)


def test_every_registered_effect_has_a_row():
    # An axis has no spring for clearance: see test_flexible_axis.
    assert {row.kind for row in ROWS.values()} == set(EFFECTS) - {"backlash"}


@each_row
def test_force_is_the_tables(row):
    plant, own = plant_of(row.effects), own_of(row)
    for x in instants(row):
        now = balance(plant, x, own)
        load = MASS * x.a - float(now.residual[0])
        # forces of a few hundred N: rounding, and tanh(50) which is one to the last digit
        assert load == pytest.approx(row.load(x), abs=1e-10)
        if not EFFECTS[row.kind].adds_force and not row.dry:  # what sits in the drive
            assert float(now.drive[0]) == pytest.approx(row.load(x), abs=1e-10)


def test_added_mass_weighs_on_a_vertical_axis():
    plant = plant_of((("added_mass", {"mass": 20.0}),), vertical=True)
    x = Instant(0.1, 0.2, 3.0, 50.0, 0.0)
    expected = (MASS + 20.0) * (3.0 + GRAVITY) - 50.0
    assert float(balance(plant, x, (None,)).residual[0]) == pytest.approx(expected, rel=1e-14)


def test_break_away_holds_below_and_leaves_above():
    row = ROWS["static_friction"]
    plant, rest = plant_of(row.effects), State(jnp.zeros(1), jnp.zeros(1), (None, None))
    zero, h = jnp.zeros(()), jnp.asarray(1e-4)

    @jax.jit
    def step(u, v):
        x = eqx.tree_at(lambda s: s.qd, rest, v)
        return set_valued_step(plant, x, lambda s: u, zero, h)[0].qd

    for u, leaves in ((69.9, False), (-69.9, False), (70.1, True), (-70.1, True)):
        assert (float(step(jnp.asarray([u]), jnp.zeros(1))[0]) != 0.0) == leaves
    # once it slides, only the 30 N of Coulomb are left: (69.9 - 30) / 100 * 1e-4
    slid = step(jnp.asarray([69.9]), jnp.asarray([0.01]))
    assert float(slid[0]) == pytest.approx(0.01 + 0.399e-4, rel=1e-12)


@each_row
def test_delay_is_what_the_effect_says(row):
    of_force = EFFECTS[row.kind].controller_field is None
    expected = row.values.get("delay", 0.0) if of_force else 0.0
    assert float(plant_of(row.effects).command_delays(1)[0]) == expected


def test_residual_is_in_declared_units():
    """(m a - g u) / g: in units of the load, a gain of zero would be a perfect fit."""
    plant = plant_of((("actuator_gain", {"gain": 1.2}),))
    motion = [getattr(MOTION, name) for name in ("q", "qd", "qdd", "force")]
    e = np.asarray(jax.jit(residual_along)(plant, *motion, MOTION.period)[0])
    expected = MASS / 1.2 * np.asarray(MOTION.qdd) - np.asarray(MOTION.force)
    np.testing.assert_allclose(e, expected, atol=1e-10)  # rounding of a thousand N


def test_an_offset_acts_before_what_limits_the_drive():
    """Behind it a saturation cuts off more on one side; before it, it would not."""
    offset, limit = ("actuator_offset", {"level": 25.0}), ("saturation", {"limit": 150.0})
    told = {}
    for order in ((offset, limit), (limit, offset)):
        plant = plant_of(order)
        at = [balance(plant, Instant(0.0, 0.1, 0.0, u, 0.0), (None, None)) for u in (-160.0, 50.0, 140.0)]
        told[order[0][0]] = [float(now.drive[0]) for now in at]
    # the rounding of the corner 10 N, sixty of its widths, away from it
    assert told["actuator_offset"] == pytest.approx([-135.0, 75.0, 150.0], abs=1e-9)
    assert told["saturation"] == pytest.approx([-125.0, 75.0, 165.0], abs=1e-9)


@each_row
def test_balance_is_affine_in_the_acceleration_and_rates_in_their_states(row):
    plant, own = plant_of(row.effects), own_of(row)
    for x in instants(row, 3) if row.affine else ():
        at = [balance(plant, x._replace(a=a), own).residual[0] for a in (0.0, x.a, 2 * x.a)]
        # a rounding of forces of a few hundred N
        assert float(at[2] - 2 * at[1] + at[0]) == pytest.approx(0.0, abs=1e-11)
        if row.own is None:
            continue
        scaled = [(*own[:-1], own[-1] * s) for s in (0.0, 1.0, 2.0)]
        rates = [np.asarray(balance(plant, x, z).rates[-1]) for z in scaled]
        rounding = 1e-12 * np.abs(rates[1]).max()
        np.testing.assert_allclose(rates[2] - 2 * rates[1] + rates[0], 0.0, atol=rounding)


def short_motion() -> ForceData:
    """0.4 s of a two-tone motion that reverses, at 1 kHz; the force need not fit it."""
    period = 1e-3
    t = period * np.arange(400)[:, None]
    w1, w2 = 2 * np.pi * 3.0, 2 * np.pi * 7.0
    q = 0.03 * (1 - np.cos(w1 * t)) + 0.003 * np.sin(w2 * t)
    qd = 0.03 * w1 * np.sin(w1 * t) + 0.003 * w2 * np.cos(w2 * t)
    qdd = 0.03 * w1**2 * np.cos(w1 * t) - 0.003 * w2**2 * np.sin(w2 * t)
    force = MASS * qdd + 30 * np.tanh(qd / 0.01)
    arrays = [jnp.asarray(x) for x in (q, qd, qdd, force)]
    weight, start = jnp.ones((400, 1)), jnp.zeros(())
    return ForceData(*arrays, weight, start, period, hold=period, decimator=Decimator(4, 2))


MOTION = short_motion()


def differences(f, theta: np.ndarray, relative: float) -> np.ndarray:
    """Central differences of f, a column an unknown."""
    columns = []
    for i, value in enumerate(theta):
        step = np.zeros(len(theta))
        step[i] = relative * value
        columns.append((f(theta + step) - f(theta - step)) / (2 * step[i]))
    return np.stack(columns, axis=-1)


@each_row_of_force
def test_regressor_column_is_the_slope_of_the_residual(row):
    # a sign as wide as samples at 1 kHz resolve, so that what acts at rest alone is seen at all
    plant, places = plant_of(row.effects, sharpness=2e-2), places_of(row)

    def residual(theta):
        e = force_residual(scatter(places, plant, theta), MOTION)[:, 0]
        return e, e

    both = jax.jit(jax.jacfwd(residual, has_aux=True))
    theta = np.array([*row.values.values()])
    column = np.asarray(both(theta)[0])
    expected = differences(lambda x: np.asarray(both(x)[1]), theta, 1e-4)
    # central differences of smooth functions at 1e-4: their own error is 1e-8 of the third
    # derivative, the corner of the saturation the sharpest with a width of 1e-3
    norm = np.linalg.norm(expected, axis=0)
    assert np.all(norm > 0)
    np.testing.assert_array_less(np.linalg.norm(column - expected, axis=0), 1e-3 * norm)
