"""The search of an arm of servos joint by joint; logs by the exact stepper, without a force."""

import json
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import jaxid
from benchmarks.unforced import of as machine_of
from jaxid.discovery.in_loop import unforced, whole_arm
from jaxid.discovery.in_loop.arm_search import ArmSearch
from jaxid.discovery.in_loop.by_joint import explore_by_joint, joint_words
from jaxid.discovery.in_loop.whole_arm import without_unneeded
from jaxid.discovery.result import Discovery
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.estimators.apart.joint import joints_alone
from jaxid.estimators.apart.session import session_of_joint
from jaxid.estimators.several.parts import part_of, parts_of
from jaxid.gap import simulation_of_log
from jaxid.model.effect import Effect
from jaxid.results.by_joint import joint_rows
from jaxid.session import open_session
from tests.support.servo_arm import COULOMB, command, dry, servo_arm_case, servo_arm_log


def still(seconds: float = 2.0, seed: int = 0, moving=(True, True)) -> dict[str, np.ndarray]:
    """Columns of an arm that goes where it is told: enough to open a session, and no machine's motion."""
    asked = command(seconds, seed)
    asked = np.where(moving, asked, asked[0])
    columns = {"t": np.arange(len(asked)) / 250.0}
    for k in range(2):
        columns |= {f"q{k + 1}": asked[:, k], f"r{k + 1}": asked[:, k]}
    return columns


def case_of_two(tmp_path) -> dict:
    """A case with two logs to fit, whose second has another gain at joint 2, and one to validate on."""
    case = servo_arm_case(dry())
    for name, seed in (("first", 0), ("second", 1), ("third", 2)):
        table = still(seed=seed, moving=(True, name != "first"))
        rows, head = np.stack(list(table.values()), axis=1), ",".join(table)
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.12g", ",", header=head, comments="")
    case["fit"] = [
        {"name": "first", "log": str(tmp_path / "first.csv")},
        {
            "name": "second",
            "log": str(tmp_path / "second.csv"),
            "set": {"controller.kd": [6.0, 3.0], "coulomb_friction[2].level": 0.7},
        },
    ]
    case["validation"] = [{"name": "third", "log": str(tmp_path / "third.csv")}]
    return case


def test_the_session_of_a_joint_has_the_loads_and_values_of_its_logs(tmp_path):
    session = open_session(case_of_two(tmp_path))
    others = [part_of(run, session.machine) for run in session.validations]
    second = joints_alone(session.machine, parts_of(session), others)[1].in_motion
    own = session_of_joint(session, second)
    # In the first log the joint's command rests.
    assert [run.name for run in own.runs] == ["second", "third"]
    for run, part in zip(own.runs, (*second.parts, *second.others), strict=True):
        machine = run.machine(own.machine)
        assert np.array_equal(machine.load, part.machine.load)
        assert machine.parameters.names == part.machine.parameters.names
        one, other = (simulation_of_log(m, part.log) for m in (machine, part.machine))
        assert np.array_equal(one.position, other.position)
    fitted, validated = (run.machine(own.machine) for run in own.runs)
    assert [float(machine.controller.kd[0]) for machine in (fitted, validated)] == [3.0, 2.0]
    assert "coulomb_friction[2].level" not in fitted.parameters.names
    assert "coulomb_friction[2].level" in validated.parameters.names


def test_a_joint_keeps_its_logs_at_other_values(tmp_path):
    session = open_session(case_of_two(tmp_path))
    first = joints_alone(session.machine, parts_of(session))[0]
    moved = first.with_estimate(2.0 * first.machine.parameters.guess)
    assert np.allclose(moved.machine.parameters.guess, 2.0 * first.machine.parameters.guess)
    for before, after in zip(first.parts, moved.parts, strict=True):
        assert after.machine.parameters.names == before.machine.parameters.names
        assert np.allclose(after.machine.parameters.guess, 2.0 * before.machine.parameters.guess)
        assert np.array_equal(after.machine.load, before.machine.load)


