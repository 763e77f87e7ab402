"""References: limits kept, ends met, spectra as asked, and every wrong value refused."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxid.errors import InputError
from jaxid.references import REFERENCES, make_reference
from jaxid.references.bezier import bezier_curve
from jaxid.references.moves import plan_move

RATE = 1000.0
TRAPEZOID = {"kind": "trapezoid", "targets": [0.3, -0.1], "speed": 0.5, "acceleration": 2.0}
S_CURVE = {"kind": "point_to_point", "end": 0.3, "speed": 0.5, "acceleration": 2.0, "jerk": 20.0}
BEZIER = {"kind": "bezier", "points": [0.1, 0.5]}
FOURIER = {"kind": "fourier", "base_frequency_hz": 0.5, "sine": [0.1, 0.0, 0.02]}
MULTISINE = {"kind": "multisine", "band_hz": [1.0, 20.0], "amplitude": 0.1}
VALID = [TRAPEZOID, S_CURVE, BEZIER, FOURIER, MULTISINE]


def one(table: dict, duration: float = 4.0, rate: float = RATE, **kwargs) -> np.ndarray:
    result = make_reference(table, rate, duration, **kwargs)
    assert result.shape == (round(duration * rate), 1)
    return result[:, 0]


def refuse(table: dict, match: str, **kwargs) -> None:
    with pytest.raises(InputError, match=match) as caught:
        make_reference(table, RATE, 4.0, **kwargs)
    assert "\n" not in str(caught.value)


# Every family alike


def test_names_are_those_of_the_interface():
    kinds = {"csv", "trapezoid", "bezier", "fourier", "multisine", "point_to_point"}
    # Beside what was promised, the profile of the chain's paper and the motions of the five-bar's.
    assert set(REFERENCES) == kinds | {"quarter_sine", "synchronized"}


@pytest.mark.parametrize("kind", sorted(REFERENCES))
def test_every_key_is_told(kind):
    family = REFERENCES[kind]
    assert family.doc
    assert all(key.doc for key in family.keys.values())


@pytest.mark.parametrize("table", VALID, ids=lambda table: table["kind"])
def test_required_unknown_and_kind(table):
    keys = REFERENCES[table["kind"]].keys
    for name, key in keys.items():
        if key.required:
            without = {k: v for k, v in table.items() if k != name}
            refuse(without, rf"\[reference\] kind = '{table['kind']}': '{name}' is missing; add")
    first = next(iter(keys))
    refuse({**table, first + "s_": 1.0}, f"unknown key '{first}s_'; did you mean '{first}'")
    refuse({**table, "kind": table["kind"] + "e"}, f"did you mean '{table['kind']}'")
    refuse({k: v for k, v in table.items() if k != "kind"}, r"\[input\]: kind", where="[input]")


@pytest.mark.parametrize("table", VALID, ids=lambda table: table["kind"])
@pytest.mark.parametrize("bad", ["fast", math.nan, math.inf, True, None])
def test_values_must_be_finite_numbers(table, bad):
    keys = REFERENCES[table["kind"]].keys.items()
    name = next(k for k, key in keys if key.read.schema.get("type") == "number")
    finite = "a number" if bad is True or not isinstance(bad, float) else "a finite number"
    refuse({**table, name: bad}, f"{name} = .* is not {finite}; give ")


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ({**TRAPEZOID, "speed": 0.0}, "speed = 0.0 is not positive; it must be > 0"),
        ({**TRAPEZOID, "acceleration": -1.0}, "acceleration = -1.0 is not positive; it must be > 0"),
        ({**TRAPEZOID, "dwell": -0.1}, "dwell = -0.1 is negative; it must be >= 0"),
        ({**TRAPEZOID, "targets": []}, r"targets = \[\] is empty; give a list of at least 1"),
        ({**TRAPEZOID, "targets": 0.3}, "targets = 0.3 is not a list; give a list of at least 1"),
        ({**TRAPEZOID, "repeat": "yes"}, 'repeat = "yes" is neither true nor false; write true'),
        ({**TRAPEZOID, "targets": [1e-9, 0.0]}, "less than two samples; move further"),
        ({**S_CURVE, "jerk": 0.0}, "jerk = 0.0 is not positive; it must be > 0"),
        ({**S_CURVE, "end": 0.0}, "start and end are both 0"),
        ({**BEZIER, "points": [0.1]}, "points = .* has 1 entry; give a list of at least 2"),
        ({**BEZIER, "duration": 0.0}, "duration = 0.0 is not positive; it must be > 0"),
        ({**BEZIER, "start_time": 5.0}, "start_time = 5 s is past the end"),
        ({**FOURIER, "base_frequency_hz": 200.0}, "harmonic 3 at 600 Hz is beyond half"),
        ({**FOURIER, "sine": [0.1, "x"]}, r"sine\[2\] = \"x\" is not a number; give a number"),
        ({"kind": "fourier", "base_frequency_hz": 1.0}, "neither sine nor cosine"),
        ({**MULTISINE, "band_hz": [20.0, 1.0]}, "is no band; 0 <= lowest < highest < 500 Hz"),
        ({**MULTISINE, "band_hz": [1.0, 500.0]}, "is no band"),
        ({**MULTISINE, "band_hz": [1.0, 2.0, 3.0]}, "must hold two frequencies"),
        ({**MULTISINE, "band_hz": [1.05, 1.1]}, "no line in the band: they are 0.25 Hz apart"),
        ({**MULTISINE, "period": 0.002}, "shorter than four samples"),
        ({**MULTISINE, "seed": 1.5}, "seed = 1.5 is not a whole number"),
        ({**MULTISINE, "phases": "schröder"}, "phases = .* is unknown; did you mean 'schroeder'"),
        ({**S_CURVE, "end": [0.1, 0.2], "speed": [1.0, 1.0, 1.0]}, "'end' has 2 joints"),
    ],
)
def test_wrong_values(table, match):
    refuse(table, match)


@pytest.mark.parametrize(("rate", "duration"), [(0.0, 1.0), (1000.0, -1.0), (10.0, 0.1)])
def test_wrong_grid(rate, duration):
    with pytest.raises(InputError, match=r"^\[simulation\]: .*;"):
        make_reference(FOURIER, rate, duration)


@pytest.mark.parametrize("table", VALID, ids=lambda table: table["kind"])
def test_lists_go_by_joint(table):
    """A list gives each joint what it would have alone; other values are for all."""
    name = next(k for k in ("end", "targets", "points", "sine", "amplitude") if k in table)
    value = np.array(table[name])
    lists = {**table, name: [value.tolist(), (2 * value).tolist()]}
    both = make_reference(lists, RATE, 4.0)
    assert both.shape == (4000, 2)
    np.testing.assert_array_equal(both[:, 0], one(table))
    if table["kind"] != "multisine":
        np.testing.assert_array_equal(both[:, 1], one({**table, name: lists[name][1]}))
    else:
        assert abs(np.corrcoef(both.T)[0, 1]) < 0.5, "joints have phases of their own"


# Moves


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    distance=st.floats(1e-3, 10.0),
    speed=st.floats(0.05, 5.0),
    acceleration=st.floats(0.1, 50.0),
    jerk=st.one_of(st.just(math.inf), st.floats(1.0, 1e4)),
)
def test_moves_keep_their_limits_and_use_them(distance, speed, acceleration, jerk):
    move = plan_move(-distance, speed, acceleration, jerk)
    t = np.linspace(0.0, move.duration, 20001)
    q = move.position(t)
    step = t[1]
    assert q[0] == 0.0
    assert q[-1] == pytest.approx(-distance, rel=1e-12)
    v = np.gradient(q, step, edge_order=2)
    a = np.diff(q, 2) / step**2
    # Differences of a piecewise cubic never exceed its derivative; rounding of q is 1e-16.
    rounding = 8 * np.finfo(float).eps * distance
    assert np.abs(v).max() <= speed * (1 + 1e-9) + rounding / step
    assert np.abs(a).max() <= acceleration * (1 + 1e-9) + rounding / step**2
    if jerk < math.inf:
        j = np.diff(q, 3) / step**3
        assert np.abs(j).max() <= jerk * (1 + 1e-6) + 2 * rounding / step**3
        # Time-optimal: a limit is met at every instant, the jerk's in the first phase.
        assert distance >= 2 * jerk * move.durations[0] ** 3 * (1 - 1e-9)
        cruises = move.durations[3] > 0
    else:
        cruises = move.cruise_time > 0
    if cruises:
        assert np.abs(v).max() == pytest.approx(speed, rel=1e-9, abs=rounding / step)
    assert np.all(np.diff(q) <= rounding)


def test_the_seven_phases_against_their_closed_form():
    # v/a + a/j = 0.25 + 0.1 s of ramp, (0.3 - 0.5 * 0.35) / 0.5 s of cruise.
    move = plan_move(0.3, 0.5, 2.0, 20.0)
    np.testing.assert_allclose(move.durations, [0.1, 0.15, 0.1, 0.25, 0.1, 0.15, 0.1], rtol=1e-12)
    # End of the first jerk phase: j t^3 / 6; end of the ramp: v T / 2; half way at half time.
    times = np.array([0.1, 0.35, move.duration / 2])
    np.testing.assert_allclose(move.position(times), [20e-3 / 6, 0.0875, 0.15], rtol=1e-12)


def test_short_move_is_a_triangle():
    # Way 0.02 with 2 m/s^2: up for sqrt(0.02 / 2) = 0.1 s, down for as long, peak 0.2 < 0.5.
    move = plan_move(0.02, 0.5, 2.0)
    assert move.duration == pytest.approx(0.2)
    np.testing.assert_allclose(move.position(np.array([0.1, 0.2])), [0.01, 0.02], rtol=1e-12)


def test_trapezoid_visits_its_targets_and_dwells():
    q = one({**TRAPEZOID, "dwell": 0.2, "repeat": False})
    # v/a = 0.25 s of ramp; 0.3 at 0.5: 0.3/0.5 + 0.25 = 0.85 s. Then 0.4: 1.05 s.
    assert q[0] == 0.0
    np.testing.assert_allclose(q[850:1051], 0.3, rtol=1e-12)
    assert q[1060] < 0.3
    np.testing.assert_allclose(q[2100:], -0.1, rtol=1e-12)
    np.testing.assert_allclose(np.abs(np.diff(q)).max() * RATE, 0.5, rtol=1e-9)
    repeated = one({**TRAPEZOID, "dwell": 0.2, "repeat": True})
    np.testing.assert_array_equal(repeated[:2100], q[:2100])
    assert repeated[3400] == pytest.approx(0.3)


def test_standing_at_the_only_target_is_allowed():
    np.testing.assert_array_equal(one({**TRAPEZOID, "start": 1.0, "targets": [1.0]}), 1.0)
    q = one({**TRAPEZOID, "start": 1.0, "targets": [0.9]})
    assert q[-1] == pytest.approx(0.9)


def test_point_to_point_goes_to_and_fro():
    q = one({**S_CURVE, "start": 0.1, "dwell": 0.05})
    # 0.2 at 0.5: 0.2/0.5 + 0.35 = 0.75 s a way, then the dwell.
    np.testing.assert_allclose(q[[0, 750, 800, 1550, 1600]], [0.1, 0.3, 0.3, 0.1, 0.1], rtol=1e-12)
    np.testing.assert_allclose(q[1600:3200], q[:1600], atol=1e-12)
    once = one({**S_CURVE, "start": 0.1, "repeat": False})
    np.testing.assert_allclose(once[750:], 0.3, rtol=1e-12)


# Bezier


def test_two_points_give_the_rest_to_rest_polynomial():
    q = one(BEZIER, duration=2.0)
    z = np.arange(2000) / 2000
    psi = z**5 * (252 - 1050 * z + 1800 * z**2 - 1575 * z**3 + 700 * z**4 - 126 * z**5)
    # The expanded form cancels digits near z = 1: sums of 1800 at 1e-16.
    np.testing.assert_allclose(q, 0.1 + 0.4 * psi, atol=1e-12)


def test_bezier_of_order_two_by_hand():
    z = np.array([0.0, 0.25, 0.5, 1.0])
    expected = (1 - z) ** 2 * 1.0 + 2 * z * (1 - z) * 3.0 + z**2 * -1.0
    np.testing.assert_allclose(bezier_curve(np.array([1.0, 3.0, -1.0]), z), expected, rtol=1e-14)
    q = one({**BEZIER, "points": [1.0, 3.0, -1.0], "duration": 1.0, "start_time": 0.5})
    np.testing.assert_array_equal(q[:501], 1.0)
    np.testing.assert_allclose(q[[750, 1000]], expected[1:3], rtol=1e-12)
    np.testing.assert_array_equal(q[1500:], -1.0)


def test_quarter_sine_hold_and_return():
    """The paper's reference of mass 2, its polynomial written out."""
    times = {"rise_time": 0.1, "hold_until": 5.0, "return_until": 10.0}
    table = {"kind": "quarter_sine", "level": 0.05, **times}
    got = make_reference(table, 1000.0, 11.0)[:, 0]
    t = np.arange(11000) / 1000.0
    z = np.clip((t - 5.0) / 5.0, 0.0, 1.0)
    terms = 252 - 1050 * z + 1800 * z**2 - 1575 * z**3 + 700 * z**4 - 126 * z**5
    expected = 0.05 * np.sin(np.minimum(t / 0.1, 1.0) * np.pi / 2) - 0.05 * z**5 * terms
    # Terms of up to 90 cancel to one.
    np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-13)
    with pytest.raises(InputError, match="do not follow"):
        make_reference(table | {"hold_until": 0.05}, 1000.0, 11.0)


