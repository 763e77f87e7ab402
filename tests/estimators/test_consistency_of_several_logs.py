"""Links of real bodies from several logs: coordinates, what a log has for itself, fits of other physics."""

import tomllib
from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.estimators.common.consistency import need_bodies
from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.estimators.several.parts import Scale
from jaxid.model.unknowns import Body, Free, Parameters
from jaxid.names import TEN
from jaxid.own_values import expanded, own_values
from tests.support.wrist import (
    TRUE,
    case,
    eigenvalues,
    eigenvalues_of,
    left,
    motion,
    one_link,
    swing,
    wrist_log,
)

# Such noise of the torque asks for a negative moment of inertia, although there are two logs.
NOISE, OF_NOISE = 3.0, (15, 25)


def wrist(consistent: bool = True) -> dict:
    """Return the case of the wrist, whose torque is exact at each sample and smooth between them."""
    stated = tomllib.loads(case(consistent))
    stated["log"]["hold"] = "band_limited"
    return stated


def names_of(link: int) -> list[str]:
    """Return the names of a link's ten parameters; links count from one."""
    return [f"{name}[{link}]" for name in TEN]


def test_derivatives_by_the_solvers_values_are_those_of_finite_differences():
    rng = np.random.default_rng(0)
    log, wide = np.array([True, *[False] * 11]), np.full((1, 10), 9.0)
    transform = Transform(log, -wide, wide, (tuple(range(1, 11)),))
    free = np.full(12, np.inf)
    scale = Scale(transform, -free, free, more=1)
    theta = np.concatenate([[2.0], TRUE[0], [0.7]])
    matrix = rng.normal(size=(4, 13))
    e = lambda x: matrix @ np.concatenate([*scale.outward(x)])
    x = scale.inward(theta, np.array([0.1]))
    expected = np.stack([(e(x + d) - e(x - d)) / 2e-6 for d in 1e-6 * np.eye(13)], axis=-1)
    np.testing.assert_allclose(scale.inner(matrix, theta), expected, rtol=1e-5, atol=1e-7)
    back = transform.physical(scale.inner(matrix, theta)[:, :12], jnp.asarray(theta))
    np.testing.assert_allclose(back, matrix[:, :12], rtol=1e-8, atol=1e-10)


def test_bodies_follow_the_unknowns_that_a_log_has():
    free = tuple(Free(str(k), ("mass",), "kg", "free", float(k)) for k in range(25))
    bodies = tuple(Body(tuple(range(k, k + 10)), (0.0,) * 10, (1.0,) * 10) for k in (2, 14))
    some = Parameters(free, bodies).chosen([k for k in range(25) if k not in (0, 3)])
    assert [f.name for f in some.free] == [str(k) for k in range(25) if k not in (0, 3)]
    # The first body lacks a parameter; the other one is the same body at other places.
    [body] = some.bodies
    assert [some.free[k].name for k in body.places] == [str(k) for k in range(14, 24)]
    assert np.flatnonzero(some.in_bodies).tolist() == list(body.places)


def two_logs(per_log=(), known=None):
    """Return a session's case, machine and two logs of which one may know values, without their samples."""
    where = load_case(wrist())
    machine = build_machine(where, period=0.01)
    own = [
        own_values(where, machine, "1", {}, 0.01, "1"),
        own_values(where, machine, "2", known or {}, 0.01, "2"),
    ]
    machine = expanded(where, machine, per_log, {each.log: each.plant for each in own})
    runs = [SimpleNamespace(name=each.log, own=each) for each in own]
    with_machine = lambda m: SimpleNamespace(machine=m, fits=runs)
    return SimpleNamespace(machine=machine, case=where, fits=runs, with_machine=with_machine)


def test_a_link_that_differs_between_logs_is_a_body_in_each():
    session = need_bodies(two_logs(per_log=names_of(3)))
    unknown = session.machine.parameters
    inside = [[unknown.free[k].name for k in body.places] for body in unknown.bodies]
    mine = [[f"{name} @ {log}" for name in names_of(3)] for log in ("1", "2")]
    assert inside == [names_of(1), names_of(2), *mine]
    for run, own in zip(session.fits, mine, strict=True):
        there = run.own.machine(session.machine).parameters
        assert [[there.free[k].name for k in body.places] for body in there.bodies] == [*inside[:2], own]


def test_a_link_that_one_log_knows_is_a_body_in_the_other():
    ball = dict(zip(names_of(3), [1.0, 0.1, 0.05, 0.1, 0.03, -0.005, -0.01, 0.03, -0.005, 0.03], strict=True))
    session = need_bodies(two_logs(known=ball))
    assert len(session.machine.parameters.bodies) == 3
    first, second = (run.own.machine(session.machine).parameters for run in session.fits)
    assert len(first.bodies) == 3
    assert [[second.free[k].name for k in body.places] for body in second.bodies] == [
        names_of(1),
        names_of(2),
    ]