def test_a_spring_in_front_of_links_is_tried_on_request_only():
    """The search takes many times as long with it; a spring without its law for links is not accepted."""
    for asked in ({}, {"candidates": ["joint_flexibility"]}):
        session = open_session(servo_arm_case(dry()) | ({"discover": asked} if asked else {}), still())
        alone = joints_alone(session.machine, parts_of(session))[0]
        kinds = {cls.kind for cls in unforced.searched(session_of_joint(session, alone), alone.machine)}
        assert ("joint_flexibility" in kinds) == bool(asked)
        assert {"load_friction", "coulomb_friction", "saturation", "dead_band"} <= kinds

    class Other(Effect):
        adds_spring = True

    assert not alone.machine.plant.accepts(Other, 0, 1)
    assert alone.machine.plant.accepts(EFFECTS["joint_flexibility"], 0, 1)


def test_commands_that_rest_are_refused_in_one_line():
    session = open_session(servo_arm_case(dry()), still())
    log = replace(session.fit.log, reference=np.zeros_like(session.fit.log.reference))
    session = replace(session, fit=replace(session.fit, log=log))
    with pytest.raises(InputError, match="no joint's command moves"):
        explore_by_joint(session, max_effects=5, progress=lambda text: None)


def loaded(session, force: float):
    """The session of the first joint, whose links push with a force at every tick."""
    alone = joints_alone(session.machine, parts_of(session))[0]
    (part,) = alone.parts
    load = np.full((part.log.samples, 1), force)
    part = replace(part, machine=replace(part.machine, held_load=load))
    return replace(alone, parts=(part,)), session_of_joint(session, replace(alone, parts=(part,)))


def test_what_was_found_is_refitted_under_the_load_of_the_links(monkeypatch):
    """The machine of a search is that of a fit, which has no load of its own."""
    _, own = loaded(open_session(servo_arm_case(dry()), still()), 7.0)
    seen = []

    def fitted(machine, log, start, **options):
        seen.append(machine.held_load)
        yield from ()
        return "fit"

    monkeypatch.setattr(unforced, "fitted_with_noise", fitted)
    bare = replace(own.machine, load=None, held_load=None)
    assert unforced.refitted(own, bare, None) == "fit"
    assert np.all(seen[0] == 7.0)


def test_a_joint_is_searched_again_only_if_other_loads_move_it(monkeypatch):
    session = open_session(servo_arm_case(dry()) | {"sensor": {"position_noise": 2e-4}}, still())
    alone, own = loaded(session, 0.0)
    fit = SimpleNamespace(
        machine=own.machine, theta=own.machine.parameters.guess, residual=np.ones(3), samples=3
    )
    search = SimpleNamespace(session=own, after=fit, effects=(), kinds=[])
    arm = ArmSearch(session, parts_of(session), [alone], {0: fit})
    for force, again in ((0.0, []), (1e-4, []), (0.5, [0])):
        other, _ = loaded(session, force)
        monkeypatch.setattr(ArmSearch, "_with_loads", lambda self, joints, found, other=other: [other])
        assert arm.waiting({}, Counter()) == [0]
        assert arm.waiting({0: search}, Counter({0: 1})) == again
        assert arm.waiting({0: search}, Counter({0: 3})) == []


def test_readings_at_rest_leave_the_fit_of_a_joint_as_good_as_it_is():
    """They have no residual: a fit with such readings was taken for one that diverged, and never renewed."""
    session = open_session(servo_arm_case(dry()) | {"sensor": {"position_noise": 2e-4}}, still())
    every = joints_alone(session.machine, parts_of(session))

    def fit(alone, *residual):
        rows = np.array(residual)[:, None]
        return SimpleNamespace(machine=alone.machine, residual=rows, samples=int(np.isfinite(rows).sum()))

    fits = {0: fit(every[0], 1e-3, 1e-3, 1e-3), 1: fit(every[1], np.nan, 3e-3, 3e-3)}
    assert ArmSearch(session, parts_of(session), every, fits).by_excess == [1, 0]
    fits[0] = fit(every[0], np.inf, np.nan, np.nan)
    fits[0].samples = 3
    assert ArmSearch(session, parts_of(session), every, fits).by_excess == [0, 1]


