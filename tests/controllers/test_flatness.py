"""Flatness: the error obeys the poles; the law on a machine that is not jaxid's; live, and switched."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from experiments.wi_loop import CASE, driven, errors, text, true_values
from jaxid.case.case import load_case
from jaxid.commands.live import Live, follow
from jaxid.controllers import Flatness, Path, Tick, flat_inputs
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.plants import Axis
from jaxid.plants.chain import Chain
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import Drive, closed_loop, open_loop
from truth.chain.six_masses import KINDS

PERIOD, MASS, STIFF, DRAG, GAIN = 1e-4, 2.0, 300.0, 5.0, 4.0


def in_loop(poles: tuple[float, ...], offset: float, sensor: Sensor | None = None):
    """A sprung axis that starts off its reference, under a law that knows it: the run, the error."""
    effects = (EFFECTS["viscous_friction"](coefficient=DRAG), EFFECTS["linear_stiffness"](coefficient=STIFF))
    plant = Axis(MASS, effects=effects)
    law = Flatness(
        poles=poles,
        epsilon=jnp.asarray(1e-6),
        model=plant,
        gain=jnp.asarray([GAIN]),
        period=PERIOD,
    )
    reference = 0.05 * np.sin(8.0 * PERIOD * np.arange(4000))[:, None]
    slope = 0.05 * 8.0
    run = closed_loop(
        plant,
        Drive(jnp.asarray([GAIN]), PERIOD),
        law,
        jnp.asarray(reference),
        jnp.zeros((4000, 1)),
        jnp.asarray([offset]),
        jnp.asarray([slope]),
        sensor,
    )
    return run, np.asarray(run.position)[:, 0] - reference[:, 0]


@pytest.mark.parametrize("poles", [(-30.0, -50.0), (-40.0, -40.0)])
def test_error_dies_out_by_its_poles(poles):
    off = in_loop(poles, 0.01)[1]
    companion = np.array([[0.0, 1.0], [-poles[0] * poles[1], poles[0] + poles[1]]])
    t = PERIOD * np.arange(len(off))
    expected = np.array([(scipy.linalg.expm(companion * x) @ [0.01, 0.0])[0] for x in t[::400]])
    # The held command acts half a tick late, and the velocity is half a tick old: of 10 mm, 1e-4 s of 20 ms.
    np.testing.assert_allclose(off[::400], expected, atol=2e-5)
    # A law that asked for the acceleration alone would leave c v + k q, of 2 mm.
    assert np.abs(off[3000:]).max() < 2e-5


def test_reconstructed_velocity_and_integral():
    """Three poles: the error's third-order polynomial, its integral driven to zero."""
    off = in_loop((-30.0, -40.0, -50.0), 0.01)[1]
    polynomial = np.poly([-30.0, -40.0, -50.0])
    companion = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], -polynomial[:0:-1]])
    # States: integral of e, e, e'.
    t = PERIOD * np.arange(len(off))
    expected = np.array([(scipy.linalg.expm(companion * x) @ [0.0, 0.01, 0.0])[1] for x in t[::400]])
    np.testing.assert_allclose(off[::400], expected, atol=2e-5)
    assert np.abs(off[3000:]).max() < 2e-5


def test_reconstructed_velocity_does_not_see_the_counts():
    """A count of 1 um is 10 mm/s from tick to tick: the law that differences readings passes it on."""
    counts = Sensor(position_resolution=jnp.asarray(1e-6))
    jitter = {}
    for poles in ((-40.0, -40.0), (-40.0, -40.0, -40.0)):
        run, off = in_loop(poles, 0.0, counts)
        jitter[len(poles)] = np.std(np.diff(np.asarray(run.command)[2000:, 0], 2))
        assert np.abs(off[2000:]).max() < 2e-4  # It still follows, by 0.1 m.
    assert jitter[3] < 0.1 * jitter[2]


