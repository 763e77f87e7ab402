"""Gyroscopes and accelerometers: MuJoCo's readings, fusion, range, calibration, and a loop with them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.spatial.transform

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.commands.simulate import simulate
from jaxid.errors import InputError
from jaxid.sensors.inertial import Inertial, InertialSensors, calibrate, scale_factor
from tests.plants.test_serial_arm import GRAVITY, ROWS, arm, case, mujoco_model
from truth.arm.two_links_case import TRUTH, written

BOTH = ("gyroscope", "accelerometer")


def mounted(links: int, seed: int = 0) -> tuple[Inertial, ...]:
    """A sensor of each kind on each link, turned and off its origin."""
    rng = np.random.default_rng(seed)
    out = []
    for link in range(links):
        place, turn = rng.uniform(-0.3, 0.3, 3), rng.uniform(-1.5, 1.5, 3)
        for kind in BOTH:
            at = tuple(place) if kind == "accelerometer" else (0.0, 0.0, 0.0)
            out.append(Inertial(kind, link, 1e-3, position=at, rotation=tuple(turn)))
    return tuple(out)


def as_site(sensor: Inertial, name: str) -> str:
    turn = scipy.spatial.transform.Rotation.from_rotvec(np.array(sensor.rotation))
    quaternion = turn.as_quat(scalar_first=True)
    words = [" ".join(repr(float(v)) for v in x) for x in (sensor.position, quaternion)]
    return f'<site name="{name}" pos="{words[0]}" quat="{words[1]}"/>'


@pytest.mark.parametrize("name", ROWS)
def test_readings_are_mujocos(name):
    rows, parameters, (q, qd, qdd) = case(name)
    sensors = mounted(len(rows))
    pairs = list(enumerate(sensors))
    sites = ["".join(as_site(s, f"s{k}") for k, s in pairs if s.link == link) for link in range(len(rows))]
    tags = {"gyroscope": "gyro", "accelerometer": "accelerometer"}
    text = "".join(f'<{tags[s.kind]} site="s{k}"/>' for k, s in pairs)
    model = mujoco_model(mujoco, rows, parameters, GRAVITY, sites, text)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
    mujoco.mj_inverse(model, data)
    # The forces that give these accelerations: its sensors read what forward dynamics finds.
    data.qfrc_applied[:] = data.qfrc_inverse
    mujoco.mj_forward(model, data)
    plant = arm(rows, parameters)
    ours = InertialSensors(sensors, sensors).read(plant, *(jnp.asarray(x) for x in (q, qd, qdd)))
    np.testing.assert_allclose(ours, data.sensordata, rtol=1e-8, atol=1e-8 * np.abs(data.sensordata).max())
    assert np.abs(data.sensordata).max() > 5


def test_fusion_returns_the_motion():
    """Revolute joints' velocities by gyroscopes; all accelerations by accelerometers on every link."""
    rows, parameters, (q, qd, qdd) = case("general")
    plant, n = arm(rows, parameters), len(rows)
    turns = np.array([r[0] == "revolute" for r in rows])
    sensors = mounted(n)
    suite, still = InertialSensors(sensors, sensors), jnp.zeros(n)
    readings = suite.read(plant, jnp.asarray(q), jnp.asarray(qd), jnp.asarray(qdd))
    velocity, acceleration, sound = suite.fused(plant, jnp.asarray(q), readings, still, still)
    np.testing.assert_allclose(np.asarray(velocity)[turns], qd[turns], atol=1e-6)
    # What slides turns nothing: a gyroscope does not tell it, and that is said.
    assert bool(sound) == turns.all()
    if turns.all():
        np.testing.assert_allclose(acceleration, qdd, atol=1e-5)


def planar(*sensors: Inertial, known: tuple = (), hold: int = 1):
    plant = build_machine(load_case(planar.case)).plant
    return plant, InertialSensors(sensors, known or sensors, hold)


@pytest.fixture(autouse=True)
def _two_links(tmp_path):
    planar.case = written(tmp_path)


MOTION = [jnp.asarray(x) for x in ([0.4, 0.9], [1.5, -2.0], [10.0, -20.0])]
ZERO = jnp.zeros(2)


