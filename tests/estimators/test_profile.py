"""Profile likelihoods: against a cost that is profiled by hand, at a bound, and within a prior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import jaxid
from jaxid.build import build_machine
from jaxid.cli import main
from jaxid.estimators.common.profile import OFFSETS, likelihood_interval, profile_entry
from jaxid.estimators.output_error import output_error, output_error_steps
from jaxid.estimators.simulated_output import output_residual
from jaxid.numerics.lanes import run_batched
from jaxid.simulation.replay import make_replay, with_fitted_start
from tests.estimators.test_full_hessian import BENT, CASE, NUMERICS, PERIOD, SAMPLES, STIFFNESS, logs
from tests.support.cli_setup import place, recorded, refused, run

NAME = "linear_stiffness.coefficient"


@pytest.fixture(scope="module")
def machine():
    return build_machine(jaxid.load_case(CASE), period=PERIOD)


def profiled_by_hand(machine, log):
    """The sum of squares by the stiffness, at the best start, in which the swing is linear."""
    replay = with_fitted_start(make_replay(machine, log, NUMERICS), machine.plant, log)
    places = machine.parameters.places
    residual = output_residual(
        replay, places, machine.plant, jnp.asarray(log.position), jnp.ones((SAMPLES, 1))
    )
    both = jax.jit(lambda x: (residual(x)[:, 0], jax.jacfwd(residual)(x)[:, 0, 1:]))

    def least(stiffness: float) -> float:
        e, start = map(np.asarray, both(jnp.array([stiffness, 0.0, 0.0])))
        return float(np.sum((e - start @ np.linalg.lstsq(start, e)[0]) ** 2))

    return least


def test_the_profile_is_that_of_the_cost_by_hand(machine):
    """On a log whose cost is no parabola: it rises less than the deviation says."""
    log = logs(BENT + 1)[BENT]
    estimate = output_error(machine, log, numerics=NUMERICS, profile=[NAME])
    entry, least = estimate.details["profiles"][NAME], profiled_by_hand(machine, log)
    variance = estimate.precision.equivalent_variance[0]
    rise = lambda x: (least(x) - least(estimate.theta[0])) / variance
    np.testing.assert_allclose(entry["at"], estimate.theta[0] + OFFSETS * estimate.std[0], rtol=1e-12)
    np.testing.assert_allclose(entry["rise"], [rise(x) for x in entry["at"]], rtol=5e-3, atol=1e-3)
    # Quadratic it would be nine.
    assert entry["rise"][0] < 7 or entry["rise"][-1] < 7
    for level in (68, 95):
        wanted = scipy.stats.chi2.ppf(level / 100, 1)
        for end, far in zip(entry[f"interval_{level}"], (entry["at"][0], entry["at"][-1]), strict=True):
            root = scipy.optimize.brentq(lambda x, w=wanted: rise(x) - w, estimate.theta[0], far)
            assert end == pytest.approx(root, abs=0.03 * estimate.std[0])


def test_a_quiet_log_has_the_parabola_of_the_covariance(machine):
    (log,) = logs(1, noise=1e-4)
    estimate = output_error(machine, log, numerics=NUMERICS, profile=[NAME])
    entry = estimate.details["profiles"][NAME]
    np.testing.assert_allclose(entry["rise"], OFFSETS**2, rtol=0.01)
    half = 1.96 * estimate.std[0]
    np.testing.assert_allclose(entry["interval_95"], estimate.theta[0] + np.array([-half, half]), rtol=1e-6)


@pytest.mark.slow
def test_intervals_of_the_profile_hold_what_they_say(machine):
    """192 logs on which the deviation is a tenth too small: intervals of the profile hold no less."""
    steps = [output_error_steps(machine, log, numerics=NUMERICS, profile=[NAME]) for log in logs(192)]
    estimates = run_batched(steps, 16)
    inside = lambda ends: (
        (ends[0] is None or ends[0] <= STIFFNESS) and (ends[1] is None or STIFFNESS <= ends[1])
    )
    held = np.mean([inside(e.details["profiles"][NAME]["interval_95"]) for e in estimates])
    plain = np.mean([abs(e.theta[0] - STIFFNESS) < 1.96 * e.std[0] for e in estimates])
    # Binomial: 1.6 %.
    assert held >= plain
    assert 0.89 < held <= 1.0


def test_the_interval_of_a_known_curve():
    """A cubic term makes the sides unequal; the ends are where the rise is the quantile."""
    curve = lambda z, wanted=0.0: z**2 + 0.15 * z**3 - wanted
    for level in (0.68, 0.95):
        ends = likelihood_interval(curve(OFFSETS), level)
        wanted = scipy.stats.chi2.ppf(level, 1)
        roots = [scipy.optimize.brentq(curve, *sorted((0.0, far)), args=(wanted,)) for far in (-3.0, 3.0)]
        np.testing.assert_allclose(ends, roots, atol=0.03)
    np.testing.assert_allclose(likelihood_interval(OFFSETS**2, 0.95), [-1.96, 1.96], atol=1e-3)


def test_an_end_that_is_not_reached_is_open():
    flat = np.array([np.nan, np.nan, 1.0, 1.0, 4.0, 9.0])
    low, high = likelihood_interval(flat, 0.95)
    assert np.isnan(low)
    assert high == pytest.approx(1.96, abs=1e-3)
    entry = profile_entry(5.0, 0.5, 5.0 + 0.5 * OFFSETS, flat, 1.3, "kg")
    assert entry["interval_95"][0] is None
    assert entry["interval_95"][1] == pytest.approx(5.98, abs=1e-3)
    assert entry["rise"][:2] == [None, None]


def test_it_is_asked_for_by_option_case_and_argument(tmp_path, capsys):
    case, log = place(tmp_path / "in", recorded())
    out = tmp_path / "out"
    ran = run(capsys, "identify", case, log, "--profile", "inertia", folder=out)
    assert ran.status == 0
    assert "profile of inertia: 68 % interval " in ran.out
    assert "its colour as a constant factor of the variance" in ran.out
    entry = ran.json("result.json")["profiles"]["inertia"]
    assert entry["interval_95"][0] < entry["interval_68"][0] < entry["value"] < entry["interval_68"][1]
    page = (out / "report.html").read_text("utf-8")
    assert "Profile likelihood" in page
    case.write_text(case.read_text() + '[identification]\nprofile = ["inertia"]\n')
    assert jaxid.identify(case, log).estimate.details["profiles"].keys() == {"inertia"}
    for words, told in (
        (
            ("--profile", "inertja"),
            "profile: 'inertja' is not an unknown of the case; did you mean 'inertia'?",
        ),
        (
            ("--method", "algebraic", "--profile", "inertia"),
            "profile needs a method that maximises a likelihood",
        ),
        (("--method", "power"), "profile needs a method that maximises a likelihood, and power does not"),
    ):
        refused(capsys, tmp_path, "identify", case, log, *words, "-o", tmp_path / "none", told=told)
    assert main(["identify", str(case), str(log), "--profile"]) == 2
