"""Computed torque and adaptive: split of the forces, errors that shrink, estimates, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.commands.live import Live
from jaxid.commands.simulate import simulate
from jaxid.controllers import Tick
from jaxid.controllers.computed_torque import ComputedTorque, inverse_dynamics
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.plants import Axis
from jaxid.simulation.loops import Drive, closed_loop
from tests.support.adaptive_arm import driven
from truth.arm.two_links import TwoLinks
from truth.arm.two_links_case import TEXT, TRUTH, written

ENCODER = "velocity_average = 4\nreach = 8"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Run one arm with its sensors and course under three laws."""
    folder = tmp_path_factory.mktemp("laws")
    laws = {
        "pd": 'kind = "computed_torque"\ndynamics = false\nvelocity_average = 4',
        "computed_torque": 'kind = "computed_torque"\nvelocity_average = 4',
        "adaptive": ENCODER,
    }
    return {k: driven(written(folder, law), encoder=2e-6, torque=0.1) for k, law in laws.items()}


def test_errors_shrink_by_what_is_fed_forward(runs):
    """Computed torque leaves what friction makes of a PD's error, the adaptive law a fiftieth of that."""
    pd, torque, adaptive = (runs[k].rms() for k in ("pd", "computed_torque", "adaptive"))
    assert np.all(pd > 2 * torque)
    assert np.all(torque > 50 * adaptive)
    assert np.all(adaptive < 5e-5)


def test_it_learns_from_encoders_alone(runs):
    live = runs["adaptive"].live
    assert live.machine.parameters.names[::2] == [
        "actuator_gain[1].gain",
        "viscous_friction[1].coefficient",
        "coulomb_friction[1].level",
    ]
    start = live.machine.parameters.guess
    assert not np.any(np.abs(start - TRUTH) < 0.05 * TRUTH)
    np.testing.assert_allclose(live.estimate.theta, TRUTH, rtol=0.01)
    # Of differences of positions neighbours cancel: the deviations given are too large, not too small.
    assert np.all(np.abs(live.estimate.theta - TRUTH) < 3 * np.asarray(live.estimate.std))


def test_a_cold_start_is_computed_torque_until_it_closes(runs):
    cold, plain = runs["adaptive"].command, runs["computed_torque"].command
    closed = runs["adaptive"].live.switched
    assert 400 < closed < 6000
    # Until then not a bit differs; then the command does, for the better.
    np.testing.assert_allclose(cold[:closed], plain[:closed], rtol=1e-12, atol=1e-12)
    assert np.abs(cold[closed] - plain[closed]).max() > 0.5


@pytest.mark.slow
def test_estimates_are_within_their_deviations(tmp_path):
    """Velocity, acceleration and torque with white noise: errors are of the size of their deviations."""
    scores = []
    for seed in range(2):
        ran = driven(
            written(tmp_path, "half_life = 600.0", 1.5),
            encoder=1e-6,
            torque=0.1,
            inertial=(1e-3, 0.5),
            seed=seed,
        )
        told = ran.live.estimate
        assert ran.live.switched is not None
        scores.append((told.theta - TRUTH) / told.std)
    scores = np.array(scores)
    assert np.abs(scores).max() < 3
    # Twelve numbers, of which few are independent.
    assert 0.3 < np.sqrt(np.mean(scores**2)) < 1.6
    # The tolerance is what it closes at.
    never = Live(written(tmp_path, "tolerance = 1e-9", 0.5))
    assert driven(tmp_path / "case.toml", live=never).live.switched is None


@pytest.mark.slow
def test_the_model_of_the_drives_force_is_an_instrument(tmp_path):
    """2 N m of noise on the measured torque: it stands in the gains' columns, and pulls them down."""
    found = {}
    for instrument in ("none", "model"):
        law = f'instrument = "{instrument}"\ntolerance = 1e-9'
        ran = driven(written(tmp_path, law, 1.5), torque=2.0, inertial=(1e-4, 1e-2))
        told = ran.live.estimate
        found[instrument] = np.asarray(told.theta / TRUTH - 1)[:2], np.asarray(told.std / TRUTH)[:2]
    # Weight moves joint 1, whose torque stands far above the noise.
    (none, _), (model, std) = found["none"], found["model"]
    assert none.min() < -0.05
    assert np.all(np.abs(model) < 3 * std)
    assert np.all(std < 0.015)


