"""The likelihood of innovations, on logs of the exact axis, whose physics shares no code with the filter."""

import dataclasses
import re
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.consistency.law import noise_free_command
from jaxid.errors import InputError
from jaxid.estimators.choice import choose_method
from jaxid.estimators.common.scoring import maximise_likelihood
from jaxid.estimators.likelihood import likelihood_of, needed_numerics
from jaxid.estimators.prediction_error import prediction_error
from jaxid.session import open_session
from jaxid.simulation.kalman import readings_used, slow_samples, smooth_steps
from tests.support.axis_log import log_of
from truth.axis.cases import case_text, write_case
from truth.axis.machines import EMPS_ACCELERATION, EMPS_LOOP, Setup, emps_like, moves, multisine
from truth.axis.stepper import Loop, Machine, Sensor
from truth.hidden.cases import cases

TRUE = np.array([95.1, 203.5, 20.39])
LOGS = 6


def setup(seed: int, **sensor: float) -> Setup:
    """Build two seconds of an EMPS axis: a slow, a fast and a middle move, drawn by a few percent."""
    rng = np.random.default_rng(seed)
    t = np.arange(2000) / 1000.0
    speeds = np.array([0.05, 0.3, 0.13]) * rng.uniform(0.9, 1.1, 3)
    reference = moves(t, [0.0, 0.02, 0.12], speeds, 2 * EMPS_ACCELERATION, rest=0.02)
    given = {"position_resolution": 1e-7, "position_noise": 1e-6, "force_noise": 0.1, **sensor}
    loop = dataclasses.replace(EMPS_LOOP, reference=reference)
    base = emps_like()
    return Setup(base.machine, loop, Sensor(**given), rate=1000.0, duration=2.0, seed=seed)


def opened(folder, seed: int, *, closed: bool, sensor: bool = True, **values: float):
    """Return the case's file and its log as columns; the guesses are off by a factor of 1.5."""
    made = setup(seed, **values)
    run = made.run()
    path = folder / f"{seed}{closed}{sensor}.toml"
    effects = list(made.machine.effects.items())
    path.write_text(case_text(made, effects, closed=closed, sensor=sensor, true=True))
    return path, {"t": run["t"], "q": run["position"], "u": run["force"], "ref": run["reference"]}


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """The estimates of six logs without and with the controller."""
    folder = tmp_path_factory.mktemp("innovations")
    out = {}
    for closed in (False, True):
        files = [opened(folder, seed, closed=closed) for seed in range(1, LOGS + 1)]
        cases, logs = zip(*files, strict=True)
        out[closed] = jaxid.identify_many(cases, logs, method="prediction_error", lanes=LOGS)
    return out


@pytest.mark.slow
def test_the_bound_at_the_truth_is_that_of_the_fit(fits):
    """A fit is near the truth, so that the information there is nearly its own, which may be widened."""
    for fit in fits[False]:
        ratio = fit.std / np.array([fit.details["least_std"][name] for name in fit.names])
        assert np.all((0.9 < ratio) & (ratio < 2.0))


@pytest.mark.slow
def test_a_delay_of_a_part_of_a_sample_leaves_the_inertia_right():
    """As the mean of the two values in a sample it moved the inertia by 3e-5 to 1.2e-4, 8 to 10 sigma."""
    true = [100.0, 200.0, 20.0, 1.4e-3]
    t = np.arange(2000) / 1000.0
    effects = {
        "viscous_friction": {"coefficient": true[1]},
        "coulomb_friction": {"level": true[2]},
        "input_delay": {"delay": true[3]},
    }
    force = Loop(input=multisine(t, [0.8, 1.9, 3.7, 6.1, 9.0], 150.0, 1))
    made = Setup(Machine(true[0], effects), force, Sensor(position_noise=1e-8), 1000.0, 2.0, 1)
    case = tomllib.loads(case_text(made, list(effects.items()), off=1.2, sensor=False))
    case["log"]["hold"] = "zero_order"
    run = made.run()
    log = {"t": run["t"], "q": run["position"], "u": run["force"]}
    fit = jaxid.identify(case, log, method="prediction_error").estimate
    assert abs(fit.theta[0] / true[0] - 1) < 1e-5
    assert np.all(np.abs(fit.theta - true) < 3.5 * fit.std)


