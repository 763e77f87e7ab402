"""The verdict on a model: complete or not on exact logs, impossible values, the order of its sentences."""

import json
from dataclasses import replace
from html import unescape

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_arms import arm
from jaxid.consistency.late_force import LateForce
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.gap import force_gap, gaps
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.numerics.precision import Precision
from jaxid.results.as_text import verdict_line
from jaxid.results.verdict import judge
from jaxid.results.verdict.absurd import remarks_on
from jaxid.results.verdict.completeness import (
    Residual,
    cumulated_excess,
    position_residuals,
    residuals_of,
    spectrum_of_draws,
    systematic_rms,
)
from jaxid.session import open_session
from truth.axis.cases import case_text, write_case
from truth.axis.machines import Setup, multisine
from truth.axis.slow_axis import DECLARED, STRIBECK, drag_axis, slow_axis
from truth.axis.stepper import Loop, Machine, Sensor


def columns(setup):
    run = setup.run()
    return {"t": run["t"], "q": run["position"], "u": run["force"], "ref": run["reference"]}


def fitted(folder, setup, declared=DECLARED, *, sensor=True, closed=False, **options):
    """Identify a setup by inverse dynamics."""
    path = write_case(folder, case_text(setup, declared, sensor=sensor, closed=closed))
    return jaxid.identify(path, columns(setup), method="inverse_dynamics", **options)


@pytest.fixture(scope="module")
def missing(tmp_path_factory):
    return fitted(tmp_path_factory.mktemp("missing"), slow_axis(1, duration=4.0))


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    return fitted(tmp_path_factory.mktemp("complete"), slow_axis(1, duration=4.0), [*DECLARED, STRIBECK])


def verdicts(folder, seeds, sensor, **axis):
    out = []
    for seed in seeds:
        setup = slow_axis(seed, **axis)
        declared = DECLARED if axis.get("stribeck", 1.0) < 1.0 else [*DECLARED, STRIBECK]
        path = write_case(folder, case_text(setup, declared, sensor=sensor, closed=False))
        session = open_session(path, columns(setup), align_hold=True)
        estimate = inverse_dynamics(session.machine, session.fit.data)
        gap = force_gap(estimate.machine, session.fit.data)
        (found,) = residuals_of(estimate.machine, session.fit, gap)
        out.append(found.complete)
    return out


@pytest.mark.parametrize("sensor", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_complete_model_is_complete(tmp_path, sensor):
    for noise in (0.1, 1.0, 10.0):
        assert verdicts(tmp_path, (1, 2), sensor, noise=noise) == [True, True]


@pytest.mark.parametrize("sensor", [True, False])
def test_a_tenth_of_a_stribeck_term_is_seen_where_the_noise_allows(tmp_path, sensor):
    """It adds a fifth to the RMS of the residual; under ten times the noise it is out of sight."""
    assert verdicts(tmp_path, (1, 2), sensor, stribeck=0.1) == [False, False]
    assert verdicts(tmp_path, (1,), sensor, stribeck=0.1, noise=10.0) == [True]


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [True, False])
def test_false_alarms_and_power(tmp_path, sensor):
    for noise in (0.1, 1.0, 10.0):
        assert verdicts(tmp_path, range(1, 41), sensor, noise=noise).count(True) >= 39
    assert verdicts(tmp_path, range(1, 41), sensor, stribeck=0.1).count(False) >= 38


def test_white_rows_exceed_the_limit_as_rarely_as_is_said():
    random = np.random.default_rng(1)
    tests = [cumulated_excess(random.standard_normal(400)) for _ in range(4000)]
    for part in (0.2, 0.01):
        above = np.mean([excess > np.sqrt(-0.5 * np.log(part) / count) for excess, count, _ in tests])
        assert 0.5 * part < above < 1.3 * part
    assert np.mean([power for *_, power in tests]) == pytest.approx(1.0, abs=0.01)
    slow = np.convolve(random.standard_normal(409), np.ones(10) / 10, "valid")
    assert cumulated_excess(slow)[0] > 0.5


