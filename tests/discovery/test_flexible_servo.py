"""A servo without a force whose drive is flexible, after a public report: a rigid model fits wrong values.

There the friction of a joint came out as nothing beside a harmonic drive. Of the exact servos here it is the
delay that does: the rigid model needs all of it for the spring.
"""

from dataclasses import replace

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_machines import Servo, servo


def resonance(values: dict[str, float]) -> float:
    """Return the natural frequency of motor and load, free [Hz]."""
    load = values["load_inertia"]
    motor = values["inertia"] - load
    return float(np.sqrt(values["stiffness"] * (1 / motor + 1 / load)) / (2 * np.pi))


@pytest.fixture(scope="module", params=[0, 1])
def flexible(request) -> Servo:
    """Return a servo of known kp, of 200 Hz and a log of 50 Hz."""
    return replace(servo(request.param, "joint_flexibility"), known=True)


@pytest.mark.slow
def test_the_rigid_model_takes_the_delay_for_nothing_and_is_incomplete(flexible):
    result = jaxid.identify(flexible.case(), flexible.columns())
    assert result.model_complete is False
    assert flexible.effects["command_delay"]["delay"] >= 0.005
    assert result.value("controller.delay") < 1e-4
    assert (
        result.value("viscous_friction.coefficient") > 1.3 * flexible.truth()["viscous_friction.coefficient"]
    )


@pytest.mark.slow
def test_the_spring_is_named_with_its_resonance(flexible):
    found = jaxid.discover(flexible.case(), flexible.columns())
    assert found.kinds == ["joint_flexibility"]
    assert found.model_complete
    values = {name.removeprefix("joint_flexibility."): p.value for name, p in found.parameters.items()}
    true = {"inertia": flexible.inertia, **flexible.effects["joint_flexibility"]}
    assert resonance(values) == pytest.approx(resonance(true), rel=0.03)
    for name, value in flexible.truth().items():
        if name != "controller.kp":
            assert abs(found.parameters[name].value - value) < 4 * found.parameters[name].std, name
