"""A loop whose reference nobody logged: its onset, speed and ramp are fitted with the machine."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxid
from jaxid.cli import main
from jaxid.logs.log import Log
from jaxid.references import make_reference
from jaxid.references.unknown import UnknownReference
from truth.axis.stepper import Loop, Machine, Sensor, simulate
from truth.chain import stages

TRUE = {"onset": 0.31, "speed": 0.42, "acceleration": 3.1}
GUESS = {"onset": 0.22, "speed": 0.6, "acceleration": 5.0}
TARGETS = [0.25, 0.03]
AXIS = """
[plant]
kind = "axis"
[plant.parameters]
inertia = { guess = 40.0 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 40.0 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 60.0 }
[log]
time = "t"
position = "q"
force = "u"
[controller]
kind = "cascade_pd"
kp = 60.0
kv = 3000.0
period = 0.001
"""


def table(values: dict[str, float] = GUESS, more: str = "repeat = false\n") -> str:
    lines = [f"{k} = {{ guess = {v}, true = {TRUE[k]} }}\n" for k, v in values.items()]
    return f'[reference]\nkind = "trapezoid"\ntargets = {TARGETS}\ndwell = 0.2\n{"".join(lines)}{more}'


def moved() -> np.ndarray:
    """The reference by its velocity, summed: nothing of jaxid's."""
    fine, dt = np.zeros(250_000), 1e-5
    start = TRUE["onset"]
    here = 0.0
    for target in TARGETS:
        way, ramp = target - here, TRUE["speed"] / TRUE["acceleration"]
        cruise = abs(way) / TRUE["speed"] - ramp
        t = dt * (np.arange(fine.size) + 0.5) - start
        part = np.interp(t, [0, ramp, ramp + cruise, 2 * ramp + cruise], [0.0, 1.0, 1.0, 0.0])
        fine += np.sign(way) * TRUE["speed"] * part
        start, here = start + 2 * ramp + cruise + 0.2, target
    return np.concatenate([[0.0], np.cumsum(fine) * dt])[::100][:2500]


@pytest.fixture(scope="module")
def log() -> Log:
    """An axis that followed it, by exact friction."""
    machine = Machine(95.0, {"viscous_friction": {"coefficient": 203.0}, "coulomb_friction": {"level": 20.0}})
    loop = Loop("cascade_pd", reference=moved(), kp=60.0, kv=3000.0)
    # A loop that hears more noise shakes its axis, and dry friction with it: no silent simulation does.
    sensor = Sensor(force_noise=3.0, position_noise=1e-7)
    made = simulate(machine, loop, sensor, rate=1000.0, duration=2.5)
    columns = {k: made[k][:, None] for k in ("position", "force")}
    return Log(time=made["t"], **columns, source="axis")


@pytest.fixture
def case(tmp_path):
    def write(text: str):
        (tmp_path / "case.toml").write_text(text)
        return tmp_path / "case.toml"

    return write


def test_a_course_is_what_its_family_samples_and_has_slopes():
    time = np.arange(2500) / 1000
    stated = {"kind": "trapezoid", "targets": TARGETS, "dwell": 0.2, "repeat": False}
    unknown_reference = UnknownReference.of(stated, TRUE).at(time)
    np.testing.assert_allclose(unknown_reference()[:, 0], moved(), atol=1e-8)
    np.testing.assert_allclose(unknown_reference(), make_reference(stated | TRUE, 1000, 2.5), atol=1e-12)
    slopes = jax.jacfwd(lambda x: replace(unknown_reference, numbers=x)()[:, 0])(unknown_reference.numbers)
    for k in range(3):
        h = 1e-6
        up, down = (
            replace(unknown_reference, numbers=unknown_reference.numbers.at[k].add(s * h))()[:, 0]
            for s in (1, -1)
        )
        np.testing.assert_allclose(slopes[:, k], (up - down) / (2 * h), atol=1e-5)
        assert np.abs(slopes[:, k]).max() > 0.01


def test_machine_and_reference_are_found_together(case, log):
    found = jaxid.identify(case(AXIS + table()), log)
    assert found.converged
    truth = {"inertia": 95.0, "viscous_friction.coefficient": 203.0, "coulomb_friction.level": 20.0}
    truth |= {f"reference.{k}": v for k, v in TRUE.items()}
    for name, std in zip(found.estimate.names, found.estimate.std, strict=True):
        assert found.value(name) == pytest.approx(truth[name], rel=1e-3), name
        assert 0 < std < 1e-3 * truth[name], name
    # What is shown beside the log follows the reference found, not the guess.
    assert found.gaps[0].simulation.relative[0] < 1e-3