def shaken(rng: np.random.Generator, runs: int) -> np.ndarray:
    """White readings of a motion that their noise shakes slowly, (runs, 600)."""
    slow = np.convolve(rng.standard_normal(runs * 600 + 9), np.ones(10) / 10, "valid").reshape(runs, 600)
    return rng.standard_normal((runs, 600)) + 2.0 * slow


def test_noise_that_shakes_a_loop_is_no_missing_physics():
    rng = np.random.default_rng(2)
    moving = rng.random(600) < 0.8
    white = [cumulated_excess(e[moving])[:2] for e in shaken(rng, 100)]
    limit = np.sqrt(-0.5 * np.log(1e-3) / white[0][1])
    assert np.mean([excess > limit for excess, _ in white]) > 0.5

    # The high band holds some of the shaking too, in the draws as in the log.
    for level, power in ((1.0, 1.0), (None, 1.07)):
        colour = spectrum_of_draws(shaken(rng, 50), moving, level)
        tests = [cumulated_excess(e[moving], colour) for e in shaken(rng, 400)]
        assert np.mean([excess > limit for excess, *_ in tests]) < 0.01
        assert np.mean([mean for *_, mean in tests]) == pytest.approx(power, abs=0.02)
        missing = 1.5 * np.sin(0.02 * np.arange(600))
        seen = [cumulated_excess((e + missing)[moving], colour)[0] > limit for e in shaken(rng, 100)]
        assert np.mean(seen) > 0.95


def arm_at_truth(seed: int, *, gain: float = 1.0):
    """Return the session of an arm without a force at its true values, or with other gains of position."""
    drawn = arm(seed)
    case = drawn.case()
    case["controller"]["kp"] = [{"guess": gain * servo.kp} for servo in drawn.servos]
    case["controller"]["kd"] = [{"guess": servo.kd} for servo in drawn.servos]
    case["controller"]["delay"] = [
        {"guess": servo.effects["command_delay"]["delay"]} for servo in drawn.servos
    ]
    for link, servo in zip(case["plant"]["links"], drawn.servos, strict=True):
        link["rotor_inertia"] = {"guess": servo.rotor}
    for effect in case["effects"]:
        name = {"viscous_friction": "coefficient", "coulomb_friction": "level"}[effect["kind"]]
        effect[name] = {"guess": drawn.servos[effect["joint"] - 1].effects[effect["kind"]][name]}
    return open_session(case, drawn.columns())


@pytest.mark.slow
def test_an_arm_whose_loops_shake_it_is_complete_at_the_truth():
    """The excess of its second joint over white noise is 0.155 for a limit of 0.121."""
    session = arm_at_truth(40_018)
    (gap,) = gaps(session.machine, session.runs)
    found = position_residuals(session.machine, session.fit, gap.simulation)
    assert [r.complete for r in found] == [True, True]


@pytest.mark.slow
def test_a_search_of_an_arm_that_leaves_more_than_noise_says_what_it_does_not_try():
    session = arm_at_truth(40_018, gain=0.8)
    machine, names = session.machine, session.machine.parameters.names
    known, covariance = np.ones(len(names), bool), 1e-8 * np.eye(len(names))
    precision = replace(Precision.unknown(names), covariance=covariance, identifiable=known)
    estimate = Estimate("", machine, machine.parameters.guess, precision, True, "", np.zeros((1, 2)), 1)
    left = gaps(machine, session.runs)
    for search in ("found", "unexplained", "nothing_missing", None):
        findings = judge(session, estimate, left, search).findings
        said = any("elastic or has clearance is searched for" in line for line in findings)
        assert said == (search in ("found", "unexplained"))


@pytest.mark.parametrize("samples", [1, 2, 4])
def test_so_few_samples_have_no_systematic_part(samples):
    assert systematic_rms(np.ones(samples), NoiseModel.fit(np.ones(40), np.ones(40, bool))) == 0.0


def test_an_incomplete_model_is_said_first(missing):
    assert missing.model_complete is False
    assert missing.judgement.explains
    first = missing.findings[0]
    assert first.startswith("The model is incomplete: the force gap of ")
    assert first.endswith(" that the sensors' noise leaves.")
    assert any("jaxid discover" in line for line in missing.findings)
    assert str(missing).startswith(first)
    assert first in repr(missing)
    assert "The model is incomplete" in missing._repr_html_()


