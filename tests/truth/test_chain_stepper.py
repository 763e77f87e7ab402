"""The ground-truth chain against closed forms, numpy's eigenvalues and the ground-truth axis."""

import numpy as np
import pytest

from truth.axis.stepper import Loop, Machine, Sensor, simulate
from truth.chain.stepper import ChainMachine, elongations, simulate_chain, write_csv

IDEAL = Sensor()
RATE = 1000.0
FREE = ChainMachine(mass=(2.0, 1.2, 2.8), damping=(0.0,) * 3, stiffness=(1500.0, 1700.0, 2100.0, 1300.0))
LEVELS = (2.0, 3.0, 1.5)


def rubbing(machine: ChainMachine = FREE) -> ChainMachine:
    """With Coulomb friction at every mass."""
    for joint, level in enumerate(LEVELS, start=1):
        machine = machine.with_effect("coulomb_friction", joint, level=level)
    return machine


def free_run(machine: ChainMachine, duration: float = 1.0, force=0.0, **options):
    """Open loop, a constant force or one by sample and drive."""
    shape = (round(duration * RATE), len(machine.driven))
    loops = [Loop(input=column) for column in np.broadcast_to(force, shape).T]
    return simulate_chain(machine, loops, IDEAL, rate=RATE, duration=duration, **options)


def energy(machine: ChainMachine, log) -> np.ndarray:
    """Return the energy of masses and linear springs, (time,) [J]."""
    e = elongations(log["true_position"])
    kinetic = log["true_velocity"] ** 2 @ np.array(machine.mass)
    return 0.5 * (kinetic + e**2 @ np.array(machine.stiffness))


def test_keeps_its_energy():
    log = free_run(FREE, initial_position=(0.03, 0.0, -0.01), initial_velocity=(0.0, 0.2, 0.0))
    total = energy(FREE, log)
    # leapfrog's energy swings by (w h)^2 / 4 = 2e-8 and does not drift
    assert np.ptp(total) / total[0] < 1e-7


def test_friction_takes_its_level_times_the_way():
    log = free_run(rubbing(), 1.0, initial_position=(0.03, 0.0, -0.02))
    way = np.abs(np.diff(log["true_position"], axis=0)).sum(0)
    lost = np.diff(energy(FREE, log)[[0, -1]])[0]
    # the way between two ticks that hold a turn is a little longer than their distance
    assert -lost == pytest.approx(way @ np.array(LEVELS), rel=1e-3)


@pytest.mark.parametrize("mode", range(3))
def test_swings_at_the_frequencies_of_eigh(mode):
    k, root = np.array(FREE.stiffness), np.sqrt(FREE.mass)
    matrix = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    squares, shapes = np.linalg.eigh(matrix / np.outer(root, root))
    start = 0.01 * shapes[:, mode] / root
    log = free_run(FREE, initial_position=start)
    expected = np.cos(np.sqrt(squares[mode]) * log["t"])[:, None] * start
    # leapfrog is ahead by w t (w h)^2 / 24: 2.3e-7 rad at 10 Hz after 1 s
    np.testing.assert_allclose(log["true_position"], expected, atol=3e-9)
    assert FREE.frequencies()[mode] == pytest.approx(np.sqrt(squares[mode]) / (2.0 * np.pi))


def test_a_force_below_the_level_leaves_a_mass_exactly_still():
    machine = FREE.with_effect("coulomb_friction", 2, level=60.0)
    log = free_run(machine, initial_position=(0.01, 0.002, -0.005), force=(0.0, 5.0, 0.0))
    pull = 1700.0 * (log["true_position"][:, 0] - 0.002) + 2100.0 * (log["true_position"][:, 2] - 0.002)
    assert 50.0 > np.abs(pull + 5.0).max() > 30.0
    assert np.all(log["true_position"][:, 1] == 0.002)
    assert np.all(log["true_velocity"][:, 1] == 0.0)
    assert np.all(log["true_acceleration"][:, 1] == 0.0)


def test_slides_to_its_stop_at_level_over_mass():
    machine = ChainMachine((2.0, 1.0), (0.0, 0.0), (0.0, 0.0, 0.0))
    machine = machine.with_effect("coulomb_friction", 1, level=3.0)
    machine = machine.with_effect("coulomb_friction", 2, level=4.0)
    log = free_run(machine, initial_velocity=(1.0, -1.0))
    left = np.maximum(1.0 - np.outer(log["t"], (1.5, 4.0)), 0.0)
    np.testing.assert_allclose(log["true_velocity"], left * (1.0, -1.0), atol=1e-12)
    assert np.all(log["true_velocity"][log["t"] > 0.67] == 0.0)