def test_redundant_readings_are_weighed():
    """Two gyroscopes on the last link, one five times as noisy: the variance is that of the weights' sum."""
    first = Inertial("gyroscope", 0, 1e-3, (2,))
    one = Inertial("gyroscope", 1, 2e-3, (2,))
    other = Inertial("gyroscope", 1, 1e-2, (2,), scale=1.3, bias=0.2)
    plant, suite = planar(first, one, other)
    noise = jax.random.normal(jax.random.key(0), (4000, 3))
    q, qd, qdd = MOTION

    def found(noise):
        return suite.fused(plant, q, suite.read(plant, q, qd, qdd, noise), ZERO, ZERO)[0]

    velocity = np.asarray(eqx.filter_jit(jax.vmap(found))(noise))
    np.testing.assert_allclose(velocity.mean(axis=0), qd, atol=4e-4 * 3)
    joint2 = np.sqrt(1e-3**2 + 1 / (1 / 2e-3**2 + (1.3 / 1e-2) ** 2))
    # Of 4000 draws, a standard deviation to 1.1 %.
    np.testing.assert_allclose(velocity.std(axis=0), [1e-3, joint2], rtol=0.04)


def test_what_is_out_of_range_does_not_count():
    q, qd, qdd = MOTION
    gyros = [Inertial("gyroscope", k, 1e-3) for k in (0, 1)]
    meters = [
        Inertial("accelerometer", 0, 0.1, position=(0.2, 0.0, 0.0)),
        Inertial("accelerometer", 1, 0.1, position=(0.2, 0.0, 0.0)),
        Inertial("accelerometer", 1, 0.1, position=(0.05, 0.0, 0.0), range=4.0),
    ]
    held = jnp.asarray([3.0, 4.0])
    plant, suite = planar(*gyros, *meters)
    readings = suite.read(plant, q, qd, qdd)
    assert float(jnp.abs(readings[-3:]).max()) == 4.0
    _, acceleration, sound = suite.fused(plant, q, readings, ZERO, held)
    assert sound
    np.testing.assert_allclose(acceleration, qdd, atol=1e-5)
    # Taken at their word, clipped readings would be off by metres per second squared.
    blind = eqx.tree_at(lambda s: [k.range for k in s.known], suite, [np.inf] * 5)
    assert np.abs(blind.fused(plant, q, readings, ZERO, held)[1] - qdd).max() > 1.0
    # Alone it tells nothing of joint 2: what was held stays, and that is said.
    plant, suite = planar(*gyros, meters[0], meters[2])
    suite = eqx.tree_at(lambda s: s.sensors[3].range, suite, 1e-3)
    suite = eqx.tree_at(lambda s: s.known[3].range, suite, 1e-3)
    _, acceleration, sound = suite.fused(plant, q, suite.read(plant, q, qd, qdd), ZERO, held)
    assert not sound
    np.testing.assert_allclose(acceleration, [qdd[0], held[1]], atol=1e-4)


def test_weight_stands_in_a_resting_accelerometer():
    sensor = Inertial("accelerometer", 1, 0.1, rotation=(0.0, 0.0, np.pi / 2))
    gyro = Inertial("gyroscope", 1, 0.1)
    plant, suite = planar(gyro, sensor)
    readings = suite.read(plant, jnp.asarray([0.0, 0.0]), ZERO, ZERO)
    # The sensor's x axis points up: 9.81 m/s^2, upwards.
    np.testing.assert_allclose(readings, [0, 0, 0, 9.81, 0, 0], atol=1e-12)


