"""The five-bar robot against multipliers, its paper's own derivatives, energy, and an exact stepper."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.arms.base_parameters import base_parameters, inertial_regressor
from jaxid.dynamics.rhs import State, acceleration
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.model.balance import port_motion
from jaxid.model.smoothing import Smoothing
from jaxid.plants import FiveBar, righettini_five_bar
from jaxid.simulation.loops import with_diffrax
from truth.five_bar import oracle
from truth.five_bar.oracle import HINGES, ORDERS, Robot, possible_states
from truth.five_bar.stepper import acceleration as stepped

# Unlike in every entry, so that no two can be exchanged unseen.
UNEVEN = Robot(
    length=(0.21, 0.24, 0.27, 0.26, 0.23),
    center=((0.11, 0.02), (0.14, -0.03)),
    mass=(2.1, 2.9),
    inertia=(0.25, 0.33, 0.028, 0.041),
    tip_mass=1.7,
)
FRICTION = {kind: np.random.default_rng(k).uniform(0.1, 2.0, 5) for k, kind in enumerate(ORDERS)}


def plant_of(robot: Robot, **more) -> FiveBar:
    effects = tuple(
        EFFECTS[kind](values[k], port=k) for kind, values in robot.friction.items() for k in range(5)
    )
    own = {name: getattr(robot, name) for name in ("length", "mass", "inertia", "tip_mass")}
    center = jnp.asarray(robot.center)
    return FiveBar(**{k: jnp.asarray(v) for k, v in own.items()}, center=center, effects=effects, **more)


def grid(count=60) -> np.ndarray:
    """All angles of both joints."""
    turn = np.linspace(-np.pi, np.pi, count)
    return np.stack(np.meshgrid(turn, turn), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("robot", [Robot(), UNEVEN], ids=["tables", "uneven"])
def test_closure_holds_on_a_grid_of_all_angles(robot):
    plant = plant_of(robot)
    q = grid()
    pose = jax.vmap(plant.pose)(jnp.asarray(q))
    there = np.isfinite(np.asarray(pose.tool)).all(axis=1)
    assert there.sum() > 800
    distal = np.asarray(pose.distal)[there]
    assert np.abs(np.linalg.norm(distal, axis=-1) - robot.length[3:]).max() < 1e-12
    ground = np.array([[-0.5, 0.0], [0.5, 0.0]]) * robot.length[0]
    proximal = np.linalg.norm(np.asarray(pose.elbow)[there] - ground, axis=-1)
    assert np.abs(proximal - robot.length[1:3]).max() < 1e-12
    # the tool lies left of the way from elbow 1 to elbow 2, which is where p_2 is greater
    assert np.all(distal[:, 0, 0] * distal[:, 1, 1] - distal[:, 0, 1] * distal[:, 1, 0] > 0)
    elbow, tool = np.asarray(pose.elbow)[there], np.asarray(pose.tool)[there]
    way = elbow[:, 1] - elbow[:, 0]
    foot = elbow[:, 0] + way * (np.sum((tool - elbow[:, 0]) * way, 1) / np.sum(way**2, 1))[:, None]
    right = way[:, 0] > 1e-9
    assert right.sum() > 400
    assert np.all((tool - foot)[right, 1] > 0)
    # what is no number is out of reach, or within half a degree of a line: no position is lost
    elbows = np.asarray(pose.elbow)
    apart = np.linalg.norm(elbows[:, 1] - elbows[:, 0], axis=1)
    reach = np.array(robot.length[3:])
    cosine = (np.sum(reach**2) - apart**2) / (2 * np.prod(reach))
    np.testing.assert_array_equal(there, np.abs(cosine) < np.sqrt(1 - 1e-4))


@pytest.mark.parametrize("robot", [Robot(), UNEVEN], ids=["tables", "uneven"])
def test_inverse_kinematics_is_the_working_mode(robot):
    plant = plant_of(robot)
    x, y = np.meshgrid(np.linspace(-0.15, 0.15, 9), np.linspace(0.2, 0.42, 9))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    q = np.asarray(jax.vmap(plant.inverse)(jnp.asarray(points)))
    # low points are those of the other assembly, below the line of the elbows
    there = np.isfinite(q).all(axis=1)
    assert 60 < there.sum()
    assert there[points[:, 1] > 0.25].all()
    points, q = points[there], q[there]
    pose = jax.vmap(plant.pose)(jnp.asarray(q))
    np.testing.assert_allclose(pose.tool, points, rtol=0, atol=1e-12)
    elbow, l = np.asarray(pose.elbow), robot.length
    # the other place of each elbow is its mirror in the way from ground to tool: that of 1 lies to the right
    for k, side in enumerate((-1, 1)):
        ground = np.array([side * l[0] / 2, 0.0])
        way = points - ground
        along = np.sum((elbow[:, k] - ground) * way, axis=1) / np.sum(way**2, axis=1)
        other = 2 * (ground + along[:, None] * way) - elbow[:, k]
        assert np.all(side * elbow[:, k, 0] > side * other[:, 0])
    assert np.isnan(np.asarray(plant.inverse(jnp.array([0.0, 0.9])))).all()


@pytest.mark.slow
def test_derivatives_are_those_of_the_paper():
    """(34)-(37) and (40), (41), with differences of nothing: products of the closure's own derivatives."""
    robot = UNEVEN
    plant = plant_of(robot)
    for q in possible_states(robot, 20)[0]:
        q = jnp.asarray(q)
        pose = plant.pose(q)
        first = jax.jacfwd(plant.pose)(q)
        second = jax.jacfwd(jax.jacfwd(plant.pose))(q)
        turn, turns = (d(plant.angles)(q) for d in (jax.jacfwd, lambda f: jax.jacfwd(jax.jacfwd(f))))
        for i in range(2):
            arm = pose.tool - pose.elbow[i]
            rate = first.tool - first.elbow[i]
            bend = second.tool - second.elbow[i]
            np.testing.assert_allclose(arm @ rate, 0, atol=1e-13)
            both = jnp.einsum("h,hjk->jk", arm, bend) + rate.T @ rate
            np.testing.assert_allclose(both, 0, atol=1e-11)
            square = robot.length[3 + i] ** 2
            np.testing.assert_allclose(turn[i], (arm[0] * rate[1] - arm[1] * rate[0]) / square, atol=1e-12)
            expected = arm[0] * bend[1] - arm[1] * bend[0]
            expected += np.outer(rate[1], rate[0]).T - np.outer(rate[1], rate[0])
            np.testing.assert_allclose(turns[i], expected / square, atol=1e-9)
            # centres of mass by rotation of what they are at phi = 0
            c, s = np.cos(plant.angles(q)[i]), np.sin(plant.angles(q)[i])
            a0, a1 = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
            r = np.array(robot.center[i])
            rows = slice(4 + 2 * i, 6 + 2 * i)
            there = lambda q, rows=rows: plant._moved(q)[rows]
            np.testing.assert_allclose(there(q), pose.elbow[i] + a0 @ r, atol=1e-14)
            np.testing.assert_allclose(
                jax.jacfwd(there)(q), first.elbow[i] + np.outer(a1 @ r, turn[i]), atol=1e-12
            )
            expected = second.elbow[i] + np.einsum("a,jk->ajk", a1 @ r, turns[i])
            expected -= np.einsum("a,j,k->ajk", a0 @ r, turn[i], turn[i])
            np.testing.assert_allclose(jax.jacfwd(jax.jacfwd(there))(q), expected, atol=1e-9)


