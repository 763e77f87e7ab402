"""Springs that ring faster than a log samples: damped in a fit within a prior, and only there."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.build import build_machine
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.estimators.within_prior.problem import Problem
from jaxid.logs.log import Log
from jaxid.session import open_session
from jaxid.simulation.replay import make_replay
from jaxid.simulation.step_size import with_numerical_damping
from truth.chain import stages

REST = jnp.zeros(2)


def plant_of(folder, **stated):
    (folder / "case.toml").write_text(stages.text(1, coupling="elastic", **stated))
    return build_machine(jaxid.load_case(folder / "case.toml"), period=1 / stages.RATE).plant


def test_a_ring_that_no_sample_shows_is_damped(tmp_path):
    """Table and motor on the screw: 990 Hz, sampled at 200; at 5 kHz every period has five samples."""
    plant = plant_of(tmp_path)
    truth, motor = stages.TRUTH[1], stages.TRUTH[1]["motor_inertia"] / stages.R**2
    reduced = 1 / (1 / motor + 1 / truth["table_mass"])
    assert np.sqrt(truth["stiffness"] / reduced) / (2 * np.pi) == pytest.approx(990, rel=0.01)
    *before, more = with_numerical_damping(plant, REST, 1 / stages.RATE).effects
    assert [(e.kind, e.port) for e in before] == [(e.kind, e.port) for e in plant.effects]
    assert (more.kind, plant.place(more.port)) == ("viscous_friction", ("spring", 1))
    assert float(more.coefficient) == pytest.approx(0.6 * np.sqrt(truth["stiffness"] * reduced), rel=1e-9)
    assert with_numerical_damping(plant, REST, 1 / 5000) is plant
    damped = dataclasses.replace(plant, damping=jnp.asarray(1.01 * more.coefficient))
    assert with_numerical_damping(damped, REST, 1 / stages.RATE) is damped
    half = dataclasses.replace(plant, damping=0.5 * more.coefficient)
    lacking = with_numerical_damping(half, REST, 1 / stages.RATE).effects[-1].coefficient
    assert float(lacking) == pytest.approx(0.5 * float(more.coefficient), rel=1e-9)


def test_a_fit_within_a_prior_is_of_the_calmed_plant_in_fewer_steps(tmp_path):
    """What is found is a machine without: its own unknowns stand where they did."""
    reference = stages.move(0.5, **stages.MOVES[1])
    made = stages.record(stages.machine(1), reference, resolution=0.0, step=5e-5)
    columns = {"position": made["q"], "force": made["i"], "reference": reference, "load_position": made["x"]}
    log = Log(time=made["t"], **{name: x[:, None] for name, x in columns.items()})
    stated = '[output_error]\non = "both"\nprior = 0.5\n'
    (tmp_path / "case.toml").write_text(stages.text(1, coupling="elastic", resolution=0.0, more=stated))
    session = open_session(tmp_path / "case.toml", log)
    numerics = choose_numerics(session.machine, session.fit.log)
    problem = Problem.of(session.machine, session.fit.log, 0.5, "both", numerics)
    assert problem.places == session.machine.parameters.places
    assert len(problem.plant.effects) == len(session.machine.plant.effects) + 1
    assert problem.replay.drive.substeps == np.ceil(0.4 * numerics.substeps)
    of_current = Problem.of(session.machine, session.fit.log, 0.5, "force", numerics)
    assert of_current.replay.drive.substeps == np.ceil(0.2 * numerics.substeps)
    assert make_replay(session.machine, session.fit.log, numerics).drive.substeps == numerics.substeps