def test_leaves_at_level_plus_static():
    machine = ChainMachine((2.0,), (0.0,), (0.0, 0.0)).with_effect("coulomb_friction", 1, level=3.0)
    machine = machine.with_effect("static_friction", 1, level=1.5)
    log = free_run(machine, 1.0, (0.01 * np.arange(1000))[:, None])
    first = log["t"][np.flatnonzero(log["true_velocity"])[0]]
    assert first == pytest.approx(0.451 + 1e-3)  # 4.51 N acts from 0.451 s on


@pytest.mark.parametrize(
    ("kind", "force"), [("quadratic_stiffness", -300 * 0.03**2), ("cubic_stiffness", 300 * 0.03**3)]
)
def test_a_spring_acts_on_both_neighbours(kind, force):
    options = {"initial_position": (0.02, -0.01, 0.005), "duration": 0.01}
    plain = free_run(FREE, **options)["true_acceleration"]
    more = free_run(FREE.with_effect(kind, 2, coefficient=300.0), **options)["true_acceleration"]
    push = (more - plain)[0] * np.array(FREE.mass)
    # elongation of spring 2: -0.03 m; mass 2 gets -f(e), mass 1 gets +f(e)
    np.testing.assert_allclose(push, [-force, force, 0.0], atol=1e-12)


def test_balance_of_forces_closes_at_every_tick():
    machine = rubbing(ChainMachine(FREE.mass, (5.0, 6.0, 7.0), FREE.stiffness))
    machine = machine.with_effect("quadratic_drag", 1, coefficient=8.0)
    machine = machine.with_effect("constant_force", 3, level=1.5)
    machine = machine.with_effect("stribeck_friction", 2, level=1.0, velocity=0.1)
    machine = machine.with_effect("cogging", 2, amplitude=0.8, period=0.004, phase=0.3)
    machine = machine.with_effect("cubic_stiffness", 4, coefficient=1e5)
    log = free_run(machine, force=20.0 * np.sin(np.outer(np.arange(1000) / RATE, (30.0, 17.0, 11.0))))
    x, v = log["true_position"], log["true_velocity"]
    e = elongations(x)
    spring = e * machine.stiffness
    spring[:, 3] += 1e5 * e[:, 3] ** 3
    net = log["true_force"] + np.diff(spring, axis=1) - v * machine.damping - np.sign(v) * LEVELS
    net[:, 0] -= 8.0 * v[:, 0] * np.abs(v[:, 0])
    net[:, 2] += 1.5
    net[:, 1] -= np.sign(v[:, 1]) * np.exp(-((v[:, 1] / 0.1) ** 2))
    net[:, 1] -= 0.8 * np.cos(2 * np.pi * x[:, 1] / 0.004 + 0.3)
    slides = v != 0.0
    error = log["true_acceleration"] * machine.mass - net
    assert np.mean(slides) > 0.8
    assert np.abs(error[slides]).max() < 1e-11
    # and the motion has that acceleration: over a tick without a turn, but for the drive's steps
    # of up to 20 N * 30 rad/s * 1 ms over 2 kg, half of them, and ripples of 100 Hz
    a = log["true_acceleration"]
    off = np.abs(np.diff(v, axis=0) * RATE - 0.5 * (a[:-1] + a[1:]))[v[:-1] * v[1:] > 0]
    assert np.quantile(off, 0.9) < 0.01 * np.abs(a).max()


def test_one_mass_is_the_axis():
    effects = {"coulomb_friction": {"level": 2.0}, "viscous_friction": {"coefficient": 4.0}}
    axis = Machine(2.0, effects).with_effect("linear_stiffness", coefficient=800.0)
    chain = ChainMachine((2.0,), (4.0,), (300.0, 500.0)).with_effect("coulomb_friction", 1, level=2.0)
    t = np.arange(1000) / RATE
    loop = Loop(kind="pid", kp=8e3, kd=150.0, ki=2e3, reference=0.02 * np.sin(9.0 * t))
    sensor = Sensor(1e-7, 1e-7)
    one = simulate(axis, loop, sensor, rate=RATE, duration=1.0, seed=3)
    other = simulate_chain(chain, [loop], sensor, rate=RATE, duration=1.0, seed=3)
    for name in ("position", "force", "true_velocity", "true_acceleration"):
        np.testing.assert_allclose(other[name][:, 0], one[name], rtol=1e-9, atol=1e-9)


