"""A log slower than its loop: the reference between its samples is a curve, not lines."""

import re
from pathlib import Path

import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.commands.identify import identify
from jaxid.commands.simulate import simulate
from jaxid.simulation.replay import make_replay

STUDY = Path(__file__).parents[2] / "experiments" / "cases" / "study.toml"


@pytest.fixture(scope="module")
def slow(tmp_path_factory):
    """The axis of the ladder in its loop of 1 kHz, logged at 100 Hz."""
    text = re.sub(r"\n\[study\].*", "\n", STUDY.read_text(), flags=re.S)
    path = tmp_path_factory.mktemp("slow") / "case.toml"
    assert "period = 0.001" in text
    path.write_text(text.replace("sample_rate = 1000.0", "sample_rate = 100.0"))
    return path, simulate(path, seed=1).log


def test_inertia_is_not_bent(slow):
    """Lines between samples made it 11 % too large, with a deviation that said 0.1 %."""
    path, log = slow
    found = identify(path, log, method="output_error").estimate
    at = found.names.index("inertia")
    true = found.machine.parameters.free[at].true
    assert found.theta[at] == pytest.approx(true, rel=5e-3)
    assert abs(found.theta[at] - true) < 4 * found.std[at]


def test_reference_between_samples(slow):
    """Trapezoids of velocity: exact but near a corner, which no sample shows."""
    path, log = slow
    machine = build_machine(load_case(path), period=log.period)
    made = np.asarray(make_replay(machine, log).reference)[:, 0]
    case = load_case(path)
    from jaxid.references import make_reference

    exact = make_reference(case.reference, 1000.0, 8.0)[: len(made), 0]
    off = np.abs(made - exact)
    assert off.max() < 1.2e-5  # a corner of 0.8 m/s^2 within 10 ms: a h^2 / 8 = 1e-5
    assert np.median(off) < 1e-12
    assert np.mean(off > 1e-9) < 0.1
