"""Delay of a logged force by the balance of forces; logs of the exact steppers."""

import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import jaxid
from benchmarks.interval_machines import MACHINES
from jaxid.consistency.timing import SEEMS
from jaxid.session import open_session
from jaxid.session.timing import session_with_force_at
from truth.axis.hidden_effects import SEARCH_CASES


def moved(log: dict, late: int) -> dict:
    """Columns of a log whose forces are read so many samples late, or early below zero."""
    rows = np.arange(len(log["t"]))
    forces = {k: np.asarray(x)[np.clip(rows - late, 0, rows[-1])] for k, x in log.items() if k[0] == "u"}
    return {**log, **forces}


def said(session) -> str | None:
    """Return the warning on a delay; None without one."""
    found = [f for f in session.findings if f.what.startswith(SEEMS)]
    return f"{found[0].what}; {found[0].hint}" if found else None


def opened(machine: str, late: int):
    text, log, _ = MACHINES[machine](1, "unknown", "not stated")
    return open_session(tomllib.loads(text), moved(log, late), method="inverse_dynamics")


@pytest.mark.parametrize("machine", ["axis", "arm"])
@pytest.mark.parametrize("late", [3, -2])
def test_a_force_that_was_logged_late_or_early_is_questioned(machine, late):
    text = said(opened(machine, late))
    samples = float(re.search(r"\(([\d.]+) samples\)", text).group(1))
    assert samples == pytest.approx(abs(late), abs=0.15)
    assert ("late" if late > 0 else "early") in text
    assert ("state delay = { force = 0.00" in text) == (late > 0)
    assert ("input_delay" in text) == (late < 0)


@pytest.mark.parametrize("machine", ["axis", "arm"])
def test_a_force_in_time_is_not_questioned(machine):
    assert said(opened(machine, 0)) is None


def test_a_stated_delay_is_not_questioned():
    text, log, _ = MACHINES["axis"](1, "unknown", "not stated")
    case = tomllib.loads(text)
    case["log"]["delay"] = {"force": 1e-6}
    assert said(open_session(case, moved(log, 3), method="inverse_dynamics")) is None


def test_a_force_that_is_taken_back_keeps_its_noise():
    session = opened("axis", 3)
    late = next(f for f in session.findings if f.what.startswith(SEEMS))
    back = session_with_force_at(session, 3e-3, late)
    assert session.fit.data.force_noise == pytest.approx(0.05, rel=0.2)
    np.testing.assert_array_equal(back.fit.data.force_noise, session.fit.data.force_noise)


KINDS = [kind for kind in SEARCH_CASES if kind not in ("actuator_lag", "input_delay")]


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_effect_is_no_delay(kind):
    row = replace(SEARCH_CASES[kind], duration=4.0)
    run = row.setup(1).run()
    case = tomllib.loads(row.text())
    case = {name: case[name] for name in ("plant", "effects", "actuator") if name in case}
    case["log"] = {"time": "t", "position": "q", "force": "u"}
    columns = {"t": run["t"], "q": run["position"], "u": run["force"]}
    assert said(open_session(case, columns, method="inverse_dynamics")) is None


def test_the_delay_of_the_likelihood_takes_its_place():
    text, log, _ = MACHINES["axis"](1, "unknown", "not stated")
    found = jaxid.identify(tomllib.loads(text), moved(log, 3))
    (finding,) = [f for f in found.session.findings if "logged" in f.what]
    assert "raises the log-likelihood" in finding.what
