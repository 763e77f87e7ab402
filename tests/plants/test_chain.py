"""The chain against plain NumPy physics: frequencies, energy, parameters, springs, drives."""

import dataclasses
import itertools
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.commands.discover import discover
from jaxid.commands.identify import identify
from jaxid.commands.simulate import simulate
from jaxid.discovery.candidates import CandidateSamples as SearchSamples
from jaxid.discovery.candidates import evaluate
from jaxid.discovery.points import start_points
from jaxid.discovery.superset import build_candidate_model
from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.rhs import State, acceleration, hold_polynomial
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.gap import force_gap
from jaxid.logs.log import Log
from jaxid.plants.chain import Chain
from jaxid.results.as_json import identification_json
from jaxid.session import open_session
from jaxid.simulation.loops import Drive, interval_forces, open_loop
from truth.chain import stepper as chain_stepper
from truth.hidden.chains import ChainCase, text_of_chain

MASS, DAMPING = np.array([2.0, 1.4, 2.6]), np.array([8.0, 7.0, 9.0])
STIFFNESS = np.array([1700.0, 1600.0, 1900.0, 1500.0])
CUBIC = 4e5  # N/m^3, in spring 2
BARE = f"""
[plant]
kind = "chain"
[plant.parameters]
mass = {MASS.tolist()}
damping = {DAMPING.tolist()}
stiffness = {STIFFNESS.tolist()}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "case.toml"
    path.write_text(text)
    return path


def plant(**options) -> Chain:
    return Chain(MASS.tolist(), DAMPING.tolist(), STIFFNESS.tolist(), **options)


def matrix(k: np.ndarray) -> np.ndarray:
    return np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)


def rates(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Positions and velocities after one another, and the force on each mass."""
    q, v = x[:3], x[3:]
    e = np.diff(np.concatenate([[0.0], q, [0.0]]))
    pull = STIFFNESS * e + CUBIC * np.array([0.0, 1.0, 0.0, 0.0]) * e**3
    return np.concatenate([v, (u - DAMPING * v - pull[:-1] + pull[1:]) / MASS])


def recorded(driven: tuple[int, ...], *, rate: float = 500.0, duration: float = 4.0) -> Log:
    """A log of the chain under held sines on some masses, by classical Runge-Kutta."""
    t = np.arange(round(rate * duration)) / rate
    phases = np.random.default_rng(1).uniform(0, 2 * np.pi, (len(driven), 6))
    sines = [np.sin(2 * np.pi * np.array([0.7, 1.9, 3.1, 5.3, 8.3, 11.0]) * t[:, None] + p) for p in phases]
    u = np.stack([15.0 * s.sum(axis=1) for s in sines], axis=1)
    force = np.zeros((len(t), 3))
    force[:, list(driven)] = u
    x, h, seen = np.zeros(6), 0.5 / rate, []
    for f in force:
        seen.append(x[:3])
        for _ in range(2):
            a = rates(x, f)
            b = rates(x + 0.5 * h * a, f)
            c = rates(x + 0.5 * h * b, f)
            x = x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c, f))
    noise = 1e-8 * np.random.default_rng(2).standard_normal((len(t), 3))
    return Log(t, np.array(seen) + noise, u, source="numpy.csv")


def unknown(driven: str = "", effect: str = "") -> str:
    """A case of that log with all of the plant unknown."""
    row = lambda values: "[" + ", ".join(f"{{ guess = {1.3 * v!r} }}" for v in values.tolist()) + "]"
    count = 3 if not driven else len(driven.split(","))
    names = lambda letter, n: str([f"{letter}{k + 1}" for k in range(n)])
    return f"""
[plant]
kind = "chain"
{f"actuated = [{driven}]" if driven else ""}
[plant.parameters]
mass = {row(MASS)}
damping = {row(DAMPING)}
stiffness = {row(STIFFNESS)}
{effect}
[log]
time = "t"
position = {names("q", 3)}
force = {names("u", count)}
[sensor]
position_noise = 1e-8
"""


