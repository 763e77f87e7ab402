"""Every registered effect in a closed loop: gradients against differences, motion against truth."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.controllers import CONTROLLERS
from jaxid.model.unknowns import scatter
from jaxid.simulation.loops import Drive, closed_loop, needed_substeps
from tests.effects.test_effects import differences, places_of, plant_of
from truth.axis.effect_forces import MASS, ROWS, Row
from truth.axis.stepper import Loop, Machine, Sensor, simulate
from truth.chain.stepper import ChainMachine, simulate_chain

PERIOD, TICKS, GAIN = 1e-3, 300, 35.0
KP, KV, AVERAGE = 40.0, 200.0, 2
TIME = PERIOD * np.arange(TICKS)
# From rest and through one reversal at 0.25 s: 0.06 m, 0.38 m/s, 470 N.
REFERENCE = 0.03 * (1 - np.cos(4 * np.pi * TIME))
STROKE = 0.06
LAW = CONTROLLERS["cascade_pd"](
    kp=jnp.asarray([KP]), kv=jnp.asarray([KV]), period=PERIOD, velocity_average=AVERAGE
)
each_row = pytest.mark.parametrize("name", ROWS)


def loop_with_jacobian(row: Row, *, set_valued: bool, substeps: int):
    """Position, and its Jacobian in the row's parameters, as one compiled function of them."""
    plant, places = plant_of(row.effects), places_of(row)
    delays = 4 if row.kind == "input_delay" else 0
    drive = Drive(jnp.asarray([GAIN]), PERIOD, "zero_order", substeps, set_valued, delays)
    reference, rest = jnp.asarray(REFERENCE)[:, None], jnp.zeros(1)

    def position(theta):
        plant_now = scatter(places, plant, theta)
        run = closed_loop(plant_now, drive, LAW, reference, jnp.zeros((TICKS, 1)), rest, rest).position[:, 0]
        return run, run

    return jax.jit(jax.jacfwd(position, has_aux=True))


@cache
def exact_loop(name: str, substeps: int):
    """The loop that sticks exactly, shared by the tests: compiling it is what takes time."""
    return loop_with_jacobian(ROWS[name], set_valued=True, substeps=substeps)


def substeps_for(row: Row) -> int:
    if not row.dry:
        return 1
    drive = Drive(jnp.asarray([GAIN]), PERIOD)
    speeds = jnp.asarray([[0.0], [1e-3], [0.05], [0.4]])
    zero = jnp.zeros_like(speeds)
    return needed_substeps(plant_of(row.effects), drive, zero, speeds, zero)


def check_gradient(both, row: Row) -> None:
    theta = np.array([*row.values.values()])
    jacobian = np.asarray(both(theta)[0])
    # 1e-5: rounding of 1e-17 m over changes above 1e-9 m; curvature and the ticks at which a
    # stop moves by a step stay below 1e-4
    expected = differences(lambda x: np.asarray(both(x)[1]), theta, 1e-5)
    norm = np.linalg.norm(expected, axis=0)
    assert np.all(norm * np.abs(theta) > 1e-6)  # m: it acts
    np.testing.assert_array_less(np.linalg.norm(jacobian - expected, axis=0), 1e-3 * norm)


# The command jumps at the edge of a dead band: see test_dead_band.
@pytest.mark.parametrize("name", [n for n, row in ROWS.items() if row.kind != "dead_band"])
def test_gradient_through_the_smoothed_loop(name):
    row = ROWS[name]
    check_gradient(loop_with_jacobian(row, set_valued=False, substeps=substeps_for(row)), row)


# Break-away jumps where sliding starts, and the command at the edge of a dead band.
JUMP = ("static_friction", "dead_band")


@pytest.mark.parametrize("name", [n for n, row in ROWS.items() if row.kind not in JUMP])
def test_gradient_through_the_loop_that_sticks(name):
    check_gradient(exact_loop(name, 4), ROWS[name])


def truth(effects: tuple) -> np.ndarray:
    loop = Loop("cascade_pd", reference=REFERENCE, kp=KP, kv=KV, velocity_average=AVERAGE)
    if "joint_flexibility" in dict(effects):
        return behind_a_spring(loop, **dict(effects)["joint_flexibility"])
    machine = Machine(MASS, dict(effects), actuator_gain=GAIN)
    log = simulate(machine, loop, Sensor(), rate=1 / PERIOD, duration=TICKS * PERIOD)
    return log["true_position"]


def behind_a_spring(loop: Loop, stiffness: float, damping: float, load_inertia: float) -> np.ndarray:
    """Part of the mass as a second one of the independent chain."""
    machine = ChainMachine(
        (MASS - load_inertia, load_inertia),
        (0.0, 0.0),
        (0.0, stiffness, 0.0),
        actuated=(1,),
        actuator_gain=GAIN,
        coupling=(0.0, damping, 0.0),
    )
    log = simulate_chain(machine, [loop], Sensor(), rate=1 / PERIOD, duration=TICKS * PERIOD)
    return log["true_position"][:, 0]


def distance(name: str, substeps: int) -> float:
    """Largest difference in position between jaxid and the independent stepper [m]."""
    row = ROWS[name]
    ours = np.asarray(exact_loop(name, substeps)(np.array([*row.values.values()]))[1])
    return float(np.abs(ours - truth(row.effects)).max())


# Of the stroke. Dry friction turns exactly within a step where its level is constant; one that moves with
# speed or drifts is taken halfway (second order), one that jumps with the direction as at the step's start
# where the joint turns (first). Under a delay off the grid a line stands in a tick for two
# values (third order in it). |v| is rounded over 1 mm/s, the corners of the limit by voltage, which speed
# crosses within a tick, over a thousandth of it. All else is smooth: the stepper's second order at 5 us.
CLOSE = {
    "input_delay": 1e-6,
    "asymmetric_viscous": 1e-6,
    "hysteresis": 1e-6,
    "quadratic_drag": 2e-9,
    "stribeck_friction": 2e-8,
    "velocity_hysteresis": 2e-8,
    "voltage_limit": 2e-8,
    "load_friction": 1e-5,
}


# A profile of limited acceleration brakes from tick to tick in the stepper, at the instant in jaxid:
# test_command_effects compares them to half a tick.
@pytest.mark.parametrize("name", [name for name in ROWS if name != "acceleration_limit"])
def test_motion_is_the_independent_steppers(name):
    row = ROWS[name]
    # break-away acts in the first milliseconds alone: it needs the finer step to stand out
    off = distance(name, 16 if name == "static_friction" else 4)
    removed = float(np.abs(truth(row.effects) - truth(row.effects[:-1])).max())
    assert off < CLOSE.get(name, 1e-9) * STROKE
    assert removed > 20 * off


@pytest.mark.parametrize("name", ["coulomb_friction", "static_friction"])
def test_one_step_a_tick_turns_where_friction_does(name):
    assert distance(name, 1) < 1e-9 * STROKE


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("stribeck_friction", 0.1),
        ("velocity_hysteresis", 0.1),
        ("friction_drift", 0.2),
        ("load_friction", 0.4),
    ],
)
def test_distance_to_the_truth_falls_with_the_step(name, part):
    # Second order, and first, as said above: a sixteenth and a fourth. The error of a drift is so small that
    # the stepper's counts.
    assert distance(name, 16) < part * distance(name, 4)