def test_a_saved_memory_goes_on(tmp_path):
    case = written(tmp_path, "", 0.5)
    whole, first, second = Live(case), Live(case), Live(case)
    readings = whole.reference + 1e-4 * np.random.default_rng(0).standard_normal(whole.reference.shape)
    for k in range(400):
        u = whole.command(readings[k])
        if k < 200:
            first.command(readings[k])
        else:
            if k == 200:
                second.memory = jax.tree.map(np.asarray, first.memory)
                second._tick = 200
            np.testing.assert_array_equal(second.command(readings[k]), u)
    assert int(whole.memory[1].ticks) == 400


def test_a_new_run_keeps_what_was_identified_and_no_readings(tmp_path):
    """From another place: a difference to where the last run ended would be 1e5 rad/s^2."""
    case = written(tmp_path, ENCODER, 1.5)
    first, second = driven(case), Live(case)
    before = first.live.estimate.theta
    with pytest.raises(InputError, match=r"position has shape \(3,\); give one reading of each of 2 joints"):
        second.command(np.zeros(3))
    second.memory = jax.tree.map(np.asarray, first.live.memory)
    ran = driven(case, live=second, ticks=60)
    assert first.live.switched > 0
    assert second.switched == 0
    np.testing.assert_allclose(second.estimate.theta, before, rtol=0.01)
    assert np.abs(ran.command).max() < 1.5 * np.abs(first.command).max()


