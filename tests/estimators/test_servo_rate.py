"""The rate of a servo's loop and its commands between two rows, which a case leaves open."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_arms import arm
from benchmarks.unforced_machines import servo
from jaxid.estimators import servo_rate
from jaxid.session import open_session


def open_case(seed: int) -> tuple[dict, dict, object]:
    """A drawn servo, whose case states neither the period of its loop nor the course of its command."""
    drawn = servo(seed)
    return without_rate(drawn), drawn.columns(), drawn


def without_rate(drawn) -> dict:
    """Return the case of a machine, without the period of its loop and the course of its command."""
    case = drawn.case()
    del case["controller"]["period"], case["log"]["reference_hold"]
    return case


def fits(left: dict, tried: list, theta=lambda loop: 1.0):
    """A fit whose residual has a size by loop, and the loops that were fitted."""

    def fitted(session, *, without_noise=False):
        machine = session.machine
        loop = (round(session.fit.log.period / machine.controller.period), machine.reference_hold)
        tried.append((*loop, without_noise))
        rng = np.random.default_rng(len(tried))
        estimate = FakeFit(np.array([theta(loop)]), left.get(loop, 5.0) * rng.standard_normal((600, 1)))
        return estimate
        yield

    return fitted


@dataclass(frozen=True)
class FakeFit:
    """What the choice takes of an estimate."""

    theta: np.ndarray
    residual: np.ndarray
    held: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
    details: dict = field(default_factory=dict)
    converged: bool = True

    def holding(self, *others):
        return replace(self, held=tuple(float(other[0]) for other in others))


@pytest.fixture
def chosen(monkeypatch):
    """The choice among fits whose residuals have given sizes."""
    case, log, _ = open_case(1)
    monkeypatch.setattr(servo_rate, "misfit", lambda e: float(np.sum(e.residual**2)))

    def choose(left, theta=lambda loop: 1.0, period=None, incomplete=False):
        monkeypatch.setattr(servo_rate, "leaves_far_more_than_noise", lambda *a: incomplete)
        if period is not None:
            case["controller"]["period"] = period
        session = open_session(case, log)
        assert servo_rate.leaves_rate_open(session) == (period is None)
        assert servo_rate.leaves_course_open(session) == (period is not None)
        tried: list = []
        steps = servo_rate.with_rate_of_log(session, fits(left, tried, theta))
        with pytest.raises(StopIteration) as end:
            next(steps)
        return end.value.value, tried

    return choose


def test_the_loop_that_leaves_clearly_least_is_taken(chosen):
    found, tried = chosen({(4, "zero_order"): 1.0, (5, "zero_order"): 1.3, (10, "zero_order"): 2.0})
    assert found.details["settings"]["period"]["value"] == "0.005 s"
    assert found.details["settings"]["reference_hold"]["value"] == "zero_order"
    assert found.held == ()
    assert len(tried) == len(set(tried)) == 9
    # Loops that leave far more without noise are not fitted with it.
    assert {tuple(loop) for *loop, plain in tried if not plain} == {(4, "zero_order"), (5, "zero_order")}


def test_loops_that_leave_as_little_widen_the_intervals(chosen):
    found, _ = chosen(
        {(4, "zero_order"): 1.0, (10, "zero_order"): 1.01, (20, "zero_order"): 2.0},
        theta=lambda loop: loop[0],
    )
    assert found.held == (10.0,) or found.held == (4.0,)
    assert "about equally well" in found.notes[-1]


def test_an_incomplete_model_is_fitted_with_noise_once(chosen):
    left = {(4, "zero_order"): 1.0, (5, "zero_order"): 1.01, (10, "zero_order"): 2.0}
    found, tried = chosen(left, theta=lambda loop: loop[0], incomplete=True)
    assert [plain for *_, plain in tried].count(False) == 1
    assert found.held == (5.0,) or found.held == (4.0,)


def test_ratios_to_a_base_are_widened_too():
    def loop(value, std):
        values = {"controller.kp": {"value": value, "std": std, "unit": "1"}}
        fit = FakeFit(
            np.zeros(1), np.zeros((1, 1)), details={"relative": {"to": "inertia", "values": values}}
        )
        return servo_rate._Loop(1, "zero_order", fit)

    best, other = loop(300.0, 1.0), loop(300.0 + 1.96 * 2.0, 1.0)
    assert servo_rate._relative_holding(best, [])["relative"]["values"]["controller.kp"]["std"] == 1.0
    held = servo_rate._relative_holding(best, [other])["relative"]
    assert held["to"] == "inertia"
    assert held["values"]["controller.kp"]["std"] == pytest.approx(3.0)
    plain = servo_rate._Loop(1, "zero_order", FakeFit(np.zeros(1), np.zeros((1, 1))))
    assert servo_rate._relative_holding(plain, [other]) == {}


def test_a_log_that_holds_every_tick_needs_no_faster_loop(chosen):
    found, tried = chosen({(1, "zero_order"): 1.0, (1, "band_limited"): 1.0})
    assert found.details["settings"]["period"]["value"] == "0.02 s"
    assert "reference_hold" not in found.details["settings"]
    assert {ticks for ticks, _, _ in tried} == {1, 10}


def test_the_command_between_two_rows_is_found_where_the_period_is_stated(chosen):
    found, tried = chosen({(4, "zero_order"): 1.0, (4, "band_limited"): 2.0}, period=5e-3)
    assert tried == [(4, "zero_order", True), (4, "band_limited", True), (4, "zero_order", False)]
    assert set(found.details["settings"]) == {"reference_hold"}
    assert found.details["settings"]["reference_hold"]["value"] == "zero_order"
    assert found.held == ()
    assert "the course of the command between two rows is not stated: zero_order" in found.notes[-1]


def test_a_stated_period_is_kept():
    drawn = servo(1)
    session = open_session(drawn.case(), drawn.columns())
    assert not servo_rate.leaves_rate_open(session)
    assert not servo_rate.leaves_course_open(session)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 6])
def test_the_rate_of_a_servo_is_found(seed):
    """At the rate of the log, inertias were 42 % off, and delays 40 standard deviations."""
    case, log, drawn = open_case(seed)
    check(jaxid.identify(case, log), drawn)


def beside(drawn):
    """Return the same machine under another command."""
    return replace(drawn, command=-0.7 * drawn.command)


def test_every_log_of_several_follows_the_course_of_the_command_that_is_tried():
    """The others kept that of the case, which left ten times the noise of the right loop."""
    drawn = servo(1)
    session = open_session(without_rate(drawn), [drawn.columns(), beside(drawn).columns()])
    assert servo_rate.leaves_rate_open(session)
    tried = servo_rate._at(session, 4, "zero_order")
    assert [run.machine(tried.machine).reference_hold for run in tried.fits] == ["zero_order"] * 2


def test_logs_of_several_rates_share_a_loop_whose_period_divides_both_rows():
    drawn = servo(1)
    first = drawn.columns()
    row = first["t"][1] - first["t"][0]
    for factor, common in ((2.0, row), (1.5, row / 2), (0.75, row / 4)):
        other = first | {"t": factor * first["t"]}
        session = open_session(without_rate(drawn), [first, other])
        assert servo_rate.leaves_rate_open(session)
        at = servo_rate._at(session, 5, "zero_order")
        periods = [run.machine(at.machine).controller.period for run in at.fits]
        assert periods == pytest.approx([common / 5] * 2, rel=1e-6)
    unlike = first | {"t": 1.0137 * first["t"]}
    session = open_session(without_rate(drawn), [first, unlike])
    assert not servo_rate.leaves_rate_open(session)
    # Then each log has a loop of its rate.
    periods = [run.machine(session.machine).controller.period for run in session.fits]
    assert periods == pytest.approx([row, 1.0137 * row], rel=1e-6)


@pytest.mark.slow
def test_one_servo_is_found_in_logs_of_two_rates():
    """The second log has every second row: one loop explains both."""
    drawn = servo(1)
    second = beside(drawn)
    second = replace(second, command=np.repeat(second.command[::2], 2)[: len(second.command)])
    slow = {name: column[::2] for name, column in second.columns().items()}
    result = jaxid.identify(without_rate(drawn), [drawn.columns(), slow])
    assert result.model_complete
    check(result, drawn)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_the_rate_of_a_servo_is_found_in_two_logs(seed):
    drawn = servo(seed)
    result = jaxid.identify(without_rate(drawn), [drawn.columns(), beside(drawn).columns()])
    check(result, drawn)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_the_rate_of_an_arm_is_found(seed):
    """At the rate of the log values were up to 17 standard deviations off, and said to be incomplete."""
    drawn = arm(seed)
    check(jaxid.identify(without_rate(drawn), drawn.columns()), drawn)


def check(result, drawn):
    """Check a fit whose loop is that of a machine, or a faster one that leaves as little."""
    estimate, truth = result.estimate, drawn.truth()
    assert float(estimate.details["settings"]["period"]["value"].split()[0]) <= 1.01 / drawn.rate
    assert estimate.details["settings"]["reference_hold"]["value"] == "zero_order"
    assert result.model_complete
    known = [k for k, ok in enumerate(estimate.identifiable) if ok]
    assert known
    for k in known:
        assert abs(estimate.theta[k] - truth[estimate.names[k]]) < 4 * estimate.std[k]
