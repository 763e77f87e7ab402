"""The files of the guide on effects: their forces, a fit of each, and a search that names each."""

import math
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.case.case import load_case
from jaxid.commands.discover import discover
from jaxid.model import Effect, Signals

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "docs" / "examples"
# By file: its class, and rivals for the search.
GUIDES = {
    "magnetic_pull": ("MagneticPull", ("constant_force", "linear_stiffness", "cogging")),
    "lugre_friction": ("LuGreFriction", ("coulomb_friction", "stribeck_friction", "hysteresis")),
    "drive_ripple": ("DriveRipple", ("actuator_gain", "cogging", "saturation")),
}
each_guide = pytest.mark.parametrize("name", GUIDES)


def case_of(name: str) -> Path:
    return EXAMPLES / f"{name}.toml"


def made(name: str, **values: float) -> Effect:
    cls = load_case(case_of(name)).effects[-1].cls
    assert cls.__name__ == GUIDES[name][0]
    return cls(**values)


def signals(q: float, v: float, u: float) -> Signals:
    one = jnp.asarray
    rest = {n: one(0.0) for n in ("ydd", "t", "gravity", "normal", "stiffness", "damping")}
    return Signals(y=one(q), yd=one(v), u=one(u), width=one(1e-6), dry_scale=one(1.0), **rest)


MOTIONS = [(0.01, 0.2, 30.0), (0.1, -0.05, -80.0), (-0.02, 0.003, 5.0), (0.2, -0.4, 0.0)]


@pytest.mark.parametrize(("q", "v", "u"), MOTIONS)
def test_magnetic_pull_is_its_formula(q, v, u):
    action = made("magnetic_pull", strength=30.0, reach=0.02).act(signals(q, v, u), None)
    assert float(action.force) == pytest.approx(-30.0 * math.exp(-q / 0.02), rel=1e-14)


@pytest.mark.parametrize("z", [-1.2e-3, 0.0, 0.7e-3])
@pytest.mark.parametrize(("q", "v", "u"), MOTIONS)
def test_lugre_is_its_formula(q, v, u, z):
    s0, s1, coulomb, static, velocity = 2e4, 100.0, 20.0, 30.0, 0.03
    effect = made(
        "lugre_friction", stiffness=s0, damping=s1, coulomb=coulomb, static=static, velocity=velocity
    )
    action = effect.act(signals(q, v, u), jnp.asarray(s0 * z / coulomb))
    level = coulomb + (static - coulomb) * math.exp(-((v / velocity) ** 2))
    slope = v - s0 * abs(v) * z / level
    assert float(action.force) == pytest.approx(-(s0 * z + s1 * slope), rel=1e-12, abs=1e-12)
    assert float(action.rate) == pytest.approx(s0 * slope / coulomb, rel=1e-12, abs=1e-12)


def test_lugre_at_a_steady_velocity_is_the_stribeck_curve():
    effect = made("lugre_friction", stiffness=2e4, damping=100.0, coulomb=20.0, static=30.0, velocity=0.03)
    for v in (0.002, 0.03, 0.2):
        level = 20.0 + 10.0 * math.exp(-((v / 0.03) ** 2))
        action = effect.act(signals(0.0, v, 0.0), jnp.asarray(level / 20.0))
        assert float(action.rate) == pytest.approx(0.0, abs=1e-9)
        assert float(action.force) == pytest.approx(-level, rel=1e-12)


@pytest.mark.parametrize(("q", "v", "u"), MOTIONS)
def test_drive_ripple_is_its_formula(q, v, u):
    action = made("drive_ripple", depth=0.1, period=0.02, phase=0.7).act(signals(q, v, u), None)
    expected = u * (1 + 0.1 * math.cos(2 * math.pi * q / 0.02 + 0.7))
    assert float(action.drive) == pytest.approx(expected, rel=1e-14)
    assert float(jnp.asarray(action.force)) == 0.0


@each_guide
def test_it_is_identified_from_guesses_that_are_off(name):
    log = jaxid.simulate(case_of(name)).log
    # The memory of LuGre friction along a measured motion takes one pass; in a loop a fit takes many.
    found = jaxid.identify(case_of(name), log, method="inverse_dynamics")
    free = found.session.machine.parameters.free
    true, guess = (np.array([getattr(f, n) for f in free]) for n in ("true", "guess"))
    assert found.converged
    assert np.all(guess != true)
    assert np.all(np.abs(found.estimate.theta - true) < 3 * found.estimate.std)


def without_effect(name: str) -> tuple[str, str]:
    """The case of a guide without its effect, and the effect's kind."""
    text = case_of(name).read_text(encoding="utf-8")
    kind = f"{name}.py:{GUIDES[name][0]}"
    tables = re.split(r"(?=^\[)", text, flags=re.MULTILINE)
    kept = [t for t in tables if f'kind = "{kind}"' not in t]
    assert len(kept) == len(tables) - 1
    return "".join(kept), kind


# The search for a memory, and for a ripple among a hundred starts, take longer.
SEARCHES = {"magnetic_pull": 3.0, "lugre_friction": 3.0, "drive_ripple": 6.0}
marked = [
    pytest.param(n, s, marks=() if n == "magnetic_pull" else pytest.mark.slow) for n, s in SEARCHES.items()
]


@pytest.mark.parametrize(("name", "seconds"), marked)
def test_a_search_names_it_among_its_candidates(name, seconds, tmp_path):
    text, kind = without_effect(name)
    (tmp_path / f"{name}.py").write_bytes((EXAMPLES / f"{name}.py").read_bytes())
    short = case_of(name).read_text(encoding="utf-8").replace("duration = 6.0", f"duration = {seconds}")
    (tmp_path / "true.toml").write_text(short)
    path = tmp_path / "case.toml"
    path.write_text(f'{text}\n[discover]\ncandidates = ["{kind}"]\nkinds = {[*GUIDES[name][1]]}\n')
    log = jaxid.simulate(tmp_path / "true.toml").log
    found = discover(path, log, refit=False, experiments=False)
    assert (found.verdict, found.kinds) == ("found", [kind])


def blocks(guide: str, language: str) -> list[str]:
    text = (ROOT / "docs" / guide).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("guide", ["adding_an_effect.md", "adding_an_estimator.md", "adding_a_format.md"])
def test_the_code_of_a_guide_stands_in_its_files(guide):
    """A block that begins with a comment `# file` is a part of that file; others are shown only."""
    shown = 0
    for language in ("python", "toml"):
        for block in blocks(guide, language):
            first, _, rest = block.partition("\n")
            if match := re.fullmatch(r"# (\S+\.(?:py|toml))", first):
                assert rest.strip() in (EXAMPLES / match[1]).read_text(encoding="utf-8"), match[1]
                shown += 1
    assert shown >= 1
