"""The micropositioning stage: its motion against the independent chain, what its places are called."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import stages

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.cli import main
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.model.unknowns import label
from jaxid.plants.chain import Chain
from jaxid.plants.micropositioning_stage import MicropositioningStage
from jaxid.simulation.replay import Numerics, make_replay
from jaxid.simulation.step_size import needed_steps


def replayed(case, log: dict, columns: tuple[str, ...], substeps: int):
    """Trajectory of the case's machine at its true values, in the loop of a log."""
    made = Log(
        time=log["t"],
        position=np.column_stack([log[c] for c in columns]),
        force=log["i"][:, None],
        reference=log["ref"][:, None],
    )
    machine = build_machine(case, at_truth=True, period=1 / stages.RATE)
    replay = make_replay(machine, made, Numerics(substeps=substeps))
    replay = dataclasses.replace(replay, velocity=np.zeros(len(columns)))
    return replay(machine.plant)


@pytest.mark.parametrize("data", [1, 2])
def test_rigid_stage_moves_as_the_exact_one(tmp_path, data):
    """In its loop, through the lag of the current, the quantiser and every friction of the table."""
    log = stages.record(stages.machine(data, rigid=True), stages.move(0.5, **stages.MOVES[data]))
    (tmp_path / "case.toml").write_text(stages.text(data))
    run = replayed(load_case(tmp_path / "case.toml"), log, ("q",), 64)
    assert np.ptp(log["true_q"]) > 0.5 * stages.MOVES[data]["distance"] / stages.R
    # The same counts at every tick, or a current would differ by milliamperes.
    assert np.abs(np.asarray(run.command)[:, 0] - log["true_i"]).max() < 1e-12
    assert np.abs(np.asarray(run.position)[:, 0] - log["true_q"]).max() < 1e-2 * stages.COUNT


def test_elastic_stage_moves_as_the_exact_one(tmp_path):
    """The table swings at 1 kHz behind its screw, and sticks and slips in it: that asks for fine steps."""
    log = stages.record(
        stages.machine(1),
        stages.move(0.2, **stages.MOVES[1]),
        resolution=0.0,
        step=1e-6,
    )
    (tmp_path / "case.toml").write_text(stages.text(1, coupling="elastic", resolution=0.0))
    run = replayed(load_case(tmp_path / "case.toml"), log, ("q", "x"), 2560)
    assert np.abs(np.asarray(run.position)[:, 0] - log["true_q"]).max() < 1e-4 * np.ptp(log["true_q"])
    lag = log["x"] - stages.R * log["true_q"]
    ours = np.asarray(run.position) @ [-stages.R, 1.0]
    # The screw gives by F / k, about half a micrometre.
    assert np.ptp(lag) > 3e-7
    assert np.abs(ours - lag).max() < 0.01 * np.ptp(lag)


def test_a_table_without_an_encoder_starts_where_the_screw_does_not_pull(tmp_path):
    """Its position is in metres, the motor's in radians: it stands nowhere near the same number."""
    reference = 3.0 + stages.move(0.5, **stages.MOVES[1])
    made = stages.record(stages.machine(1), reference, resolution=0.0, start=3.0)
    path = tmp_path / "case.toml"
    path.write_text(stages.text(1, coupling="elastic", resolution=0.0, load=False))
    case = load_case(path)
    log = Log(
        time=made["t"],
        position=np.column_stack([made["q"], np.full(made["q"].size, np.nan)]),
        force=made["i"][:, None],
        reference=made["ref"][:, None],
    )
    machine = build_machine(case, at_truth=True, period=1 / stages.RATE)
    replay = make_replay(machine, log, Numerics(substeps=320))
    # What the table's ripple stretches the screw by: its slope of 1 kN/m is no force at rest.
    ripple = stages.TRUTH[1]["cogging[2].amplitude"] / stages.TRUTH[1]["stiffness"]
    assert abs(replay.position[1] - stages.R * 3.0) < 1.01 * ripple
    np.testing.assert_allclose(replay.follow, [[1.0], [stages.R]], rtol=1e-3)
    moved = replay.started(np.array([0.1]))
    np.testing.assert_allclose(moved.position, [3.1, stages.R * 3.1], atol=1.01 * ripple)
    np.testing.assert_allclose(replay.velocity, [0.0, 0.0], atol=1e-6)
    # Segments that restart from the log too.
    driven = dataclasses.replace(machine, controller=None)
    flags, starts, speeds = make_replay(driven, log, Numerics(substeps=320, segment=20)).restart
    assert flags.sum() == 5
    assert np.abs(np.diff(starts[flags, 0])).max() > 0.1
    np.testing.assert_allclose(starts[flags, 1], stages.R * starts[flags, 0], atol=2 * ripple)
    np.testing.assert_allclose(speeds[:, 1], stages.R * speeds[:, 0], rtol=1e-3)
    position = np.asarray(replay(machine.plant).position)
    assert np.abs(position[:, 0] - made["true_q"]).max() < 1e-2 * np.ptp(made["true_q"])
    assert np.abs(position[:, 1] - made["x"]).max() < 1e-2 * np.ptp(made["x"])


