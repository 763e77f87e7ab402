"""Inverse dynamics of the arm against energies, Pinocchio and MuJoCo; energy and linearity."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio
import pytest

from jaxid.dynamics.rhs import State, acceleration, step
from jaxid.effects import EFFECTS
from jaxid.model.parameter import parameters_of
from jaxid.plants import DenavitHartenberg, SerialArm, pa10
from truth.arm import oracle as arm_oracle

PA10 = [
    (joint, *numbers)
    for joint, *numbers in zip(
        pa10().joints, *(np.asarray(getattr(pa10(), k)) for k in ("alpha", "a", "d", "theta")), strict=True
    )
]
ROWS = {
    "pa10": PA10,
    "scara": [
        ("revolute", 0.0, 0.0, 0.2, 0.3),
        ("revolute", 0.0, 0.4, 0.0, -0.2),
        ("prismatic", np.pi, 0.3, 0.1, 0.5),
    ],
    "general": [
        ("prismatic", 0.4, 0.1, 0.2, -0.3),
        ("revolute", -1.1, 0.3, -0.2, 0.7),
        ("revolute", 0.9, -0.2, 0.1, 0.2),
        ("prismatic", 1.7, 0.25, 0.05, -1.0),
        ("revolute", -0.6, 0.15, 0.3, 0.1),
    ],
}
GRAVITY = np.array([1.5, -2.0, -9.2])


def arm(rows, parameters, gravity=GRAVITY, **more) -> SerialArm:
    columns = dict(zip(arm_oracle.NAMES, jnp.asarray(parameters).T, strict=True))
    geometry = DenavitHartenberg.of_rows(rows)
    return SerialArm(**columns, geometry=geometry, gravity_vector=jnp.asarray(gravity), **more)


def case(name, seed=0):
    rng = np.random.default_rng(seed)
    rows = ROWS[name]
    parameters = arm_oracle.bodies(len(rows), rng)
    return rows, parameters, rng.uniform(-2, 2, (3, len(rows)))


def close(a, b):
    # 1e-10 of the largest torque: both sides add up some hundred products in another order.
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * np.abs(b).max())


@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize("seed", range(3))
def test_inverse_dynamics_is_that_of_the_energies(name, seed):
    rows, parameters, (q, qd, qdd) = case(name, seed)
    plant, zero = arm(rows, parameters), np.zeros(len(rows))
    close(plant.inertial(q, qd, qdd), arm_oracle.inverse_dynamics(rows, parameters, q, qd, qdd, GRAVITY))
    weight = plant.inertial(jnp.asarray(q), zero, zero)
    close(weight, arm_oracle.gravity_torque(rows, parameters, q, GRAVITY))
    mass = jax.jacfwd(lambda a: plant.inertial(q, qd, a))(jnp.zeros(len(rows)))
    close(mass, arm_oracle.mass_matrix(rows, parameters, q))
    coriolis = plant.inertial(q, qd, zero) - weight
    close(coriolis, arm_oracle.inverse_dynamics(rows, parameters, q, qd, zero, 0 * GRAVITY))


def states(name, count=1000):
    """Random states of an arm: position, velocity and acceleration, (count, n) each."""
    return np.random.default_rng(17).uniform(-2, 2, (3, count, len(ROWS[name])))


def close_at_each(a, b):
    # As `close`, relative to the largest entry at each state.
    axes = tuple(range(1, np.ndim(b)))
    off = np.abs(np.asarray(a) - b).max(axis=axes) / np.abs(b).max(axis=axes)
    assert off.shape == (1000,)
    assert off.max() < 1e-10, (off.argmax(), off.max())


@pytest.mark.parametrize("name", ROWS)
def test_inverse_dynamics_is_pinocchios(name):
    """Torques, mass matrices, weights and Coriolis forces at 1000 states."""
    rows, parameters, _ = case(name)
    q, qd, qdd = states(name)
    model = pinocchio.Model()
    before = 0
    for k, ((joint, *dh), body) in enumerate(zip(rows, parameters, strict=True)):
        home = arm_oracle.transforms([(joint, *dh)], [0.0])[0]
        kind = pinocchio.JointModelRZ() if joint == "revolute" else pinocchio.JointModelPZ()
        place = pinocchio.SE3(home[:3, :3], home[:3, 3])
        before = model.addJoint(before, kind, place, f"joint{k}")
        # mass, first moments, then xx xy yy xz yz zz about the joint's origin
        order = pinocchio.Inertia.FromDynamicParameters(body[[0, 1, 2, 3, 4, 5, 7, 6, 8, 9]])
        model.appendBodyToJoint(before, order, pinocchio.SE3.Identity())
    model.gravity.linear = GRAVITY
    data, plant, zero = model.createData(), arm(rows, parameters), np.zeros(len(rows))

    @jax.jit
    @jax.vmap
    def ours(q, qd, qdd):
        mass = jax.jacfwd(lambda a: plant.inertial(q, qd, a))(qdd)
        weight = plant.inertial(q, zero, zero)
        return plant.inertial(q, qd, qdd), mass, weight, plant.inertial(q, qd, zero)

    def theirs(q, qd, qdd):
        mass = np.triu(pinocchio.crba(model, data, q))
        return (
            np.array(pinocchio.rnea(model, data, q, qd, qdd)),
            mass + np.triu(mass, 1).T,
            np.array(pinocchio.computeGeneralizedGravity(model, data, q)),
            np.array(pinocchio.nonLinearEffects(model, data, q, qd)),
        )

    expected = [np.array(x) for x in zip(*map(theirs, q, qd, qdd), strict=True)]
    for a, b in zip(ours(q, qd, qdd), expected, strict=True):
        close_at_each(a, b)


def mujoco_model(mujoco, rows, parameters, gravity, sites=(), sensors=""):
    """The arm as nested bodies; MuJoCo counts inertia about the centre of mass.

    sites: what else is on each link; sensors: what reads it; both as MuJoCo writes them.
    """
    words = " ".join
    text, tail = "", ""
    sites = sites or [""] * len(rows)
    for (joint, *dh), body, site in zip(rows, parameters, sites, strict=True):
        m, x, y, z, xx, xy, xz, yy, yz, zz = body
        home = arm_oracle.transforms([(joint, *dh)], [0.0])[0]
        axes = words(repr(float(v)) for v in home[:3, :2].T.ravel())
        com = np.array([x, y, z]) / m
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        own = tensor - m * (com @ com * np.eye(3) - np.outer(com, com))
        full = words(repr(float(own[i])) for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        kind = "hinge" if joint == "revolute" else "slide"
        text += (
            f'<body pos="{words(repr(float(v)) for v in home[:3, 3])}" xyaxes="{axes}">'
            f'<joint type="{kind}" axis="0 0 1"/>'
            f'<inertial pos="{words(repr(float(v)) for v in com)}" mass="{float(m)!r}" fullinertia="{full}"/>'
            f"{site}"
        )
        tail += "</body>"
    weight = words(repr(float(v)) for v in gravity)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option gravity="{weight}"><flag contact="disable"/></option>'
        f"<worldbody>{text}{tail}</worldbody><sensor>{sensors}</sensor></mujoco>"
    )


@pytest.mark.parametrize("name", ROWS)
def test_inverse_dynamics_is_mujocos(name):
    rows, parameters, _ = case(name)
    q, qd, qdd = states(name)
    model = mujoco_model(mujoco, rows, parameters, GRAVITY)
    data = mujoco.MjData(model)

    def theirs(q, qd, qdd):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        return data.qfrc_inverse.copy()

    # MuJoCo diagonalises each inertia and keeps its axes as a quaternion: 1e-10 still holds.
    ours = jax.jit(jax.vmap(arm(rows, parameters).inertial))(q, qd, qdd)
    close_at_each(ours, np.array(list(map(theirs, q, qd, qdd))))


def test_regressor_is_linear_and_whole():
    rows, parameters, (q, qd, qdd) = case("general")
    torque = lambda x: arm(rows, x).inertial(q, qd, qdd)
    columns = jax.jacfwd(torque)(jnp.asarray(parameters))
    close(jnp.einsum("ikp,kp->i", columns, parameters), torque(parameters))
    elsewhere = jax.jacfwd(torque)(3.0 * jnp.asarray(parameters) + 1.0)
    np.testing.assert_allclose(columns, elsewhere, rtol=0, atol=1e-12 * float(jnp.abs(columns).max()))


def test_energy_stays_without_friction():
    rows, parameters, _ = case("general")
    plant = arm(rows, parameters)
    x = State(jnp.array([0.1, 0.5, -0.4, 0.2, 1.0]), jnp.array([0.2, -1.0, 0.5, 0.3, 2.0]), ())
    none, h = jnp.zeros(5), 1e-3

    def energy(x):
        mass = arm_oracle.mass_matrix(rows, parameters, np.asarray(x.q))
        first = arm_oracle.pseudo_inertias(parameters)[:, :, 3]
        centres = np.einsum("imn,in->im", arm_oracle.transforms(rows, np.asarray(x.q)), first)
        return 0.5 * x.qd @ mass @ x.qd - np.sum(centres[:, :3] @ GRAVITY)

    advance = jax.jit(
        lambda x: jax.lax.fori_loop(0, 500, lambda k, x: step(plant, x, lambda s: none, 0.0, h), x)
    )
    start, end = energy(x), energy(advance(x))
    moved = 0.5 * x.qd @ arm_oracle.mass_matrix(rows, parameters, np.asarray(x.q)) @ x.qd
    # a fourth-order step of 1 ms
    assert abs(end - start) < 1e-8 * moved


def test_rotor_inertia_and_friction_stand_beside_the_links():
    rows, parameters, (q, qd, qdd) = case("scara")
    bare = arm(rows, parameters)
    friction = (EFFECTS["viscous_friction"](2.0, port=1),)
    geared = arm(rows, parameters, rotor_inertia=[0.1, 0.2, 0.3], effects=friction)
    now = jnp.zeros(())
    balance = geared.balance(q, qd, qdd, jnp.zeros(3), now, (None,))
    more = np.array([0.1, 0.2, 0.3]) * qdd + np.array([0.0, 2.0, 0.0]) * qd
    np.testing.assert_allclose(balance.residual, bare.inertial(q, qd, qdd) + more, rtol=1e-12)
    state = State(jnp.asarray(q), jnp.asarray(qd), (None,))
    there = acceleration(geared, state, balance.residual, now)
    np.testing.assert_allclose(there, qdd, rtol=1e-9)


def test_units_of_a_joint_are_those_of_its_motion():
    plant = arm(ROWS["scara"], np.ones((3, 10)))
    assert [plant.motion(k) for k in range(3)] == ["rotary", "rotary", "linear"]
    assert plant.joints == 3
    assert plant.own_inertia() is None
    # a force on a joint stands in no other's balance, so that a search shares its columns
    assert [plant.joints_loaded_by(k, 3) for k in range(3)] == [(0,), (1,), (2,)]
    assert set(arm_oracle.NAMES) < set(parameters_of(SerialArm))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "at least one joint"),
        ([("revolute", 0.0, 0.0, 0.0)], "row 1 has 4 columns; give joint, alpha, a, d, theta"),
        ([("helical", 0.0, 0.0, 0.0, 0.0)], "joint 1 is 'helical'; take one of revolute, prismatic"),
    ],
)
def test_impossible_geometry_is_refused(rows, words):
    with pytest.raises(ValueError, match=words):
        DenavitHartenberg.of_rows(rows)


def test_columns_of_other_lengths_are_refused():
    with pytest.raises(ValueError, match=r"d has shape \(2,\); give 1, one a joint"):
        DenavitHartenberg(("revolute",), [0.0], [0.0], [0.0, 1.0], [0.0])
