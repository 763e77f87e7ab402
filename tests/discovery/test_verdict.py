"""The verdict of a search that named nothing."""

import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from jaxid import gap
from jaxid.commands import discover
from jaxid.session import open_session
from truth.axis.cases import case_text
from truth.axis.machines import Setup, multisine
from truth.axis.stepper import Loop, Machine, Sensor


@pytest.mark.parametrize(
    ("times_the_floor", "significant", "beyond_numerics", "by_filter", "verdict"),
    [
        (1.2, True, True, 0.0, "nothing_missing"),
        (2.0, False, True, 0.0, "nothing_missing"),
        (2.0, True, True, 0.0, "unexplained"),
        # So much is never nothing, even if it stands out over no variable, unless the filter leaves as much.
        (3.5, False, True, 0.0, "unexplained"),
        (3.5, False, True, 0.4, "unexplained"),
        (3.5, False, True, 2.0, "nothing_missing"),
        (3.5, True, True, 2.0, "unexplained"),
        (3.5, True, False, 0.0, "nothing_missing"),
    ],
)
def test_the_verdict_follows_from_what_is_left(
    monkeypatch, times_the_floor, significant, beyond_numerics, by_filter, verdict
):
    monkeypatch.setattr(discover, "_rms", lambda search, samples, theta: times_the_floor * search.floor)
    monkeypatch.setattr(discover, "filter_floor", lambda machine, run: by_filter * np.array([0.5]))
    search = SimpleNamespace(
        floor=np.array([0.5]),
        samples=None,
        acceptance=SimpleNamespace(above_numerics=lambda theta: beyond_numerics),
    )
    where, steps = SimpleNamespace(significant=significant), [SimpleNamespace(theta=np.zeros(1))]
    assert discover._verdict_on_none(where, steps, search, SimpleNamespace(fit=None), None) == verdict


@pytest.mark.parametrize(("integrated", "off"), [(True, 0.0), (False, 0.5)])
def test_the_filter_is_not_judged_by_a_drifting_run_or_an_integrated_speed(monkeypatch, integrated, off):
    """Else the measured motion, or a simulation that drifts, would be taken for what the filter leaves."""
    ran = SimpleNamespace(command=None, rms=np.array([off]))
    monkeypatch.setattr(gap, "simulated", lambda machine, log: ran)
    log = SimpleNamespace(measured=(True,), integrated=integrated, position=np.sin(np.arange(5.0))[:, None])
    run = SimpleNamespace(machine=lambda machine: machine, log=log, data=SimpleNamespace(q=np.zeros((5, 1))))
    np.testing.assert_array_equal(gap.filter_floor(None, run), [0.0])


def test_the_filter_of_a_coarse_encoder_leaves_more_than_its_noise():
    """64 counts a turn at 50 Hz: the band ends at 7.4 Hz, and friction turns faster."""
    rate, counts = 50.0, 64
    friction = {"viscous_friction": {"coefficient": 2e-4}, "coulomb_friction": {"level": 2e-3}}
    t = np.arange(round(15 * rate)) / rate
    motor = Setup(
        Machine(inertia=3e-5, effects=friction, actuator_gain=6e-5),
        Loop(kind="open_loop", input=multisine(t, [0.3, 0.9, 2.1, 4.7], 220.0, 1)),
        Sensor(position_resolution=2 * np.pi / counts),
        rate=rate,
        duration=15.0,
        seed=1,
    )
    run = motor.run()
    text = case_text(motor, tuple(friction.items()), motion="rotary", sensor=False, closed=False)
    session = open_session(tomllib.loads(text), {"t": run["t"], "q": run["position"], "u": run["force"]})
    machine = session.machine.with_estimate([3e-5, 2e-4, 2e-3])
    left = gap.force_gap(machine, session.fit.data).rms
    noise = gap.noise_floor(machine, session.fit.log, session.fit.data)
    assert left[0] > 3 * noise[0], "a complete model would be called incomplete"
    assert gap.filter_floor(machine, session.fit) == pytest.approx(left, rel=0.3)