def test_a_stiff_screw_is_no_screw():
    """On the motor's side both do the same, but for starts and stops: there the motor winds up its screw."""
    reference = stages.move(0.3, **stages.MOVES[1])
    both = [
        stages.record(stages.machine(1, rigid=rigid), reference, resolution=0.0)["true_q"]
        for rigid in (True, False)
    ]
    assert np.sqrt(np.mean((both[0] - both[1]) ** 2)) < 0.01 * np.ptp(both[0])


def test_places_are_the_motor_and_the_table(tmp_path):
    (tmp_path / "case.toml").write_text(stages.text(1))
    machine = build_machine(load_case(tmp_path / "case.toml"))
    units = {f.name: f.unit for f in machine.parameters.free}
    assert units["motor_inertia"] == "kg m^2"
    assert units["table_mass"] == "kg"
    assert units["coulomb_friction[1].level"] == "N m"
    assert units["coulomb_friction[2].level"] == "N"
    assert units["viscous_friction[1].coefficient"] == "N m s/rad"
    assert units["velocity_hysteresis[2].velocity"] == "m/s"
    assert label(machine.plant, "cogging", 1) == "cogging[2]"
    # One coordinate: the table's friction counts at the motor, and nowhere else.
    zero = np.zeros(1)
    balance = machine.plant.balance(zero, zero, zero, zero, 0.0, machine.plant.initial_states(zero))
    assert balance.slides == balance.rises == (0,)
    dry = stages.combined(stages.TRUTH[1])["dry"]
    np.testing.assert_allclose(balance.dry, [dry, 0.0], rtol=1e-12)
    np.testing.assert_allclose(balance.rising[:, 0], stages.R * np.array([2.23, 1.12]), rtol=1e-12)


def test_a_coupling_that_there_is_not_is_refused(tmp_path):
    (tmp_path / "case.toml").write_text(stages.text(1).replace('"rigid"', '"loose"'))
    with pytest.raises(InputError, match=r'coupling = "loose" is unknown.*elastic.*rigid'):
        load_case(tmp_path / "case.toml")
    (tmp_path / "case.toml").write_text(stages.text(1).replace("pitch", "stiffness = 1e7\npitch"))
    assert main(["check", str(tmp_path / "case.toml"), str(tmp_path / "log.csv")]) == 2


def test_it_asks_for_as_many_steps_as_the_same_masses_in_one_unit():
    """Motor by its angle, or as the mass J / R^2 that it is to the table: the same oscillator."""
    p, n = stages.TRUTH[1], 10
    at_the_table = p["motor_inertia"] / stages.R**2
    screw = [p[k] for k in ("motor_inertia", "table_mass")]
    stage = MicropositioningStage(*screw, pitch=stages.PITCH, stiffness=p["stiffness"])
    chain = Chain(
        mass=[at_the_table, p["table_mass"]], damping=[0.0, 0.0], stiffness=[0.0, p["stiffness"], 0.0]
    )
    log = SimpleNamespace(period=5e-3, samples=n, filled=np.zeros((n, 2)), force=np.zeros((n, 1)), source="")
    steps = {}
    for plant, inputs in ((stage, 1), (chain, 2)):
        driven = SimpleNamespace(plant=plant, controller=None, gain=np.ones(inputs))
        log.force = np.zeros((n, inputs))
        steps[plant.kind] = needed_steps(driven, log)
    assert steps["micropositioning_stage"] == steps["chain"]
