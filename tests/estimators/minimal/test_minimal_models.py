"""Minimal models: their algebra against the paper's formulas, and what is refused."""

from pathlib import Path

import jax
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.estimators import METHODS
from jaxid.estimators.minimal.basis import basis_of, chi_of
from jaxid.estimators.minimal.columns import decimator_of, reach_of
from jaxid.estimators.minimal.matrices import linear_balance
from jaxid.estimators.minimal.models import form_of, structure_of
from jaxid.estimators.minimal.polynomials import adjugate, determinant, product, scaled
from jaxid.logs.prepare import Recipe
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import run_alone
from jaxid.session import open_session
from truth.chain import flexible_log as flexible

T = flexible.TRUTH
J1, J2, K, D = (T[n] for n in ("motor_inertia", "load_inertia", "stiffness", "damping"))
C1, C2 = (T[f"viscous_friction[{k}].coefficient"] for k in (1, 2))
F1, F2 = (T[f"coulomb_friction[{k}].level"] for k in (1, 2))


def machine_of(tmp_path: Path, **options: str):
    """The axis of `flexible_log` at the truth, all unknown, guesses elsewhere."""
    path = tmp_path / "case.toml"
    path.write_text(flexible.case("motor", **options))
    return build_machine(load_case(path), period=1e-3)


def chi_at_truth(machine, hidden: bool, accelerated: bool = False, printed: bool = False):
    """Chi at the truth by name; and chi as a function of the unknowns, with the truth."""
    theta = np.array([T.get(n, 0.0) for n in machine.parameters.names])
    parameters = machine.parameters.with_guess(theta)
    form = form_of(2, (True, not hidden), accelerated, printed)
    structure, samples = structure_of(machine.plant, parameters, form)
    basis = basis_of(structure, samples, parameters, machine.units)
    of = lambda theta: chi_of(
        parameters.insert(machine.plant, theta), structure, basis.gather, basis.constant
    )
    chi = basis.gather @ (samples.of(structure.unknown, structure.leading)[0][-1] - basis.constant)
    return dict(zip(basis.names, chi, strict=True)), of, theta


def test_a_matrix_times_its_adjugate_is_its_determinant():
    a = np.random.default_rng(0).standard_normal((3, 3, 3))
    left, right = jax.jit(lambda a: (product(a, adjugate(a)), scaled(determinant(a), np.eye(3)[None])))(a)
    np.testing.assert_allclose(left, right[: len(left)], atol=1e-12)


def test_matrices_are_those_of_the_paper(tmp_path):
    """(4): mass, damping and stiffness, to rounding."""
    machine = machine_of(tmp_path)
    theta = np.array([T[n] for n in machine.parameters.names])
    balance = jax.jit(linear_balance)(machine.parameters.insert(machine.plant, theta))
    expected = [
        [[K, -K], [-K, K]], [[C1 + D, -D], [-D, C2 + D]], [[J1, 0.0], [0.0, J2]],
    ]  # fmt: skip
    np.testing.assert_allclose(balance.motion, expected, rtol=1e-14, atol=1e-9)
    np.testing.assert_allclose(balance.sign, [[F1, 0.0], [0.0, F2]], rtol=1e-14)
    np.testing.assert_array_equal(balance.force, [[1.0], [0.0]])


def test_motor_alone_gives_the_coefficients_of_13(tmp_path):
    """By hand: (J1 s^2 + (C1 + d) s + K)((J2 s^2 + (C2 + d) s + K) - (d s + K)^2, over K."""
    chi, of, theta = chi_at_truth(machine_of(tmp_path), hidden=True)
    expected = {
        "b2": J2 / K,
        "b1": (D + C2) / K,
        "a4": J1 * J2 / K,
        "a3": (J1 * (D + C2) + J2 * (D + C1)) / K,
        "a2": J1 + J2 + (C1 * C2 + D * (C1 + C2)) / K,
        "a1": C1 + C2,
        "Fc": F1 + F2,
    }
    assert set(chi) == set(expected)
    for name, value in expected.items():
        assert chi[name] == pytest.approx(value, rel=1e-12), name
    value = jax.jit(of)
    np.testing.assert_allclose(value(theta), list(chi.values()), rtol=1e-12)
    # The exact slopes against differences of 1e-6, as far as those are not rounding.
    slopes = np.asarray(jax.jit(jax.jacfwd(of))(theta))
    for k, step in enumerate(1e-6 * theta):
        up, down = (np.asarray(value(theta + s * np.eye(len(theta))[k])) for s in (step, -step))
        by_difference = (up - down) / (2 * step)
        rounding = 4e-16 * np.abs(up) / step
        assert np.all(np.abs(slopes[:, k] - by_difference) < 1e-6 * np.abs(by_difference) + rounding)