def test_closure_moves_with_its_lengths_as_differences_say():
    plant, h = plant_of(UNEVEN), 1e-6
    for q in possible_states(UNEVEN, 5)[0]:
        tool = lambda l, q=q: dataclasses.replace(plant, length=l).tool(jnp.asarray(q))
        by = jax.jacfwd(tool)(plant.length)
        for k in range(5):
            ends = []
            for sign in (-1, 1):
                length = np.array(UNEVEN.length)
                length[k] += sign * h
                moved = dataclasses.replace(UNEVEN, length=tuple(length))
                ends.append(oracle.coordinates(moved, q)[8:])
            np.testing.assert_allclose(by[:, k], (ends[1] - ends[0]) / (2 * h), rtol=0, atol=1e-7)


def test_ports_are_the_angles_between_links():
    plant = plant_of(UNEVEN)
    for q, qd, qdd in possible_states(UNEVEN, 50).transpose(1, 0, 2):
        x, v = oracle.moving(UNEVEN, q, qd)
        y, yd, _ = port_motion(plant, *map(jnp.asarray, (q, qd, qdd)))
        phi1, phi2 = x[4], x[7]
        psi = np.array([np.pi - phi2 + q[1], phi2 - phi1, np.pi - q[0] + phi1])
        # up to whole turns; between links there are none to lose within the workspace
        np.testing.assert_allclose(np.exp(1j * y[2:5]), np.exp(1j * psi), atol=1e-12)
        np.testing.assert_allclose(yd[:5], HINGES @ v[oracle.TURNS], atol=1e-11)
        np.testing.assert_allclose(y[5:], x[8:], atol=1e-13)
        np.testing.assert_allclose(yd[5:], v[8:], atol=1e-12)
        phi = np.asarray(plant.angles(jnp.asarray(q)))
        np.testing.assert_allclose(np.exp(1j * phi), np.exp(1j * x[[4, 7]]), atol=1e-12)
    # a distal link that passes the x axis backwards is no jump
    q = jnp.linspace(1.9, 2.6, 400)
    moved = np.asarray(jax.vmap(lambda b: plant.ports(jnp.array([3.3, b])))(q))
    phi = np.asarray(jax.vmap(lambda b: plant.angles(jnp.array([3.3, b])))(q))[:, 1]
    assert np.abs(np.diff(phi)).max() > 6
    assert np.abs(np.diff(moved, axis=0)).max() < 0.02


