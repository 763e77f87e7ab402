"""Case files: what is refused, with which words, and what comes through."""

import math

import pytest

from jaxid.case.case import load_case
from jaxid.case.values import Value
from jaxid.controllers import CONTROLLERS
from jaxid.errors import InputError
from jaxid.settings import LogTable, Preprocess, StudyTable
from tests.support.case_faults import CASCADE, FAULTS, GOOD, message, more, swapped, write

# The example of the documentation, to the letter.
DOCUMENTED = """
[plant]
kind = "axis"                      # axis | flexible_axis | chain | ...
motion = "linear"
orientation = "horizontal"
gravity = 9.81
units = { position = "V", force = "V" }
[plant.parameters]
inertia = { guess = 80.0 }

[[effects]]
kind = "viscous_friction"
coefficient = { guess = 100.0 }

[actuator]
gain = 35.15

[log]
time = "t"
position = "q"
force = "u"
hold = "zero_order"
rows = [0, 25000]

[preprocess]
cutoff_hz = 100.0
order = 4
decimation = 10
trim = 50
rest_velocity = 1e-3

[controller]
kind = "cascade_pd"
kp = 160.18
kv = 243.45
period = 0.001
velocity_average = 2
limit = 10.0
disturbance = { level = 5.07, on = 0.5, off = 0.5, start = 0.343 }

[sensor]
position_resolution = 1.0e-6
position_noise = 2.0e-6
force_noise = 0.5

[[validation]]
name = "pulses"
log = "second.csv"
rows = [0, 20000]
disturbance = { level = 5.07, on = 0.5, off = 0.5, start = 0.343 }

[reference]
[input]
[simulation]
[study]
"""


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_told_with_key_and_mend(tmp_path, fault):
    text, words = FAULTS[fault]
    told = message(tmp_path, text)
    missing = [word for word in words if word not in told]
    assert not missing, told


def test_missing_file_lists_what_is_beside(tmp_path):
    write(tmp_path, GOOD, "axis.toml")
    with pytest.raises(InputError, match=r"axs\.toml: no such file; .*axis\.toml"):
        load_case(tmp_path / "axs.toml")


def test_folder_and_binary_are_no_cases(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_case(tmp_path)
    (tmp_path / "case.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not UTF-8"):
        load_case(tmp_path / "case.toml")


def test_good_case_comes_through(tmp_path):
    case = load_case(write(tmp_path, "\ufeff" + GOOD))
    assert case.plant.parameters["inertia"] == Value(80.0, True, 10.0, 200.0, 95.0)
    assert [e.cls.kind for e in case.effects] == ["viscous_friction", "coulomb_friction"]
    assert case.effects[0].parameters["coefficient"][0] == Value(100.0, True)
    assert case.effects[1].parameters == {"level": (Value(20.0),)}
    assert case.actuator.gain == 35.15
    assert case.columns == LogTable(time="t", position="q", force="u")
    assert case.folder == tmp_path
    assert case.preprocess == Preprocess()
    assert case.study == StudyTable()


def test_documented_example_comes_through(tmp_path):
    case = load_case(write(tmp_path, DOCUMENTED))
    assert case.plant.units.label("force") == "V"
    assert case.preprocess.cutoff_hz == 100.0
    assert case.reference is None
    (validation,) = case.validations
    assert validation.log == tmp_path / "second.csv"
    assert validation.columns.rows == (0, 20000)
    assert validation.columns.position == "q"


def test_smallest_case_needs_no_log_until_it_is_read(tmp_path):
    case = load_case(write(tmp_path, '[plant]\nkind = "axis"\nparameters = { inertia = 2 }'))
    assert case.plant.parameters["inertia"] == Value(2.0)
    with pytest.raises(InputError, match=r"\[log\] is missing; .*position"):
        _ = case.columns


def test_all_keys_of_all_tables_are_taken(tmp_path):
    case = load_case(
        write(
            tmp_path,
            more(
                """velocity_average = 2
limit = 10.0
disturbance = "d"
[preprocess]
cutoff_hz = 100
order = 4
decimation = 10
trim = 0
rest_velocity = [1e-3]
align_hold = false
[reference]
kind = "multisine"
band_hz = [0.5, 10.0]
amplitude = 0.1
[simulation]
duration = 10
sample_rate = 1000
substeps = 2
sharpness = 1e-4
initial_position = 0.1
initial_velocity = [0.0]
[study]
estimators = ["output_error", "inverse_dynamics"]
noise = [0.0, 1.0]
draw = 0.2
start_spread = 0.5
runs = 10
chunk = 4
"""
            ),
        )
    )
    assert case.preprocess.align_hold is False
    assert case.study.estimators == ("output_error", "inverse_dynamics")
    assert case.reference["kind"] == "multisine"
    assert case.simulation.initial_velocity == (0.0,)


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_every_controller_states_its_own_keys(tmp_path, kind):
    told = message(tmp_path, swapped(CASCADE, f'kind = "{kind}"\n'))
    first = "poles" if kind == "flatness" else "kp"
    doc = "poles of the closed loop [1/s]" if kind == "flatness" else "gain of the position error"
    hint = f"add {first}: {doc}; it belongs to kind = '{kind}'"
    assert f"[controller]: '{first}' is missing; {hint}" in told


def test_other_file_does_not_inherit_rows(tmp_path):
    text = swapped('force = "u"', 'force = "u"\nrows = [0, 500]')
    text += '[[validation]]\nname = "a"\nlog = "b.csv"\nsample_rate = 500.0\n'
    text += '[[validation]]\nname = "b"\nrows = [500, 900]\n'
    other, same = load_case(write(tmp_path, text)).validations
    assert other.columns == LogTable(position="q", force="u", sample_rate=500.0)
    assert same.log is None
    assert same.columns == LogTable(time="t", position="q", force="u", rows=(500, 900))


def test_validation_inherits_the_disturbance(tmp_path):
    text = more('disturbance = "d"\n[[validation]]\nname = "a"\nlog = "b.csv"\n')
    text += '[[validation]]\nname = "b"\nlog = "c.csv"\ndisturbance = "e"\n'
    inherited, own = load_case(write(tmp_path, text)).validations
    assert (inherited.disturbance, own.disturbance) == ("d", "e")


def test_bounds_are_open_where_none_are_given(tmp_path):
    value = load_case(write(tmp_path, GOOD)).effects[0].parameters["coefficient"][0]
    assert (value.lower, value.upper) == (-math.inf, math.inf)


def test_a_missing_case_names_the_cases_beside_it_and_no_other_toml_file(tmp_path):
    (tmp_path / "axis.toml").write_text('[plant]\nkind = "axis"\n')
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(InputError, match=r"no such file; .* in that folder: axis\.toml$"):
        load_case(tmp_path / "axes.toml")