def test_reconstructed_velocity_rests_with_its_joint():
    """Stuck by friction that the model lacks: the command ramps with the error's integral, no more."""
    effects = (EFFECTS["viscous_friction"](coefficient=DRAG), EFFECTS["linear_stiffness"](coefficient=STIFF))
    law = Flatness(
        poles=(-30.0, -40.0, -50.0),
        epsilon=jnp.asarray(1e-6),
        model=Axis(MASS, effects=effects),
        gain=jnp.asarray([GAIN]),
        period=PERIOD,
    )
    at, none = 0.01, jnp.zeros(1)
    tick = Tick(jnp.full(1, at), Path(none, none, none), (0,))
    memory, given, command = law.start(tick, none), [], eqx.filter_jit(law.command)
    for _ in range(300):
        u, memory = command(tick, memory, none)
        given.append(float(u[0]))
    b1, b0 = np.poly(law.poles)[2:]
    integral = at * PERIOD * np.arange(1, 301)
    # The first sample's error counts half a tick.
    expected = (STIFF * at - MASS * (b1 * at + b0 * (integral - 0.5 * at * PERIOD))) / GAIN
    # Without the reset the model's velocity would follow its force, away from the stuck joint's.
    np.testing.assert_allclose(given, expected, rtol=1e-9)


def test_flat_output_gives_all_inputs():
    """Three masses driven open loop by what their trajectories ask for follow them."""
    plant = Chain([2.0, 1.4, 2.6], [8.0, 7.0, 9.0], [1700.0, 1600.0, 1900.0, 1500.0])
    t = 1e-4 * np.arange(5001)
    size, rate = np.array([0.01, -0.02, 0.015]), np.array([5.0, 7.0, 9.0])
    angle = t[:, None] * rate
    motion = [size * np.sin(angle), size * rate * np.cos(angle), -size * rate**2 * np.sin(angle)]
    path = Path(*(jnp.asarray(x) for x in motion))
    force = flat_inputs(plant, path, 3)
    run = open_loop(plant, Drive(jnp.ones(3), 1e-4, "linear"), force, jnp.zeros(3), jnp.asarray(motion[1][0]))
    # Forces joined by lines over 0.1 ms: (rate h)^2 / 8 of the motion.
    np.testing.assert_allclose(np.asarray(run.position), motion[0], atol=1e-8)
    np.testing.assert_allclose(np.asarray(run.velocity), motion[1], atol=1e-6)


@pytest.mark.slow
def test_live_identifies_switches_and_tracks(tmp_path):
    """Wrong values, truth of the exact simulator: all found in 0.1 s, then tracked far better."""
    case = tmp_path / "case.toml"
    case.write_text(text(duration="1.0"))
    late = {}
    for identify in (False, True):
        run = driven(case, 1.0, identify=identify)
        off = (run.position - run.log.reference)[200:, 1]
        late[identify] = float(np.sqrt(np.mean(off**2)))
    switched = run.live.switched
    assert 30 < switched <= 100
    found = errors(list(true_values()), run.live.online_estimate.theta)
    assert run.live.told is run.live.online_estimate, "the name of version 0.1"
    assert all(found[kind] <= aim for kind, aim in KINDS.items())
    assert late[True] < 1e-4 < 2e-4 < late[False]
    told = follow(case, run.log)
    assert told.trusted[switched - 1].all()
    assert not told.trusted[5].any()
    # What is trusted is within what trust means.
    worst = errors(list(true_values()), told.theta[switched - 1])
    assert max(worst.values()) < 0.05


def test_live_refuses(tmp_path):
    live = Live(CASE)
    live._tick = len(live.reference)
    with pytest.raises(InputError, match="the reference ends after 10000 ticks"):
        live.command(np.zeros(6))
    case = tmp_path / "case.toml"
    law = 'kind = "flatness"\npoles = [-60.0, -60.0]\nepsilon = 1e-3'
    assert law in text()
    case.write_text(text().replace(law, 'kind = "pd"\nkp = 1.0\nkd = 1.0'))
    with pytest.raises(InputError, match="a controller of kind 'pd' has no model"):
        Live(case, identify=True)
    Live(case)


@pytest.mark.parametrize(
    ("poles", "words"),
    [
        ("[-60.0]", "has 1 entry"),
        ("[-60.0, 60.0]", "is not negative"),
        ("-60.0", "is not a list"),
        ("[-9.0, -9.0, -9.0, -9.0]", "at most 3"),
    ],
)
def test_poles_that_cannot_be(tmp_path, poles, words):
    case = tmp_path / "case.toml"
    case.write_text(text(poles=poles))
    with pytest.raises(InputError, match=words):
        load_case(case)