def test_a_complete_model_says_so(complete):
    assert complete.model_complete is True
    assert complete.findings[0] == (
        "The model is complete for this log: what it leaves has the size and colour of noise."
    )


# A residual of twice the noise that follows the motion, within the errors of filtering.
SMALL = Residual("log", 0, True, rms=2.0, floor=1.0, excess=0.5, limit=0.1, systematic=1.7, numerics=3.0)


@pytest.mark.parametrize(
    ("changed", "within"),
    [
        ({}, True),
        ({"excess": 0.0}, True),
        ({"numerics": 1.8}, True),
        ({"rms": 1.2}, False),
        ({"floor": np.nan}, False),
        ({"complete": False}, False),
        ({"excess": 0.0, "numerics": 1.8}, False),
    ],
)
def test_more_than_noise_is_not_called_noise(changed, within):
    assert replace(SMALL, **changed).within_numerics == within


def test_a_doubt_on_the_unit_of_the_force_comes_first(tmp_path):
    setup = slow_axis(1, duration=4.0)
    path = write_case(tmp_path, case_text(setup, [*DECLARED, STRIBECK], sensor=False, closed=False))
    log = columns(setup)
    log["u"] = 1e3 * log["u"]
    result = jaxid.identify(path, log, method="inverse_dynamics")
    assert result.model_complete is not True
    assert result.findings[0].startswith("A unit is in doubt: the log implies an inertia")
    assert "force looks like thousandths of its unit" in result.findings[0]


def test_files_and_report_say_the_same(missing, complete, tmp_path):
    for result, badge in ((missing, "the model is incomplete"), (complete, "5 parameters identified")):
        folder = result.save(tmp_path / badge.replace(" ", "_"))
        written = json.loads((folder / "result.json").read_text())
        assert written["model_complete"] is result.model_complete
        assert written["explains_log"] is True
        assert written["findings"] == list(result.findings)
        page = unescape((folder / "report.html").read_text()).replace("\u00a0", " ")
        style = "good" if result.model_complete else "open"
        assert f'<p class="badge {style}">{badge}</p>' in page
        for finding in result.findings:
            assert finding in page


def rejudged(result, **changes):
    """Judge a result with another estimate, or other gaps."""
    estimate = replace(result.estimate, **changes.pop("estimate", {}))
    gap = result.gaps[0]
    force = replace(gap.force, **changes.pop("force", {}))
    return judge(result.session, estimate, [replace(gap, force=force, **changes)])


def test_a_gap_of_the_order_of_the_force_comes_first(missing, complete):
    found = rejudged(missing, force={"relative": np.array([0.66])})
    assert not found.explains
    assert found.findings[0] == (
        "This model does not explain the log: it leaves 66 % of the measured force unexplained."
    )
    # The force of a complete model may be mostly noise.
    assert rejudged(complete, force={"relative": np.array([0.66])}).explains


def test_an_open_loop_that_drifts_is_no_headline(missing):
    found = rejudged(missing, simulation=None)
    assert found.explains
    assert found.drifted
    assert "open loop" in found.findings[-1]
    assert "open loop" not in found.findings[0]


def test_a_loop_that_leaves_the_log_is_a_headline(tmp_path):
    setup = slow_axis(1, duration=4.0)
    result = fitted(tmp_path, setup, [*DECLARED, STRIBECK], closed=True)
    assert result.judgement.explains
    far = result.gaps[0].simulation
    far = replace(far, rms=np.array([0.7 * np.std(result.session.fit.log.position)]))
    found = rejudged(result, simulation=far)
    assert found.findings[0] == (
        "This model does not explain the log: the simulated loop leaves it, by 70 % of the motion."
    )
    assert rejudged(result, simulation=None).findings[0].endswith("the simulated loop diverges.")


def changed(result, name, value, std=None):
    k = result.estimate.names.index(name)
    theta = np.where(np.arange(len(result.estimate.theta)) == k, value, result.estimate.theta)
    covariance = result.estimate.precision.covariance.copy()
    covariance[k, k] = covariance[k, k] if std is None else std**2
    return {"theta": theta, "precision": replace(result.estimate.precision, covariance=covariance)}