def test_simulation_and_live_are_one_law_and_readings_are_held(tmp_path):
    """Readings at 1 kHz in a loop at 4 kHz, exact sticking: live, on the same readings, commands the same."""
    sensor = "rate = 1000.0\nposition_noise = 1e-7\nforce_noise = 0.1"
    case = written(tmp_path, "velocity_average = 4\nreach = 8", 1.5, sensor)
    run = simulate(case)
    readings = run.log.position.reshape(-1, 4, 2)
    assert np.all(readings == readings[:, :1])
    assert np.all(np.any(np.diff(readings[:, 0], axis=0) != 0, axis=1))
    # The log has what the drives report, and so has the law.
    given, reported = np.asarray(run.trajectory.command), run.log.force
    assert np.std(reported - given) == pytest.approx(0.1, rel=0.05)
    live = Live(case)
    for k in range(len(readings) * 4):
        measured = reported[k - 1] if k else given[0]
        u = live.command(run.log.position[k], measured=measured)
        # The first ones know where the arm stood before: the simulation to the last digit, a reading not.
        if k >= 4:
            np.testing.assert_allclose(u, given[k], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(live.estimate.theta, TRUTH, rtol=0.02)
    closed = np.asarray(run.trajectory.found.closed)
    assert live.switched == np.argmax(closed)
    assert closed[-1]
    np.testing.assert_allclose(run.trajectory.found.theta[-1], live.estimate.theta, rtol=1e-9)


def test_forces_with_and_without_friction(tmp_path):
    """Against Lagrange's equations of two links: accelerations that the forces give are those asked for."""
    machine = build_machine(load_case(written(tmp_path)), at_truth=True)
    q, v, a = np.array([0.4, 0.7]), np.array([1.2, -2.0]), np.array([3.0, -5.0])
    smooth, friction = inverse_dynamics(machine.plant, q, v, a, 2)
    arm = TwoLinks(viscous=(0.0, 0.0), coulomb=(0.0, 0.0))
    np.testing.assert_allclose(arm.acceleration(*q, *v, *np.asarray(smooth)), a, rtol=1e-9)
    # Not of the width of the sign: at these speeds it is one.
    np.testing.assert_allclose(friction, TRUTH[2:4] * v + TRUTH[4:] * np.sign(v), rtol=1e-9)
    # Springs, offsets and drags of an axis: what is left at rest belongs to the first part.
    effects = (
        EFFECTS["linear_stiffness"](coefficient=300.0),
        EFFECTS["constant_force"](level=2.0),
        EFFECTS["quadratic_drag"](coefficient=0.5),
        EFFECTS["added_mass"](mass=0.5),
    )
    motion = (jnp.full(1, x) for x in (0.1, 3.0, 4.0))
    smooth, friction = inverse_dynamics(Axis(2.0, effects=effects), *motion, 1)
    np.testing.assert_allclose(smooth, [2.5 * 4.0 + 30.0 - 2.0], rtol=1e-12)
    np.testing.assert_allclose(friction, [4.5], rtol=1e-12)


def test_switches_of_a_model_that_is_right():
    """All fed forward, over the gain: an axis follows to the hold, at no gains of feedback at all."""
    effects = (
        EFFECTS["actuator_gain"](gain=0.8),
        EFFECTS["coulomb_friction"](level=3.0),
        EFFECTS["viscous_friction"](coefficient=4.0),
    )
    plant, none = Axis(2.0, effects=effects), jnp.zeros(1)
    t = 1e-4 * np.arange(5000)
    reference = jnp.asarray(0.1 * np.sin(6.0 * t) ** 2)[:, None]
    off = {}
    for switches in ("all", "dynamics", "friction", "gains"):
        law = ComputedTorque(
            none,
            none,
            plant,
            jnp.asarray([2.0]),
            period=1e-4,
            epsilon=jnp.asarray(1e-3),
            friction=True,
        )
        law = (
            law
            if switches == "all"
            else ComputedTorque(
                none,
                none,
                plant,
                jnp.asarray([2.0]),
                period=1e-4,
                epsilon=jnp.asarray(1e-3),
                **({"friction": True} | {switches: False}),
            )
        )
        drive = Drive(jnp.asarray([2.0]), 1e-4, "zero_order", 1, True)
        run = closed_loop(plant, drive, law, reference, jnp.zeros((5000, 1)), none, none)
        off[switches] = float(np.abs(np.asarray(run.position) - np.asarray(reference)).max())
    assert off["all"] < 2e-4
    assert min(off[k] for k in ("dynamics", "friction", "gains")) > 50 * off["all"]


def test_feedback_does_not_see_how_late_a_velocity_is():
    """Velocity is a difference over ten ticks, and so is the reference's: on it, nothing is fed back."""
    law = ComputedTorque(
        jnp.full(1, 100.0),
        jnp.full(1, 50.0),
        Axis(1.0),
        jnp.ones(1),
        period=1e-3,
        velocity_average=10,
        dynamics=False,
    )
    t = 1e-3 * np.arange(-200, 300)
    reference = jnp.asarray(0.5 * t**2)[:, None]
    path = law.path(reference)
    at = lambda k: Tick(reference[k], jax.tree.map(lambda x: x[k], path), (0,))
    memory = law.start(at(200), jnp.zeros(1), path)
    for k in range(200, 400):
        u, memory = law.command(at(k), memory, jnp.zeros(1))
    # Against the slope at the tick itself it would be 50 * 4.5 ms * 1.
    np.testing.assert_allclose(u, 0.0, atol=1e-9)


MASS = """
[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 1.0, true = 2.5 }
[controller]
kind = "adaptive"
kp = 400.0
kd = 40.0
reach = 8
period = 0.001
disturbance = { level = 30.0, on = 0.013, off = 0.017 }
[reference]
kind = "synchronized"
points = [[0.4], [0.0]]
velocity = 1.0
acceleration = 10.0
jerk = 1000.0
[simulation]
duration = 1.0
sample_rate = 1000.0
"""


@pytest.mark.parametrize(("rate", "apart"), [(None, 8), (250.0, 4)])
def test_half_life_is_of_time_however_far_samples_are_apart(tmp_path, rate, apart):
    case = tmp_path / "case.toml"
    text = MASS.replace("reach = 8", "reach = 8\nhalf_life = 0.05")
    if rate is None:
        case.write_text(text)
        live, more = Live(case), {}
    else:
        case.write_text(
            TEXT.replace("period = 0.00025", "period = 0.001\nhalf_life = 0.05").replace(
                "sample_rate = 4000.0", "sample_rate = 1000.0"
            )
            + "".join(
                f'[[inertial_sensors]]\nkind = "{kind}"\nlink = {link}\nnoise = 1e-3\nrate = {rate}\n{place}'
                for link in (1, 2)
                for kind, place in (("gyroscope", ""), ("accelerometer", "position = [0.2, 0.0, 0.0]\n"))
            )
        )
        live, more = Live(case), {"velocity": np.ones(2), "acceleration": np.ones(2)}
    n = live.machine.plant.joints
    for k in range(800):
        live.command(np.full(n, 0.1 * np.sin(0.02 * k)), **more)
    # The sum of all weights, of samples that all count, where many half-lives have passed.
    beta = 0.5 ** (apart * 0.001 / 0.05)
    assert abs(float(live.estimate.effective) / (n / (1 - beta)) - 1) < 0.2


def test_differences_and_commands_are_of_one_instant(tmp_path):
    """A mass alone, pushed by what jumps: its second difference over 16 ticks is the commands' own mean."""
    case = tmp_path / "case.toml"
    case.write_text(MASS)
    found = simulate(case).trajectory.found
    # The start counts a thousandth of a sample, of a hundred: 1e-5 of what it is off.
    np.testing.assert_allclose(found.theta[-1], [2.5], rtol=1e-5)


REFUSED = [
    ("reach = 3\nvelocity_average = 4", "rate = 1000.0", r"reach = 3 ticks, .* every 4; take reach = 4"),
    ("", "rate = 1000.0", r"velocity_average = 1 ticks, and readings are new every 4"),
    ("velocity_average = 4", "rate = 3000.0", r"rate = 3000 Hz does not fit the loop; take 4000 Hz"),
    ("half_life = -1.0", "", r"half_life = -1.0 is not positive"),
    ("regularization = 0.0", "", r"regularization = 0.0 is not positive"),
    ("tolerance = 0.0", "", r"tolerance = 0.0 is not positive"),
    ("reach = 0", "", r"reach = 0 is too small"),
    ("friction = 1", "", r"friction = 1 is neither true nor false"),
    ('rows = "sum"', "", r'rows = "sum" is unknown; did you mean .summed.'),
    ("halflife = 3.0", "", r"unknown key 'halflife'; did you mean 'half_life'"),
    ('kind = "computed_torque"\nhalf_life = 3.0', "", r"unknown key 'half_life'"),
    ("gate_velocity = 0.1\ngate_acceleration = [1.0]", "", r"gate_acceleration .* has 1 entry"),
]


@pytest.mark.parametrize(("law", "sensor", "match"), REFUSED)
def test_refuses(tmp_path, law, sensor, match):
    case = written(tmp_path, law, sensor=sensor)
    if "gate_velocity" in law:
        case.write_text(case.read_text().replace("gate_velocity = 0.1\n", "", 1))
    with pytest.raises(InputError, match=match) as caught:
        Live(case)
    assert "\n" not in str(caught.value)


def test_refuses_what_it_cannot_find(tmp_path):
    known = [("{ guess = 1.0, true = 0.93 }", "1.0"), ("{ guess = 1.0, true = 1.06 }", "1.0")]
    known += [(f"{{ guess = 0.0, true = {x} }}", "0.0") for x in (1.5, 0.8, 4.0, 2.4)]
    for message, swap in (
        ("kind = 'adaptive' needs at least one unknown parameter; take kind = 'computed_torque'", known),
        (
            "the balance is not linear in",
            [
                (
                    'kind = "viscous_friction"\ncoefficient',
                    'kind = "stribeck_friction"\nvelocity = { guess = 0.1 }\nlevel',
                )
            ],
        ),
        (
            "has an internal state or a delay",
            [("[controller]", '[[effects]]\nkind = "actuator_lag"\ntime_constant = 0.01\n[controller]')],
        ),
    ):
        case = written(tmp_path, **dict(swap))
        with pytest.raises(InputError, match=message) as caught:
            Live(case)
        assert "\n" not in str(caught.value)
        assert "[controller]" in str(caught.value)
    with pytest.raises(InputError, match="identifies by itself; leave identify out"):
        Live(written(tmp_path), identify=True)
    with pytest.raises(InputError, match="no reading yet"):
        _ = Live(written(tmp_path)).estimate


def test_refuses_joints_without_a_drive(tmp_path):
    case = tmp_path / "case.toml"
    case.write_text("""
[plant]
kind = "flexible_axis"
[plant.parameters]
motor_inertia = 50.0
load_inertia = 60.0
stiffness = 4e5
damping = 300.0
[controller]
kind = "computed_torque"
kp = 1.0
kd = 1.0
period = 0.001
[reference]
kind = "synchronized"
points = [[0.1]]
velocity = 1.0
acceleration = 1.0
jerk = 1.0
[simulation]
duration = 1.0
sample_rate = 1000.0
""")
    with pytest.raises(InputError, match="kind = 'computed_torque' needs a drive at every joint"):
        Live(case)


def test_a_command_that_is_not_measured_is_taken_as_given(tmp_path):
    """At the first tick there is none to report, and a drive may skip one; nothing is compiled anew."""
    case = written(tmp_path, ENCODER, duration=0.1)
    plain, told = Live(case), Live(case)
    last = None
    for k, q in enumerate(plain.reference + 1e-4 * np.random.default_rng(0).standard_normal((400, 2))):
        measured = last if k % 3 else np.full(2, np.nan) if k else None
        last = plain.command(q)
        np.testing.assert_array_equal(told.command(q, measured=measured), last)
    assert len(told._law._compiled) == 1


def test_what_is_measured_must_have_a_number_for_each(tmp_path):
    live = Live(written(tmp_path, ENCODER, duration=0.1))
    for name in ("velocity", "acceleration", "measured"):
        with pytest.raises(InputError, match=rf"Live.command: {name} has shape \(3,\); give 2 numbers"):
            live.command(live.reference[0], **{name: np.zeros(3)})
