"""The page on the physics alone runs, and what it computes is right."""

import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.simulation.loops import Drive, closed_loop, open_loop

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "jax.md"


@pytest.fixture(scope="module")
def page():
    """What is defined when the page's code has run from top to bottom."""
    there: dict = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S):
        exec(compile(block, str(PAGE), "exec"), there)
    return there


def test_diffrax_solves_what_jaxid_simulates(page):
    ours, theirs = page["run"].position, page["trajectory"]
    assert np.ptp(ours) > 0.1
    np.testing.assert_allclose(theirs, ours, atol=1e-5 * np.ptp(ours))


def test_gradient_and_hessian_are_those_of_differences(page):
    """Of fixed steps: an adaptive solver chooses others beside, and its values jump by 1e-6."""
    zero, drive = jnp.zeros(1), Drive(jnp.ones(1), 0.01, "linear", substeps=8)

    def last(theta):
        plant = eqx.tree_at(page["leaves"], page["plant"], tuple(theta))
        return open_loop(plant, drive, page["command"][:, None], zero, zero).position[-1, 0]

    value, slope = jax.jit(last), jax.jit(jax.jacfwd(last))
    for k in range(3):
        step = jnp.zeros(3).at[k].set(1e-4)
        there, here = page["theta"] + step, page["theta"] - step
        first = (float(value(there)) - float(value(here))) / 2e-4
        assert float(page["gradient"][k]) == pytest.approx(first, rel=1e-4)
        second = (slope(there) - slope(here)) / 2e-4
        np.testing.assert_allclose(page["curvature"][k], second, atol=1e-3 * np.abs(second).max())


def test_many_machines_are_each_alone(page):
    alone = [float(page["last"](theta)) for theta in page["many"][:2]]
    np.testing.assert_allclose(page["lasts"][:2], alone, rtol=1e-6)


def test_the_fit_finds_the_truth_and_says_how_well(page):
    result = page["result"]
    assert bool(result.converged)
    assert np.all(np.abs(result.theta - page["theta"]) < 4 * result.std)
    assert np.sqrt(np.mean(result.residual**2)) == pytest.approx(1e-4, rel=0.1)
    assert float(result.plant.inertia) == float(result.theta[0])
    assert page["names"] == page["free"]


def test_a_batch_of_fits_is_a_loop_of_fits(page):
    batch = page["batch"]
    assert batch.theta.shape == (8, 3)
    assert bool(batch.converged.all())
    for k, data in enumerate(page["noisy"][:3]):
        alone = page["fitted"](data)
        np.testing.assert_allclose(batch.theta[k], alone.theta, rtol=1e-9)
        np.testing.assert_allclose(batch.std[k], alone.std, rtol=1e-6)
    # Eight draws: a spread is known to a quarter.
    ratio = np.std(batch.theta, axis=0, ddof=1) / np.mean(batch.std, axis=0)
    assert np.all((ratio > 0.4) & (ratio < 2.0))


def test_starts_end_at_one_estimate(page):
    starts = page["from_starts"]
    assert bool(starts.converged.all())
    assert np.ptp(starts.theta, axis=0) == pytest.approx(
        np.zeros(3), abs=1e-2 * float(page["result"].std.min())
    )


def test_estimates_follow_the_data_as_differences_say(page):
    step = 1e-6 * jax.random.normal(jax.random.key(5), page["measured"].shape)
    there, here = (page["fitted"](page["measured"] + s * step).theta for s in (1, -1))
    slope = jnp.sum(page["sensitivity"] * step, axis=(1, 2))
    np.testing.assert_allclose(slope, (there - here) / 2, rtol=1e-3)


def test_the_solver_keeps_to_bounds_under_optimistix(page):
    np.testing.assert_allclose(page["solution"].value, [0.5, 0.25], atol=1e-6)


def test_a_plant_of_a_case_is_the_same_plant(page, tmp_path):
    (tmp_path / "case.toml").write_text(
        '[plant]\nkind = "axis"\n[plant.parameters]\ninertia = { guess = 2.0, true = 2.5 }\n'
        '[[effects]]\nkind = "viscous_friction"\ncoefficient = 3.0\n'
        '[[effects]]\nkind = "coulomb_friction"\nlevel = 1.5\n'
        '[log]\ntime = "t"\nposition = "q"\nforce = "u"\n'
    )
    plant = jaxid.make_plant(tmp_path / "case.toml")
    assert jaxid.parameter_names(plant) == page["names"]
    x = jaxid.initial_state(plant, jnp.zeros(1), jnp.ones(1))
    rate = jaxid.vector_field(jnp.asarray(0.0), x, (plant, lambda t: jnp.ones(1)))
    np.testing.assert_allclose(rate.qd, [(1.0 - 3.0 - 1.5) / 2.0], rtol=1e-6)
    assert float(jaxid.make_plant(tmp_path / "case.toml", at_truth=True).inertia) == 2.5


def test_a_loop_is_fitted_too_and_lists_have_entries(page):
    """With the initial state given, in a loop with a controller; one entry of two."""
    from jaxid.controllers.linear import CascadePD

    plant, t = page["plant"], 0.01 * jnp.arange(150)
    law = CascadePD(jnp.asarray([8.0]), jnp.asarray([10.0]), period=0.01)
    reference = 0.3 * jnp.sin(5.0 * t)[:, None]
    drive = Drive(jnp.asarray([3.0]), 0.01, set_valued=True)
    zero = jnp.zeros(1)
    run = closed_loop(plant, drive, law, reference, jnp.zeros((150, 1)), zero, zero)
    result = jax.jit(
        lambda q: jaxid.fit(
            plant,
            lambda p: p.inertia,
            0.01,
            q,
            controller=law,
            reference=reference,
            gain=3.0,
            initial=(zero, zero),
            start=jnp.asarray([3.0]),
        )
    )(run.position)
    assert bool(result.converged)
    np.testing.assert_allclose(result.theta, [2.0], rtol=1e-6)
    chain = jaxid.PLANTS["chain"]([1.0, 2.0], [0.1, 0.1], [1.0, 2.0, 3.0])
    assert jaxid.parameter_names(chain)[:2] == ("mass[1]", "mass[2]")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"free": ("inertias",)}, "parameter 'inertias' is not known"),
        ({"free": lambda p: p.smoothing.sharpness}, "no parameter"),
        ({"free": ()}, "free names no parameter"),
        ({"time": np.arange(5.0)}, "time has 5 samples and position 301"),
        ({"time": np.sqrt(np.arange(301.0))}, "equal steps"),
        ({"start": jnp.ones(2)}, "start has shape"),
        ({"force": None}, "force is missing"),
        ({"hold": "cubic"}, "hold 'cubic' is not known"),
        ({"minimiser": "newton"}, "minimiser 'newton' is not known"),
        ({"solver": "euler"}, "solver 'euler' is not known"),
    ],
)
def test_what_cannot_be_fitted_is_one_line(page, change, told):
    given = {"free": page["free"], "time": 0.01, "position": page["measured"], "force": page["command"]}
    with pytest.raises(jaxid.InputError, match=re.escape(told)):
        jaxid.fit(page["plant"], **(given | change))


def test_a_traced_time_is_refused(page):
    with pytest.raises(jaxid.InputError, match="time is traced"):
        jax.jit(lambda t: jaxid.fit(page["plant"], page["free"], t, page["measured"], page["command"]))(0.01)
