"""Hessian and profiles of the innovations' likelihood: against differences, by hand, and in memory."""

import dataclasses
from dataclasses import dataclass

import jax
import numpy as np
import pytest
import scipy.optimize
import scipy.signal

import jaxid
from jaxid.build import build_machine
from jaxid.errors import InputError
from jaxid.estimators import choice
from jaxid.estimators.choice import choose_method
from jaxid.estimators.common.profile import OFFSETS
from jaxid.estimators.innovations import Innovations, fit, whole_hessian
from jaxid.estimators.prediction_error import prediction_error, prediction_error_steps
from jaxid.logs.log import Log
from jaxid.numerics.full_hessian import profiled_out
from jaxid.session import open_session
from jaxid.simulation.replay import Numerics
from tests.estimators.test_prediction_error import opened
from tests.support.cli_setup import run
from tests.support.written_logs import write_csv
from truth.axis.cases import write_case

PERIOD, SAMPLES = 0.02, 300
MASS, DAMPING, STIFFNESS = 2.0, 0.5, 200.0
# The force's noise swings the mass by as much as the reading's noise: both are known badly.
FORCE_NOISE, READING_NOISE = 10.0, 0.2
CASE = {
    "plant": {"kind": "axis", "parameters": {"inertia": MASS}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": DAMPING}},
        {"kind": "linear_stiffness", "coefficient": {"guess": STIFFNESS, "min": 1.0}},
    ],
    "log": {"time": "t", "position": "q", "force": "u"},
    "sensor": {"position_noise": READING_NOISE},
}
DAMPER, SPRING = "viscous_friction.coefficient", "linear_stiffness.coefficient"
NUMERICS = Numerics(substeps=4)
# The log whose noise makes the likelihood flattest along the damping, of the first sixteen.
BENT = 9


def swing(seed: int, quieter: float = 1.0) -> Log:
    """A pulse and white noise of the force on a mass at a spring, by the matrix exponential."""
    rng = np.random.default_rng(seed)
    a = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    b = np.array([[0.0], [1.0 / MASS]])
    step, push, *_ = scipy.signal.cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), PERIOD)
    u, x = np.zeros(SAMPLES), np.zeros((SAMPLES, 2))
    u[5:15] = 10.0
    force = u + FORCE_NOISE / quieter * rng.standard_normal(SAMPLES)
    for k in range(SAMPLES - 1):
        x[k + 1] = step @ x[k] + push[:, 0] * force[k]
    y = x[:, 0] + READING_NOISE / quieter * rng.standard_normal(SAMPLES)
    return Log(time=PERIOD * np.arange(SAMPLES), position=y[:, None], force=u[:, None], source="swing")


def shortened(log: Log, samples: int) -> Log:
    cut = {name: getattr(log, name)[:samples] for name in ("time", "position", "force")}
    return dataclasses.replace(log, **cut)


@pytest.fixture(scope="module")
def machine():
    return build_machine(jaxid.load_case(CASE), period=PERIOD)


@dataclass(frozen=True)
class Watched:
    """A fit, and the arguments of its requests by their function."""

    estimate: object
    requests: list

    def problem(self) -> tuple[Innovations, np.ndarray, np.ndarray]:
        """The likelihood, and the estimates and logarithms of the noise of its Hessian."""
        return next(args for function, args in self.requests if function is whole_hessian)


def watched(steps) -> Watched:
    """Run a fit by hand, and keep what it asked to be solved."""
    requests, answer = [], None
    while True:
        try:
            asked = steps.send(answer)
        except StopIteration as end:
            return Watched(end.value, requests)
        requests.append((asked.function, asked.args))
        answer = asked.function(*asked.args)


@pytest.fixture(scope="module")
def bent(machine) -> Watched:
    """The bent log, with everything asked for."""
    return watched(
        prediction_error_steps(machine, swing(BENT), numerics=NUMERICS, hessian=True, profile=[DAMPER])
    )


