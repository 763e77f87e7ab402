"""Minimal models on logs of the published machine: what they find, and what they say they cannot."""

import json
from pathlib import Path

import numpy as np
import pytest

from jaxid.cli import main
from jaxid.estimators import METHODS
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.minimal.fit import filtering_of
from jaxid.numerics.lanes import run_alone
from jaxid.results.report.minimal_plots import plot_filtering
from jaxid.session import open_session
from truth.chain import flexible_log as flexible

T = flexible.TRUTH
# 1.8 N of noise on the force, which is 78 N RMS.
NOISE = 0.05
PUBLISHED = "[preprocess]\ncutoff_hz = 60.0\ndecimation = 12\nalign_hold = true"


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    """Fifteen seconds of trapezoids with pulses."""
    made = flexible.flexible_log(duration=15.0, force_noise=NOISE)
    return flexible.write(made, tmp_path_factory.mktemp("log"))


def fitted(log: Path, measured: str, method: str = "minimal_model", extra: str = "", **options) -> Estimate:
    """From guesses off by a factor of two."""
    path = log.parent / f"{measured}.toml"
    path.write_text(flexible.case(measured, extra=extra))
    session = open_session(path, log)
    parameters = session.machine.parameters
    away = [abs(g / T[n] - 1) for n, g in zip(parameters.names, parameters.guess, strict=True)]
    assert min(away) > 0.4
    return run_alone(METHODS[method](session, **options))


def check(estimate: Estimate, within: dict[str, float], sigmas: float = 3.0) -> None:
    """That parameters lie within relative tolerances of the truth, and within their own deviations."""
    std = dict(zip(estimate.names, estimate.std, strict=True))
    for name, tolerance in within.items():
        left = estimate.value(name) - T[name]
        assert abs(left) < tolerance * T[name], name
        assert abs(left) < sigmas * std[name], name


# The tolerances on model 1.
WANTED = {
    "motor_inertia": 0.01, "load_inertia": 0.02, "stiffness": 0.02,
    "coulomb_friction[1].level": 0.05, "coulomb_friction[2].level": 0.05,
}  # fmt: skip


def test_both_positions(log):
    estimate = fitted(log, "positions")
    assert estimate.all_identified
    check(estimate, WANTED)
    content = estimate.details["minimal"]
    assert content["equation"] == "(6)"
    assert content["natural_frequency_hz"]["free"][0]["value"] == pytest.approx(29.37, abs=0.1)
    assert content["constraint"] is None
    assert content["droppable"] == []


@pytest.mark.slow
def test_the_motor_alone(log):
    """What is regrouped is named; the load's viscous friction, which the paper moves, violates (13)."""
    estimate = fitted(log, "motor")
    # 3 sigma, and the bias of a noisy force in the regressor, which 1.8 N leaves below them.
    check(estimate, {k: v for k, v in WANTED.items() if "coulomb" not in k})
    untold = [n for n, ok in zip(estimate.names, estimate.identifiable, strict=True) if not ok]
    assert untold == ["coulomb_friction[1].level", "coulomb_friction[2].level"]
    assert [set(c) for c in estimate.precision.unidentifiable] == [set(untold)]
    content = estimate.details["minimal"]
    assert len(content["coefficients"]) == 7
    friction = content["coefficients"]["Fc"]
    assert friction["value"] == pytest.approx(20.4, abs=3 * friction["std"])
    constraint = content["constraint"]
    assert constraint["degrees_of_freedom"] == 1
    assert "viscous_friction[2].coefficient" in constraint["regrouped"]
    assert constraint["p_value"] < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [25.0, 100.0])
