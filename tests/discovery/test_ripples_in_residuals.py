"""Ripples over the position in a residual, beside forces that look like them."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.discovery.where import _in_periods, _ripples

TIME = 0.01 * np.arange(1500)
POSITION = 0.1 * np.sin(2 * np.pi * 0.3 * TIME) + 0.04 * np.sin(2 * np.pi * 1.1 * TIME)
VELOCITY = np.gradient(POSITION, TIME)
NOISE = 0.1 * np.random.default_rng(3).standard_normal(TIME.size)
MOVING = np.abs(VELOCITY) > 0.02


def found(force: np.ndarray) -> tuple[tuple[float, ...], float]:
    """Return the ripples in a force along the motion, in a band of 40 Hz."""
    data = SimpleNamespace(
        q=POSITION[:, None],
        qd=VELOCITY[:, None],
        period=0.01,
        at_kept=lambda x: x,
        recipe=SimpleNamespace(band_hz=lambda rate: 40.0),
    )
    return _ripples(force + NOISE, MOVING, data, 0)


def bumps(places: list[float], heights: list[float]) -> np.ndarray:
    """Return a force at some places of the stroke."""
    return np.exp(-(((POSITION[:, None] - np.array(places)) / 0.012) ** 2)) @ np.array(heights)


def test_ripples_are_listed_by_their_part():
    force = np.cos(2 * np.pi * POSITION / 0.02) + 0.5 * np.cos(2 * np.pi * POSITION / 0.007 + 1.0)
    periods, part = found(force)
    assert periods == pytest.approx([0.02, 0.007], rel=0.01)
    assert part == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(
    "force",
    [
        0.0 * TIME,
        5.0 * POSITION,
        20.0 * POSITION**2,
        np.sin(2 * np.pi * 7.3 * TIME),
        np.sign(VELOCITY),
        VELOCITY,
        np.cos(2 * np.pi * POSITION / 0.15),
        bumps([-0.07, 0.0, 0.05], [1.0, -1.0, 1.0]),
        bumps([-0.06, 0.0, 0.06], [3.0, 3.0, 3.0]),
    ],
    ids=[
        "noise",
        "spring",
        "bent spring",
        "clock",
        "dry friction",
        "damper",
        "two periods",
        "three places",
        "three alike",
    ],
)
def test_other_forces_are_no_ripple(force):
    assert found(force)[0] == ()


@pytest.mark.parametrize(
    ("periods", "unit", "words"),
    [
        ((0.02,), "m", "every 0.02 m, as a ripple does"),
        (
            (np.pi / 9, np.pi / 6),
            "rad",
            "every 0.3491 rad and 0.5236 rad (18 and 12 times a turn), as a ripple does",
        ),
        ((0.3, 0.2, 0.1), "m", "every 0.3 m, 0.2 m and 0.1 m, as a ripple does"),
    ],
)
def test_periods_are_said_with_their_unit(periods, unit, words):
    assert _in_periods(periods, 1, unit) == f"joint 2: the residual repeats over the position, {words}"