SPRING = '[[effects]]\nkind = "cubic_stiffness"\nspring = 2\ncoefficient = { guess = 0.0 }\n'


def test_eigenfrequencies():
    at = lambda q: acceleration(plant(), State(q, jnp.zeros(3), ()), jnp.zeros(3), jnp.zeros(()))
    values = np.linalg.eigvals(-np.asarray(jax.jacfwd(at)(jnp.zeros(3))))
    expected = np.linalg.eigvals(matrix(STIFFNESS) / MASS[:, None])
    np.testing.assert_allclose(np.sort(values), np.sort(expected), rtol=1e-12)


def test_energy_is_kept_without_friction():
    free = Chain(MASS.tolist(), [0.0] * 3, STIFFNESS.tolist())
    free = free.with_effect(EFFECTS["cubic_stiffness"](coefficient=CUBIC, port=4))
    drive = Drive(jnp.ones(3), 1e-3, substeps=2, set_valued=True)
    run = eqx.filter_jit(open_loop)(
        free, drive, jnp.zeros((4000, 3)), jnp.asarray([0.01, -0.02, 0.015]), jnp.zeros(3)
    )
    q, v = np.asarray(run.position), np.asarray(run.velocity)
    e = chain_stepper.elongations(q)
    energy = 0.5 * v**2 @ MASS + 0.5 * e**2 @ STIFFNESS + 0.25 * CUBIC * e[:, 1] ** 4
    assert np.ptp(e[:, 1]) > 0.04
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)


def test_weight_acts_along_a_vertical_chain():
    hangs = plant(vertical=True, gravity=9.7)
    x = State(jnp.zeros(3), jnp.zeros(3), ())
    np.testing.assert_allclose(acceleration(hangs, x, jnp.zeros(3), jnp.zeros(())), -9.7)


@pytest.mark.parametrize("method", ["inverse_dynamics", "output_error", "algebraic", "recursive"])
def test_parameters_and_a_spring_are_recovered(tmp_path, method):
    found = identify(write(tmp_path, unknown(effect=SPRING)), recorded((0, 1, 2)), method=method)
    assert found.converged
    truth = [*MASS, *DAMPING, *STIFFNESS, CUBIC]
    np.testing.assert_allclose(found.estimate.theta, truth, rtol=0.02)
    names = identification_json(found)["parameters"]
    assert names["stiffness"]["value"] == pytest.approx(STIFFNESS, rel=0.02)
    assert names["cubic_stiffness[spring 2].coefficient"]["unit"] == "N/m^3"


@pytest.mark.parametrize("method", ["inverse_dynamics", "output_error"])
def test_one_drive_tells_all_masses(tmp_path, method):
    found = identify(write(tmp_path, unknown("2", SPRING)), recorded((1,)), method=method)
    assert found.converged
    np.testing.assert_allclose(found.estimate.theta, [*MASS, *DAMPING, *STIFFNESS, CUBIC], rtol=0.02)
    relative = found.gaps[0].force.relative
    # There is no measured force on a mass that nothing drives.
    assert np.isnan(relative[[0, 2]]).all()
    assert relative[1] < 1e-2
    assert identification_json(found)["gap"]["fit"][0] < 0.1
    assert found.gaps[0].force.measured.shape[1] == 3


def test_known_entries_keep_their_place_in_lists(tmp_path):
    row = f"mass = {MASS.tolist()}".replace("1.4", "{ guess = 1.0 }")
    text = unknown(effect=SPRING).split("\n")
    text = "\n".join(row if line.startswith("mass") else line for line in text)
    found = identify(write(tmp_path, text), recorded((0, 1, 2)), method="inverse_dynamics")
    entry = identification_json(found)["parameters"]["mass"]
    assert entry["value"] == pytest.approx(MASS, rel=0.01)
    assert [s is None for s in entry["std"]] == [True, False, True]


