"""The flexible axis: motion, identification with and without the load's encoder, what couplings hide."""

import dataclasses
import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.cli import main
from jaxid.dynamics.hidden_joints import complete_motion
from jaxid.errors import InputError
from jaxid.estimators import METHODS, _doubts_of_output_error
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.logs.log import Log
from jaxid.numerics.lanes import run_alone
from jaxid.results.as_json import derived_json
from jaxid.session import open_session
from jaxid.simulation.replay import make_replay
from jaxid.simulation.sensor_noise import position_noise
from truth.chain import flexible_axes as axes

# Of the paper's aims for the first model: motor inertia 1 %, load inertia 2 %, stiffness 2 %, Coulomb 5 %.
WITHIN = {
    "motor_inertia": 0.01,
    "load_inertia": 0.02,
    "stiffness": 0.02,
    "coulomb_friction[1].level": 0.05,
    "coulomb_friction[2].level": 0.05,
}
# Free motor, free load, undamped [Hz].
FREQUENCY = np.sqrt(8e5 * (1 / 72.3 + 1 / 34.8)) / (2 * np.pi)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The log of Table 2's axis, and its case with the load's encoder and without."""
    folder = tmp_path_factory.mktemp("axis")
    axes.write(axes.record(), folder / "log.csv")
    for name, load in (("both", True), ("motor", False)):
        (folder / f"{name}.toml").write_text(axes.text(load=load))
    return folder


def z_scores(result) -> np.ndarray:
    truth = np.array([axes.TRUTH[n] for n in result.estimate.names])
    return (result.estimate.theta - truth) / result.estimate.std


def exact(folder, gap: float):
    """A log without noise, and jaxid's machine at the truth; with clearance in the coupling."""
    sensor = dataclasses.replace(axes.SENSOR, position_noise=0.0, force_noise=0.0, position_resolution=0.0)
    machine = axes.machine() if gap == 0.0 else axes.machine().with_effect("backlash", 2, gap=gap)
    log = axes.record(machine, duration=2.0, sensor=sensor)
    spring = f'[[effects]]\nkind = "backlash"\nspring = 1\ngap = {gap}\n' if gap else ""
    (folder / "case.toml").write_text(axes.text(sensor=sensor).replace("[actuator]", spring + "[actuator]"))
    return log, build_machine(load_case(folder / "case.toml"), at_truth=True, period=1 / axes.RATE)


@pytest.mark.parametrize("gap", [0.0, 60e-6])
def test_loop_is_that_of_the_independent_chain(tmp_path, gap):
    """Also with clearance in the coupling."""
    log, machine = exact(tmp_path, gap)
    made = Log(time=log["t"], position=log["position"], force=log["force"], reference=log["reference"][:, :1])
    ours = np.asarray(make_replay(machine, made)(machine.plant).position)
    off = np.abs(ours - log["true_position"]).max()
    # The corner of the clearance is rounded over a hundredth of it.
    assert off < (2e-7 if gap else 1e-7)
    assert np.ptp(np.diff(log["true_position"], axis=1)) > max(1.5 * gap, 1e-5)


@pytest.mark.parametrize(("gap", "steps", "within"), [(0.0, 1, 1e-7), (0.0, 3, 1e-8), (60e-6, 1, 5e-7)])
def test_load_moves_as_the_motion_of_the_motor_has_it(tmp_path, gap, steps, within):
    log, machine = exact(tmp_path, gap)
    motion = [jnp.asarray(log[f"true_{name}"]) for name in ("position", "velocity", "acceleration")]
    seen = [a.at[:, 1].set(jnp.nan) for a in motion]
    u = jnp.asarray(machine.gain * log["force"])
    whole = eqx.filter_jit(complete_motion)(machine.plant, *seen, u, log["t"], (True, False), steps)
    for found, true in zip(whole, motion, strict=True):
        np.testing.assert_array_equal(np.asarray(found)[:, 0], np.asarray(true)[:, 0])
    assert np.abs(np.asarray(whole[0] - motion[0])).max() < within
    # Friction's reaction is in it: without, it would be off by 10.4 N / 34.8 kg = 0.3.
    assert np.std(np.asarray(whole[2] - motion[2])[:, 1]) < 0.01