def test_bezier_to_and_fro():
    q = one({**BEZIER, "duration": 1.0, "repeat": True})
    np.testing.assert_allclose(q[1000:2000], q[1000:0:-1], rtol=1e-9)
    np.testing.assert_allclose(q[2000:], q[:2000], rtol=1e-9)


# Periodic ones


def test_fourier_is_its_series():
    q = one({**FOURIER, "cosine": [0.05], "offset": 1.0})
    t = np.arange(4000) / RATE
    w = 2 * np.pi * 0.5
    expected = 1 + 0.1 * np.sin(w * t) + 0.02 * np.sin(3 * w * t) + 0.05 * np.cos(w * t)
    np.testing.assert_allclose(q, expected, atol=1e-13)


@pytest.mark.parametrize("odd", [False, True])
@pytest.mark.parametrize("phases", ["random", "schroeder"])
def test_multisine_has_a_flat_spectrum_in_its_band_alone(odd, phases):
    q = one({**MULTISINE, "odd": odd, "phases": phases, "offset": 0.3, "period": 2.0})
    assert np.abs(q - 0.3).max() == pytest.approx(0.1, rel=1e-12)
    np.testing.assert_allclose(q[:2000], q[2000:], atol=1e-15)
    spectrum = np.abs(np.fft.rfft(q[:2000] - 0.3))
    harmonics = np.arange(2, 41)  # 1 to 20 Hz, half a hertz apart, both ends included
    harmonics = harmonics[harmonics % 2 == 1] if odd else harmonics
    excited = np.flatnonzero(spectrum > 1e-9 * spectrum.max())
    np.testing.assert_array_equal(excited, harmonics)
    np.testing.assert_allclose(spectrum[harmonics], spectrum[harmonics[0]], rtol=1e-9)


