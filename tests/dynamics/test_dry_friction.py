"""The step that sticks exactly, against the exact stepper: breaking loose, sliding and stopping."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.rhs import State, hold_polynomial
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.model.smoothing import Smoothing
from jaxid.plants import Axis, Chain
from jaxid.simulation.loops import Drive, open_loop
from truth.axis import stepper

MASS, RATE, SECONDS = 2.5, 500.0, 0.6
COULOMB = {"coulomb_friction": {"level": 11.8}}
STRIBECK = COULOMB | {"stribeck_friction": {"level": 3.7, "velocity": 0.05}}
RISING = COULOMB | {"velocity_hysteresis": {"level": 3.7, "velocity": 0.05, "level_negative": 1.5}}
BREAK_AWAY = COULOMB | {"static_friction": {"level": 3.7}}
# Up through the level at which it breaks loose, and back down until it stops.
COMMAND = 25.0 * np.sin(2 * np.pi * 1.3 * np.arange(round(SECONDS * RATE)) / RATE)


def true_position(effects) -> np.ndarray:
    machine = stepper.Machine(inertia=MASS, effects=effects)
    loop = stepper.Loop(kind="open_loop", input=COMMAND)
    return stepper.simulate(machine, loop, stepper.Sensor(0.0, 0.0, 0.0), rate=RATE, duration=SECONDS)[
        "true_position"
    ]


class CoupledAxis(Axis):
    """An axis whose balance is solved as that of an arm, whose steps are tried in a loop."""

    coupled = True


def error(effects, substeps: int, machine: type[Axis] = Axis) -> float:
    """Largest, over the largest position."""
    plant = machine(MASS, effects=tuple(EFFECTS[kind](**values) for kind, values in effects.items()))
    drive = Drive(jnp.ones(1), 1 / RATE, substeps=substeps, set_valued=True)
    run = open_loop(plant, drive, jnp.asarray(COMMAND)[:, None], jnp.zeros(1), jnp.zeros(1))
    true = true_position(effects)
    return float(np.abs(np.asarray(run.position)[:, 0] - true).max() / np.abs(true).max())


@pytest.mark.parametrize(
    "effects", [COULOMB, STRIBECK, RISING, BREAK_AWAY], ids=["coulomb", "stribeck", "rising", "static"]
)
def test_motion_from_rest_is_the_exact_one(effects):
    assert error(effects, 1) < 2e-3
    assert error(effects, 8) < 3e-4


@pytest.mark.parametrize("effects", [COULOMB, STRIBECK, BREAK_AWAY], ids=["coulomb", "stribeck", "static"])
def test_a_coupled_machine_sticks_and_slides_as_exactly(effects):
    assert error(effects, 1, CoupledAxis) == pytest.approx(error(effects, 1), rel=1e-6)


def test_friction_that_falls_with_speed_is_taken_halfway():
    """One look at the level, at the motion without friction, leaves an error of first order."""
    coarse, fine = error(STRIBECK, 1), error(STRIBECK, 4)
    # Taken once they are 1.1e-2 and 2.6e-3.
    assert coarse < 5e-4
    assert fine < 0.2 * coarse


def test_friction_while_speed_grows_beside_friction_in_a_spring_is_refused():
    """Their shares are found together, of which the first knows nothing: it was left out without a word."""
    rising = EFFECTS["velocity_hysteresis"](level=5.0, velocity=0.5, port=0)
    in_spring = EFFECTS["coulomb_friction"](level=1.0, port=3)

    def moved(*effects) -> float:
        plant = Chain([1.0, 2.0], [2.0, 1.0], [100.0, 200.0, 150.0], effects=effects)
        drive = Drive(jnp.ones(2), 1 / RATE, set_valued=True)
        run = open_loop(plant, drive, jnp.full((3, 2), 10.0), jnp.zeros(2), jnp.zeros(2))
        return float(run.position[-1, 0])

    assert moved(rising) < moved(in_spring)
    with pytest.raises(InputError, match="velocity_hysteresis.*kind = 'chain'.*in a spring"):
        moved(rising, in_spring)


def stepped(plant, speed: float, force: float) -> tuple[float, float]:
    """Position and velocity after one step from zero under a held force."""
    x = State(jnp.zeros(1), jnp.asarray([speed]), (None,) * len(plant.effects))
    y, _ = set_valued_step(
        plant, x, hold_polynomial((jnp.asarray([force]),)), jnp.zeros(()), jnp.asarray(1 / RATE)
    )
    return float(y.q[0]), float(y.qd[0])


def test_a_stop_and_a_turn_within_a_step_are_two_parabolas():
    """Exact where friction is Coulomb's: one parabola over the step would go nearly twice as far."""
    level, speed, h = 11.8, 5e-3, 1 / RATE
    plant = Axis(MASS, effects=(EFFECTS["coulomb_friction"](level=level),))
    way, end = stepped(plant, speed, 0.0)
    assert end == 0.0
    assert way == pytest.approx(0.5 * MASS * speed**2 / level, rel=1e-9)
    force = -20.0
    slowing, back = (force - level) / MASS, (force + level) / MASS
    rest = h + speed / slowing
    way, end = stepped(plant, speed, force)
    assert end == pytest.approx(back * rest, rel=1e-9)
    assert way == pytest.approx(-0.5 * speed**2 / slowing + 0.5 * back * rest**2, rel=1e-9)


def test_a_velocity_stands_just_where_the_force_lies_between_both_frictions():
    """However much damping takes of an impulse within the step: here a fifth."""
    dry, rising, damping, speed = 10.0, 4.0, 0.5 * MASS * RATE, 0.2
    effects = (
        EFFECTS["coulomb_friction"](level=dry),
        EFFECTS["viscous_friction"](coefficient=damping),
        EFFECTS["velocity_hysteresis"](level=rising, velocity=1e3),
    )
    plant = Axis(MASS, effects=effects, smoothing=Smoothing(1e-6))
    for left in (0.01, 2.0, 3.99):
        way, end = stepped(plant, speed, dry + damping * speed + left)
        assert (way, end) == (speed / RATE, speed)
    # Beyond either end what is left speeds it up or slows it down, as if nothing stood in between.
    taken = -np.expm1(-damping / MASS / RATE) / damping
    for left, over in ((-0.1, -0.1), (4.1, 0.1)):
        _, end = stepped(plant, speed, dry + damping * speed + left)
        assert end - speed == pytest.approx(over * taken, rel=1e-3)
