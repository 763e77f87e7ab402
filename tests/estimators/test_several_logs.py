"""Several logs in one fit, on the exact axis: shared unknowns, known and unknown differences, weights."""

import dataclasses
import json
import tomllib

import numpy as np
import pytest

import jaxid
from jaxid import Log
from jaxid.errors import InputError
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.session import open_session
from tests.support.several_logs import LOADED, axis_case, axis_log, axis_setup, write_log

TRUE = np.array([95.1, 203.5, 20.39])


def slow(*methods: str) -> list:
    return [pytest.param(method, marks=pytest.mark.slow) for method in methods]


# Each of these has a quick test below; the others take longer.
METHODS = ("inverse_dynamics", "output_error", "prediction_error")
QUICK = METHODS[:2]
SLOWER = ("instrumental_variable", "didim", "within_prior", "recursive")
SLOW = slow(*SLOWER)
LOOPED = ("output_error", "instrumental_variable", "didim", "within_prior")


def case_of(method: str, **options) -> dict:
    """Return the case as a method takes it: with the loop if the method simulates it."""
    case = tomllib.loads(axis_case(closed=method in LOOPED, **options))
    return case | ({"within_prior": {"prior": 0.3, "drawn": False}} if method == "within_prior" else {})


@pytest.fixture(scope="module")
def logs() -> list[Log]:
    return [axis_log(seed) for seed in range(1, 5)]


@pytest.mark.parametrize("method", [*QUICK, *slow("prediction_error", "algebraic", "power"), *SLOW])
def test_the_deviation_of_n_equal_logs_falls_as_one_over_the_root_of_n(method, logs):
    case = case_of(method)
    one, four = (jaxid.identify(case, logs[:n], method=method).estimate for n in (1, 4))
    alone = [jaxid.identify(case, log, method=method).estimate.std for log in logs]

    assert four.converged
    assert np.all(np.abs(four.theta - TRUE) < 4 * four.std)
    # Each log's own deviation is an estimate, off by some percent; of some dozen windows by more.
    expected = 1 / np.sqrt(np.sum(np.square(1 / np.array(alone)), axis=0))
    if method != "didim":  # whose deviation of inertia scatters by a quarter among such logs
        assert four.std == pytest.approx(expected, rel=0.2 if method in ("algebraic", "power") else 0.1)
    assert one.std / four.std == pytest.approx(np.full(3, 2.0), rel=0.2)


@pytest.mark.parametrize(
    "method", [*QUICK, "instrumental_variable", "recursive", *slow("prediction_error"), *SLOW[1:3]]
)
def test_a_log_counts_by_its_information(method):
    # The long log has ten times the noise of the short one.
    seconds = (1.5, 2.5) if method in LOOPED and method in SLOWER else (2.0, 6.0)
    quiet, noisy = axis_log(5, seconds=seconds[0]), axis_log(6, noise=10.0, seconds=seconds[1])
    case = case_of(method, sensor=False)

    first, second = (jaxid.identify(case, log, method=method).estimate.std for log in (quiet, noisy))
    both = jaxid.identify(case, [quiet, noisy], method=method).estimate

    assert both.std == pytest.approx(1 / np.sqrt(1 / first**2 + 1 / second**2), rel=0.1)
    assert np.all(both.std < first)
    assert np.all(np.abs(both.theta - TRUE) < 4 * both.std)


@pytest.mark.parametrize("method", [*METHODS, *SLOW])
def test_a_payload_known_in_one_log_separates_the_gain(method, tmp_path):
    case = case_of(method, gain_unknown=True)
    case["fit"] = [{"name": "empty"}, {"log": "loaded.csv", "set": {"added_mass.mass": LOADED}}]
    write_log(tmp_path / "loaded.csv", axis_setup(8, added=LOADED, noise=0.1))
    empty = axis_log(7, noise=0.1)

    fit_alone = lambda: jaxid.identify({k: v for k, v in case.items() if k != "fit"}, empty, method=method)
    if method == "recursive":
        with pytest.raises(InputError, match="actuator_gain.gain is not identifiable"):
            fit_alone()
    elif method != "within_prior":
        assert not fit_alone().estimate.identifiable.any()
    case["fit"][1]["log"] = str(tmp_path / "loaded.csv")
    both = jaxid.identify(case, empty, method=method).estimate

    assert both.names[-1] == "actuator_gain.gain"
    assert both.identifiable.all()
    assert np.all(np.abs(both.theta - [*TRUE, 1.0]) < 4 * both.std)
    # Far below the prior of 0.3.
    assert np.all(both.std < 0.03 * np.abs(both.theta))