def test_the_first_samples_of_a_log_with_dry_friction_do_not_count(tmp_path):
    """With the wrong direction of motion the filter took the friction for certain: 9 sigma off."""
    session = open_session(*opened(tmp_path, 1, closed=False))
    rest = np.asarray(session.fit.data.recipe.rest_velocity)
    made = likelihood_of(session.machine, session.fit.log, rest_velocity=rest)
    rested = made.at_rest_too(made.problem)
    for counts in (made.problem.counts, rested.counts):
        assert not counts[:4].any()
    assert rested.counts[4:].all()


@pytest.mark.slow
def test_a_force_beside_a_law_with_an_integral_has_intervals_that_hold():
    """What the mean of the noise tells of the integral made the constant force 23 and 44 sigma off."""
    z = []
    for case in (c for c in cases("fresh") if c.seed in (12076, 12202)):
        setup = case.setup()
        run = setup.run()
        text = case_text(setup, [*case.values.items()], off=1.3, motion=case.size.motion, sensor=case.sensor)
        log = {"t": run["t"], "q": run["position"], "u": run["force"], "ref": run["reference"]}
        fit = jaxid.identify(tomllib.loads(text), log, method="prediction_error").estimate
        assert any("declared law" in note for note in fit.notes)
        z += [(fit.value(n) - case.truth[n]) / std for n, std in zip(fit.names, fit.std, strict=True)]
    assert len(z) == 9
    assert np.abs(z).max() < 3.5


@pytest.mark.slow
def test_a_stribeck_curve_in_samples_of_5_ms_has_intervals_that_hold():
    """With one step a sample its level was 9 sigma off, and sigma 26 times as large."""
    case = next(c for c in cases("last") if c.seed == 14343)
    setup = case.setup()
    run = setup.run()
    text = case_text(setup, [*case.values.items()], off=1.3, motion=case.size.motion, sensor=case.sensor)
    log = {"t": run["t"], "q": run["position"], "u": run["force"], "ref": run["reference"]}
    fit = jaxid.identify(tomllib.loads(text), log, method="prediction_error").estimate
    true = np.array([case.truth[name] for name in fit.names])
    assert np.all(np.abs(fit.theta - true) < 3.5 * fit.std)
    assert fit.std[fit.names.index("stribeck_friction.level")] < 1e-4 * case.truth["stribeck_friction.level"]


@pytest.mark.slow
def test_an_encoder_of_500_counts_a_turn_gives_intervals_that_hold():
    """Without the samples at rest sigma was 2.7 times as large, and held less often."""
    count, t, z, parts = 2 * np.pi / 500, np.arange(4000) / 500.0, [], []
    for seed in range(5):
        rng = np.random.default_rng([3, seed])
        inertia, viscous, coulomb = (np.array([0.02, 0.12, 0.25]) * rng.uniform(0.6, 1.6, 3)).tolist()
        force = 3.0 * np.sin(2 * np.pi * rng.uniform(0.3, 0.5) * t)
        force += multisine(t, [0.7, 1.3, 2.9, 5.1], 1.8, seed)
        effects = {"viscous_friction": {"coefficient": viscous}, "coulomb_friction": {"level": coulomb}}
        sensor = Sensor(position_resolution=count)
        made = Setup(Machine(inertia, effects), Loop(input=force), sensor, 500.0, 8.0, seed)
        text = case_text(made, list(effects.items()), off=1.4, motion="rotary", sensor=False)
        case = tomllib.loads(text) | {"sensor": {"position_resolution": count}}
        run = made.run()
        log = {"t": run["t"], "q": run["position"], "u": run["force"]}
        fit = jaxid.identify(case, log, method="prediction_error").estimate
        z.append((fit.theta - [inertia, viscous, coulomb]) / fit.std)
        parts.append(fit.std[0] / inertia)
    assert np.all(np.abs(z) < 3), z
    assert np.mean(parts) < 1e-4


def test_nothing_unknown_leaves_the_noise(tmp_path):
    path, log = opened(tmp_path, 1, closed=False)
    path.write_text(re.sub(r"{ guess = \S+, true = (\S+) }", r"\1", path.read_text()))
    session = open_session(path, log)
    fit = prediction_error(session.machine, session.fit.log)
    assert fit.converged
    assert fit.theta.size == 0
    assert fit.std_misspecified.size == 0
    # As simulated, in units of the command and in metres.
    assert fit.details["noise"]["force"] == pytest.approx([0.1], rel=0.1)
    assert fit.details["noise"]["position"] == pytest.approx([1e-6], rel=0.1)