def test_calibration_finds_scale_mounting_and_bias():
    rng = np.random.default_rng(1)
    known = rng.uniform(-5, 5, (2000, 3))
    turn = scipy.spatial.transform.Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix()
    matrix, bias, noise = np.diag([1.02, 0.97, 1.01]) @ turn.T, np.array([0.1, -0.05, 0.02]), 0.05
    raw = known @ matrix.T + bias + noise * rng.standard_normal((2000, 3))
    found, offset, std = calibrate(raw, known)
    scores = np.concatenate([((found - matrix) / std[:, :3]).ravel(), (offset - bias) / std[:, 3]])
    assert np.abs(scores).max() < 3.5
    assert 0.5 < scores.std() < 1.6
    np.testing.assert_allclose(std[:, 3], noise / np.sqrt(2000), rtol=0.05)
    with pytest.raises(ValueError, match="does not turn"):
        calibrate(raw, np.outer(known[:, 0], [0.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match="4 samples do not determine"):
        calibrate(raw[:4], known[:4])


def test_the_papers_factor_is_low_by_the_noise():
    """(47): a gyroscope that reads 4 % too much, of uniform velocities up to 3.67 rad/s, noise 0.5 rad/s."""
    rng = np.random.default_rng(2)
    speed = rng.uniform(-3.67, 3.67, 40000)
    assert scale_factor(1.04 * speed, speed) == pytest.approx(1 / 1.04, rel=1e-12)
    power = 1.04**2 * 3.67**2 / 3
    noisy = scale_factor(1.04 * speed + 0.5 * rng.standard_normal(40000), speed)
    assert noisy == pytest.approx(power / (power + 0.25) / 1.04, rel=2e-3)


def suite_text(*, calibrated: bool = True, scale: float = 1.0, rate: str = "rate = 1000.0") -> str:
    parts = []
    for link in (1, 2):
        for kind, noise, bound in (("gyroscope", 2e-3, 17.45), ("accelerometer", 0.05, 78.5)):
            place = "position = [0.2, 0.0, 0.0]" if kind == "accelerometer" else ""
            parts.append(
                f'[[inertial_sensors]]\nkind = "{kind}"\nlink = {link}\nnoise = {noise}\nrange = {bound}\n'
                f"{rate}\n"
                f"scale = {scale}\ncalibrated = {str(calibrated).lower()}\n{place}\n"
            )
    return "force_noise = 0.1\n" + "".join(parts)


@pytest.mark.slow
def test_a_loop_learns_by_inertial_sensors(tmp_path):
    """4 kHz, sensors at 1 kHz, exact sticking: all found; with 4 % of scale that nobody knows, not."""
    run = simulate(written(tmp_path, "", 2.0, suite_text(scale=1.04)))
    error = np.asarray(run.trajectory.position) - run.log.reference
    assert np.asarray(run.trajectory.found.closed)[5000]
    np.testing.assert_allclose(run.trajectory.found.theta[-1], TRUTH, rtol=0.02)
    assert np.abs(error[6000:]).max() < 4e-4
    naive = simulate(written(tmp_path, "", 2.0, suite_text(scale=1.04, calibrated=False)))
    off = np.asarray(naive.trajectory.found.theta[-1]) / TRUTH - 1
    assert np.abs(off[:2]).max() > 0.02


REFUSED = [
    ('kind = "gyro"\nlink = 1\nnoise = 1.0', "kind = \"gyro\" is unknown; did you mean 'gyroscope'"),
    ('kind = "gyroscope"\nlink = 3\nnoise = 1.0', "link = 3 does not exist; the plant has 2 links"),
    ('kind = "gyroscope"\nlink = 1', "'noise' is missing"),
    (
        'kind = "gyroscope"\nlink = 1\nnoise = 1.0',
        "the gyroscopes do not determine the motion of every joint",
    ),
    ('kind = "gyroscope"\nlink = 2\nnoise = 1.0\naxes = ["z"]', "do not determine the motion of every joint"),
    ('kind = "gyroscope"\nlink = 1\nnoise = 1.0\naxes = ["z", "z"]', "names an axis twice"),
    ('kind = "gyroscope"\nlink = 1\nnoise = 1.0\naxes = ["z"]\nscale = [1.0, 1.0]', "scale .* has 2 entries"),
    ('kind = "gyroscope"\nlink = 1\nnoise = 1.0\nposition = [0.0, 0.0, 0.1]', "is a key of accelerometers"),
    ('kind = "accelerometer"\nlink = 1\nnoise = 1.0', "there are accelerometers only; add gyroscopes"),
    ('kind = "gyroscope"\nlink = 2\nnoise = 1.0\nrate = 3000.0', "rate = 3000 Hz does not fit the loop"),
    ('kind = "gyroscope"\nlink = 2\nnoise = 1.0\nrotation = [0.0]', "rotation .* has 1 entry"),
]


@pytest.mark.parametrize(("sensor", "match"), REFUSED)
def test_refuses(tmp_path, sensor, match):
    path = written(tmp_path, sensor=f"[[inertial_sensors]]\n{sensor}")
    with pytest.raises(InputError, match=match) as caught:
        build_machine(load_case(path), period=2.5e-4)
    assert "\n" not in str(caught.value)


def test_refuses_a_plant_without_links(tmp_path):
    path = tmp_path / "axis.toml"
    path.write_text(
        '[plant]\nkind = "axis"\n[plant.parameters]\ninertia = 1.0\n'
        '[[inertial_sensors]]\nkind = "gyroscope"\nlink = 1\nnoise = 1.0\n'
    )
    with pytest.raises(InputError, match="the plant has no links"):
        load_case(path)