@pytest.fixture(scope="module")
def with_exact_command():
    """Fits of log 3, of log 1, and of both."""
    case, logs = tomllib.loads(axis_case(closed=True)), [axis_log(3), axis_log(1)]
    return [jaxid.identify(case, of, method="prediction_error").estimate for of in (logs[0], logs[1], logs)]


@pytest.mark.slow
def test_logs_with_an_exact_command_add_their_information(with_exact_command):
    # With the samples at rest the noise of log 3 rose to 0.3 % of the force, and its deviations by 20.
    one, other, both = (fit.std for fit in with_exact_command)
    assert np.all(np.maximum(one, other) < [0.001, 0.006, 0.001])
    assert both == pytest.approx((one**-2 + other**-2) ** -0.5, rel=0.2)
    for fit in with_exact_command:
        assert np.all(np.abs(fit.theta - TRUE) < 3 * fit.std)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="a factor of 1.77 in the Coulomb friction: log 1 says more of it")
def test_an_exact_command_informs_alike_in_every_log(with_exact_command):
    one, _, both = (fit.std for fit in with_exact_command)
    assert one / both == pytest.approx(np.full(3, 2**0.5), rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_noise_round_the_loop_does_not_bias_output_error(seed, tmp_path):
    # Not removed, it is 2.3 to 3.7 standard deviations in inertia, viscous friction and gain.
    case = case_of("output_error", gain_unknown=True)
    loaded = write_log(tmp_path / "loaded.csv", axis_setup(20 + seed, added=LOADED))
    case["fit"] = [{"name": "empty"}, {"log": str(loaded), "set": {"added_mass.mass": LOADED}}]
    both = jaxid.identify(case, axis_log(40 + seed), method="output_error").estimate
    assert np.all(np.abs(both.theta - [*TRUE, 1.0]) < 2 * both.std)
    assert any("the noise of the readings goes round the loop" in note for note in both.notes)


def test_a_payload_that_is_not_stated_does_not_separate_it(tmp_path):
    case = case_of("inverse_dynamics", gain_unknown=True)
    logs = [axis_log(7), axis_log(9)]
    both = jaxid.identify(case, logs, method="inverse_dynamics").estimate
    assert not both.identifiable.any()


@pytest.mark.parametrize("method", [*METHODS, *(p for p in SLOW if p.values[0] != "within_prior")])
def test_an_unknown_of_each_log_has_a_value_in_each(method, tmp_path):
    case = case_of(method, offset=True)
    case["identification"] = {"per_log": ["constant_force.level"]}
    logs = [axis_log(k, offset=offset) for k, offset in ((1, 4.0), (2, -3.0))]

    result = jaxid.identify(case, logs, method=method)
    shared = jaxid.identify(case_of(method, offset=True), logs, method=method)

    names = [f"constant_force.level @ {name}" for name in ("1", "2")]
    assert result.estimate.names[-2:] == names
    found = [result.parameters[name] for name in names]
    assert [abs(p.value - true) < 4 * p.std for p, true in zip(found, (4.0, -3.0), strict=True)] == [True] * 2
    contrary = ["contradict each other" in " ".join(r.estimate.notes) for r in (result, shared)]
    assert contrary == [False, True]
    if method != "prediction_error":  # which takes a log that is contradicted for a noisy one
        assert -2.5 < shared.estimate.value("constant_force.level") < 3.5
    result.save(tmp_path / "out")
    entry = json.loads((tmp_path / "out" / "result.json").read_text())["parameters"]["constant_force.level"]
    assert (entry["value"], entry["std"], entry["unit"]) == (None, None, "N")
    assert entry["by_log"]["2"]["value"] == pytest.approx(found[1].value)
    assert entry["by_log"]["1"]["std"] > 0


def test_one_log_among_several_arguments_gives_the_result_of_one(logs):
    case = case_of("inverse_dynamics")
    one, listed = (jaxid.identify(case, log, method="inverse_dynamics") for log in (logs[0], [logs[0]]))
    session = open_session(case, logs[0])
    assert np.array_equal(one.estimate.theta, listed.estimate.theta)
    assert np.array_equal(one.estimate.std, listed.estimate.std)
    assert np.array_equal(one.estimate.theta, inverse_dynamics(session.machine, session.fit.data).theta)
    assert one.session.fit.name == listed.session.fit.name == "fit"


def test_two_stretches_inform_as_much_as_both_alone(tmp_path):
    write_log(tmp_path / "log.csv", axis_setup(3, seconds=8.0))
    case, method = case_of("inverse_dynamics"), "inverse_dynamics"

    def of_rows(rows: list):
        return jaxid.identify(
            case | {"log": case["log"] | {"rows": rows}}, tmp_path / "log.csv", method=method
        )

    both, first, second = (of_rows(r) for r in ([[0, 4000], [4000, 8000]], [0, 4000], [4000, 8000]))
    names = [run.name for run in both.session.fits]
    assert names == ["fit, rows 0 to 4000", "fit, rows 4000 to 8000"]
    expected = 1 / np.sqrt(1 / first.estimate.std**2 + 1 / second.estimate.std**2)
    assert np.all(both.estimate.std < 1.1 * expected)
    assert np.all(np.abs(both.estimate.theta - TRUE) < 4 * both.estimate.std)


def test_a_log_with_a_gap_is_used_on_both_sides(tmp_path):
    path = write_log(tmp_path / "log.csv", axis_setup(3, seconds=4.0))
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *lines[1:1601], *lines[2201:]]) + "\n")
    case = case_of("inverse_dynamics")

    both = jaxid.identify(case, path, method="inverse_dynamics")
    longest = jaxid.identify(
        case | {"log": case["log"] | {"rows": [1600, 3400]}}, path, method="inverse_dynamics"
    )

    assert [run.log.rows for run in both.session.fits] == [(1600, 3400), (0, 1600)]
    assert np.all(both.estimate.std < 0.9 * longest.estimate.std)
    assert np.all(np.abs(both.estimate.theta - TRUE) < 4 * both.estimate.std)
    # A search takes the longest stretch.
    assert len(open_session(case, path, method="discover").fits) == 1


