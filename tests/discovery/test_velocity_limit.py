"""A servo whose command is followed with a limited velocity, which its case does not declare."""

from dataclasses import replace

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_machines import servo
from truth.axis.stepper import Machine, reached


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_limited_velocity_of_the_command_is_named_with_its_value(seed):
    """Without this effect the first servo was named a saturation, with 19 times the noise left."""
    drawn = servo(seed)
    fastest = np.abs(np.diff(drawn.command)).max() * drawn.rate / drawn.every
    limit = float(fastest * np.random.default_rng([77, seed]).uniform(0.4, 0.8))
    on_command = {"command_delay": drawn.effects["command_delay"], "velocity_limit": {"limit": limit}}
    command = reached(np.repeat(drawn.command, drawn.every), Machine(1.0, on_command), drawn.rate)
    effects = {kind: values for kind, values in drawn.effects.items() if kind != "command_delay"}
    run = replace(drawn, every=1, command=command, effects=effects).run()
    log = {"t": run["t"][:: drawn.every], "q": run["position"][:: drawn.every], "r": drawn.command}

    found = jaxid.discover(drawn.case(), log)
    assert found.kinds == ["velocity_limit"]
    assert found.model_complete is True
    for name, true in {**drawn.truth(), "velocity_limit.limit": limit}.items():
        if name in found.parameters and found.parameters[name].identifiable:
            value = found.parameters[name]
            assert abs(value.value - true) < 4 * value.std, name
