"""Labels of every dimension on every kind of machine."""

import pytest

from jaxid.effects import EFFECTS
from jaxid.model.effect import Scales
from jaxid.model.parameter import parameters_of
from jaxid.model.units import Units
from jaxid.plants import PLANTS

LABELS = {
    # dimension: linear, rotary, in volts
    "force": ("N", "N m", "V"),
    "position": ("m", "rad", "V"),
    "time": ("s", "s", "s"),
    "inertia": ("kg", "kg m^2", "V s^2/V"),
    "moment": ("kg m", "kg m", "V s^2/m"),
    "1": ("1", "1", "1"),
    "1/time": ("1/s", "1/s", "1/s"),
    "position/time": ("m/s", "rad/s", "V/s"),
    "force/position": ("N/m", "N m/rad", "V/V"),
    "force/position2": ("N/m^2", "N m/rad^2", "V/V^2"),
    "force/position3": ("N/m^3", "N m/rad^3", "V/V^3"),
    "force*time/position": ("N s/m", "N m s/rad", "V s/V"),
    "force*time2/position2": ("N s^2/m^2", "N m s^2/rad^2", "V s^2/V^2"),
    "force*time4/position4": ("N s^4/m^4", "N m s^4/rad^4", "V s^4/V^4"),
    "position/force": ("m/N", "rad/(N m)", "V/V"),
}
MACHINES = (Units(), Units("rotary"), Units(position="V", force="V"))


@pytest.mark.parametrize("dimension", LABELS)
def test_labels(dimension):
    assert tuple(units.label(dimension) for units in MACHINES) == LABELS[dimension]


def test_one_override_leaves_the_other():
    assert Units("rotary", force="A").label("force*time/position") == "A s/rad"
    assert Units("rotary", force="A").label("inertia") == "A s^2/rad"
    assert Units("rotary", force="A").label("moment") == "A s^2/m"
    assert Units("rotary").label("moment") == "kg m"


def test_unknown_dimension_is_refused():
    with pytest.raises(ValueError, match="is not a dimension"):
        Units().label("Force")


DECLARED = {
    info.dimension for cls in [*EFFECTS.values(), *PLANTS.values()] for info in parameters_of(cls).values()
}


@pytest.mark.parametrize("dimension", sorted(DECLARED))
def test_every_declared_dimension_has_labels_and_a_natural_size(dimension):
    assert all(units.label(dimension) for units in MACHINES)
    # ten times the force and a hundred times the mass: sizes follow their dimension
    one = Scales(1.0, 2.0, 3.0, 5.0, 4.0, 10.0, 1e-3, 20.0)
    two = Scales(1.0, 2.0, 3.0, 50.0, 4.0, 100.0, 1e-3, 20.0)
    factor = 10.0 if dimension.startswith(("force", "inertia", "moment")) else 1.0
    assert two.natural(dimension) == pytest.approx(factor * one.natural(dimension))


def test_natural_sizes_explain_all_of_the_force():
    scales = Scales(0.1, 0.5, 3.0, 40.0, 1.0, 90.0, 1e-3, 20.0)
    assert scales.natural("inertia") * 3.0 == pytest.approx(40.0)
    assert scales.natural("force/position3") * 0.1**3 == pytest.approx(40.0)
    # a velocity is written as position over time, time as position over velocity
    assert scales.natural("force*time2/position2") * 0.5**2 == pytest.approx(40.0)