def test_commands_can_be_recomputed_from_the_log():
    t = np.arange(2000) / RATE
    references = 0.02 * np.sin(np.outer(t, (9.0, 14.0)))
    loops = [
        Loop(kind="pd", kp=800.0, kd=15.0, reference=references[:, 0]),
        Loop(kind="pid", kp=700.0, kd=12.0, ki=200.0, reference=references[:, 1]),
    ]
    machine = rubbing(ChainMachine(FREE.mass, (5.0,) * 3, FREE.stiffness, {}, (3, 1), (10.0, 20.0)))
    log = simulate_chain(machine, loops, Sensor(1e-7, 2e-7), rate=RATE, duration=2.0, seed=1)
    np.testing.assert_array_equal(log["reference"], np.insert(references[:, ::-1], 1, 0.0, axis=1))
    error = (log["reference"] - log["position"])[:, [2, 0]]
    slope = np.diff(error, axis=0, prepend=error[:1]) * RATE
    u = error * (800.0, 700.0) + slope * (15.0, 12.0)
    u[:, 1] += 200.0 * np.cumsum(error[:, 1]) / RATE
    np.testing.assert_allclose(log["force"], u, atol=1e-9)
    np.testing.assert_allclose(log["true_force"][:, [2, 0]], u * (10.0, 20.0), atol=1e-9)
    assert np.all(log["true_force"][:, 1] == 0.0)
    assert np.ptp(log["true_position"][:, 1]) > 0.005


def test_noise_is_of_the_size_and_independent_by_mass():
    machine = ChainMachine(FREE.mass, FREE.damping, FREE.stiffness)
    loops = [Loop(input=np.zeros(20000))] * 3
    log = simulate_chain(machine, loops, Sensor(1e-7, 5e-6, 0.2), rate=RATE, duration=20.0)
    np.testing.assert_allclose(log["position"].std(0), 5e-6, rtol=0.03)
    np.testing.assert_allclose(log["force"].std(0), 0.2, rtol=0.03)
    assert np.abs(np.corrcoef(log["position"].T) - np.eye(3)).max() < 0.03
    assert np.abs(log["position"] / 1e-7 - np.round(log["position"] / 1e-7)).max() < 1e-8


def test_halving_the_step_changes_little():
    """By 0.17 nm of 36 mm; four times less with each halving, stops and sticking included."""
    smooth = ChainMachine(FREE.mass, (5.0,) * 3, FREE.stiffness)
    smooth = smooth.with_effect("cubic_stiffness", 2, coefficient=1e5)
    force = 20.0 * np.sin(np.outer(np.arange(1000) / RATE, (30.0, 17.0, 11.0)))
    for machine in (smooth, rubbing(smooth)):
        coarse, one, half = (
            free_run(machine, force=force, step=h)["true_position"] for h in (1e-5, 5e-6, 2.5e-6)
        )
        change = np.abs(one - half).max()
        assert change < 3e-10
        assert np.abs(coarse - one).max() / change == pytest.approx(4.0, rel=0.1)
        assert np.abs(half).max() > 0.01


def test_csv_has_the_promised_columns(tmp_path):
    machine = ChainMachine((1.0, 1.0), (0.0, 0.0), (10.0, 10.0, 10.0), actuated=(2,))
    write_csv(free_run(machine, 0.01, 1.0), tmp_path / "log.csv")
    lines = (tmp_path / "log.csv").read_text().splitlines()
    assert lines[0] == "t,position1,position2,force1,reference1,reference2"
    assert len(lines) == 11


@pytest.mark.parametrize(
    ("machine", "message"),
    [
        (ChainMachine((1.0,), (1.0,), (1.0,)), "springs"),
        (ChainMachine((1.0,), (1.0,), (1.0, 1.0), actuated=(2,)), "actuated"),
        (FREE.with_effect("hysteresis", 1, stiffness=1.0, level=1.0), "hysteresis"),
        (FREE.with_effect("cogging", 4, amplitude=1.0, period=1.0, phase=1.0), "cannot act at 4"),
        (FREE.with_effect("cubic_stiffness", 5, coefficient=1.0), "cannot act at 5"),
        (FREE.with_effect("coulomb_friction", 1, coefficient=1.0), "level"),
    ],
)
def test_refuses_what_it_does_not_know(machine, message):
    with pytest.raises(ValueError, match=message):
        free_run(machine, 0.01)