def test_another_log_is_simulated_with_the_reference_that_it_has(case, log):
    """Its motion is another one, and what the fitted log followed is nothing to it."""
    reference = 0.1 * (1 - np.cos(2 * np.pi * 1.5 * np.arange(2000) / 1000))
    machine = Machine(95.0, {"viscous_friction": {"coefficient": 203.0}, "coulomb_friction": {"level": 20.0}})
    loop = Loop("cascade_pd", reference=reference, kp=60.0, kv=3000.0)
    made = simulate(machine, loop, Sensor(position_noise=1e-7), rate=1000.0, duration=2.0)
    columns = {k: made[k][:, None] for k in ("position", "force")}
    other = Log(time=made["t"], **columns, reference=reference[:, None], source="other")
    found = jaxid.identify(case(AXIS + table()), log, validate=[other])
    assert found.gaps[1].simulation.relative[0] < 1e-3


@pytest.mark.slow
def test_a_hundred_samples_of_a_stage_tell_its_reference_too(case):
    move = stages.MOVES[1]
    true = {"onset": move["onset"], "speed": move["speed"] / stages.R}
    true["acceleration"] = true["speed"] / stages.RAMP
    off = {"onset": 1.4, "speed": 0.8, "acceleration": 1.3}
    way = move["distance"] / stages.R
    reference = f'[reference]\nkind = "trapezoid"\ntargets = [{way!r}]\nrepeat = false\n'
    reference += "".join(f"{k} = {{ guess = {v * off[k]!r} }}\n" for k, v in true.items())
    stated = '[output_error]\non = "force"\nprior = 0.5\n'
    path = case(stages.text(1, guess=stages.drawn(3), resolution=0.0, reference="", more=stated + reference))
    stage = stages.machine(1, rigid=True)
    made = stages.record(stage, stages.move(0.5, **move), noise=0.0135, resolution=0.0)
    log = Log(time=made["t"], position=made["q"][:, None], force=made["i"][:, None], source="stage")
    estimate = jaxid.identify(path, log).estimate
    assert estimate.converged
    told = dict(zip(estimate.names, estimate.identifiable, strict=True))
    assert told["reference.speed"]
    assert told["reference.onset"]
    for name, std in zip(estimate.names, estimate.std, strict=True):
        if name.startswith("reference"):
            value = true[name.partition(".")[2]]
            # Of what is not identifiable nothing is printed; of the rest, more than the guess knows.
            assert np.isfinite(std) == told[name], name
            if told[name]:
                assert abs(estimate.value(name) - value) < 3 * std, name
                assert std < 0.25 * value, name


def test_a_simulation_takes_the_true_values_and_a_fit_a_stated_reference(case, log):
    scene = "[simulation]\nduration = 2.5\nsample_rate = 1000.0\n"
    made = jaxid.simulate(case(AXIS + table() + scene)).log
    np.testing.assert_allclose(made.reference[:, 0], moved(), atol=1e-8)
    stated = AXIS + table({}, "repeat = false\n" + "".join(f"{k} = {v}\n" for k, v in TRUE.items()))
    found = jaxid.identify(case(stated), log)
    assert abs(found.value("inertia") - 95.0) < 0.1


WRONG = {
    "targets": ("targets = [0.25, 0.03]", "targets = { guess = 0.2 }", "targets cannot be unknown"),
    "repeat": ("repeat = false", "repeat = true", "is unknown, and has no end"),
    "column": ('force = "u"', 'force = "u"\nreference = "r"', "names a column for it"),
    "kind": ('kind = "trapezoid"', 'kind = "bezier"', "onset cannot be unknown"),
    "sign": ("guess = 0.6", "guess = -0.6", "speed.guess"),
    "key": ("guess = 0.6", "gues = 0.6", "gues"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_unknown_is_refused(case, log, name):
    old, new, words = WRONG[name]
    with pytest.raises(jaxid.InputError, match=words.replace("[", r"\[")):
        jaxid.identify(case((AXIS + table()).replace(old, new)), log)


def test_methods_that_do_not_simulate_the_loop_say_so(case, log, tmp_path, capsys):
    path = case(AXIS + table())
    with pytest.raises(jaxid.InputError, match="the reference has unknowns"):
        jaxid.discover(path, log)
    rows = np.column_stack([log.time, log.position, log.force])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,q,u", comments="")
    out = tmp_path / "out"
    asked = ["identify", str(path), str(tmp_path / "log.csv"), "--method", "inverse_dynamics", "-o", str(out)]
    assert main(asked) == 2
    error = capsys.readouterr().err
    assert "fit them by output_error" in error
    assert not out.exists()
