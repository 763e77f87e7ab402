"""Forces that were logged late or through a low-pass, taken back as the case states."""

import numpy as np
import pytest

import jaxid
from jaxid.logs.in_memory import as_log
from jaxid.logs.log import read_log

PERIOD = 0.001
TIME = PERIOD * np.arange(400)
FORCE = np.random.default_rng(1).standard_normal(400)
PART = 1.0 - np.exp(-PERIOD / 0.004)


def read(force, **keys):
    log = {"t": TIME, "q": np.sin(TIME), "u": force}
    return as_log(log, {"time": "t", "position": "q", "force": "u", **keys}).force[:, 0]


def low_passed(u):
    out = np.zeros_like(u)
    for k in range(1, u.size):
        out[k] = out[k - 1] + PART * (u[k] - out[k - 1])
    return out


def test_a_delay_of_whole_samples_is_taken_back():
    late = np.concatenate([np.zeros(3), FORCE[:-3]])
    np.testing.assert_allclose(read(late, delay={"force": 0.003})[:-3], FORCE[:-3], atol=1e-9)


def test_a_part_of_a_sample_of_a_held_force_is_the_mean_of_what_was_held():
    moved = read(FORCE, delay={"force": 0.25 * PERIOD})
    np.testing.assert_allclose(moved[:-1], 0.75 * FORCE[:-1] + 0.25 * FORCE[1:], atol=1e-9)


def test_a_force_that_is_not_held_follows_splines():
    smooth = np.sin(2 * np.pi * 40 * TIME)
    moved = read(smooth, delay={"force": 0.4 * PERIOD}, hold="linear")
    true = np.sin(2 * np.pi * 40 * (TIME + 0.4 * PERIOD))
    # A cubic spline errs by some 1e-4 of an oscillation of 25 samples, a line by 6e-3.
    assert np.max(np.abs(moved - true)[20:-20]) < 2e-4


def test_a_low_pass_of_the_drive_is_undone():
    read_back = read(low_passed(FORCE), lag={"force": 0.004})
    np.testing.assert_allclose(read_back[1:], FORCE[1:], atol=1e-9)


def test_both_are_undone():
    late = np.concatenate([np.zeros(2), low_passed(FORCE)[:-2]])
    back = read(late, lag={"force": 0.004}, delay={"force": 0.002})
    np.testing.assert_allclose(back[3:-2], FORCE[3:-2], atol=1e-9)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"delay": {"force": 0.0}}, "delay"),
        ({"delay": {"position": 0.1}}, "position"),
        ({"delay": {"force": [0.001, 0.002]}}, "delay.force has 2 entries, and there are 1 columns"),
        ({"lag": {"force": 2.0}}, "lag.force = 2 s is as long as the log"),
    ],
)
def test_what_cannot_be_is_refused(keys, said):
    with pytest.raises(jaxid.InputError, match=said):
        read(FORCE, **keys)


def test_a_delay_of_a_force_that_was_not_logged_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    np.savetxt(path, np.stack([TIME, np.sin(TIME)], 1), delimiter=",", header="t,q", comments="")
    with pytest.raises(jaxid.InputError, match=r"lag\.force changes nothing: \[log\] names no force"):
        read_log(path, {"time": "t", "position": "q", "lag": {"force": 0.002}})