@pytest.mark.slow
def test_friction_of_an_exact_stepper_is_recovered(tmp_path):
    """Closed loop, one mass of two driven: the controller sees that mass alone."""
    case = ChainCase("null", "chain2", 1.0, 11)
    log = case.run()
    driven = [i - 1 for i in case.machine.actuated]
    taken = Log(log["t"], log["position"], log["force"], reference=log["reference"][:, driven])
    found = identify(write(tmp_path, text_of_chain(case)), taken)
    assert found.converged
    levels = [found.value(f"{name}.level") for name in case.values]
    truth = [v["level"] for v in case.values.values()]
    np.testing.assert_allclose(levels, truth, rtol=0.01)
    np.testing.assert_allclose(found.estimate.theta[:2], case.machine.mass, rtol=0.01)


def test_diagonal_mass_gives_what_a_full_one_gives():
    class Full(Chain):
        diagonal = False

    motion = jnp.asarray([0.01, -0.02, 0.005]), jnp.asarray([0.1, 0.0, -0.001])
    found, u = [], jnp.asarray([1.0, 2.0, 3.0])
    for cls in (Chain, Full):
        p = cls(MASS.tolist(), DAMPING.tolist(), STIFFNESS.tolist())
        for port, level in ((0, 3.0), (1, 100.0), (2, 2.0)):
            p = p.with_effect(EFFECTS["coulomb_friction"](level=level, port=port))
        x = State(*motion, (None,) * 3)
        a = acceleration(p, x, u, jnp.zeros(()))
        new = set_valued_step(p, x, hold_polynomial((u,)), jnp.zeros(()), jnp.asarray(1e-3))[0]
        found.append((a, new.q, new.qd))
        assert float(new.qd[1]) == 0.0
        assert float(new.qd[0]) != 0.0
    for one, two in zip(*found, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-10, atol=1e-14)


def test_effects_of_one_kind_do_together_what_they_do_apart():
    kinds = {"coulomb_friction": "level", "actuator_gain": "gain", "actuator_lag": "time_constant"}
    made = {
        (kind, port): EFFECTS[kind](**{name: 0.2 + port}, port=port)
        for (kind, name), port in itertools.product(kinds.items(), range(3))
    }
    together = plant(effects=tuple(made.values()))
    apart = plant(effects=tuple(made[kind, port] for port in range(3) for kind in kinds))
    motion = [jnp.asarray(x) for x in ([0.1, 0.2, 0.3], [1.0, -2.0, 3.0], [0.3, 0.2, 0.1])]
    u = jnp.asarray([5.0, 6.0, 7.0])
    one, two = (p.balance(*motion, u, jnp.zeros(()), p.initial_states(2 * u)) for p in (together, apart))
    np.testing.assert_allclose(one.residual, two.residual, rtol=1e-12)
    np.testing.assert_allclose(one.drive, two.drive, rtol=1e-12)
    assert one.slides == two.slides == (0, 1, 2)


def test_a_delay_is_that_of_its_drive():
    late = plant(actuated=(2, 0)).with_effect(EFFECTS["input_delay"](delay=2e-3, port=0))
    np.testing.assert_allclose(late.command_delays(2), [0.0, 2e-3])
    command = jnp.asarray(np.arange(20.0).reshape(10, 2))
    force, _ = interval_forces(late, Drive(jnp.ones(2), 1e-3), command)
    np.testing.assert_allclose(force[5], [command[5, 0], command[3, 1]])
    np.testing.assert_allclose(late.applied(jnp.asarray([3.0, 4.0]), 3), [4.0, 0.0, 3.0])


