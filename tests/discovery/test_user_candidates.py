"""A user's own effects in a search: found where they are the truth, refused where no search can be."""

import dataclasses

import pytest

from jaxid.commands.discover import discover
from jaxid.discovery.superset import build_candidate_model
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.session import open_session
from tests.support.axis_log import log_of
from truth.axis import machines
from truth.axis.cases import case_text, write_case
from truth.axis.hidden_effects import COULOMB, VISCOUS

# A force in time at a known frequency: nothing that is registered does that.
OWN = """
import jax.numpy as jnp
from jaxid.model import Action, Effect, parameter


class Hum(Effect):
    amplitude: object = parameter("force", "positive", "A")
    phase: object = parameter("1", "free", "rad, at t = 0")

    def act(self, x, state):
        return Action(force=self.amplitude * jnp.sin(2 * jnp.pi * 7.3 * x.t + self.phase))

    @classmethod
    def starts(cls, scales):
        return [{"amplitude": scales.force, "phase": p} for p in (0.0, 2.1, 4.2)]


class Clip(Effect):
    limit: object = parameter("force", "positive", "where the drive ends")

    def act(self, x, state):
        return Action(drive=jnp.clip(x.u, -self.limit, self.limit))


class Root(Effect):
    strength: object = parameter("force", "free", "k")

    def act(self, x, state):
        return Action(force=-self.strength * jnp.sqrt(x.yd))


class Unsized(Effect):
    strength: object = parameter("gravity", "free", "k")

    def act(self, x, state):
        return Action(force=-self.strength * x.yd)


class Known(Effect):
    def act(self, x, state):
        return Action(force=-3.0 * x.y)


class Misspelt(Effect):
    strength: object = parameter("force", "free", "k")

    def act(self, x, state):
        return Action(force=self.strength * x.y)

    @classmethod
    def starts(cls, scales):
        return [{"strenght": 1.0}]
"""


@pytest.fixture(scope="module")
def log():
    setup = machines.emps_like(5, 1.0, 6.0)
    machine = dataclasses.replace(setup.machine, clock_force=(4.0, 7.3))
    return log_of(dataclasses.replace(setup, machine=machine))


def case(folder, *candidates):
    (folder / "my_effects.py").write_text(OWN)
    text = case_text(machines.emps_like(5), (VISCOUS, COULOMB))
    if candidates:
        text += f"[discover]\ncandidates = {[f'my_effects.py:{c}' for c in candidates]}\n"
    return write_case(folder, text)


@pytest.mark.slow
def test_a_candidate_of_the_case_is_found_and_no_other_case_knows_it(tmp_path, log):
    d = discover(case(tmp_path, "Hum"), log, refit=False)
    assert (d.verdict, d.kinds) == ("found", ["my_effects.py:Hum"])
    for name, true in (("amplitude", 4.0), ("phase", 0.0)):
        at = d.after.names.index(f"my_effects.py:Hum.{name}")
        # Three deviations, or what half a step of the stepper shifts a sine.
        assert abs(d.after.theta[at] - true) < max(3 * d.after.std[at], 2e-3 * max(abs(true), 1))
    without = discover(case(tmp_path), log, refit=False)
    assert (without.verdict, without.kinds) == ("unexplained", [])


def union(path, log):
    session = open_session(path, log)
    return build_candidate_model(session.machine, session.fit.data, session.case.searched)


def test_candidates_stand_beside_the_registered_and_leave_the_model_alone(tmp_path, log):
    path = case(tmp_path, "Hum")
    found = {c.kind for c in union(path, log).candidates}
    # An axis has no spring that could have clearance, and no stages apart; the drive's are not asked for.
    elsewhere = {"backlash", "velocity_hysteresis", "actuator_offset", "voltage_limit", "back_emf_damping"}
    elsewhere |= {"unbalance", "load_friction", "command_delay", "command_lag"}
    elsewhere |= {"velocity_limit", "acceleration_limit"}
    elsewhere |= {"dead_band"}
    assert found == {*EFFECTS, "my_effects.py:Hum"} - {VISCOUS[0], COULOMB[0]} - elsewhere
    effects = open_session(path, log).machine.plant.effects
    assert [e.kind for e in effects] == [VISCOUS[0], COULOMB[0]]


def test_a_search_may_be_kept_to_some_kinds(tmp_path, log):
    """Beside them only the case's own; a kind that is none is refused, with what there is."""
    path = case(tmp_path, "Hum")
    text = path.read_text().replace("[discover]", '[discover]\nkinds = ["cogging", "quadratic_drag"]')
    path.write_text(text)
    assert [c.kind for c in union(path, log).candidates] == ["quadratic_drag", "cogging", "my_effects.py:Hum"]
    path.write_text(text.replace('"cogging"', '"coging"'))
    with pytest.raises(InputError, match="discover.*kinds.*coging.*cogging"):
        open_session(path, log)


def test_some_of_the_registered_are_searched_for_on_request(tmp_path, log):
    path = case(tmp_path, "Hum")
    text = path.read_text()
    path.write_text(text.replace("'my_effects.py:Hum'", '"voltage_limit"'))
    found = {c.kind for c in union(path, log).candidates}
    assert {"voltage_limit", "saturation"} < found
    assert "actuator_offset" not in found
    path.write_text(text.replace("[discover]", '[discover]\nkinds = ["actuator_offset"]'))
    assert [c.kind for c in union(path, log).candidates] == ["actuator_offset", "my_effects.py:Hum"]
    path.write_text(text.replace("'my_effects.py:Hum'", '"cogging"'))
    with pytest.raises(InputError, match="candidates.*cogging.*takes part in every search.*leave it out"):
        open_session(path, log)


FAULTS = {
    "Clip": "changes the force by .* at its neutral values; define neutral.*adds_force = False",
    "Root": "is not finite at the values of neutral; change them, or correct act",
    "Unsized": "cannot be built at its neutral .* .KeyError.*; let neutral.*give a number for strength",
    "Known": "has no parameters; declare",
    "Misspelt": "cannot be built at its neutral values or its starts.*give a number for strength",
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_a_search_could_not_handle_is_refused(tmp_path, log, name):
    with pytest.raises(InputError, match=FAULTS[name]) as caught:
        union(case(tmp_path, name), log)
    assert str(caught.value).startswith(f"effect my_effects.py:{name}: ")
    assert "\n" not in str(caught.value)
