"""The declared control law beside the logged command, of exact loops; the law that fits is named."""

import dataclasses
import re
import tomllib

import numpy as np
import pytest

from jaxid.consistency.law import noise_free_command
from jaxid.errors import InputError
from jaxid.session import Session, open_session
from tests.consistency.test_noise import EFFECTS, LOOPS, setup
from truth.axis.cases import case_text
from truth.axis.stepper import Sensor

NAMES = {"t": "t", "q": "position", "u": "force", "ref": "reference"}
LAWS = {
    "cascade_pd": {"kp": 40.0, "kv": 60.0, "velocity_average": 2},
    "pid": {"kp": 600.0, "ki": 800.0, "kd": 40.0, "derivative_filter": 2e-3},
    "velocity": {"kind": "pd", "derivative": "velocity", "kp": 2400.0, "kd": 60.0, "velocity_average": 2},
    "pd": {"kind": "pd", "kp": 2400.0, "kd": 60.0, "velocity_average": 2},
}


@pytest.fixture(scope="module", params=[0.0, 0.03], ids=["exact", "noisy"])
def runs(request) -> dict[str, dict]:
    """Logs under a cascade and a PID: the PD on velocity, kp 2400 and kd 60, is the cascade."""
    out = {}
    for name in LOOPS:
        run = setup(name, request.param).run()
        out[name] = {column: run[field] for column, field in NAMES.items()}
    return out


def opened(log: dict, law: dict, kind: str) -> Session:
    text = case_text(setup(), tuple(EFFECTS.items()), sensor=False, closed=False)
    case = tomllib.loads(text.replace('force = "u"', 'force = "u"\nreference = "ref"'))
    return open_session(case | {"controller": {"kind": kind, "period": 1e-3, "limit": 20.0} | law}, log)


@pytest.mark.parametrize(
    ("loop", "law"), [("cascade_pd", "cascade_pd"), ("cascade_pd", "velocity"), ("pid", "pid")]
)
def test_the_right_law_raises_nothing(runs, loop, law):
    assert opened(runs[loop], LAWS[law], loop).findings == ()


def test_a_wrong_gain_behind_a_coarse_encoder_is_named():
    """What it leaves is less than twice the high band of the command, which differentiates the counts."""
    run = dataclasses.replace(setup(noise=0.0), sensor=Sensor(position_resolution=2e-4)).run()
    log = {column: run[field] for column, field in NAMES.items()}
    assert opened(log, LAWS["velocity"], "pd").findings == ()
    with pytest.raises(InputError, match=r"take kind = 'pd' with .* kp = 2400, kd = 60 "):
        opened(log, LAWS["velocity"] | {"kd": 66.0}, "pd")


def test_a_derivative_of_the_error_is_not_one_of_the_velocity(runs):
    with pytest.raises(InputError) as caught:
        opened(runs["cascade_pd"], LAWS["pd"], "pd")
    said = str(caught.value)
    assert "the declared control law leaves" in said
    fitted = (
        r"derivative = 'velocity', kp = (\S+), kd = (\S+) \(the same as kind = 'cascade_pd' with kp = (\S+), "
    )
    numbers = re.search(fitted + r"kv = (\S+)\), velocity_average = 2", said)
    assert numbers is not None, said
    values = [float(text) for text in numbers.groups()]
    assert values == pytest.approx([2400.0, 60.0, 40.0, 60.0], rel=2e-3)


def test_wrong_gains_are_named(runs):
    named = r"take kind = 'cascade_pd' with kp = 40, kv = 60(\.0\d)?, velocity_average = 2"
    with pytest.raises(InputError, match=named):
        opened(runs["cascade_pd"], {**LAWS["cascade_pd"], "kv": 45.0}, "cascade_pd")


def test_a_law_that_no_kind_has_is_a_warning(runs):
    log = runs["cascade_pd"]
    odd = {**log, "u": log["u"] + 0.8 * abs(log["u"]) ** 0.5}
    (told,) = opened(odd, LAWS["cascade_pd"], "cascade_pd").findings
    assert re.search(r"leaves \d+.* % of the logged command", told.what)


def test_a_log_of_one_tick_in_ten_is_replayed_between_its_samples(runs):
    """Its readings in between are interpolated; the law is recognised, not reproduced."""
    slow = {name: values[::10] for name, values in runs["cascade_pd"].items()}
    law = dataclasses.asdict(LOOPS["cascade_pd"])
    right = opened(slow, {k: law[k] for k in ("kp", "kv", "velocity_average")}, "cascade_pd")
    assert not [f for f in right.findings if "law" in f.what]
    with pytest.raises(InputError, match=r"derivative = 'velocity', kp = 2[34]\d\d, kd = (59|6\d)"):
        opened(slow, LAWS["pd"], "pd")


@pytest.mark.parametrize(("loop", "integral"), [("cascade_pd", False), ("pid", True)])
def test_a_noisy_command_is_replaced_by_that_of_its_law(loop, integral):
    """The integral of a law began anywhere: the mean of the noise tells where, and its error is stated."""
    applied, run = setup(loop, 0.0).run()["force"], setup(loop, 0.03).run()
    session = opened({column: run[field] for column, field in NAMES.items()}, LAWS[loop], loop)
    found = noise_free_command(session.machine, session.fit.log)
    assert found is not None
    error = (found.command - applied.reshape(found.command.shape))[found.logged :]
    if integral:
        assert np.ptp(error) < 1e-6
        assert found.offset == pytest.approx(0.03 / np.sqrt(len(error)), rel=0.05)
        assert abs(error.mean()) < 3 * found.offset
    else:
        assert found.offset is None
        assert np.abs(error).max() < 1e-6
