"""diffrax between the samples: the same runs, derivatives and estimates as by fine fixed steps."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.controllers.linear import CascadePD
from jaxid.dynamics.rhs import State
from jaxid.effects import EFFECTS
from jaxid.estimators.output_error import output_error
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.smoothing import Smoothing
from jaxid.model.units import Units
from jaxid.model.unknowns import Free, Parameters
from jaxid.names import SOLVERS
from jaxid.plants import Axis
from jaxid.simulation.loops import with_diffrax
from jaxid.simulation.replay import Numerics, make_replay
from jaxid.simulation.solvers import AdaptiveStep

PERIOD, SAMPLES, GAIN = 5e-3, 300, 3.0
TIMES = PERIOD * np.arange(SAMPLES)
WAVE = 2.0 * np.sin(9.0 * TIMES) + 1.5 * np.cos(31.0 * TIMES)
# An own state each (lag, presliding), a smoothed sign and a spring.
TRUTH = {
    "inertia": (("inertia",), 2.0),
    "viscous": (("effects", 0, "coefficient"), 3.0),
    "dry": (("effects", 1, "level"), 1.5),
    "lag": (("effects", 2, "time_constant"), 0.012),
    "presliding": (("effects", 3, "stiffness"), 200.0),
    "delay": (("effects", 4, "delay"), 1.6 * PERIOD),
}
FINE = Numerics(set_valued=False, substeps=16, longest_delay=4)
LOOP = CascadePD(jnp.asarray([8.0]), jnp.asarray([10.0]), period=PERIOD)


def plant() -> Axis:
    value = {name: v for name, (_, v) in TRUTH.items()}
    effects = (
        EFFECTS["viscous_friction"](coefficient=value["viscous"]),
        EFFECTS["coulomb_friction"](level=value["dry"]),
        EFFECTS["actuator_lag"](time_constant=value["lag"]),
        EFFECTS["hysteresis"](stiffness=value["presliding"], level=2.0),
        EFFECTS["input_delay"](delay=value["delay"]),
    )
    # Smooth enough for fixed steps to be the reference: 16 a sample then leave 1e-8.
    return Axis(value["inertia"], effects=effects, smoothing=Smoothing(0.2))


def machine(closed: bool, unknown: tuple = tuple(TRUTH)) -> Machine:
    free = tuple(Free(n, path, "", "positive", v) for n, (path, v) in TRUTH.items() if n in unknown)
    controller = LOOP if closed else None
    return Machine(plant(), Parameters(free), np.array([GAIN]), Units(), controller)


@functools.cache
def log(closed: bool, hold: str = "zero_order") -> Log:
    """What the machine does by fine fixed steps."""
    empty = Log(
        TIMES,
        np.zeros((SAMPLES, 1)),
        WAVE[:, None],
        reference=0.05 * WAVE[:, None],
        hold=hold,
        source="made.csv",
    )
    run = make_replay(machine(closed), empty, FINE)(plant())
    return Log(
        TIMES,
        np.asarray(run.position),
        np.asarray(run.command),
        reference=empty.reference,
        hold=hold,
        source="made.csv",
    )


def run_and_slopes(numerics: Numerics, closed: bool, hold: str) -> tuple[np.ndarray, np.ndarray]:
    m, data = machine(closed), log(closed, hold)
    replay = make_replay(m, data, numerics)

    @eqx.filter_jit
    def both(replay, theta):
        def position(theta):
            q = replay(m.parameters.insert(m.plant, theta)).position[:, 0]
            return q, q

        return jax.jacfwd(position, has_aux=True)(theta)

    slopes, q = both(replay, m.parameters.guess)
    return np.asarray(q), np.asarray(slopes * m.parameters.guess)


@pytest.mark.parametrize(
    ("closed", "hold", "name"),
    [
        (False, "zero_order", "dopri8"),
        (False, "band_limited", "tsit5"),  # which is linear between refined samples
        (True, "zero_order", "tsit5"),
        pytest.param(True, "zero_order", "kvaerno5", marks=pytest.mark.slow),
    ],
)
def test_runs_and_their_derivatives_are_those_of_fine_steps(closed, hold, name):
    numerics = Numerics(longest_delay=4, solver=name)
    ours, theirs = (run_and_slopes(n, closed, hold) for n in (FINE, numerics))
    # each of 300 intervals within 1e-8, and a hundredth of that from the fixed steps
    for a, b, tolerance in zip(ours, theirs, (1e-7, 1e-6), strict=True):
        assert np.all(np.isfinite(b))
        np.testing.assert_allclose(b, a, atol=tolerance * np.abs(a).max())


def test_interval_by_interval_is_the_whole_log_at_once():
    """Held between samples: diffrax over the log, told of every jump."""
    data, m = log(False), machine(False)
    own = eqx.tree_at(lambda p: p.effects, plant(), plant().effects[:4])
    times, force = jnp.asarray(TIMES), GAIN * jnp.asarray(data.force)
    held = lambda t: force[jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0)]
    start = make_replay(m, data, FINE)
    whole, _ = with_diffrax(
        own,
        held,
        times,
        start.position,
        start.velocity,
        controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=1e-10, atol=1e-12), jump_ts=times[1:-1]
        ),
    )
    run = make_replay(m, data, Numerics(solver="tsit5"))(own).position
    np.testing.assert_allclose(np.asarray(run), np.asarray(whole), atol=1e-7 * np.ptp(whole))


@pytest.mark.parametrize("closed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_estimates_through_diffrax_are_those_of_fine_steps(closed):
    # Lag and delay of a few samples are hard to tell apart, and this is no test of that.
    m, data = machine(closed, ("inertia", "viscous", "dry", "lag")), log(closed)
    start = np.asarray(m.parameters.guess) * [1.3, 0.7, 1.2, 0.8]
    noise = 1e-4 * np.random.default_rng(1).standard_normal(data.position.shape)
    data = Log(TIMES, data.position + noise, data.force, reference=data.reference, source="made.csv")
    fixed, solved = (
        output_error(m, data, start=start, numerics=n)
        for n in (FINE, Numerics(longest_delay=4, solver="tsit5"))
    )
    assert fixed.converged
    assert solved.converged
    # A ten-thousandth of a standard deviation is what a fit is asked for; ten times that between two.
    assert np.all(np.abs(fixed.theta - solved.theta) < 1e-3 * fixed.std)
    np.testing.assert_allclose(solved.std, fixed.std, rtol=1e-3)
    assert any("diffrax's tsit5" in note and "smoothed" in note for note in solved.notes)


def test_what_a_solver_cannot_follow_is_no_number():
    stiff = Axis(1.0, effects=(EFFECTS["viscous_friction"](coefficient=1e9),))
    x = State(jnp.zeros(1), jnp.ones(1), (None,))
    solver = AdaptiveStep.sized("tsit5", 1.0, 1.0)
    after = solver(stiff, x, (jnp.zeros(1),), jnp.zeros(()), jnp.asarray(1.0))
    assert np.all(np.isnan(np.asarray(after.q)))
    implicit = AdaptiveStep.sized("kvaerno5", 1.0, 1.0)
    after = implicit(stiff, x, (jnp.zeros(1),), jnp.zeros(()), jnp.asarray(1.0))
    np.testing.assert_allclose(np.asarray(after.q), [1e-9], atol=1e-9)


def test_a_solver_smooths_and_chooses_its_own_steps():
    numerics = choose_numerics(machine(True), log(True), solver="dopri5")
    assert numerics == Numerics(False, 1, 12, None, "dopri5")


def test_names_are_those_of_diffrax():
    assert all(issubclass(getattr(diffrax, SOLVERS[n]), diffrax.AbstractSolver) for n in SOLVERS)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"solver": "tsit6"}, "did you mean 'tsit5'?"),
        ({"solver": "tsit5", "method": "algebraic"}, "only with output_error"),
    ],
)
def test_a_solver_that_cannot_be_is_refused(options, told):
    with pytest.raises(jaxid.InputError, match=told):
        jaxid.identify("none.toml", "none.csv", **options)