@pytest.mark.parametrize(
    "differs", [{"per_log": ["mass[3]"]}, {"known": {"mass[3]": 0.2}}], ids=["unknown", "known"]
)
def test_a_part_of_a_body_that_differs_between_logs_is_refused(differs):
    with pytest.raises(InputError, match="link 3.*some of the link's ten parameters for itself"):
        need_bodies(two_logs(**differs))


@pytest.fixture(scope="module")
def logs():
    return [wrist_log(seed, NOISE, of) for seed, of in zip((0, 3), OF_NOISE, strict=True)]


@pytest.mark.slow
def test_noise_of_two_logs_makes_plain_least_squares_impossible_and_not_the_other(logs):
    plain, kept = (
        jaxid.identify(wrist(consistent), logs, method="inverse_dynamics") for consistent in (False, True)
    )
    at = plain.estimate.names.index("inertia_zz[3]")
    assert plain.estimate.identifiable[at]
    assert plain.estimate.theta[at] < -0.001
    assert kept.estimate.converged
    assert eigenvalues(kept).min() > 0
    assert kept.value("inertia_zz[3]") > 0
    assert left(kept) < 1.01
    assert left(kept) < left(plain)
    assert len(kept.estimate.details["links"]) == 3
    assert [entry["noise"] > 0 for entry in kept.estimate.details["fits"].values()] == [True, True]


@pytest.mark.slow
def test_power_keeps_links_of_several_logs_too(logs):
    kept = jaxid.identify(wrist(), logs, method="power")
    assert kept.estimate.converged
    assert eigenvalues(kept).min() > 0
    assert left(kept) < 1.02


@pytest.mark.slow
def test_a_recursion_through_several_logs_ends_at_real_bodies(logs):
    kept = jaxid.identify(wrist(), logs, method="recursive")
    assert eigenvalues(kept).min() > 0
    assert left(kept) < 1.02


@pytest.mark.slow
def test_a_payload_in_one_log_is_a_body_too():
    """A ball of 2 kg, 4 cm off the last joint; the last link has all ten parameters in each log."""
    r = np.array([0.04, 0.0, 0.02])
    inertia = 2.0 * (r @ r * np.eye(3) - np.outer(r, r)) + 1e-4 * np.eye(3)
    ball = np.array([2.0, *(2.0 * r), *inertia[np.triu_indices(3)]])
    loaded = TRUE + ball * (np.arange(3) == 2)[:, None]
    logs = [wrist_log(0, 1.0, 1), wrist_log(3, 1.0, 2, loaded)]
    stated = wrist()
    stated["identification"]["per_log"] = names_of(3)
    found = jaxid.identify(stated, logs, method="inverse_dynamics")
    assert found.estimate.converged
    assert "links" not in found.estimate.details
    entries = found.estimate.details["fits"]
    for run, bodies in zip(found.session.fits, (TRUE, loaded), strict=True):
        plant = run.machine(found.estimate.machine).plant
        assert eigenvalues_of(plant).min() > 0
        assert entries[run.name]["links"][2]["eigenvalue_ratio"] > 0
        for name, value in zip(TEN, bodies[2], strict=True):
            at = found.estimate.names.index(f"{name}[3] @ {run.name}")
            if found.estimate.identifiable[at]:
                assert abs(found.estimate.theta[at] - value) < 4 * found.estimate.std[at], name
    parts = [found.parameters[f"first_moment_x[3] @ {run.name}"] for run in found.session.fits]
    assert abs(parts[1].value - parts[0].value - 0.08) < 4 * np.hypot(parts[0].std, parts[1].std) < 0.08


@pytest.mark.slow
def test_a_search_of_several_logs_ends_at_real_bodies(logs):
    """A friction of the second joint is hidden in both logs."""
    rubbing = np.array([0.0, 5.0, 0.0])
    rubbed = [
        replace(log, force=log.force + rubbing * motion(seed)[2])
        for log, seed in zip(logs, (0, 3), strict=True)
    ]
    # The torque is exact at each sample and held by no drive: with two logs more effects pass as its lag.
    found = jaxid.discover(wrist(), rubbed, max_effects=1)
    assert [e.label for e in found.effects] == ["viscous_friction[2]"]
    p = found.parameters["viscous_friction[2].coefficient"]
    assert abs(p.value - 5.0) < 4 * p.std < 2.0
    for estimate in (found.before, found.after):
        assert eigenvalues_of(estimate.machine.plant).min() > 0
        assert len(estimate.details["links"]) == 3


@pytest.mark.slow
def test_output_error_keeps_links_of_several_logs_too():
    found = jaxid.identify(tomllib.loads(one_link()), [swing(0), swing(2)])
    assert found.estimate.method == "output_error"
    assert found.estimate.converged
    assert eigenvalues(found).min() > 0
    for name, value in (("first_moment_x", 1), ("first_moment_y", 2), ("inertia_zz", 9)):
        at = found.estimate.names.index(f"{name}[1]")
        assert abs(found.estimate.theta[at] - TRUE[0][value]) < 4 * found.estimate.std[at], name
        assert found.estimate.std[at] < 0.01 * np.abs(TRUE[0][9])
