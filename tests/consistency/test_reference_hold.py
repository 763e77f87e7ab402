"""Course of the reference between the samples of a slow log, found from exact loops, and its effect."""

import dataclasses
import tomllib

import numpy as np
import pytest

import jaxid
from jaxid.consistency.law import loop_velocity_findings
from jaxid.errors import InputError
from jaxid.results.as_json import identification_json
from jaxid.session import Session, open_session
from tests.consistency.test_noise import EFFECTS, LOOPS, REFERENCE, setup
from truth.axis.cases import case_text

NAMES = {"t": "t", "q": "position", "u": "force", "ref": "reference"}
# Ticks of the loop, at 1 kHz, for each row of the log.
EVERY = 10
TICKS = np.arange(REFERENCE.size)
COURSES = {
    "zero_order": REFERENCE[TICKS // EVERY * EVERY],
    "linear": np.interp(TICKS, TICKS[::EVERY], REFERENCE[::EVERY]),
    "band_limited": REFERENCE,
}


@pytest.fixture(scope="module")
def logs() -> dict[tuple[str, str], dict]:
    """Logs at 100 Hz of loops at 1 kHz whose reference takes each course between the rows."""
    out = {}
    for loop in LOOPS:
        for course, reference in COURSES.items():
            base = setup(loop)
            gentle = dataclasses.replace(base.loop, reference=reference)
            run = dataclasses.replace(base, loop=gentle).run()
            out[loop, course] = {column: run[field][::EVERY] for column, field in NAMES.items()}
    return out


def case(loop: str = "cascade_pd", stated: str | None = None, **law: float) -> dict:
    text = case_text(setup(loop), tuple(EFFECTS.items()), sensor=False, closed=True)
    made = tomllib.loads(text)
    made["controller"] |= {"period": 1e-3, **law}
    if stated is not None:
        made["log"]["reference_hold"] = stated
    return made


def said(session: Session) -> list[str]:
    return [f.what for f in session.findings if f.where.endswith("reference")]


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("course", COURSES)
def test_the_course_of_the_reference_is_found(logs, loop, course):
    session = open_session(case(loop), logs[loop, course])
    assert session.machine.reference_hold == course
    setting = session.settings["reference_hold"]
    assert setting["value"] == course
    others = [h for h in COURSES if h != course]
    assert all(f"'{h}'" in setting["reason"] for h in others)
    expected = f"reference_hold is not stated, and '{course}' is used"
    # The default needs no word.
    assert [text.split(":")[0] for text in said(session)] == ([expected] * (course != "band_limited"))
    # Under the right course the right law is not questioned.
    assert not [f for f in session.findings if "law" in f.what and "control" in f.what]


def test_a_stated_course_is_kept_and_questioned(logs):
    log = logs["cascade_pd", "zero_order"]
    session = open_session(case(stated="linear"), log)
    assert session.machine.reference_hold == "linear"
    (text,) = said(session)
    assert text.startswith("reference_hold = 'linear' is stated, but 'zero_order' fits better")
    right = open_session(case(stated="zero_order"), log)
    assert said(right) == []
    assert right.settings["reference_hold"] == {"value": "zero_order", "reason": "the case states it"}


def test_friction_is_right_under_the_course_that_was_found(logs):
    """400 N s/m, 60 N, 180 kg; under the smooth course the loop misses all three."""
    log, true = logs["cascade_pd", "zero_order"], np.array([180.0, 400.0, 60.0])
    found, smooth = (
        jaxid.identify(case(stated=hold), log, method="output_error") for hold in (None, "band_limited")
    )
    assert found.settings["reference_hold"]["value"] == "zero_order"
    assert identification_json(found)["settings"]["reference_hold"]["value"] == "zero_order"
    np.testing.assert_allclose(found.estimate.theta, true, rtol=0.01)
    assert np.all(np.abs(smooth.estimate.theta / true - 1) > 0.01)


def test_a_reference_at_rest_decides_nothing_and_says_nothing(logs):
    """All courses of a constant reference are one; the motion comes from pulses on the command."""
    base = setup()
    still = dataclasses.replace(
        base.loop,
        reference=np.zeros(REFERENCE.size),
        disturbance={"level": 12.0, "on": 0.15, "off": 0.15, "start": 0.2},
    )
    run = dataclasses.replace(base, loop=still).run()
    log = {column: run[field][::EVERY] for column, field in NAMES.items()}
    session = open_session(
        case() | {"controller": case()["controller"] | {"disturbance": still.disturbance}}, log
    )
    assert session.machine.reference_hold == "band_limited"
    assert "do not decide" in session.settings["reference_hold"]["reason"]
    assert said(session) == []


def test_what_cannot_be_decided_is_said(logs):
    """A delay of unknown size moves the force in time as another hold does."""
    delayed = case()
    delayed["effects"] = [*delayed["effects"], {"kind": "input_delay", "delay": {"guess": 1e-3}}]
    session = open_session(delayed, logs["cascade_pd", "zero_order"])
    assert session.machine.reference_hold == "band_limited"
    (text,) = said(session)
    assert "cannot be decided: an effect of the drive changes the force in time" in text


@pytest.mark.parametrize("course", COURSES)
def test_a_wrong_gain_is_still_refused(logs, course):
    """Masses and frictions that scale with it explain the motion as well."""
    with pytest.raises(InputError, match=r"the declared control law leaves [\d.]+ % of the logged command"):
        open_session(case(kp=36.0), logs["cascade_pd", course])


def test_the_right_law_is_not_refused_where_the_reference_jumps_every_20_ticks():
    base = setup()
    held = dataclasses.replace(base.loop, reference=REFERENCE[TICKS // 20 * 20])
    run = dataclasses.replace(base, loop=held).run()
    session = open_session(case(), {column: run[field][::20] for column, field in NAMES.items()})
    assert session.machine.reference_hold == "zero_order"
    # The case states how the loop averages positions, so nothing is asked about its velocity.
    assert [f.where for f in session.findings] == ["arrays, reference"]


def test_a_loop_may_use_a_velocity_that_its_drive_measures():
    run = setup().run()
    session = open_session(case(), {column: run[field][::20] for column, field in NAMES.items()})
    assert session.machine.controller is not None
    controller = dataclasses.replace(session.machine.controller, velocity_average=1)
    machine = dataclasses.replace(session.machine, controller=controller)
    (finding,) = loop_velocity_findings(machine, session.fit.log)
    assert finding.what.startswith("the case does not state whether the loop differences positions")
    assert loop_velocity_findings(session.machine, session.fit.log) == []


def test_a_log_of_every_tick_has_nothing_to_choose():
    run = setup().run()
    session = open_session(case(), {column: run[field] for column, field in NAMES.items()})
    assert "reference_hold" not in session.settings