def test_joints_go_by_number_and_by_name():
    session = open_session(servo_arm_case(dry()), still())
    assert joint_words(session, 1) == "joint 2"
    plant = replace(session.case.plant, names=("lift", "elbow"))
    assert joint_words(replace(session, case=replace(session.case, plant=plant)), 1) == "joint 2, elbow"


def test_the_table_has_a_row_for_each_effect_and_for_each_joint_without_one():
    def error(before, after):
        return {"unit": "rad", "before": before, "after": after, "noise_floor": 5e-4}

    def effect(kind, name, value, std, unit, others=()):
        parameters = {name: {"value": value, "std": std, "unit": unit}}
        rivals = [{"kind": other, "evidence": 1.0} for other in others]
        return {"kind": kind, "joint": 2, "parameters": parameters, "evidence": 213.4, "alternatives": rivals}

    content = {
        "joints": [
            {"joint": 1, "joint_name": "pan", "verdict": "unexplained", "simulation": error(3e-3, 3e-3)},
            {"joint": 2, "joint_name": "lift", "verdict": "found", "simulation": error(9.6e-3, 5.2e-3)},
            {"joint": 3, "joint_name": "jaw", "verdict": "at_rest", "simulation": error(None, None)},
        ],
        "effects": [
            effect("load_friction", "coefficient", 0.573, 0.027, "1", ["stribeck_friction"]),
            effect("dead_band", "width", 3.1e-3, 4e-4, "rad"),
        ],
    }
    head, *rows = joint_rows(content)
    assert head[4] == "simulated position: before [mrad]"
    assert rows == [
        ["1 pan", "none named, though more than noise is left", "", "", "3.00", "3.00", "0.500"],
        ["2 lift", "load_friction: coefficient = 0.573 ± 0.027", "213", "stribeck_friction"]
        + ["9.60", "5.20", "0.500"],
        ["", "dead_band: width = 3.10 ± 0.40 mrad", "213", "–", "", "", ""],
        ["3 jaw", "its command does not move", "", "", "–", "–", "0.500"],
    ]
    assert joint_rows({"effects": []}) == []


# Few kinds, so that the tests take minutes: those that act alike, and one of each other place.
KINDS = ("load_friction", "coulomb_friction", "stribeck_friction", "dead_band", "command_lag", "unbalance")
KINDS += ("constant_force", "actuator_lag", "linear_stiffness")


def searched(case: dict, log: dict) -> jaxid.Discovery:
    return jaxid.discover(case | {"discover": {"kinds": list(KINDS)}}, log)


@pytest.mark.slow
def test_friction_of_one_gear_is_named_alone_at_its_joint(tmp_path):
    d = searched(servo_arm_case(dry()), servo_arm_log(gear=(0.15, 0.0)))
    assert [e.label for e in d.effects] == ["load_friction[1]"]
    found = d.parameters["load_friction[1].coefficient"]
    assert abs(found.value - 0.15) < 3 * found.std
    assert found.std < 0.01
    for name, true in zip(("coulomb_friction[1].level", "coulomb_friction[2].level"), COULOMB, strict=True):
        assert abs(d.parameters[name].value - true) < 4 * d.parameters[name].std

    d.save(tmp_path / "out")
    content = json.loads((tmp_path / "out" / "discovery.json").read_text())
    first, second = content["joints"]
    assert (first["effects"], second["effects"]) == (["load_friction"], [])
    assert first["simulation"]["after"] < 0.2 * first["simulation"]["before"]
    assert content["steps"][1] | {"added": "load_friction", "joint": 1} == content["steps"][1]
    report = (tmp_path / "out" / "report.html").read_text()
    assert "Joint by joint" in report
    assert "found: load_friction (joint 1)" in report
    assert "load_friction" in (tmp_path / "out" / "case.toml").read_text()


@pytest.mark.slow
def test_dry_friction_of_one_joint_is_named_alone_at_its_joint():
    """The case has that of the other joint."""
    other = {"kind": "coulomb_friction", "joint": 1, "level": {"guess": 1.5}}
    d = searched(servo_arm_case(other), servo_arm_log(seed=3))
    assert [e.label for e in d.effects] == ["coulomb_friction[2]"]
    found = d.parameters["coulomb_friction[2].level"]
    assert abs(found.value - COULOMB[1]) < 3 * found.std