@pytest.mark.parametrize(
    ("name", "value", "std", "told", "explains"),
    [
        ("inertia", 1e-8, 1e-9, "ran to zero", False),
        ("inertia", 1.2e6, 1.0, "times above its guess", False),
        ("inertia", 20000.0, 100000.0, "exceeds the value", True),
        ("coulomb_friction.level", 0.0, 1.0, "is at its lower bound, 0", True),
        ("coulomb_friction.level", -5.0, 1.0, "is negative, which no machine is", False),
        ("coulomb_friction.level", -5.0, 2.5, "is negative, which no machine is: the log does not", False),
        ("coulomb_friction.level", -5.0, 10.0, "is negative, which no machine is: the log does not", True),
    ],
)
def test_values_in_words(missing, name, value, std, told, explains):
    # The lower bound of the inertia is 1e-9 of its guess, 120 kg.
    value = 120e-9 if told == "ran to zero" else value
    found = rejudged(missing, estimate=changed(missing, name, value, std))
    assert found.explains is explains
    (line,) = [line for line in found.findings if told in line and name in line]
    assert (line == found.findings[0]) is not explains


def test_nothing_identified_is_said(missing):
    precision = missing.estimate.precision
    covariance = np.diag(np.square(10.0 * np.abs(missing.estimate.theta) + 1.0))
    found = rejudged(missing, estimate={"precision": replace(precision, covariance=covariance)})
    assert not found.identified
    assert found.findings[0] == "This log determines none of the unknowns."


def test_a_ripple_finer_than_the_encoder_is_impossible(tmp_path):
    setup = slow_axis(1, duration=4.0)
    cogging = ("cogging", {"amplitude": 1.0, "period": 0.02, "phase": 0.1})
    path = write_case(tmp_path, case_text(setup, [*DECLARED, cogging], closed=False))
    session = open_session(path, columns(setup))
    free = session.machine.parameters.free
    theta = np.array([1e-7 if f.name == "cogging.period" else f.guess for f in free])
    precision = Precision(np.diag(np.square(0.01 * theta)), np.ones(len(free), bool), [], np.ones(len(free)))
    machine = session.machine.with_estimate(theta)
    residual = np.zeros((1, 1))
    (remark,) = remarks_on(session, Estimate("", machine, theta, precision, True, "", residual, 1))
    assert remark.impossible
    assert remark.text == (
        "cogging.period = 1.00 × 10⁻⁷ m is shorter than two counts of the encoder, 2.00 × 10⁻⁶ m"
    )


@pytest.mark.parametrize(
    ("load", "std", "impossible"), [(181.0, 0.1, True), (181.0, 2.0, False), (100.0, 1.0, None)]
)
def test_a_part_that_exceeds_the_whole_is_not_complete(tmp_path, load, std, impossible):
    setup = slow_axis(1, duration=4.0)
    spring = ("joint_flexibility", {"stiffness": 1e6, "damping": 100.0, "load_inertia": 100.0})
    path = write_case(tmp_path, case_text(setup, [*DECLARED, spring], closed=False, off=1.0))
    session = open_session(path, columns(setup))
    free = session.machine.parameters.free
    theta = np.array([load if f.name.endswith("load_inertia") else f.guess for f in free])
    deviation = np.array([std if f.name.endswith("load_inertia") else 0.01 * f.guess for f in free])
    precision = Precision(np.diag(np.square(deviation)), np.ones(len(free), bool), [], np.ones(len(free)))
    machine = session.machine.with_estimate(theta)
    residual = np.zeros((1, 1))
    remarks = remarks_on(session, Estimate("", machine, theta, precision, True, "", residual, 1))
    assert [(r.impossible, r.forbids) for r in remarks] == (
        [] if impossible is None else [(impossible, True)]
    )
    assert all("is a part of the joint's inertia, and exceeds it, 180 kg" in r.text for r in remarks)


def test_no_model_with_a_late_force_is_complete(complete):
    late = LateForce(
        gap=np.array([1.0]),
        rival=np.array([1.01]),
        effects=("joint_flexibility",),
        unit="N",
        delay=0.002,
        lag=0.0,
    )
    found = judge(complete.session, complete.estimate, complete.gaps, "found", late)
    assert found.model_complete is None
    assert found.findings[0].startswith(
        "The force seems to be logged 2 ms late: that explains the log as well"
    )
    assert "Whether the model is complete is not known: joint_flexibility may stand for the late force." in (
        found.findings
    )


