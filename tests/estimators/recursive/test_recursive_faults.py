"""What the method `recursive` refuses, each in one line."""

import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.commands.identify import identify
from jaxid.errors import InputError
from jaxid.estimators.recursive.estimate import recursive_steps
from jaxid.settings import Recursive
from tests.support.recursive_axis import COULOMB, GAIN, VISCOUS, estimate, slide, with_table, written_axis
from truth.axis.cases import case_text, write_case


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    return written_axis(tmp_path_factory.mktemp("axis"))


REFUSED = {
    "an unknown key": ("half_live = 3.0", "unknown key 'half_live'; did you mean 'half_life'"),
    "a half-life of nothing": ("half_life = 0.0", "half_life = 0.0 is not positive"),
    "a start that does not count": ("regularization = 0", "regularization = 0 is not positive"),
    "a negative gate": ("gate_velocity = -1.0", "gate_velocity = -1.0 is negative"),
    "rows of a third kind": ('rows = "half"', 'rows = "half" is unknown'),
    "an instrument without a gain": ('instrument = "model"', "needs an unknown gain of a drive"),
    "nothing passes": ("gate_velocity = 1e3", "0 samples pass the gate, for 3 unknowns; lower"),
    "no memory": ('restart = "none.json"', "none.json: no such file"),
    "another memory": ('restart = "case.toml"', "has no memory of the method recursive"),
    "a restart with a start": ('restart = "a"\nstart = "guess"', "start does not go with restart"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_refuses_in_one_line(fault, axis, tmp_path):
    line, message = REFUSED[fault]
    path = with_table(tmp_path, axis, f"\n[recursive]\n{line}\n")
    with pytest.raises(InputError) as caught:
        estimate(path, axis[1])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


NOT_IN_PROPORTION = {
    "a velocity": (
        ("stribeck_friction", {"level": 5.0, "velocity": 0.01}),
        "not linear in stribeck_friction.level and stribeck_friction.velocity; declare one",
    ),
    "a rate and its level": (
        ("friction_drift", {"rate": 0.01}),
        "not linear in coulomb_friction.level and friction_drift.rate; declare one",
    ),
    "a gain with nothing known": (
        GAIN,
        "actuator_gain.gain is not identifiable: its balance has no known term",
    ),
}


@pytest.mark.parametrize("fault", NOT_IN_PROPORTION)
def test_refuses_what_is_not_in_proportion(fault, axis, tmp_path):
    effect, message = NOT_IN_PROPORTION[fault]
    text = case_text(slide(), [VISCOUS, COULOMB, effect], off=2.0)
    with pytest.raises(InputError) as caught:
        estimate(write_case(tmp_path, text), axis[1])
    assert message in str(caught.value)


STAGE = """
[plant]
kind = "micropositioning_stage"
[plant.parameters]
motor_inertia = { guess = 1e-5 }
table_mass = 0.4
pitch = 2e-3
stiffness = 1e6
[log]
sample_rate = 1000.0
position = ["q1", "q2"]
force = "u"
"""


def test_forces_and_torques_have_no_sum(tmp_path):
    machine = build_machine(load_case(write_case(tmp_path, STAGE)))
    with pytest.raises(InputError, match="would add forces to torques; take rows"):
        next(recursive_steps(machine, None, Recursive(rows="summed")))


def test_a_restart_about_other_unknowns(axis, tmp_path):
    identify(*axis, method="recursive").save(tmp_path / "first")
    text = case_text(slide(), [VISCOUS, COULOMB], off=2.0, inertia_known=True)
    path = write_case(tmp_path, text + '\n[recursive]\nrestart = "first/result.json"\n')
    with pytest.raises(InputError, match="has the unknowns inertia, .* make both the same"):
        estimate(path, axis[1])
    path = with_table(tmp_path, axis, '\n[recursive]\nrestart = "first/result.json"\nrows = "summed"\n')
    with pytest.raises(InputError, match="the run to restart from had other rows"):
        estimate(path, axis[1])