def test_friction_on_the_motor_alone_gives_13_as_published(tmp_path):
    """Without friction of the load the formulas under (13), F_v12 = ZZ2 b1 / b2 among them."""
    path = tmp_path / "case.toml"
    path.write_text(flexible.case("motor", joints=(1,)))
    machine = build_machine(load_case(path), period=1e-3)
    chi = chi_at_truth(machine, hidden=True)[0]
    assert chi["a3"] == pytest.approx((C1 * J2 + D * J2 + D * J1) / K, rel=1e-12)
    assert chi["a2"] == pytest.approx(D * C1 / K + J1 + J2, rel=1e-12)
    assert chi["a4"] / chi["b2"] == pytest.approx(J1, rel=1e-12)
    assert J2 * chi["b1"] / chi["b2"] == pytest.approx(D, rel=1e-12)


def test_positions_and_accelerations_give_the_parameters_themselves(tmp_path):
    machine = machine_of(tmp_path)
    assert chi_at_truth(machine, hidden=False)[0] == pytest.approx(T, rel=1e-9)
    for printed in (False, True):
        chi = chi_at_truth(machine, True, True, printed)[0]
        assert chi.pop("coulomb_friction[1].level + coulomb_friction[2].level") == pytest.approx(F1 + F2)
        assert chi == pytest.approx({n: v for n, v in T.items() if "coulomb" not in n}, rel=1e-9)


def test_the_zero_offset_of_an_encoder_is_one_coefficient_more(tmp_path):
    path = tmp_path / "case.toml"
    text = flexible.case("positions").replace(
        "[plant.parameters]", "[plant.parameters]\nzero_offset = { guess = 0.001 }"
    )
    path.write_text(text)
    chi = chi_at_truth(build_machine(load_case(path), period=1e-3), hidden=False)[0]
    assert len(chi) == len(T) + 1
    assert chi["c, row 1"] == pytest.approx(0.0, abs=1e-9)


def test_a_stated_recipe_passes_its_band_and_folds_it():
    """60 Hz and one sample in 12 of 1 kHz, as published: 41.7 Hz is half the rate that is kept."""
    recipe = Recipe(60.0, 6, 12, 0, (1e-3,), False, "central", True)
    gain = decimator_of(recipe, 1000.0).response(np.array([50.0]), 1000.0)
    assert gain[0] > 0.9
    assert recipe.decimator.response(np.array([50.0]), 1000.0)[0] < 1e-4
    assert 20 < reach_of(recipe, 1000.0, 2) < 200


def test_derivatives_up_to_the_fourth_are_exact_in_the_band():
    t, w = np.arange(4000) * 1e-3, 2 * np.pi * 5.0
    many = signals.spectral_derivatives(np.sin(w * t)[:, None], 1e-3, 100.0, 4)
    # 3e-4: what the ends of the log leave in its middle.
    np.testing.assert_allclose(many[4][400:-400, 0], w**4 * np.sin(w * t)[400:-400], atol=3e-4 * w**4)


EFFECT = '[[effects]]\nkind = "{}"\n{}'
WRONG = {
    "stribeck": (EFFECT.format("stribeck_friction", "joint = 1\nlevel = 1.0\nvelocity = 0.01"), "not linear"),
    "drag": (EFFECT.format("quadratic_drag", "joint = 2\ncoefficient = 1.0"), r"quadratic_drag\[2\]"),
    "backlash": (EFFECT.format("backlash", "spring = 1\ngap = 1e-5"), "not linear"),
    "memory": (EFFECT.format("hysteresis", "joint = 1\nstiffness = 1e6\nlevel = 5.0"), "internal state"),
    "lag": (EFFECT.format("actuator_lag", "joint = 1\ntime_constant = 0.001"), "internal state"),
    "delay": (EFFECT.format("input_delay", "joint = 1\ndelay = { guess = 0.001 }"), "delay"),
    "gain": (EFFECT.format("actuator_gain", "joint = 1\ngain = { guess = 1.1 }"), "gain"),
}


@pytest.fixture(scope="module")
def still(tmp_path_factory) -> Path:
    """A short log, for what is refused before any fit."""
    return flexible.write(flexible.flexible_log(duration=3.0), tmp_path_factory.mktemp("log"))


@pytest.mark.parametrize("name", WRONG)
def test_what_is_not_linear_is_refused(name, still, tmp_path):
    effects, words = WRONG[name]
    path = tmp_path / "case.toml"
    path.write_text(flexible.case("positions", effects=effects))
    with pytest.raises(InputError, match=words):
        run_alone(METHODS["minimal_model"](open_session(path, still)))


def test_the_printed_model_needs_an_accelerometer(still, tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(flexible.case("motor"))
    with pytest.raises(InputError, match="load_acceleration"):
        run_alone(METHODS["minimal_model_printed"](open_session(path, still)))
