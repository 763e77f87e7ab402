"""Logs in memory: tables and arrays give what their file gives, and are refused in one line as it is."""

import numpy as np
import pandas
import polars
import pytest
import xarray

import jaxid
from jaxid.logs.in_memory import as_log
from tests.support.cli_setup import place, recorded

KINDS = {
    "arrays": lambda data: {name: list(values) for name, values in data.items()},
    "pandas": pandas.DataFrame,
    "pandas, indexed by time": lambda data: pandas.DataFrame(data).set_index("t"),
    "pandas, nullable": lambda data: pandas.DataFrame(data).convert_dtypes(),
    "polars": polars.DataFrame,
    "polars, lazy": polars.LazyFrame,
    "xarray": lambda data: xarray.Dataset(
        {name: ("t", values) for name, values in data.items() if name != "t"}, coords={"t": data["t"]}
    ),
}


@pytest.fixture(scope="module")
def data():
    return {name: np.ravel(values) for name, values in recorded().items()}


@pytest.fixture(scope="module")
def files(tmp_path_factory, data):
    return place(tmp_path_factory.mktemp("in_memory"), data)


@pytest.mark.parametrize("kind", KINDS)
def test_a_table_is_the_log_of_its_file(kind, files, data):
    case = jaxid.load_case(files[0])
    read, given = jaxid.read_log(files[1], case.columns), as_log(KINDS[kind](data), case.columns)
    for name in ("time", "position", "force", "reference"):
        np.testing.assert_array_equal(getattr(given, name), getattr(read, name))
    assert (given.hold, given.rows) == (read.hold, read.rows)


def test_all_commands_take_a_table(files, data):
    case, table = files[0], pandas.DataFrame(data)
    fitted = jaxid.identify(case, table, method="inverse_dynamics", validate=[polars.DataFrame(data)])
    of_file = jaxid.identify(case, files[1], method="inverse_dynamics")
    np.testing.assert_array_equal(fitted.estimate.theta, of_file.estimate.theta)
    assert [run.name for run in fitted.session.runs] == ["fit", "DataFrame"]
    assert jaxid.check(case, data).json()["log"] == jaxid.check(case, files[1]).json()["log"]
    many = jaxid.identify_many(case, [data, table], method="inverse_dynamics")
    assert [m.value("inertia") for m in many] == pytest.approx([of_file.value("inertia")] * 2, rel=1e-9)


def spoilt(data, name, k, value):
    return data | {name: np.where(np.arange(len(data[name])) == k, value, data[name])}


FAULTS = {
    "no column": (lambda d: {n: v for n, v in d.items() if n != "u"}, "arrays: has no variable 'u'"),
    "NaN": (lambda d: spoilt(d, "q", 7, np.nan), "arrays, column 'q': 1 row(s) are NaN"),
    "missing": (lambda d: pandas.DataFrame(spoilt(d, "q", 7, np.nan)).convert_dtypes(), "1 row(s) are NaN"),
    "text": (lambda d: d | {"u": ["x"] * len(d["t"])}, "arrays, variable 'u': is not numeric"),
    "lengths": (lambda d: d | {"u": d["u"][:-1]}, "arrays: unequal lengths"),
    "short": (lambda d: {n: v[:20] for n, v in d.items()}, "arrays: is too short: 20 samples"),
    "time": (lambda d: d | {"t": d["t"][::-1]}, "arrays, column 't'"),
    "two columns": (
        lambda d: pandas.concat([pandas.DataFrame(d), pandas.DataFrame({"q": d["q"]})], axis=1),
        "DataFrame: has two columns 'q'",
    ),
    "no table": (lambda d: np.ones((100, 3)), "a log cannot be a ndarray"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault(fault, files, data):
    make, words = FAULTS[fault]
    with pytest.raises(jaxid.InputError) as caught:
        jaxid.identify(files[0], make(data))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_log_in_place_of_a_list(files, data):
    with pytest.raises(jaxid.InputError, match="validate is not a list of logs"):
        jaxid.check(files[0], files[1], validate=data)