def gradient(problem: Innovations, x: np.ndarray) -> np.ndarray:
    """The gradient by the scoring, which has first derivatives only, by physical values and noise."""
    p = len(problem.places)
    slope = np.concatenate([np.asarray(problem.transform.slope(x[:p])), np.ones(len(x) - p)])
    return np.asarray(fit(problem, x[:p], x[p:], np.asarray(1)).gradient) / slope


def test_the_hessian_is_that_of_differences_of_the_gradient(machine, bent):
    """Over unknowns and noise: with Fisher's information for the Hessian each of these lines fails."""
    problem, theta, noise = bent.problem()
    x = np.concatenate([theta, noise])
    found = np.asarray(whole_hessian(problem, theta, noise))
    size = np.sqrt(np.abs(np.diag(found)))
    steps = np.diag(1e-4 / size)
    rows = [(gradient(problem, x + d) - gradient(problem, x - d)) / (2 * d[k]) for k, d in enumerate(steps)]
    differenced = np.array(rows)
    assert np.all(np.abs(gradient(problem, x)) < 0.02 * size)
    np.testing.assert_allclose(found / np.outer(size, size), differenced / np.outer(size, size), atol=1e-5)

    # The noise is profiled out: the block of the inverse is the inverse of the Schur complement.
    wanted = np.sqrt(np.diag(np.linalg.inv(differenced))[:2])
    plain = prediction_error(machine, swing(BENT), numerics=NUMERICS)
    assert (bent.estimate.precision.kind, plain.precision.kind) == ("full_hessian", "fisher_information")
    np.testing.assert_array_equal(bent.estimate.theta, plain.theta)
    # But for the colour of the innovations, which is the same in both.
    colour = np.sqrt(plain.precision.equivalent_variance)
    np.testing.assert_allclose(bent.estimate.std / colour, wanted, rtol=0.05)
    assert wanted[0] > 1.4 * plain.std[0] / colour[0]
    # Known noise would make the damping 1.2 times as certain.
    assert wanted[0] > 1.2 / np.sqrt(np.linalg.inv(np.linalg.inv(differenced[:2, :2]))[0, 0])
    assert any("times Fisher's information" in note for note in bent.estimate.notes)
    assert not any("Hessian" in note for note in plain.notes)


def test_profiles_fit_the_noise_again(bent):
    problem, theta, noise = bent.problem()
    entry = bent.estimate.details["profiles"][DAMPER]
    outputs = jax.jit(problem.outputs)

    def cost(x: np.ndarray, noise: np.ndarray) -> float:
        e, variance = map(np.asarray, outputs(x, noise))
        return float(np.sum((e**2 / variance + np.log(variance))[problem.counts]))

    def least(damping: float) -> float:
        size = np.array([theta[1], 1.0, 1.0])
        by_hand = lambda x: cost(np.array([damping, x[0] * theta[1]]), x[1:])
        start = np.array([theta[1], *noise]) / size
        options = {"xatol": 1e-5, "fatol": 1e-6, "maxfev": 2000}
        return float(scipy.optimize.minimize(by_hand, start, method="Nelder-Mead", options=options).fun)

    at = np.array(entry["at"])
    inside = at > 0
    assert 3 <= inside.sum() < len(at)  # a damping is not negative
    assert [r is None for r in entry["rise"]] == list(~inside)
    std, factor = bent.estimate.std[0], bent.estimate.precision.equivalent_variance[0]
    np.testing.assert_allclose(at, theta[0] + OFFSETS * std, rtol=1e-12)
    rise = np.array([r for r in entry["rise"] if r is not None])
    by_hand = np.array([least(x) - least(theta[0]) for x in at[inside]]) / factor
    np.testing.assert_allclose(rise, by_hand, rtol=5e-3, atol=2e-3)
    # At the noise of the fit it would rise by more.
    held = [cost(np.array([x, theta[1]]), noise) - cost(theta, noise) for x in at[inside]]
    assert held[-1] / factor > 1.2 * rise[-1]