@pytest.mark.parametrize("method", ["inverse_dynamics", "output_error"])
@pytest.mark.parametrize("case", ["both", "motor"])
def test_finds_table_2(folder, case, method):
    """From the motor alone too, friction split included: the load moves as its own balance has it."""
    result = jaxid.identify(folder / f"{case}.toml", folder / "log.csv", method=method)
    assert result.converged
    assert result.estimate.identifiable.all()
    assert np.abs(z_scores(result)).max() < 3.5
    for name, part in WITHIN.items():
        assert result.value(name) == pytest.approx(axes.TRUTH[name], rel=part)
    swing = derived_json(result.session, result.estimate)["derived"]["natural_frequency"]
    assert abs(swing["value"] - FREQUENCY) < 3.5 * swing["std"] < 0.02 * FREQUENCY
    told = result.gaps[0].simulation
    assert told.rms[0] < 2 * axes.COUNT
    assert np.isnan(told.rms[1]) == (case == "motor")


def test_fits_take_the_steps_that_turning_friction_asks_for(folder):
    session = open_session(folder / "motor.toml", folder / "log.csv")
    machine, log = build_machine(session.case, at_truth=True, period=1 / axes.RATE), session.fit.log
    chosen = choose_numerics(machine, log)

    def position(steps: int) -> np.ndarray:
        replay = make_replay(machine, log, dataclasses.replace(chosen, substeps=steps))
        return np.asarray(eqx.filter_jit(lambda r, p: r(p).position)(replay, machine.plant))[:, 0]

    noise, fine = position_noise(machine, log)[0], position(24)
    assert np.abs(position(chosen.substeps) - fine).max() < 0.3 * noise
    assert np.abs(position(1) - fine).max() > noise


@pytest.mark.slow
def test_didim_tells_the_split_from_forces_alone(folder):
    result = jaxid.identify(folder / "motor.toml", folder / "log.csv", method="didim")
    assert result.converged
    assert result.estimate.identifiable.all()
    assert np.abs(z_scores(result)).max() < 3.5
    assert np.all(result.estimate.std[-2:] < 1.0)  # N


@pytest.mark.slow
def test_coarse_readings_of_the_motor_alone_are_fitted_from_the_guesses_too(tmp_path):
    """1000 counts a revolution: inverse dynamics ends at 2.6 N/mm, and a fit from there at 0.9."""
    count = 100 * axes.COUNT
    sensor = axes.Sensor(position_resolution=count, position_noise=0.5 * count, force_noise=0.1)
    axes.write(axes.record(sensor=sensor, seed=2), tmp_path / "log.csv")
    (tmp_path / "case.toml").write_text(axes.text(load=False, sensor=sensor))
    session = open_session(tmp_path / "case.toml", tmp_path / "log.csv")
    far = run_alone(METHODS["inverse_dynamics"](session))
    assert far.all_identified
    assert far.value("stiffness") < 0.1 * axes.TRUTH["stiffness"]
    found = run_alone(METHODS["output_error"](session))
    assert found.converged
    assert found.value("stiffness") == pytest.approx(axes.TRUTH["stiffness"], rel=0.025)


@pytest.mark.parametrize("method", ["power", "algebraic"])
def test_what_needs_every_encoder_says_so(folder, method):
    with pytest.raises(InputError, match="joint 2 has no position.*load_position"):
        jaxid.identify(folder / "motor.toml", folder / "log.csv", method=method)


def test_tells_the_zero_offset_of_the_second_encoder(tmp_path):
    log = axes.record(duration=4.0)
    log["position"][:, 1] += 2.5e-3
    axes.write(log, tmp_path / "log.csv")
    (tmp_path / "case.toml").write_text(axes.text(offset=True))
    result = jaxid.identify(tmp_path / "case.toml", tmp_path / "log.csv", method="inverse_dynamics")
    k = result.estimate.names.index("zero_offset")
    assert result.value("zero_offset") == pytest.approx(2.5e-3, abs=4 * result.estimate.std[k])
    assert result.value("stiffness") == pytest.approx(8e5, rel=0.02)


