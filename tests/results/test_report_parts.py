"""What the report is drawn and written with: digits, thinned lines, figures."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.estimators import METHODS
from jaxid.results.parameters import Parameter
from jaxid.results.report import CandidateScore, LogView, SearchStep
from jaxid.results.report.curves import binned_mean, envelope
from jaxid.results.report.data import ParameterRow
from jaxid.results.report.numbers import plain, pretty_unit, scaled_unit, usual_unit, with_std
from jaxid.results.report.plots import plot_candidates, plot_fit, plot_residual_against
from jaxid.results.report.study import _answer
from jaxid.results.report.study_plots import _look, plot_coverage, plot_errors
from jaxid.results.report.words import GapRow, _gap_words, _gaps_words, _parameter_line


def _view(**changes):
    time = np.linspace(0.0, 5.0, 500)
    position, velocity = 0.3 * np.cos(time), -0.3 * np.sin(time)
    fields = {
        "name": "fit",
        "time": time,
        "position_measured": position,
        "position_simulated_before": position + 1e-3,
        "position_simulated_after": position + 1e-5,
        "band_time": time,
        "velocity": velocity,
        "position": position,
        "force_measured": 20.0 * np.sign(velocity),
        "residual_before": 20.0 * np.sign(velocity),
        "residual_after": 0.1 * np.cos(9.0 * time),
    }
    return LogView(**{**fields, **changes})


@pytest.mark.parametrize(
    ("value", "std", "texts"),
    [
        (95.1034, 0.2134, ("95.10", "0.21")),
        (203.5, 1.96, ("203.5", "2.0")),
        (5.0, 0.0996, ("5.00", "0.10")),
        (12345.0, 230.0, ("12340", "230")),
        (-0.001, 0.25, ("0.00", "0.25")),
        (1.2345e6, 1.2e4, ("1.234 × 10⁶", "0.012 × 10⁶")),
        (1.2349e-5, 2.3e-7, ("1.235 × 10⁻⁵", "0.023 × 10⁻⁵")),
        (3.14159, None, ("3.142", "–")),
        (None, None, ("–", "–")),
        (float("nan"), 1.0, ("–", "1.0")),
    ],
)
def test_digits_follow_the_standard_deviation(value, std, texts):
    assert with_std(value, std) == texts


def test_plain_numbers_and_units():
    assert plain(0.99999) == "1.00"
    assert plain(-1234.5) == "−1230"
    assert plain(2.5e-7, 2) == "2.5 × 10⁻⁷"
    assert plain(True) == "–"
    assert pretty_unit("(N m)^2 s^-1") == "(N m)² s⁻¹"
    assert scaled_unit("m", [0.0012, None, np.array([np.nan])]) == (1e-3, "mm")
    assert scaled_unit("V", [0.0]) == (1.0, "V")
    assert scaled_unit("counts", [1e-5]) == (1.0, "counts")


def test_thinned_lines_keep_extremes_and_gaps():
    time = np.concatenate([np.arange(0.0, 5.0, 1e-3), np.arange(7.0, 12.0, 1e-3)])
    values = np.sin(time)
    values[[1234, 8765]] = (9.0, -9.0)
    x, y = envelope(time, values, 100)
    assert x.size < 250
    assert np.nanmax(y) == 9.0
    assert np.nanmin(y) == -9.0
    (hole,) = np.flatnonzero(np.isnan(x))
    assert x[hole - 1] < 5.0
    assert x[hole + 1] >= 7.0


def test_means_do_not_cross_groups():
    x = np.linspace(-1.0, 1.0, 1000)
    mean_x, mean_y = binned_mean(x, np.sign(x), bins=7, group=(x >= 0.0).astype(int))
    (hole,) = np.flatnonzero(np.isnan(mean_x))
    np.testing.assert_allclose(mean_y[:hole], -1.0)
    np.testing.assert_allclose(mean_y[hole + 1 :], 1.0)


def test_figures_label_their_axes_with_units():
    units = {"position": "rad", "velocity": "rad/s", "force": "N m", "time": "s"}
    fit = plot_fit(_view(), units)
    assert [ax.get_ylabel() for ax in fit.axes][0] == "position [rad]"
    assert fit.axes[-1].get_xlabel() == "time [s]"
    assert "[mrad]" in fit.axes[-1].get_ylabel()
    against = plot_residual_against(_view(), units)
    assert [ax.get_xlabel() for ax in against.axes[3:]] == [
        "velocity [rad/s]",
        "position [rad]",
        "time [s]",
    ]
    with pytest.raises(ValueError, match="no force residual"):
        plot_residual_against(_view(residual_before=None, residual_after=None), units)


def test_candidates_are_ranked():
    scores = (("cogging", -3.0), ("backlash", np.nan), ("hysteresis", 811.2), ("coulomb", 812.4))
    step = SearchStep("coulomb", None, 6.1, None, tuple(CandidateScore(*s) for s in scores), 12.0)
    (ax,) = plot_candidates(step).axes
    names = [label.get_text() for label in ax.get_yticklabels()]
    assert names == ["coulomb", "hysteresis", "cogging", "backlash"]


def test_many_joints_in_one_sentence():
    rows = [GapRow("force, joint 1", "fit", "N", 2.0, x, 0.02) for x in (0.003, 0.001, 0.002)]
    assert _gaps_words("force", rows) == (
        "The force residual of the 3 joints on the fit log falls from 2.00 N to 0.00100–0.00300 N (RMS), "
        "at noise floors of 0.0200 N"
    )
    small = [GapRow("force, joint 1", "fit", "N", after=x) for x in (0.003, 0.001, 0.002)]
    assert _gaps_words("force", small).endswith("is 1.00–3.00 mN (RMS)")


def test_a_gap_that_grows_rises_and_one_that_reads_the_same_stays():
    change = lambda before, after: _gap_words(GapRow("force", "fit", "N", before, after))
    assert change(4.96, 0.3).endswith("falls from 4.96 N to 0.300 N (RMS)")
    assert change(0.3, 4.96).endswith("rises from 0.300 N to 4.96 N (RMS)")
    assert change(0.30001, 0.3).endswith("stays at 0.300 N (RMS)")
    rows = [GapRow("force, joint 1", "fit", "N", 1.0, x) for x in (3.0, 1.0, 2.0)]
    assert " rises from 1.00 N to " in _gaps_words("force", rows)


def test_usual_units_with_the_digits_of_the_deviation():
    line = _parameter_line(ParameterRow("cogging.period", 0.02000002, 2.3e-7, "m"))
    assert (line["value"], line["std"], line["unit"]) == ("20.00002", "0.00023", "mm")
    line = _parameter_line(ParameterRow("input_delay.delay", 0.0094503, 9.3e-7, "s"))
    assert (line["value"], line["std"], line["unit"]) == ("9.45030", "0.00093", "ms")
    assert _parameter_line(ParameterRow("offset", 0.001, 0.11, "N"))["relative"] == "over 100 %"
    assert usual_unit("m", 0.0, 2e-6) == (1e-6, "µm")
    assert usual_unit("kg m^2", 1e-5, 1e-7) == (1.0, "kg m²")
    assert str(Parameter("cogging.period", 0.02000002, 2.3e-7, "m")) == "20.00002 ± 0.00023 mm"


def _row(estimator, **numbers):
    row = dict.fromkeys(("rmse", "std", "bound", "coverage_95"), np.nan)
    row |= {"estimator": estimator, "noise": 1.0, "parameter": "inertia", "unit": "kg", "used": 8}
    return row | numbers


def test_study_of_estimators_without_deviation_or_value():
    """Neither a nan in a sentence, nor a line of nothing in a legend."""
    rows = [_row("a", rmse=0.1, std=0.1, coverage_95=0.9), _row("b", rmse=0.2), _row("c", used=0)]
    table = {"converged": np.zeros(24)}
    study = SimpleNamespace(summary=rows, failures=[{"runs": 8}], table=_Table(table, ["a", "b", "c"]))
    assert _answer(study) == (
        "95 % intervals held the truth, over all parameters and settings, in: a: 90 %. "
        "8 of 24 fits failed. c gave none at all."
    )
    drawn = lambda figure: [t.get_text() for t in figure.legends[0].get_texts()]
    assert drawn(plot_errors(rows)) == ["a", "b", "reported σ"]
    assert drawn(plot_coverage(rows)) == ["a", "nominal"]


class _Table(dict):
    def __init__(self, data, estimators):
        super().__init__(data)
        self.estimator = SimpleNamespace(values=estimators)


def test_every_method_looks_its_own():
    looks = {(_look(k)["color"], _look(k)["marker"]) for k in range(len(METHODS) + 1)}
    assert len(looks) == len(METHODS) + 1