def test_an_incomplete_model_has_a_deviation_that_holds_for_the_best_fit(missing, complete, tmp_path):
    """Beside the other, with the words that go with it; a complete model needs none."""
    k = missing.estimate.names.index("coulomb_friction.level")
    written = json.loads((missing.save(tmp_path / "a") / "result.json").read_text())
    entry = written["parameters"]["coulomb_friction.level"]
    assert entry["std_misspecified"] == missing.estimate.std_misspecified[k] > 0
    assert "std of the best fit" in str(missing)
    assert "σ of the best fit" in (tmp_path / "a" / "report.html").read_text()

    written = json.loads((complete.save(tmp_path / "b") / "result.json").read_text())
    assert all("std_misspecified" not in entry for entry in written["parameters"].values())
    assert "of the best fit" not in str(complete) + (tmp_path / "b" / "report.html").read_text()


@pytest.mark.slow
def test_spread_over_motions_of_a_model_without_drag(tmp_path):
    """Under quadratic drag that the model lacks the deviation for noise is a quarter of the spread."""
    theta, plain, beside = [], [], []
    for seed in range(1, 41):
        setup = drag_axis(seed)
        path = write_case(tmp_path, case_text(setup, DECLARED, closed=False))
        session = open_session(path, columns(setup), align_hold=True)
        estimate = inverse_dynamics(session.machine, session.fit.data)
        theta.append(estimate.theta[1])
        plain.append(estimate.std[1])
        beside.append(estimate.std_misspecified[1])
    spread = np.std(theta, ddof=1)
    assert np.sqrt(np.mean(np.square(plain))) < 0.4 * spread
    assert 0.7 < np.sqrt(np.mean(np.square(beside))) / spread < 1.3


@pytest.mark.parametrize(
    ("verdict", "complete", "hedged"),
    [("nothing_missing", None, True), ("nothing_missing", True, False), ("found", None, False)],
)
def test_the_terminal_says_if_nothing_is_known_to_be_missing(verdict, complete, hedged):
    line = verdict_line(verdict, complete)
    assert line.startswith(f"verdict: {verdict}")
    assert line.endswith("is not known)") == hedged


@pytest.mark.slow
def test_a_gap_far_above_the_noise_floor_is_no_complete_model():
    """A ripple of a wrong period leaves several times the floor, in the colour of a rough command."""
    t = np.arange(10_000) / 1000.0
    reference = multisine(t, [0.3, 0.7, 1.3, 2.6], 1.5, 1)
    ripple = {"amplitude": 0.15, "period": 2 * np.pi / 36, "phase": 0.5}
    friction = {"viscous_friction": {"coefficient": 0.12}, "coulomb_friction": {"level": 0.5}}
    law = Loop("cascade_pd", kp=40.0 / 1.2, kv=1.2, limit=np.inf, reference=reference)
    encoder = Sensor(position_resolution=2 * np.pi / 20_000, position_noise=1e-5, force_noise=0.02)
    machine = Machine(0.04, {**friction, "cogging": ripple})
    run = Setup(machine, law, encoder, 1000.0, 10.0, 1).run()
    effects = [
        {"kind": "viscous_friction", "coefficient": {"guess": 0.08}},
        {"kind": "coulomb_friction", "level": {"guess": 0.3}},
        {"kind": "cogging", "amplitude": {"guess": 0.1}, "period": 0.1698, "phase": {"guess": 0.1}},
    ]
    case = {
        "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": {"guess": 0.06}}},
        "effects": effects,
        "log": {"time": "t", "position": "q", "force": "u"},
    }
    log = {"t": run["t"], "q": run["position"], "u": run["force"]}
    wrong = jaxid.identify(case, log)
    assert wrong.model_complete is not True
    assert "times the noise" in wrong.findings[0]
    assert any("jaxid discover" in line for line in wrong.findings)
    effects[2]["period"] = ripple["period"]
    assert jaxid.identify(case, log).model_complete is True