def test_drift_of_one_joint_leaves_the_others():
    drifting = plant()
    for port in range(3):
        drifting = drifting.with_effect(EFFECTS["coulomb_friction"](level=2.0, port=port))
    drifting = drifting.with_effect(EFFECTS["friction_drift"](rate=0.5, port=1))
    zero = jnp.zeros(3)
    balance = drifting.balance(zero, zero, zero, zero, jnp.asarray(2.0), (None,) * 4)
    np.testing.assert_allclose(balance.dry[:3], [2.0, 4.0, 2.0])


def test_places_of_effects(tmp_path):
    effects = """
[[effects]]
kind = "coulomb_friction"
friction_coefficient = { guess = 0.1 }
[[effects]]
kind = "cubic_stiffness"
coefficient = 1.0
[[effects]]
kind = "linear_stiffness"
joint = 2
coefficient = { guess = 1.0 }
[[effects]]
kind = "actuator_gain"
gain = { guess = 1.0 }
"""
    case = load_case(write(tmp_path, BARE.replace('"chain"', '"chain"\nactuated = [3, 1]') + effects))
    assert [e.ports for e in case.effects] == [(0, 1, 2), (3, 4, 5, 6), (1,), (2, 0)]
    machine = build_machine(case)
    names = [f"coulomb_friction[{k}].friction_coefficient" for k in (1, 2, 3)]
    names += ["linear_stiffness[2].coefficient", "actuator_gain[3].gain", "actuator_gain[1].gain"]
    assert machine.parameters.names == names
    np.testing.assert_allclose(machine.plant.port_normal(jnp.zeros(3)), [*9.81 * MASS, 0, 0, 0, 0])
    assert machine.gain.shape == (2,)


@pytest.mark.parametrize("gravity", ["0.0", "9.81"])
def test_a_coefficient_needs_a_weight(tmp_path, gravity):
    effect = '[[effects]]\nkind = "coulomb_friction"\nfriction_coefficient = 0.1\n'
    text = BARE.replace('"chain"', f'"chain"\ngravity = {gravity}') + effect
    case = load_case(write(tmp_path, text))
    if gravity == "0.0":
        with pytest.raises(InputError, match=r"\[1\] has a friction_coefficient, but its joint carries no"):
            build_machine(case)
    else:
        assert len(build_machine(case).plant.effects) == 3


def test_tables_of_lists(tmp_path):
    text = BARE.replace(f"mass = {MASS.tolist()}", "mass = { guess = [1.0, 2.0, 3.0], min = 0.5 }")
    values = load_case(write(tmp_path, text)).plant.parameters["mass"]
    assert [v.guess for v in values] == [1.0, 2.0, 3.0]
    assert {v.lower for v in values} == {0.5}