def test_a_profile_compiles_nothing(machine, monkeypatch):
    """Each point is a fit between other bounds: it runs the code of the fit itself."""
    # Of a length that no other test compiles.
    traced, log = [], shortened(swing(BENT), SAMPLES - 7)
    plain = Innovations.outputs
    monkeypatch.setattr(Innovations, "outputs", lambda *of: traced.append(1) or plain(*of))
    prediction_error(machine, log, numerics=NUMERICS)
    before = len(traced)
    assert before > 0
    profiled = watched(prediction_error_steps(machine, log, numerics=NUMERICS, profile=[DAMPER, SPRING]))
    assert len(profiled.requests) > 8
    assert len(traced) == before


def test_noise_is_profiled_out_by_the_schur_complement():
    rng = np.random.default_rng(0)
    a = rng.standard_normal((5, 5))
    whole = a @ a.T + np.eye(5)
    kept = np.array([True, False, True, True, False])
    wanted = np.linalg.inv(np.linalg.inv(whole)[np.ix_(kept, kept)])
    np.testing.assert_allclose(profiled_out(whole, kept), wanted, rtol=1e-9)
    np.testing.assert_array_equal(profiled_out(whole, np.ones(5, bool)), whole)
    whole[1, 1] = -1.0
    assert profiled_out(whole, kept) is None
    assert profiled_out(np.full((5, 5), np.nan), kept) is None


def test_a_name_that_is_no_unknown_is_refused(machine):
    with pytest.raises(InputError, match=r"did you mean 'linear_stiffness\.coefficient'"):
        prediction_error(machine, swing(0), numerics=NUMERICS, profile=["linear_stifness.coefficient"])


# With so much noise as above nothing seems to move.
QUIETER = 100.0
TEXT = f"""
[plant]
kind = "axis"
[plant.parameters]
inertia = {MASS}
[[effects]]
kind = "linear_stiffness"
coefficient = {{ guess = {STIFFNESS}, min = 1.0 }}
[[effects]]
kind = "viscous_friction"
coefficient = {DAMPING}
[log]
time = "t"
position = "q"
force = "u"
[sensor]
position_noise = {READING_NOISE / QUIETER}
[preprocess]
cutoff_hz = 5.0
"""


def test_it_is_asked_for_by_option_case_and_argument(tmp_path, capsys):
    """On a log whose method is chosen: it stays prediction_error."""
    made = swing(BENT, quieter=QUIETER)
    log = write_csv(tmp_path / "log.csv", {"t": made.time, "q": made.position[:, 0], "u": made.force[:, 0]})
    case = write_case(tmp_path, TEXT)
    ran = run(capsys, "identify", case, log, "--hessian", "--profile", SPRING, folder=tmp_path / "out")
    assert ran.status == 0, ran.err
    assert "σ from the full Hessian" in ran.out
    assert f"profile of {SPRING}: 68 % interval " in ran.out
    content = ran.json("result.json")
    assert content["settings"]["method"]["value"] == "prediction_error"
    assert content["covariance"]["kind"] == "full_hessian"
    entry = content["profiles"][SPRING]
    assert entry["interval_68"][0] < entry["value"] < entry["interval_68"][1]
    case.write_text(TEXT + f'[identification]\nhessian = true\nprofile = ["{SPRING}"]\n')
    by_case = jaxid.identify(case, log)
    assert by_case.estimate.method == "prediction_error"
    np.testing.assert_allclose(by_case.covariance.matrix, content["covariance"]["matrix"], rtol=1e-9)
    assert by_case.estimate.details["profiles"][SPRING]["rise"] == pytest.approx(entry["rise"], rel=1e-6)
    assert jaxid.identify(case, log, hessian=False).covariance.kind == "fisher_information"


def test_a_filter_that_takes_long_leaves_it_to_output_error(tmp_path, monkeypatch):
    path, log = opened(tmp_path, 1, closed=True)
    session = open_session(path, log)
    assert choose_method(session, curvature=True).method == "prediction_error"
    monkeypatch.setattr(choice, "_LONG", 1000)
    assert choose_method(session).method == "inverse_dynamics"
    found = choose_method(session, curvature=True)
    assert found.method == "output_error"
    assert "Hessian" in found.reason