@pytest.mark.slow
def test_an_offset_is_not_told_without_the_encoder(tmp_path, folder):
    (tmp_path / "case.toml").write_text(axes.text(load=False, offset=True))
    result = jaxid.identify(tmp_path / "case.toml", folder / "log.csv", method="inverse_dynamics")
    told = dict(zip(result.estimate.names, result.estimate.identifiable, strict=True))
    assert not told.pop("zero_offset")
    assert all(told.values())


def test_simulated_log_has_the_columns_that_the_case_names(tmp_path):
    scene = '[reference]\nkind = "trapezoid"\ntargets = [0.1, 0.0]\nspeed = 0.2\nacceleration = 2.0\n'
    scene += "[simulation]\nduration = 2.0\nsample_rate = 1000.0\n"
    for load, header in ((True, "t,q,q_load,u,ref"), (False, "t,q,u,ref")):
        (tmp_path / "case.toml").write_text(axes.text(load=load) + scene)
        jaxid.simulate(tmp_path / "case.toml").save(tmp_path / "log.csv")
        assert (tmp_path / "log.csv").read_text().splitlines()[0] == header
        session = open_session(tmp_path / "case.toml", tmp_path / "log.csv")
        assert session.fit.log.measured == (True, load)


def test_check_says_nothing_of_a_joint_without_encoder(folder, tmp_path):
    arguments = [str(a) for a in (folder / "motor.toml", folder / "log.csv", "-o", tmp_path / "out")]
    assert main(["check", *arguments]) == 0
    told = json.loads((tmp_path / "out" / "check.json").read_text())["log"]
    assert told["stroke"][1] is None
    assert told["stroke"][0] == pytest.approx(0.2, rel=0.01)


