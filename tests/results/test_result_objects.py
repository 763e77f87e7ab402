"""Results in Python: parameters, covariance, residuals, plots, tables and short forms."""

import builtins
import json

import numpy as np
import pytest
import xarray
from matplotlib.figure import Figure

import jaxid
from jaxid.errors import InputError
from tests.support.cli_setup import COULOMB, TRUTH, VISCOUS, place, recorded, text


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("objects")
    place(made, recorded())
    place(made / "second", recorded(1))
    (made / "bare.toml").write_text(text([VISCOUS]))
    return made


@pytest.fixture(scope="module")
def fitted(folder):
    second = folder / "second" / "log.csv"
    return jaxid.identify(
        folder / "case.toml", folder / "log.csv", method="inverse_dynamics", validate=[second]
    )


@pytest.fixture(scope="module")
def found(folder):
    return jaxid.discover(folder / "bare.toml", folder / "log.csv", refit=False)


@pytest.fixture(scope="module")
def checked(folder):
    return jaxid.check(folder / "case.toml", folder / "log.csv")


def test_parameters_by_name(fitted):
    inertia = fitted.parameters["inertia"]
    assert inertia.value == fitted.value("inertia") == pytest.approx(TRUTH["inertia"], rel=0.05)
    assert (inertia.unit, inertia.identifiable, inertia.guess) == ("kg", True, pytest.approx(95.1 / 1.5))
    assert 0 < inertia.std < 0.05 * inertia.value
    assert [*fitted.parameters] == fitted.estimate.names
    with pytest.raises(KeyError, match="did you mean 'inertia'"):
        fitted.parameters["inertai"]


def test_a_list_is_asked_for_by_its_entries():
    from jaxid.results.parameters import Parameter, ParameterTable

    table = ParameterTable([Parameter(f"mass[{k}]", 1.0, 0.1, "kg") for k in (1, 2)])
    with pytest.raises(KeyError, match=r"it is a list: ask for mass\[1\], mass\[2\]"):
        table["mass"]


def test_covariance(fitted, folder):
    covariance = fitted.covariance
    assert list(covariance.names) == fitted.estimate.names
    np.testing.assert_allclose(covariance.std, fitted.estimate.std)
    np.testing.assert_allclose(np.diag(covariance.correlation), 1.0)
    fitted.save(folder / "out")
    written = json.loads((folder / "out" / "result.json").read_text())
    assert written["covariance"]["names"] == fitted.estimate.names
    np.testing.assert_array_equal(written["covariance"]["matrix"], covariance.matrix)
    assert written["versions"]["jaxid"] == jaxid.__version__


def test_residuals(fitted, folder):
    for k, log in enumerate((None, "log", folder / "second" / "log.csv")):
        residuals = fitted.residuals(log)
        gap = fitted.gaps[min(k, 1)]
        np.testing.assert_array_equal(residuals.force, gap.force.residual)
        rms = np.sqrt(np.nanmean(residuals.force**2, axis=0))
        np.testing.assert_allclose(rms, gap.force.rms)
        np.testing.assert_allclose(np.sqrt(np.mean(residuals.position**2, axis=0)), gap.simulation.rms)
        assert residuals.units == {"time": "s", "position": "m", "force": "N"}
        table = residuals.to_pandas()
        assert (len(table), [*table.columns], table.index.name) == (2000, ["position", "force"], "time")
        assert table["force"].notna().sum() == np.isfinite(residuals.force).sum()
    with pytest.raises(jaxid.InputError, match="did you mean 'fit'"):
        fitted.residuals("fitt")


def test_a_result_as_a_dataset(fitted, folder):
    data = fitted.to_xarray()
    log, gap = fitted.session.fit.log, fitted.gaps[0]
    np.testing.assert_array_equal(data.position.values, log.position)
    np.testing.assert_array_equal(data.position_simulated.values, gap.simulation.position)
    np.testing.assert_array_equal(data.force_residual.values, gap.force.residual)
    assert data.position.units == "m"
    assert data.force.units == "N"
    assert float(data.estimate.sel(parameter="inertia")) == fitted.value("inertia")
    assert float(data["std"].sel(parameter="inertia")) == fitted.parameters["inertia"].std
    data.to_netcdf(folder / "fit.nc", engine="scipy")
    assert xarray.load_dataset(folder / "fit.nc", engine="scipy").attrs["method"] == "inverse_dynamics"
    assert fitted.to_xarray("log").attrs["log"] == "log"
    with pytest.raises(jaxid.InputError, match="did you mean 'fit'"):
        fitted.to_xarray("fitt")