FAULTS = {
    "no list": ("mass = [2.0, 1.4, 2.6]", "mass = 3.0", ["mass", "not a list", "even of one"]),
    "no masses": ("mass = [2.0, 1.4, 2.6]", "mass = []", ["mass", "0 entries", "1 to 50"]),
    "missing": ("mass = [2.0, 1.4, 2.6]", "", ["'mass' is missing"]),
    "too few dampings": ("[8.0, 7.0, 9.0]", "[8.0, 7.0]", ["damping", "2 entries", "give 3"]),
    "one damping": ("[8.0, 7.0, 9.0]", "{ guess = 8.0 }", ["damping", "not a list", "of 3"]),
    "too few springs": (", 1500.0]", "]", ["stiffness", "3 entries", "give 4", "1 more than"]),
    "lists of two lengths": (
        "[8.0, 7.0, 9.0]",
        "{ guess = [1.0, 2.0, 3.0], max = [9.0] }",
        ["damping.max", "1 entry"],
    ),
    "negative": ("1600.0", "-1600.0", ["stiffness[2]", ">= 0"]),
    "actuated out of range": ('"chain"', '"chain"\nactuated = [4]', ["actuated", "3 joints"]),
    "actuated twice": ('"chain"', '"chain"\nactuated = [2, 2]', ["actuated", "twice"]),
    "actuated nothing": ('"chain"', '"chain"\nactuated = []', ["actuated", "is empty"]),
    "actuated number": ('"chain"', '"chain"\nactuated = 2', ["actuated", "not a list"]),
    "gears to two drives": (
        '"chain"',
        '"chain"\nactuated = [1, 3]\n[actuator]\ntransmission = [[1.0, 0.0], [1.0, 1.0]]',
        ["transmission", "a drive for each joint, not 2 for 3", "leave it out"],
    ),
    "actuated axis": ('"chain"', '"axis"\nactuated = [1]', ["actuated", "unknown key"]),
}
PLACES = {
    "spring out of range": ("cubic_stiffness", "spring = 5\ncoefficient = 1", ["4 springs", "1 to 4"]),
    "spring 0": ("cubic_stiffness", "spring = 0\ncoefficient = 1", ["spring", "at least 1"]),
    "spring twice": ("cubic_stiffness", "spring = [1, 1]\ncoefficient = 1", ["spring twice"]),
    "friction on a spring": ("coulomb_friction", "spring = 1\nlevel = 1", ["name a joint"]),
    "both": ("cubic_stiffness", "spring = 1\njoint = 1\ncoefficient = 1", ["exclude each other"]),
    "values by spring": ("cubic_stiffness", "coefficient = [1, 2]", ["4 in a list", "one a spring"]),
    "no drive": ("actuator_lag", "joint = 1\ntime_constant = 1", ["no drive", "driven is: 2"]),
    "no drives": ("actuator_lag", "joint = [1, 2]\ntime_constant = 1", ["no drive", "driven is: 2"]),
}


def told(folder: Path, text: str) -> str:
    with pytest.raises(InputError) as caught:
        load_case(write(folder, text))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_the_plant(tmp_path, fault):
    old, new, words = FAULTS[fault]
    assert old in BARE
    message = told(tmp_path, BARE.replace(old, new))
    assert not [w for w in words if w not in message], message


@pytest.mark.parametrize("fault", PLACES)
def test_faults_of_places(tmp_path, fault):
    kind, lines, words = PLACES[fault]
    text = BARE.replace('"chain"', '"chain"\nactuated = [2]')
    message = told(tmp_path, f'{text}[[effects]]\nkind = "{kind}"\n{lines}\n')
    assert not [w for w in words if w not in message], message


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('[log]\ntime = "t"\nposition = ["a", "b"]\nforce = "u"', ["position", "3 columns", "a joint"]),
        ('[log]\ntime = "t"\nposition = "q"\nforce = ["u", "v"]', ["force", "1 column", "a drive"]),
        ("[actuator]\ngain = [1.0, 2.0]", ["gain", "2 entries", "one a drive"]),
        ("[sensor]\nforce_noise = [1.0, 2.0]", ["force_noise", "one a drive"]),
        ("[sensor]\nposition_noise = [1.0]", ["position_noise", "one a joint"]),
        ('[input]\nkind = "bezier"\npoints = [[0, 1], [0, 2]]', ["2 joints", "drives 1"]),
    ],
)
def test_lists_by_joint_and_by_drive(tmp_path, lines, words):
    message = told(tmp_path, BARE.replace('"chain"', '"chain"\nactuated = [2]') + lines)
    assert not [w for w in words if w not in message], message


def test_a_log_of_the_wrong_width_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"force has 3 column\(s\) where 1 belong"):
        open_session(write(tmp_path, unknown("2")), recorded((0, 1, 2)))


def test_simulated_logs_hold_a_column_a_joint_and_a_drive(tmp_path):
    text = (
        BARE.replace('"chain"', '"chain"\nactuated = [3, 1]')
        + """
[controller]
kind = "pd"
kp = [1000.0, 2000.0]
kd = 50.0
[sensor]
position_noise = [1e-6, 2e-6, 3e-6]
[reference]
kind = "multisine"
band_hz = [0.5, 3.0]
amplitude = [0.01, 0.02]
[simulation]
duration = 1.0
sample_rate = 500.0
"""
    )
    log = simulate(write(tmp_path, text)).log
    assert (log.position.shape, log.force.shape, log.reference.shape) == ((500, 3), (500, 2), (500, 2))
    assert np.ptp(log.reference[:, 1]) > 1.5 * np.ptp(log.reference[:, 0])


