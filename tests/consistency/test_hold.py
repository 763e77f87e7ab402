"""The hold of a force, chosen where the case states none: a log of every tick, and one of every tenth."""

import tomllib

import numpy as np
import pytest

import jaxid
from jaxid.session import Session, open_session
from tests.consistency.test_noise import EFFECTS, setup
from truth.axis.cases import case_text


@pytest.fixture(scope="module")
def logs() -> dict[str, dict]:
    run = setup().run()
    log = {c: run[n] for c, n in {"t": "t", "q": "position", "u": "force", "ref": "reference"}.items()}
    return {"every": log, "tenth": {name: values[::10] for name, values in log.items()}}


def case(hold: str | None = None, *, friction: int = 0, closed: bool = False) -> dict:
    text = case_text(setup(), tuple(EFFECTS.items())[friction:], sensor=False, closed=closed)
    text = text.replace("[controller]", "[controller]\nperiod = 0.001")
    return tomllib.loads(text if hold is None else text.replace("[log]", f'[log]\nhold = "{hold}"'))


def opened(case: dict, log: dict) -> Session:
    session = open_session(case, log)
    assert session.machine.hold == session.fit.log.hold
    assert (session.fit.data.hold > 0) == (session.fit.log.hold == "zero_order")
    return session


@pytest.mark.parametrize("closed", [False, True])
def test_a_log_of_every_tick_keeps_the_default(logs, closed):
    session = opened(case(closed=closed), logs["every"])
    assert session.fit.log.hold == "zero_order"
    assert session.findings == ()


@pytest.mark.parametrize("friction", [0, 1])
def test_of_one_tick_in_ten_the_force_is_not_held(logs, friction):
    """Also with viscous friction missing in the case, which acts as a shift in time does."""
    session = opened(case(friction=friction), logs["tenth"])
    assert session.fit.log.hold == "linear"
    (told,) = session.findings
    assert told.what.startswith("hold is not stated, and 'linear' is used")


def test_a_stated_hold_is_kept_and_questioned(logs):
    session = opened(case("zero_order"), logs["tenth"])
    assert session.fit.log.hold == "zero_order"
    (told,) = session.findings
    assert told.what.startswith("hold = 'zero_order' is stated, but 'linear' leaves")
    assert opened(case("linear"), logs["tenth"]).findings == ()


def test_the_chosen_hold_brings_the_friction_home(logs):
    """400 N s/m; under the default hold it is off by more than the tenth part."""
    found = {
        hold: jaxid.identify(case(hold), logs["tenth"], method="inverse_dynamics").estimate.theta[1]
        for hold in (None, "zero_order")
    }
    assert found[None] == pytest.approx(400.0, rel=0.02)
    assert abs(found["zero_order"] - 400.0) > 0.05 * 400.0


def test_a_declared_loop_knows_the_time_for_which_its_command_is_held(logs):
    session = opened(case(closed=True), logs["tenth"])
    assert session.fit.data.hold == pytest.approx(1e-3)
    assert session.findings == ()


def test_validation_logs_follow_unless_they_state_their_own(logs, tmp_path):
    rows = {"rows": [0, 400]}
    text = case() | {"validation": [{"name": "own", "hold": "zero_order", **rows}, {"name": "other", **rows}]}
    path = tmp_path / "log.csv"
    np.savetxt(
        path, np.stack(list(logs["tenth"].values()), 1), delimiter=",", header="t,q,u,ref", comments=""
    )
    holds = {run.name: run.log.hold for run in open_session(text, path).runs}
    assert holds == {"fit": "linear", "own": "zero_order", "other": "linear"}
