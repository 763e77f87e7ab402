"""A search over several logs: a spring that none of them declares, beside what is known to differ."""

import tomllib

import numpy as np
import pytest

import jaxid
from jaxid import Log
from tests.support.several_logs import LOADED, axis_case, axis_setup, write_log
from truth.axis.cases import recorded

SPRING = 300.0


def sprung(seed: int, **options: float):
    return axis_setup(seed, **options).with_effect("linear_stiffness", coefficient=SPRING)


@pytest.mark.slow
def test_an_effect_is_found_in_logs_of_which_one_has_a_known_payload(tmp_path):
    write_log(tmp_path / "loaded.csv", sprung(8, added=LOADED))
    case = tomllib.loads(axis_case(closed=True, gain_unknown=True))
    entry = {"log": str(tmp_path / "loaded.csv"), "set": {"added_mass.mass": LOADED}}
    log = Log(**(recorded(sprung(1)) | {"source": "1.csv"}))

    found = jaxid.discover(case | {"fit": [{"name": "empty"}, entry]}, log, experiments=False)

    assert found.verdict == "found"
    assert [effect.label for effect in found.effects] == ["linear_stiffness"]
    p = found.parameters["linear_stiffness.coefficient"]
    assert abs(p.value - SPRING) < 4 * p.std
    assert np.all(found.estimate.identifiable)
    # Alone, the empty log does not even determine the gain.
    one = jaxid.check(case, log)
    assert not one.precision.identifiable.any()
    rms = [gap.force.rms[0] for gap in found.gaps]
    assert max(rms) < 1.1 * found.noise_floor[0]
    assert found.where.text.endswith(("(log empty)", "(log loaded)"))