@pytest.mark.slow
def test_a_complete_arm_gets_nothing():
    """A hair more than noise is left, as `identify` says too: each loop shakes the other joint."""
    d = searched(servo_arm_case(dry()), servo_arm_log(seed=5))
    assert d.kinds == []
    assert np.all(d.gaps[0].simulation.rms < 3e-4)


def test_effects_of_joints_that_the_declared_model_explains_are_left_out():
    def search(kind: str) -> Discovery:
        effect = SimpleNamespace(kind=kind, score=SimpleNamespace(evidence=66.2))
        fields = dict.fromkeys(("session", "where", "noise_floor"))
        return Discovery(
            **fields,
            verdict="found",
            effects=(effect,),
            rounds=("first", "second"),
            before="declared",
            after="with it",
            gaps_before=("large",),
            gaps_after=("small",),
        )

    found = {0: search("stribeck_friction"), 1: search("load_friction")}
    kept, notes = without_unneeded(found, {0})
    assert kept[0] is found[0]
    assert (kept[1].effects, kept[1].rounds, kept[1].after) == ((), ("first",), "declared")
    assert kept[1].gaps_after == ("large",)
    (note,) = notes
    assert note.startswith("load_friction[2] was not added, at 66 nats for the joint alone")
    assert without_unneeded(found, {0, 1}) == (found, ())


@pytest.mark.slow
def test_what_one_joint_alone_lacks_is_no_effect_of_the_whole_arm():
    """Alone, the second joint of this complete arm asks for load friction."""
    drawn = machine_of("arm_nulls", 4)
    d = jaxid.discover(drawn.case(), drawn.columns())
    assert d.verdict == "nothing_missing"
    assert any(note.startswith("load_friction[2] was not added") for note in d.after.notes)
    truth = np.array([drawn.truth()[name] for name in d.after.names])
    assert np.all(np.abs(d.after.theta - truth) < 3 * d.after.std)


@pytest.mark.parametrize("needed", [{"saturation"}, {"saturation", "dead_band"}, {"stribeck_friction"}])
def test_effects_that_the_whole_arm_does_not_need_beside_others_are_left_out(needed, monkeypatch):
    """Joints with fewer effects are fitted as a whole; here the fit leaves noise if it has what is needed."""

    def effect(kind, evidence):
        return SimpleNamespace(kind=kind, score=SimpleNamespace(evidence=evidence))

    def search(*effects):
        return SimpleNamespace(effects=effects)

    class Arm:
        session = None

        def without(self, found, joint, k):
            effects = found[joint].effects
            return {**found, joint: search(*effects[:k], *effects[k + 1 :])}

        def start_of_whole(self, found):
            return frozenset(e.kind for d in found.values() for e in d.effects), None

    monkeypatch.setattr(
        whole_arm, "_by_whole", lambda session, kinds, start: (kinds, set() if needed <= kinds else {0})
    )
    found = {
        0: search(effect("saturation", 900.0), effect("stribeck_friction", 39.0)),
        1: search(effect("dead_band", 60.0)),
    }
    kept, fit, notes = whole_arm.with_fewest(Arm(), found, lambda text: None)
    assert {e.kind for d in kept.values() for e in d.effects} == set(fit) == needed
    assert len(notes) == 3 - len(needed)
    assert all("the model with the other effects leaves no more than noise" in note for note in notes)


@pytest.mark.slow
def test_no_curve_is_named_beside_the_friction_of_a_gear():
    """Along the measured motion of the links the joint had asked for a Stribeck term too."""
    drawn = machine_of("arm_hidden", 15)
    d = jaxid.discover(drawn.case(), drawn.columns())
    assert [e.label for e in d.effects] == ["load_friction[1]"]
    assert d.model_complete
    truth = drawn.truth() | {
        "load_friction[1].coefficient": drawn.servos[0].effects["load_friction"]["coefficient"]
    }
    assert np.all(np.abs(d.after.theta - [truth[name] for name in d.after.names]) < 4 * d.after.std)