def test_pieces_of_one_log_share_its_own_values(tmp_path):
    write_log(tmp_path / "log.csv", axis_setup(3, seconds=4.0, offset=2.0))
    case = case_of("inverse_dynamics", offset=True)
    case["identification"] = {"per_log": ["constant_force.level"]}
    case["log"]["rows"] = [[0, 2000], [2000, 4000]]
    result = jaxid.identify(case, [tmp_path / "log.csv", axis_log(4, offset=-2.0)], method="inverse_dynamics")
    assert result.estimate.names[-2:] == ["constant_force.level @ log", "constant_force.level @ 4"]
    assert len(result.session.fits) == 3


def test_entries_and_arguments_are_joined(tmp_path):
    for name, seed in (("a", 1), ("b", 2), ("c", 3)):
        write_log(tmp_path / f"{name}.csv", axis_setup(seed))
    text = axis_case(closed=False) + '[[fit]]\nname = "second"\nlog = "b.csv"\n[[fit]]\nlog = "c.csv"\n'
    (tmp_path / "case.toml").write_text(text)
    case = tmp_path / "case.toml"

    def names(*given: str) -> list[str]:
        return [run.name for run in open_session(case, [tmp_path / g for g in given] or None).fits]

    assert names() == ["second", "c"]
    assert names("a.csv") == ["a", "second", "c"]
    assert names("b.csv", "a.csv") == ["second", "a", "c"]


def test_one_log_with_an_entry_is_fitted_with_its_values():
    case = case_of("inverse_dynamics") | {"fit": [{"name": "loaded", "set": {"added_mass.mass": LOADED}}]}
    result = jaxid.identify(case, axis_log(8, added=LOADED), method="inverse_dynamics")
    assert result.session.fit.name == "loaded"
    assert np.all(np.abs(result.estimate.theta - TRUE) < 4 * result.estimate.std)