def test_steps_are_counted_where_the_fit_starts(tmp_path, monkeypatch):
    counted = []

    def steps(machine, log):
        counted.append(float(machine.plant.inertia))
        raise InputError("enough")

    monkeypatch.setattr("jaxid.estimators.likelihood.needed_steps", steps)
    session = open_session(*opened(tmp_path, 1, closed=False))
    for start in (TRUE, None):
        with pytest.raises(InputError, match="enough"):
            prediction_error(session.machine, session.fit.log, start=start)
    assert counted == [TRUE[0], pytest.approx(TRUE[0] / 1.5)]


def test_a_machine_at_its_estimates_leaves_out_the_same_samples_at_rest(tmp_path):
    """Its values are numbers of numpy, as those of a refit are."""
    session = open_session(*opened(tmp_path, 1, closed=False))
    machine, rest = session.machine, np.asarray(session.fit.data.recipe.rest_velocity)
    again = machine.with_estimate(machine.parameters.guess)
    counts = [likelihood_of(m, session.fit.log, rest_velocity=rest).problem.counts for m in (machine, again)]
    np.testing.assert_array_equal(counts[0], counts[1])
    assert counts[0].sum() < session.fit.log.samples


@pytest.mark.parametrize("closed", [False, True])
def test_deviations_are_those_of_the_standard_deviations(fits, closed):
    z = np.array([(fit.theta - TRUE) / fit.std for fit in fits[closed]])
    assert all(fit.converged for fit in fits[closed])
    # The largest of 18 normal numbers is below 3.5 in 99 %. Their RMS is about one; those of one log are
    # correlated.
    assert np.abs(z).max() < 3.5
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.5


def test_the_noise_is_estimated(fits):
    noise = [fit.details["noise"] for fit in fits[False]]
    assert np.median([n["force"] for n in noise]) == pytest.approx(0.1, rel=0.15)
    assert np.median([n["force_reading"] for n in noise]) == pytest.approx(0.1, rel=0.1)
    assert np.median([n["position"] for n in noise]) == pytest.approx(1e-6, rel=0.05)


def test_a_declared_law_removes_the_noise_of_the_reading(fits):
    for alone, looped in zip(*fits.values(), strict=True):
        assert np.all(looped.std < 0.3 * alone.std)
        assert looped.details["noise"]["force"] < 0.03  # 0.1 with that of the reading
        assert any("declared law" in note for note in looped.notes)
        assert not any("declared law" in note for note in alone.notes)


@pytest.mark.slow
def test_innovations_of_a_complete_model_are_white_and_of_another_not(fits, tmp_path):
    assert all(min(fit.details["whiteness"]["p"]) > 1e-3 for fit in fits[False])
    path, log = opened(tmp_path, 1, closed=False)
    text = path.read_text()
    at = text.index('[[effects]]\nkind = "coulomb')
    path.write_text(text[:at] + text[text.index("[actuator]") :])
    bare = jaxid.identify(path, log, method="prediction_error").estimate
    assert min(bare.details["whiteness"]["p"]) < 1e-6
    assert any("not white" in note and "Hz" in note for note in bare.notes)


@pytest.mark.slow
def test_noise_of_the_command_does_not_bias_the_inertia(tmp_path):
    # Noise of a fifth of the command: without the correction the mean is 3.4 deviations too large.
    noise = {"force_noise": 0.6, "position_noise": 1e-7}
    files = [opened(tmp_path, seed, closed=False, **noise) for seed in range(1, LOGS + 1)]
    cases, logs = zip(*files, strict=True)
    fits = jaxid.identify_many(cases, logs, method="prediction_error", lanes=LOGS)
    z = np.array([(fit.theta - TRUE) / fit.std for fit in fits])[:, 0]
    assert abs(z.mean()) < 3 / np.sqrt(LOGS)


def test_a_law_explains_its_command_but_for_white_noise(tmp_path):
    path, log = opened(tmp_path, 3, closed=True, force_noise=0.0)
    session = open_session(path, log)
    rough = session.fit.log
    assert noise_free_command(session.machine, rough) is not None
    read = dataclasses.replace(
        rough, force=rough.force + 0.05 * np.random.default_rng(0).standard_normal(rough.force.shape)
    )
    assert noise_free_command(session.machine, read) is not None
    # One tick in a hundred is off: the law does not explain the command.
    jumps = np.where(np.arange(rough.samples) % 100 == 50, 0.5, 0.0)[:, None]
    pulsed = dataclasses.replace(read, force=read.force + jumps)
    assert noise_free_command(session.machine, pulsed) is None
    # A law with another gain does not explain the command.
    kp = dataclasses.replace(session.machine.controller, kp=1.1 * session.machine.controller.kp)
    other = dataclasses.replace(session.machine, controller=kp)
    assert noise_free_command(other, read) is None