def test_seeds():
    np.testing.assert_array_equal(one(MULTISINE), one({**MULTISINE, "seed": 0}))
    assert abs(np.corrcoef(one(MULTISINE), one({**MULTISINE, "seed": 1}))[0, 1]) < 0.5


def test_schroeder_has_the_lower_crest():
    def rms(phases):
        return one({**MULTISINE, "phases": phases}).std()

    assert rms("schroeder") > rms("random")  # both have the same peak


# Files


@pytest.fixture
def folder(tmp_path):
    t = np.arange(0.0, 1.0, 0.01)
    rows = np.stack([t + 5.0, 3.0 * t, -t], axis=1)
    np.savetxt(tmp_path / "ref.csv", rows, delimiter=",", header="t,a,b", comments="")
    return tmp_path


def test_file_is_resampled_and_its_last_row_held(folder):
    table = {"kind": "csv", "file": "ref.csv", "column": ["a", "b"], "time": "t"}
    q = make_reference(table, RATE, 2.0, folder)
    t = np.minimum(np.arange(2000) / RATE, 0.99)
    np.testing.assert_allclose(q, np.stack([3 * t, -t], axis=1), atol=1e-12)
    by_rate = {"kind": "csv", "file": "ref.csv", "column": "a", "sample_rate": 100.0}
    np.testing.assert_allclose(one(by_rate, 2.0, base_dir=folder), 3 * t, atol=1e-12)
    as_it_is = {"kind": "csv", "file": "ref.csv", "column": "b"}
    np.testing.assert_allclose(one(as_it_is, 0.1, base_dir=folder), -np.arange(100) / 100)


def test_file_faults(folder):
    table = {"kind": "csv", "file": "ref.csv", "column": "a", "time": "t"}
    refuse({**table, "file": "rf.csv"}, r"no such file; .*ref\.csv", base_dir=folder)
    refuse({**table, "column": "A"}, "no column 'A'; did you mean 'a'", base_dir=folder)
    refuse({**table, "time": "b"}, "time does not run forward in row 1", base_dir=folder)
    refuse({**table, "column": 3}, "column = 3 is not a text", base_dir=folder)
    np.savez(folder / "ref.npz", m=np.ones((9, 2)), bad=np.array([1.0, np.nan, 2.0]))
    matrix = {"kind": "csv", "file": "ref.npz", "column": "m"}
    refuse(matrix, r"is a matrix; name one of its columns: 'm\[1\]'", base_dir=folder)
    refuse({**matrix, "column": "bad"}, "row 1 is no number", base_dir=folder)