FITTED = ("fit", "difference", "force", "residual", "scatter", "parameters", "correlation", "gaps")


@pytest.mark.parametrize("kind", FITTED)
def test_axes_in_axes_out(kind, fitted, found):
    for result in (fitted, found):
        ax = Figure().add_subplot()
        assert result.plot(kind, ax) is ax
        assert ax.has_data()
        assert ax.get_xlabel() or kind == "correlation"


def test_plots_of_a_search(found):
    for kind in ("where", "candidates"):
        ax = Figure().add_subplot()
        assert found.plot(kind, ax) is ax
        assert ax.has_data()


def test_a_new_figure_where_no_axes_are_given(fitted):
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    figure = fitted.plot("scatter", against="position", log="log").figure
    assert figure.number not in before
    assert "position" in figure.axes[0].get_xlabel()
    with pytest.raises(jaxid.InputError, match="has no candidates"):
        fitted.plot("candidates")
    assert pyplot.get_fignums() == [*before, figure.number]
    pyplot.close(figure)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "resid"}, "did you mean 'residual'"),
        ({"kind": "fit", "log": "second"}, "log 'second' is not in this result"),
        ({"kind": "fit", "joint": 2}, "joint 2 has no measured position"),
        ({"kind": "scatter", "against": "speed"}, "against 'speed' is not known"),
        ({"kind": "history"}, "only a recursive estimate has a history"),
        ({"kind": "where"}, "no curve of the mean residual"),
    ],
)
def test_fault(fitted, options, words):
    with pytest.raises(jaxid.InputError, match=words):
        fitted.plot(**options, ax=Figure().add_subplot())


def test_history(folder):
    result = jaxid.identify(folder / "case.toml", folder / "log.csv", method="recursive")
    ax = result.plot("history", Figure().add_subplot(), parameter="inertia")
    assert ax.get_title(loc="left") == "inertia"


def test_short_forms(fitted, found, checked):
    for result, first in (
        (fitted, "Identification of case.toml by inverse_dynamics: converged"),
        (found, "Discovery in bare.toml: found: coulomb_friction"),
        (checked, "Check of case.toml: the log is sound"),
    ):
        lines = repr(result).splitlines()
        assert lines[0] == first
        assert 2 < len(lines) < 12
        page = result._repr_html_()
        assert page.count("<table>") == page.count("</table>") >= 1
        assert "inertia" in page
        assert "http" not in page
    assert "95." in repr(fitted)
    assert "95." in fitted._repr_html_()


def test_html_escapes_and_raises_powers():
    from jaxid.results.parameters import html_table

    page = html_table([["name", "value", "unit"], ["<b>", "1", "kg m^2"]], "a & b")
    assert "&lt;b&gt;" in page
    assert ">1<" in page
    assert "kg m²" in page
    assert "a &amp; b" in page


def test_tables(fitted, found, checked):
    table = fitted.to_pandas()
    assert [*table.index] == fitted.estimate.names
    assert table.loc["inertia", "value"] == fitted.value("inertia")
    assert table.loc["inertia", "unit"] == "kg"
    np.testing.assert_array_equal(fitted.covariance.to_pandas().to_numpy(), fitted.covariance.matrix)
    assert np.isnan(found.to_pandas().loc["coulomb_friction.level", "guess"])
    assert checked.parameters["inertia"].std == checked.json()["parameters"]["inertia"]["expected_std"]
    assert [*checked.to_pandas().index] == [*checked.parameters] == [*checked.covariance.names]