def test_the_motor_alone_at_the_published_noise_gives_no_values(tmp_path, capsys, seconds):
    """The fit fell back to one body, of 106.7 +- 0.3 kg: the sum of motor, true 72.3 kg, and load."""
    log = flexible.write(flexible.flexible_log(duration=seconds, force_noise=0.8), tmp_path)
    (tmp_path / "case.toml").write_text(flexible.case("motor"))
    arguments = ["identify", str(tmp_path / "case.toml"), str(log), "--method", "minimal_model"]
    assert main([*arguments, "-o", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr().out
    assert printed.startswith(
        "The fit did not converge: noise of the force, which is in the differentiated columns"
    )

    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert not content["converged"]
    assert all(p["value"] is None and p["std"] is None for p in content["parameters"].values())


@pytest.mark.slow
def test_the_load_turns_round_unseen(tmp_path):
    """Where it does its friction has another sign than the motor's: left in, 0.10 N at a sample."""
    made = flexible.flexible_log(duration=12.0, force_noise=0.0, resolution=0.0)
    estimate = fitted(flexible.write(made, tmp_path), "motor")
    assert np.nanmax(np.abs(estimate.residual)) < 0.05
    # What twelve digits in the file leave.
    for name in ("motor_inertia", "load_inertia", "stiffness"):
        assert estimate.value(name) == pytest.approx(T[name], rel=1e-4)
    assert estimate.value("viscous_friction[2].coefficient") == pytest.approx(110, rel=1e-3)


@pytest.mark.slow
def test_the_loads_acceleration(log):
    """Corrected it finds the inertias; as printed its third row lacks the load's friction."""
    estimate = fitted(log, "acceleration")
    check(estimate, {k: v for k, v in WANTED.items() if "coulomb" not in k})
    both = "coulomb_friction[1].level + coulomb_friction[2].level"
    own = estimate.details["minimal"]["coefficients"]
    assert own[both]["value"] == pytest.approx(20.4, abs=3 * own[both]["std"])
    printed = fitted(log, "acceleration", "minimal_model_printed", weight=1e-3)
    biased = printed.details["minimal"]["coefficients"]
    # As in Table 3: 170 for 92, and 22.8 for 20.4, of which either takes what the other leaves.
    assert biased["viscous_friction[1].coefficient"]["value"] > 1.5 * 92
    assert biased[both]["value"] > own[both]["value"]
    assert biased["stiffness"]["value"] == pytest.approx(8e5, rel=0.02)


def test_why_a_log_is_filtered_so(log):
    path = log.parent / "why.toml"
    sensor = "[sensor]\nposition_noise = 3e-8"
    path.write_text(flexible.case("motor", extra=sensor, far=1.0))
    spectrum, recipe, notes = filtering_of(open_session(path, log))
    assert spectrum.natural == pytest.approx([29.37], abs=0.01)
    assert "29.4 Hz" in notes[0]
    # Of the encoder by (13), at guesses whose friction is 100 N s/m on both sides, and the force's own.
    f = spectrum.frequency
    s, c = 2j * np.pi * f, 126.0
    motor, load = 72.3 * s**2 + (100 + c) * s + 8e5, 34.8 * s**2 + (100 + c) * s + 8e5
    amplified = np.abs((motor * load - (c * s + 8e5) ** 2) / load) ** 2 * 2 * 3e-8**2 / 1000
    own = spectrum.noise - amplified
    assert np.ptp(own) < 1e-6 * own.max()
    # White noise of NOISE on the command; a tenth of it is what the loop makes of the encoder's.
    assert own[0] == pytest.approx(2 * (NOISE * flexible.GAIN) ** 2 / 1000, rel=0.1)
    assert 29.4 < spectrum.limit_hz < 80
    figure = plot_filtering(spectrum, recipe, 1000.0)
    assert "natural frequency" in [t.get_text() for t in figure.axes[0].get_legend().get_texts()]


def test_the_published_filter_folds_and_says_so(log):
    estimate = fitted(log, "positions", extra=PUBLISHED)
    assert any("folds frequencies above 41.7 Hz" in n for n in estimate.notes)
    assert estimate.details["minimal"]["preprocess"]["order"] == 4
    own = fitted(log, "positions", extra=PUBLISHED.replace("12", "6"))
    assert not any("folds" in n for n in own.notes)


def test_the_constraint_holds_where_the_load_has_no_friction(tmp_path):
    """Without friction of the load (13) is exact as published, and its constraint holds."""
    quiet = {"viscous_friction[2].coefficient": 0.0, "coulomb_friction[2].level": 0.0}
    made = flexible.flexible_log(duration=15.0, force_noise=NOISE, **quiet)
    estimate = fitted(flexible.write(made, tmp_path), "motor")
    assert estimate.details["minimal"]["constraint"]["p_value"] > 1e-3


def test_the_command_line(log, tmp_path, capsys):
    path = tmp_path / "case.toml"
    path.write_text(flexible.case("positions"))
    argv = ["identify", str(path), str(log), "--method", "minimal_model", "-o", str(tmp_path / "out")]
    assert main(argv) == 0
    shown = capsys.readouterr().out
    assert "natural frequency, free: 29.3" in shown
    assert "the band ends at" in shown
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["minimal"]["coefficients"]["load_inertia"]["std_white"] > 0
    assert np.isfinite(result["minimal"]["condition"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert "The minimal model" in page
    assert "natural frequency, motor locked" in page