@pytest.mark.parametrize(
    ("closed", "change", "method"),
    [
        (False, "", "prediction_error"),
        (True, "", "prediction_error"),
        (True, "[output_error]\non = 'force'\n", "output_error"),
        (True, "[within_prior]\nprior = 0.5\n", "within_prior"),
        (True, "[[effects]]\nkind = 'static_friction'\nlevel = { guess = 5.0 }\n", "output_error"),
    ],
)
def test_the_method_is_chosen_with_a_reason(tmp_path, closed, change, method):
    path, log = opened(tmp_path, 1, closed=closed)
    path.write_text(path.read_text() + change)
    choice = choose_method(open_session(path, log))
    assert choice.method == method
    assert choice.reason


def test_the_choice_stands_in_the_result(tmp_path):
    path, log = opened(tmp_path, 1, closed=True)
    found = jaxid.identify(path, log)
    assert found.estimate.method == "prediction_error"
    assert found.estimate.details["settings"]["method"]["value"] == "prediction_error"
    assert "was chosen because" in str(found)
    assert jaxid.identify(path, log, on="force").estimate.method == "output_error"


def test_scoring_finds_mean_and_variance():
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, 4000)[:, None]
    y = 2.0 + 3.0 * t + 0.7 * rng.standard_normal(t.shape)

    def outputs(x):
        return y - x[0] - x[1] * t, jnp.exp(2 * x[2]) * jnp.ones_like(t)

    wide = jnp.full(3, 1e3)
    fit = maximise_likelihood(outputs, jnp.ones(t.shape, bool), jnp.array([0.0, 0.0, 3.0]), -wide, wide, 60)
    rows = np.concatenate([np.ones_like(t), t], axis=1)
    best = np.linalg.lstsq(rows, y, rcond=None)[0][:, 0]
    spread = np.sqrt(np.mean((y[:, 0] - rows @ best) ** 2))
    assert bool(fit.converged)
    np.testing.assert_allclose(fit.x, [*best, np.log(spread)], atol=1e-4)
    cost = lambda x: jnp.sum(0.5 * outputs(x)[0] ** 2 / outputs(x)[1] + 0.5 * jnp.log(outputs(x)[1]))
    at = jnp.array([1.0, 2.0, 0.5])
    one = maximise_likelihood(outputs, jnp.ones(t.shape, bool), at, -wide, wide, 1)
    np.testing.assert_allclose(one.gradient, jax.grad(cost)(at), rtol=1e-9)


def test_slow_readings_of_a_coarse_encoder_are_thinned(tmp_path):
    path, log = opened(tmp_path, 4, closed=False, position_resolution=2e-5, position_noise=1e-6)
    session = open_session(path, log)
    measured = session.fit.log
    used = readings_used(session.machine, measured)[:, 0]
    speed = np.abs(smooth_steps(measured))[:, 0] / 2e-5
    assert used[speed > 1.0].all()
    between = (speed > 0.1) & (speed < 0.9)
    assert used[between].sum() == pytest.approx(speed[between].sum(), rel=0.15)
    # With noise of half a count each rounding error is new.
    dithered = dataclasses.replace(session.machine.sensor, position_noise=np.asarray(1e-5))
    assert readings_used(dataclasses.replace(session.machine, sensor=dithered), measured).all()


def test_samples_at_rest_and_at_reversals_are_slow(tmp_path):
    path, log = opened(tmp_path, 5, closed=False)
    measured = open_session(path, log).fit.log
    velocity = np.gradient(log["ref"], 1e-3)
    slow = slow_samples(measured, np.array([5e-3]))[:, 0]
    assert slow[np.abs(velocity) < 1e-4].mean() > 0.9
    assert not slow[np.abs(velocity) > 0.04].any()


@pytest.mark.parametrize(("lag", "friction", "steps"), [(True, True, 4), (True, False, 1), (False, True, 1)])
def test_friction_behind_a_lag_takes_finer_steps(tmp_path, lag, friction, steps):
    """The force changes within a step: with one a sample a fit lost 1800 of log-likelihood."""
    axis = emps_like(0, 1.0, 1.0)
    effects = {"viscous_friction": {"coefficient": 203.5}}
    effects |= {"coulomb_friction": {"level": 20.39}} if friction else {}
    effects |= {"actuator_lag": {"time_constant": 0.01}} if lag else {}
    text = case_text(axis, [*effects.items()], off=1.0)
    session = open_session(write_case(tmp_path, text), log_of(axis))
    assert needed_numerics(session.machine, session.fit.log, None).substeps == steps