def test_candidates_sit_where_the_plant_has_room(tmp_path):
    session = open_session(write(tmp_path, unknown("2")), recorded((1,)), align_hold=True)
    union = build_candidate_model(session.machine, session.fit.data)
    labels = {c.label for c in union.candidates}
    assert {"cubic_stiffness[spring 4]", "coulomb_friction[1]", "actuator_lag[2]"} <= labels
    drives = {"actuator_gain", "actuator_lag", "input_delay", "saturation"}
    assert {c.label for c in union.candidates if c.kind in drives} == {f"{k}[2]" for k in drives}
    kinds = {c.kind for c in union.candidates}
    # Unknown masses, dampings and springs stand in the plant already.
    assert not {"added_mass", "viscous_friction", "linear_stiffness"} & kinds
    known = build_candidate_model(build_machine(load_case(write(tmp_path, BARE))), session.fit.data)
    assert {"added_mass", "viscous_friction", "linear_stiffness"} <= {c.kind for c in known.candidates}


@pytest.mark.slow
def test_shared_columns_are_those_of_each_unknown(tmp_path):
    session = open_session(write(tmp_path, unknown()), recorded((0, 1, 2)), align_hold=True)
    union = build_candidate_model(session.machine, session.fit.data)
    samples = SearchSamples(session.fit.data)
    theta = union.neutral.copy()
    for c in union.candidates:
        theta[c.index] = c.starts[0]
    each = dataclasses.replace(union, colours=tuple(range(len(theta))))
    (e, shared), (same, own) = (evaluate(u, samples, theta) for u in (union, each))
    assert max(union.colours) + 1 < 0.5 * len(theta)
    np.testing.assert_allclose(e, same, rtol=1e-9, atol=1e-12)
    size = np.abs(own).max(axis=(0, 1))
    assert np.all(np.abs(shared - own).max(axis=(0, 1)) <= 1e-9 * size)
    # A shift by a drive effect is that of its own joint.
    theta = union.neutral
    e, _ = evaluate(union, samples, theta)
    c = next(c for c in union.candidates if c.label == "saturation[2]")
    rivals = [c for c in union.candidates if c.kind == "saturation"]
    (alone,) = (p for p in start_points(union, [c], samples, theta, e) if p.start == 3)
    (among,) = (
        p for p in start_points(union, rivals, samples, theta, e) if p.start == 3 and p.candidate is c
    )
    np.testing.assert_allclose(alone.offset, among.offset, atol=1e-9)


@pytest.mark.slow
def test_a_spring_is_found(tmp_path):
    """The whole search, on one drive; the fit in simulation left out."""
    case, log = write(tmp_path, unknown("2")), recorded((1,))
    before = force_gap(*_machine(case, log))
    found = discover(case, log, refit=False)
    assert found.verdict == "found"
    assert [e.label for e in found.effects] == ["cubic_stiffness[spring 2]"]
    value = found.after.value("cubic_stiffness[spring 2].coefficient")
    assert value == pytest.approx(CUBIC, rel=0.02)
    found.save(tmp_path / "out")
    content = json.loads((tmp_path / "out" / "discovery.json").read_text())
    (effect,) = content["effects"]
    assert effect["spring"] == 2
    assert "joint" not in effect
    assert content["steps"][1]["spring"] == 2
    assert "(spring 2)" in str(found)
    assert np.all(found.gaps_after[0].force.rms < before.rms)


def _machine(case: Path, log: Log):
    session = open_session(case, log, align_hold=True)
    return session.machine, session.fit.data