@pytest.mark.parametrize("robot", [Robot(), UNEVEN], ids=["tables", "uneven"])
def test_inverse_dynamics_is_that_of_the_multipliers(robot):
    robot = Robot(**{**robot.__dict__, "friction": FRICTION})
    plant = plant_of(robot, smoothing=Smoothing(1e-12))
    states = possible_states(robot, 200)
    none, now = (None,) * len(plant.effects), jnp.zeros(())
    ask = jax.jit(jax.vmap(lambda q, v, a: plant.balance(q, v, a, jnp.zeros(2), now, none).residual))
    ours = np.asarray(ask(*map(jnp.asarray, states)))
    theirs = np.array([oracle.inverse_dynamics(robot, *state) for state in states.transpose(1, 0, 2)])
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10 * np.abs(theirs).max())
    each = np.linalg.norm(ours - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
    assert each.max() < 1e-9
    # and back: by the plant's balance, by multipliers, and by the stepper that makes logs
    for q, v, a, torque in zip(*states[:, :20], theirs, strict=False):
        state = State(jnp.asarray(q), jnp.asarray(v), none)
        np.testing.assert_allclose(acceleration(plant, state, jnp.asarray(torque), now), a, rtol=1e-8)
        np.testing.assert_allclose(oracle.forward_dynamics(robot, q, v, torque), a, rtol=1e-8)
        np.testing.assert_allclose(stepped(robot, q, v, torque), a, rtol=0, atol=1e-4 * np.abs(a).max())


def test_rate_of_the_mass_matrix_is_what_coriolis_leaves():
    """q' (dM/dt - 2 C) q' = 0, and M is symmetric and positive."""
    plant = plant_of(UNEVEN)
    zero = jnp.zeros(2)
    mass = jax.jit(jax.jacfwd(plant.inertial, argnums=2))
    for q, qd, _ in possible_states(UNEVEN, 20).transpose(1, 0, 2):
        q, qd = jnp.asarray(q), jnp.asarray(qd)
        m, rate = jax.jvp(lambda q: mass(q, zero, zero), (q,), (qd,))
        np.testing.assert_allclose(m, m.T, rtol=1e-12, atol=1e-14)
        assert np.linalg.eigvalsh(m)[0] > 0
        power = qd @ plant.inertial(q, qd, zero)
        np.testing.assert_allclose(0.5 * qd @ rate @ qd, power, rtol=1e-10)
        energy = oracle.kinetic_energy(UNEVEN, np.asarray(q), np.asarray(qd))
        np.testing.assert_allclose(0.5 * qd @ m @ qd, energy, rtol=1e-12)


def test_energy_stays_without_friction():
    """Springs at both joints and at the tool's hinge turn the motion round; the rest is the bars' own."""
    k, tension, q0 = np.array([40.0, 30.0]), 6.0, np.array([2.0, 1.1])
    spring = EFFECTS["linear_stiffness"]
    effects = tuple(spring(float(x), port=i) for i, x in enumerate(k)) + (spring(tension, port=3),)
    plant = FiveBar(
        **{f: jnp.asarray(getattr(UNEVEN, f)) for f in ("length", "center", "mass", "inertia", "tip_mass")},
        effects=effects,
    )
    hold = jnp.asarray(k * q0)
    times = jnp.linspace(0.0, 2.0, 101)
    start = jnp.asarray(q0), jnp.array([1.0, -1.5])
    steps = diffrax.PIDController(rtol=1e-11, atol=1e-12)
    q, v = with_diffrax(plant, lambda t: hold, times, *start, solver=diffrax.Dopri8(), controller=steps)

    def energy(q, v):
        psi = oracle.coordinates(UNEVEN, q)[[7, 4]] @ [1, -1]
        stored = 0.5 * k @ q**2 - k * q0 @ q + 0.5 * tension * psi**2
        return oracle.kinetic_energy(UNEVEN, q, v), stored

    kinetic, stored = np.array([energy(*x) for x in zip(np.asarray(q), np.asarray(v), strict=True)]).T
    assert np.ptp(kinetic) > 0.5 * kinetic.max()
    assert np.ptp(kinetic + stored) < 1e-8 * kinetic.max()


def test_friction_takes_what_the_hinges_turn():
    robot = Robot(friction=FRICTION)
    plant = plant_of(robot, smoothing=Smoothing(1e-12))
    none = (None,) * len(plant.effects)
    for q, qd, _ in possible_states(robot, 10).transpose(1, 0, 2):
        zero = jnp.zeros(2)
        with_it = plant.balance(jnp.asarray(q), jnp.asarray(qd), zero, zero, jnp.zeros(()), none).residual
        force = with_it - plant.inertial(jnp.asarray(q), jnp.asarray(qd), zero)
        rates = HINGES @ oracle.moving(robot, q, qd)[1][oracle.TURNS]
        np.testing.assert_allclose(qd @ force, -rates @ oracle.friction_of(robot, rates), rtol=1e-11)
        assert qd @ force > 0


def test_payload_is_a_mass_at_the_tool():
    """One effect on the tool acts along both of its coordinates, as more of the tip's mass would."""
    bare = righettini_five_bar()
    loaded = righettini_five_bar((EFFECTS["added_mass"](0.7, port=5),))
    heavier = plant_of(Robot(tip_mass=2.72 + 0.7))
    zero, now = jnp.zeros(2), jnp.zeros(())
    for state in possible_states(Robot(), 10).transpose(1, 0, 2):
        state = [jnp.asarray(x) for x in state]
        ours = loaded.balance(*state, zero, now, (None,))
        np.testing.assert_allclose(ours.residual, heavier.inertial(*state), rtol=1e-12, atol=1e-12)
        assert np.abs(ours.residual - bare.inertial(*state)).max() > 1e-3
        assert ours.rates == (None,)
    assert loaded.place(5) == ("tool", 1)
    assert [bare.place(k) for k in range(5)] == [
        ("joint", 1),
        ("joint", 2),
        ("passive", 1),
        ("passive", 2),
        ("passive", 3),
    ]


def test_search_may_name_what_there_can_be():
    plant = righettini_five_bar()
    offered = {k: {kind for kind, e in EFFECTS.items() if plant.accepts(e, k, 2)} for k in range(7)}
    assert offered[5] == {"added_mass"}
    assert offered[6] == set()
    assert {"coulomb_friction", "cubic_friction"} < offered[2] == offered[4]
    assert not {"added_mass", "actuator_gain", "joint_flexibility"} & offered[2]
    assert {"added_mass", "actuator_gain"} < offered[0]
    mass = EFFECTS["added_mass"]
    twins = [plant.equivalent_parameter(mass, k) for k in range(6)]
    assert twins == [("inertia", 0), ("inertia", 1), None, None, None, ("tip_mass", None)]


@pytest.mark.parametrize(
    ("q", "words"),
    [
        ([3.1, 0.1], "out of reach: elbows 0.6787 m apart, distal links of 0.25 and 0.25 m"),
        ([np.arccos(-0.64) - 1e-5, np.arccos(0.64) + 1e-5], "one line, a singular configuration"),
    ],
)
def test_positions_that_cannot_be_are_named(q, words):
    plant = righettini_five_bar()
    fine = [2.0, 1.1]
    assert plant.impossible(np.array([fine, fine])) is None
    row, what = plant.impossible(np.array([fine, fine, q, q]))
    assert row == 2
    assert words in what
    assert np.isnan(np.asarray(plant.inertial(jnp.asarray(q), jnp.ones(2), jnp.ones(2)))).all()


def test_base_parameters_are_of_positions_that_can_be():
    plant = plant_of(UNEVEN)
    found, state = base_parameters(plant), jnp.array([[2.0, 1.1], [1.0, -2.0], [3.0, 1.0]])
    # Not every pair of angles is possible; the masses and inertias all are.
    assert len(found.chosen) == len(found.names) == 7
    rows = np.asarray(inertial_regressor(plant, *state[:, None]))[0]
    np.testing.assert_allclose(rows @ found.of(plant), plant.inertial(*state), rtol=1e-9)


@pytest.mark.slow
def test_lengths_that_close_nowhere_are_refused():
    plant = plant_of(dataclasses.replace(UNEVEN, length=(3.0, 0.24, 0.27, 0.26, 0.23)))
    with pytest.raises(InputError, match="five_bar' cannot take any position; check its lengths"):
        plant.any_motion(np.random.default_rng(0))


def test_condition_is_that_of_the_eigenvalues():
    plant = plant_of(UNEVEN)
    for q in possible_states(UNEVEN, 20)[0]:
        jacobian = np.asarray(jax.jacfwd(plant.tool)(jnp.asarray(q)))
        low, high = np.linalg.eigvalsh(jacobian.T @ jacobian)
        np.testing.assert_allclose(plant.condition(jnp.asarray(q)), low / high, rtol=1e-9, atol=1e-12)


def test_tables_are_the_published_ones():
    plant, robot = righettini_five_bar(), Robot()
    for name in ("length", "center", "mass", "inertia", "tip_mass"):
        np.testing.assert_array_equal(getattr(plant, name), getattr(robot, name))


def test_frames_of_the_links_are_where_the_oracle_has_them():
    plant, q = righettini_five_bar(), np.array([1.9, 1.24])
    x = oracle.coordinates(Robot(), q)
    centers = (None, None, x[2:4], x[5:7])
    for link, (turn, center) in enumerate(zip(x[[0, 1, 4, 7]], centers, strict=True)):
        axes, origin = plant.frame(link, jnp.asarray(q))
        turned = [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
        np.testing.assert_allclose(axes, turned, atol=1e-14)
        if center is None:
            np.testing.assert_allclose(origin, [(-0.09, 0.09)[link], 0, 0], atol=1e-15)
        else:
            at = axes @ np.array([*plant.center[link - 2], 0.0]) + origin
            np.testing.assert_allclose(at, [*center, 0.0], atol=1e-14)