def test_without_pandas(fitted, monkeypatch):
    real = builtins.__import__

    def without(name, *more):
        if name == "pandas":
            raise ImportError(name)
        return real(name, *more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(jaxid.InputError, match=r"to_pandas needs pandas; pip install 'jaxid\[pandas\]'"):
        fitted.to_pandas()


def test_a_discovery_looks_like_an_identification(found):
    assert found.estimate is found.after
    assert found.gaps is found.gaps_after
    assert found.value("inertia") == found.after.value("inertia")
    assert [*found.parameters] == found.after.names
    assert found.parameters["coulomb_friction.level"].guess is None
    assert COULOMB[0] in found.kinds


@pytest.fixture(scope="module")
def studied():
    """A study of two estimators, two noise levels and two parameters, forty runs each."""
    rng, shape = np.random.default_rng(0), (2, 2, 40, 2)
    dims, run = ("estimator", "noise", "run", "parameter"), ("estimator", "noise", "run")
    table = xarray.Dataset(
        {
            "estimate": (dims, 1.0 + 0.1 * rng.standard_normal(shape)),
            "std": (dims, np.full(shape, 0.1)),
            "identifiable": (dims, np.ones(shape, np.int8)),
            "converged": (run, np.ones(shape[:3], np.int8)),
            "message": (run, np.full(shape[:3], "", object)),
            "named": (run, np.full(shape[:3], "", object)),
            "truth": (("run", "parameter"), np.ones((40, 2))),
            "bound": (("noise", "parameter"), np.full((2, 2), 0.09)),
            "unit": ("parameter", np.array(["kg", "N"], object)),
        },
        coords={
            "estimator": np.array(["output_error", "didim"], object),
            "noise": [1.0, 2.0],
            "parameter": np.array(["inertia", "friction"], object),
        },
    )
    return jaxid.Study(table, 1.0, "axis")


@pytest.mark.parametrize("kind", ["errors", "coverage", "scatter", "ecdf"])
def test_plots_of_a_study(kind, studied):
    ax = Figure().add_subplot()
    assert studied.plot(kind, ax, parameter="friction") is ax
    assert ax.get_title("left") == "friction"
    with pytest.raises(jaxid.InputError, match="parameter 'fricton' is not known; did you mean 'friction'"):
        studied.plot(kind, ax, parameter="fricton")
    with pytest.raises(jaxid.InputError, match="plot 'fit' is not known"):
        studied.plot("fit")


def test_tables_of_a_study(studied):
    assert len(studied.to_pandas()) == len(studied.summary) == 8
    assert repr(studied).splitlines()[0].startswith("Study of axis: 40 runs under 2 setting(s)")
    assert studied._repr_html_().count("<tr>") == 9


def draws_of(tree) -> np.ndarray:
    """Draws of all parameters, (draws, p)."""
    posterior = tree["posterior"].to_dataset()
    return np.stack([np.ravel(posterior[name]) for name in posterior.data_vars], axis=1)


def test_the_draws_have_the_names_and_the_covariance_of_the_result(fitted):
    tree = fitted.to_arviz(5000, chains=2, seed=1)
    assert isinstance(tree, xarray.DataTree)
    posterior = tree["posterior"]
    assert list(posterior.data_vars) == fitted.estimate.names
    assert dict(posterior.sizes) == {"chain": 2, "draw": 5000}
    assert posterior["inertia"].attrs["units"] == "kg"
    assert posterior.attrs["source"].startswith("normal distribution")
    draws, std = draws_of(tree), fitted.estimate.std
    np.testing.assert_allclose((draws.mean(0) - fitted.estimate.theta) / std, 0.0, atol=0.05)
    scaled = np.cov(draws.T) / np.outer(std, std)
    np.testing.assert_allclose(scaled, fitted.covariance.correlation, atol=0.05)
    assert tree["observed_data"]["position"].sizes["time"] == fitted.session.fit.log.samples
    same = fitted.to_arviz(5000, chains=2, seed=1)
    assert posterior.to_dataset().equals(same["posterior"].to_dataset())


def test_exact_draws_need_a_likelihood_and_draws_a_number(fitted):
    with pytest.raises(InputError, match="not made of inverse_dynamics"):
        fitted.to_arviz(exact=True)
    with pytest.raises(InputError, match="chains = 0"):
        fitted.to_arviz(chains=0)


def test_arviz_takes_the_tree(fitted):
    arviz = pytest.importorskip("arviz_stats")
    table = arviz.summary(fitted.to_arviz(500), round_to="none")
    assert list(table.index) == fitted.estimate.names
    assert float(table.loc["inertia", "mean"]) == pytest.approx(fitted.value("inertia"), rel=1e-2)