FAULTS = {
    "load twice": ('position = "q"', 'position = ["q", "q_load"]', ["load_position", "remove load_position"]),
    "no such spring": (
        "[actuator]",
        '[[effects]]\nkind = "backlash"\nspring = 2\ngap = 1e-5\n[actuator]',
        ["1 spring", "leave spring out"],
    ),
    "flexibility twice": (
        "[actuator]",
        '[[effects]]\nkind = "joint_flexibility"\nstiffness = 1e5\ndamping = 1.0\nload_inertia = 1.0\n'
        "[actuator]",
        ["does not go with a plant that has springs", "axis"],
    ),
    "friction on the spring": (
        "[actuator]",
        '[[effects]]\nkind = "viscous_friction"\nspring = 1\ncoefficient = 1.0\n[actuator]',
        ["viscous_friction", "name a joint"],
    ),
    "gain without a drive": (
        "[actuator]",
        '[[effects]]\nkind = "actuator_gain"\njoint = 2\ngain = 1.1\n[actuator]',
        ["no drive", "driven is: 1"],
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_one_line(folder, tmp_path, name):
    old, new, told = FAULTS[name]
    (tmp_path / "case.toml").write_text(axes.text().replace(old, new))
    with pytest.raises(InputError) as error:
        open_session(tmp_path / "case.toml", folder / "log.csv")
    text = str(error.value)
    assert "\n" not in text
    assert all(part in text for part in told), text


def test_an_open_loop_with_a_clearance_is_doubted(tmp_path, folder):
    """Over 2.5 s its simulation parts from the exact chain by 0.1 to 0.5 mm, whatever corner and steps."""
    text = axes.text()
    open_loop = text[: text.index("[controller]")] + text[text.index("[sensor]") :]
    open_loop = open_loop.replace('reference = "ref"\n', "")
    spring = '[[effects]]\nkind = "backlash"\nspring = 1\ngap = { guess = 3e-4 }\n'
    said = []
    for case in (open_loop, open_loop.replace("[actuator]", spring + "[actuator]")):
        (tmp_path / "case.toml").write_text(case)
        session = open_session(tmp_path / "case.toml", folder / "log.csv")
        said.append(" ".join(_doubts_of_output_error(session.machine)))
    assert "clearance" not in said[0]
    assert "hangs on every impact in a clearance" in said[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loop", "method"),
    [
        ("open", "prediction_error"),
        ("closed", "output_error"),
        ("closed", "inverse_dynamics"),
        ("closed", "prediction_error"),
    ],
)
def test_a_known_clearance_is_fitted_from_both_encoders(tmp_path, loop, method):
    log = axes.record(axes.machine().with_effect("backlash", 2, gap=60e-6), duration=4.0)
    text = axes.text(effects='[[effects]]\nkind = "backlash"\nspring = 1\ngap = { guess = 2e-5 }\n')
    if loop == "open":
        text = text[: text.index("[controller]")] + text[text.index("[sensor]") :]
        text = text.replace('reference = "ref"\n', "")
    (tmp_path / "case.toml").write_text(text)
    fitted = jaxid.identify(tmp_path / "case.toml", axes.columns(log), method=method)

    estimate, true = fitted.estimate, axes.TRUTH | {"backlash[spring 1].gap": 60e-6}
    assert estimate.converged
    assert all(estimate.identifiable)
    assert len(estimate.names) == len(true)
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std, strict=True):
        assert abs(value - true[name]) < 3.5 * std, name


def test_backlash_needs_a_spring(tmp_path):
    (tmp_path / "case.toml").write_text(
        '[plant]\nkind = "axis"\n[plant.parameters]\ninertia = 1.0\n'
        '[[effects]]\nkind = "backlash"\ngap = 1e-4\n'
    )
    with pytest.raises(InputError, match="no springs"):
        load_case(tmp_path / "case.toml")


def search(folder, machine, case: str):
    """What is missing, and the gap before and after, on a log of another stroke and speed."""
    axes.write(axes.record(machine), folder / "log.csv")
    other = axes.trapezoids(6.0, stroke=0.1, speed=0.15)
    axes.write(axes.record(machine, duration=6.0, reference=other, seed=9), folder / "other.csv")
    (folder / "case.toml").write_text(case)
    return jaxid.discover(folder / "case.toml", folder / "log.csv", validate=[folder / "other.csv"])


@pytest.fixture(scope="module")
def rigid(tmp_path_factory):
    """Search for what the rigid model of the flexible axis lacks."""
    return search(tmp_path_factory.mktemp("rigid"), axes.machine(), axes.rigid_text())


@pytest.mark.slow
def test_names_the_flexibility_that_a_rigid_model_lacks(rigid):
    assert rigid.kinds == ["joint_flexibility"]
    swing = derived_json(rigid.session, rigid.after)["derived"]["natural_frequency"]["value"]
    assert swing == pytest.approx(FREQUENCY, rel=0.03)

    baseline, named = rigid.rounds[:2]
    assert named.step.added.candidate.kind == "joint_flexibility"
    assert named.validation[0] < 0.4 * baseline.validation[0]
    assert not any("complete for this log" in line for line in rigid.findings)


# The effect has no friction of the load: the refit loses some of the gain in forces, and in positions.
@pytest.mark.slow
@pytest.mark.xfail(reason="known miss, 2026-11-29: the refit leaves 0.412 of the position gap", strict=True)
def test_the_refit_brings_the_simulated_position_nearer(rigid):
    before, after = (gaps[-1].simulation.rms[0] for gaps in (rigid.gaps_before, rigid.gaps_after))
    assert after < 0.4 * before


@pytest.mark.slow
@pytest.mark.xfail(reason="known miss, 2026-11-27: the refit leaves 0.401 of the force gap", strict=True)
def test_the_refit_keeps_the_gain_in_forces(rigid):
    assert rigid.gaps_after[-1].force.rms[0] < 0.4 * rigid.gaps_before[-1].force.rms[0]


@pytest.mark.slow
def test_names_the_clearance_of_a_coupling(tmp_path):
    found = search(tmp_path, axes.machine().with_effect("backlash", 2, gap=60e-6), axes.text())
    assert found.kinds == ["backlash"]
    assert found.after.value("backlash[spring 1].gap") == pytest.approx(60e-6, rel=0.02)


@pytest.mark.slow
def test_names_the_mass_on_the_load(tmp_path):
    found = search(tmp_path, axes.machine(load_inertia=44.8), axes.text(known=axes.TRUTH))
    assert [(e.kind, e.place) for e in found.effects] == [("added_mass", ("joint", 2))]
    assert found.after.value("added_mass[2].mass") == pytest.approx(10.0, abs=0.1)


@pytest.mark.slow
def test_names_nothing_where_nothing_is_missing(tmp_path):
    found = search(tmp_path, axes.machine(), axes.text())
    assert found.verdict == "nothing_missing"
