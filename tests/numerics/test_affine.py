"""Where a step is one matrix: what counts as affine, and that the matrix is the step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.rhs import State, affine_flow, hold_polynomial, step
from jaxid.effects import EFFECTS
from jaxid.model.effect import Action, Effect
from jaxid.numerics.affine import Dependence, affine, dependences
from jaxid.plants import Axis

STEP = jnp.asarray(2e-3)
LINEAR = {
    "viscous_friction": {"coefficient": 3.0},
    "coulomb_friction": {"level": 1.5},
    "stribeck_friction": {"level": 1.0, "velocity": 0.1},
    "friction_drift": {"rate": 0.01},
    "linear_stiffness": {"coefficient": 40.0},
    "constant_force": {"level": 0.7},
    "added_mass": {"mass": 0.4},
    "actuator_lag": {"time_constant": 0.01},
}
CURVED = {
    "cubic_stiffness": {"coefficient": 3e3},
    "cogging": {"amplitude": 2.0, "period": 0.2, "phase": 0.3},
    "quadratic_drag": {"coefficient": 1.0},
    "hysteresis": {"stiffness": 200.0, "level": 3.0},
    "saturation": {"limit": 2.0},
}


class SharpSign(Effect):
    """A force whose derivative is zero everywhere, which does not make it affine."""

    def act(self, x, state):
        return Action(force=-jnp.sign(x.yd))


class Clock(Effect):
    """A force of time alone."""

    def act(self, x, state):
        return Action(force=x.t)


def axis(*effects) -> Axis:
    return Axis(2.0, effects=effects)


def linear_axis() -> Axis:
    return axis(*(EFFECTS[kind](**values) for kind, values in LINEAR.items()))


def flow_of(plant, held=True):
    x = State(jnp.zeros(1), jnp.zeros(1), plant.initial_states(jnp.zeros(1)))
    ends = (jnp.zeros(1),) if held else (jnp.zeros(1), jnp.zeros(1))
    return affine_flow(plant, x, ends, jnp.zeros(()), STEP)


@pytest.mark.parametrize("held", [True, False])
def test_matrix_is_the_step(held):
    plant = linear_axis()
    x = State(jnp.asarray([0.1]), jnp.asarray([-0.3]), plant.initial_states(jnp.asarray([2.0])))
    ends = (jnp.asarray([1.3]),) if held else (jnp.asarray([1.3]), jnp.asarray([-0.4]))
    reaction = jnp.asarray([0.6])
    flow = flow_of(plant, held)
    stepped = step(plant, x, hold_polynomial(ends), jnp.asarray(5.0), STEP, reaction)
    for a, b in zip(*map(jax.tree.leaves, (flow(x, ends, reaction), stepped)), strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-13)
    # left out: zero
    free = step(plant, x, hold_polynomial(ends), jnp.asarray(5.0), STEP, jnp.zeros(1))
    np.testing.assert_allclose(np.asarray(flow(x, ends).qd), np.asarray(free.qd), rtol=1e-13)


@pytest.mark.parametrize("v", [0.3, 1e-4, 0.0])
def test_set_valued_step_is_the_same_either_way(v):
    plant, t = linear_axis(), jnp.asarray(5.0)
    x = State(jnp.asarray([0.1]), jnp.asarray([v]), plant.initial_states(jnp.asarray([4.5])))
    u = (jnp.asarray([4.5]),)
    flow = flow_of(plant)
    fast = set_valued_step(plant, x, hold_polynomial(u), t, STEP, lambda x, *r: flow(x, u, *r))
    slow = set_valued_step(plant, x, hold_polynomial(u), t, STEP)
    for a, b in zip(*map(jax.tree.leaves, (fast, slow)), strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("kind", CURVED)
def test_curved_forces_have_no_matrix(kind):
    assert flow_of(axis(EFFECTS[kind](**CURVED[kind]))) is None


@pytest.mark.parametrize("effect", [SharpSign(), Clock()])
def test_steps_and_clocks_have_no_matrix(effect):
    assert flow_of(axis(effect)) is None


def test_matrix_has_gradients():
    def speed(coefficient, fast):
        plant = axis(EFFECTS["viscous_friction"](coefficient=coefficient))
        x = State(jnp.asarray([0.1]), jnp.asarray([0.3]), (None,))
        if fast:
            return flow_of(plant)(x, (jnp.ones(1),), jnp.zeros(1)).qd[0]
        return step(plant, x, lambda s: jnp.ones(1), jnp.zeros(()), STEP, jnp.zeros(1)).qd[0]

    slopes = [jax.grad(speed)(jnp.asarray(3.0), fast) for fast in (True, False)]
    assert float(slopes[0]) == pytest.approx(float(slopes[1]), rel=1e-12)


def test_affine_in_part_of_the_arguments():
    a = jnp.asarray([[1.0, 2.0], [3.0, 4.0]])
    x = jnp.asarray([5.0, 6.0])
    found = affine(lambda x, t: jnp.where(t > 0, a, a) @ x + 1.0, (x,), (jnp.zeros(()),))
    assert found is None  # t decides, whatever it decides
    found = affine(lambda x, t: a @ x + 1.0, (x,), (jnp.zeros(()),))
    np.testing.assert_allclose(np.asarray(found(x)), np.asarray(a @ x + 1.0), rtol=1e-15)


@jax.custom_jvp
def doubled(x):
    return 2.0 * x


doubled.defjvp(lambda x, by: (doubled(*x), 2.0 * by[0]))


def test_each_result_has_its_own_dependence():
    known = jnp.asarray([7.0, 8.0])

    def f(x):
        placed = known.at[1].set(x[0])
        return (
            known,
            placed,
            doubled(x),
            jnp.where(known > 7.5, x, known),
            jnp.sin(x),
            jnp.where(x > 0, x, 1.0),
        )

    found = dependences(f, (np.ones(2),))
    assert found == [Dependence.CONSTANT, *[Dependence.AFFINE] * 3, *[Dependence.OTHER] * 2]