def test_a_log_named_twice_is_refused(tmp_path):
    path = write_log(tmp_path / "a.csv", axis_setup(1))
    with pytest.raises(InputError, match="is named twice; name each log once"):
        jaxid.identify(case_of("inverse_dynamics"), [path, str(path)])


def test_the_found_case_has_one_guess_for_an_unknown_of_each_log():
    case = case_of("inverse_dynamics", offset=True) | {
        "identification": {"per_log": ["constant_force.level"]}
    }
    logs = [axis_log(k, offset=offset) for k, offset in ((1, 4.0), (2, -3.0))]
    result = jaxid.identify(case, logs, method="inverse_dynamics")
    guess = result.case().effects[-1].parameters["level"][0].guess
    assert guess == pytest.approx(np.mean(result.estimate.theta[-2:]), rel=1e-6)


def test_a_controller_gain_that_differs_is_set(tmp_path):
    stiffer = axis_setup(2)
    stiffer = dataclasses.replace(stiffer, loop=dataclasses.replace(stiffer.loop, kp=240.0))
    write_log(tmp_path / "b.csv", stiffer)
    case, entry = case_of("output_error"), {"log": str(tmp_path / "b.csv")}

    right = jaxid.identify(
        case | {"fit": [{**entry, "set": {"controller.kp": 240.0}}]}, axis_log(1), method="output_error"
    )
    assert np.all(np.abs(right.estimate.theta - TRUE) < 4 * right.estimate.std)
    with pytest.raises(InputError, match="take kind = 'cascade_pd' with kp = 240"):
        jaxid.identify(case | {"fit": [entry]}, axis_log(1), method="output_error")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"fit": [{"name": "x", "set": {"added_mas.mass": 2.0}}]},
            "set added_mas.mass is no declared parameter",
        ),
        ({"fit": [{"name": "x", "set": {"controller.kq": 2.0}}]}, "set controller.kq is not stated"),
        ({"fit": [{"name": "x", "set": {"coulomb_friction.level": -1.0}}]}, "is negative; it must be >= 0"),
        ({"fit": [{"set": {"inertia": 2.0}}]}, "has neither name nor log"),
        ({"fit": [{"name": "x"}, {"name": "x"}]}, "is taken"),
        ({"fit": [{"name": "x", "log": "b.csv", "position": "p"}]}, "b.csv"),
        ({"identification": {"per_log": ["added_mass.mass"]}}, "names added_mass.mass, which is known"),
        ({"identification": {"per_log": ["mass"]}}, "names mass, which is no unknown"),
    ],
)
def test_a_wrong_entry_is_told_in_one_line(change, told, logs):
    with pytest.raises(InputError) as error:
        jaxid.identify(case_of("output_error") | change, logs[:2])
    assert told in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("method", ["minimal_model", "algebraic_ratio"])
def test_a_method_for_one_log_says_so(method, logs):
    with pytest.raises(InputError, match=f"{method} fits one log, and there are 2"):
        jaxid.identify(case_of("output_error"), logs[:2], method=method)


def test_check_joins_the_information_of_all_logs(logs):
    case = case_of("inverse_dynamics")
    alone = [jaxid.check(case, log) for log in logs[:2]]
    both = jaxid.check(case, logs[:2])
    expected = 1 / np.sqrt(sum(1 / c.precision.std**2 for c in alone))
    assert both.precision.std == pytest.approx(expected, rel=0.05)
    assert list(both.json()["fits"]) == ["1", "2"]
    assert "the logs are sound" in str(both)


def test_check_sees_what_a_payload_separates(tmp_path):
    write_log(tmp_path / "loaded.csv", axis_setup(8, added=LOADED))
    case = case_of("inverse_dynamics", gain_unknown=True)
    entries = [{"name": "empty"}, {"log": str(tmp_path / "loaded.csv"), "set": {"added_mass.mass": LOADED}}]
    alone, both = jaxid.check(case, axis_log(7)), jaxid.check(case | {"fit": entries}, axis_log(7))
    assert not alone.precision.identifiable.any()
    assert both.precision.identifiable.all()
