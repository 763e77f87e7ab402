"""Units and signs of columns: a table, the drive and the encoder; what converts nothing is refused."""

import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.logs.in_memory import as_log
from jaxid.logs.units import Frame, converted, parse_unit
from jaxid.session import open_session
from jaxid.settings import Actuator, LogTable

SAMPLES = 400
T = np.arange(SAMPLES) / 200
Q, U = np.sin(3 * T) + 0.1 * np.sin(17 * T), np.cos(2 * T)
DATA = {"t": T, "q": Q, "u": U, "v": np.gradient(Q, T), "r": Q}
COLUMNS = {"time": "t", "position": "q", "force": "u"}
LINEAR, ROTARY = Frame(motions=("linear",)), Frame(motions=("rotary",))


def frame(motion, **actuator) -> Frame:
    return Frame(motions=(motion,), actuator=Actuator(**actuator))


def factor(quantity, unit, of=ROTARY, **more) -> float:
    """Return what a column is multiplied by."""
    names = {"position": "q", "force": "u", "velocity": "v", "reference": "r", "time": "t"}
    columns = {**COLUMNS, quantity: names[quantity], "units": {quantity: unit}, **more}
    log = as_log(DATA, columns, frame=of)
    column = DATA[names[quantity]]
    read = getattr(log, quantity).ravel()
    ratio = float(read @ column / (column @ column))
    np.testing.assert_allclose(read, ratio * column, rtol=1e-9, atol=1e-12)
    return ratio


# Sizes of units by their definitions (BIPM, The International System of Units, 9th ed.; 1 in = 25.4 mm).
@pytest.mark.parametrize(
    ("quantity", "unit", "of", "expected"),
    [
        ("position", "mm", LINEAR, 1e-3),
        ("position", "\u00b5m", LINEAR, 1e-6),
        ("position", "in", LINEAR, 0.0254),
        ("position", "0.5 um", LINEAR, 5e-7),
        ("position", "deg", ROTARY, np.pi / 180),
        ("position", "\u00b0", ROTARY, np.pi / 180),
        ("position", "rev", ROTARY, 2 * np.pi),
        ("velocity", "rpm", ROTARY, 2 * np.pi / 60),
        ("velocity", "deg/s", ROTARY, np.pi / 180),
        ("velocity", "mm/min", LINEAR, 1e-3 / 60),
        ("force", "kN", LINEAR, 1e3),
        ("force", "mNm", ROTARY, 1e-3),
        ("force", "mA", ROTARY, 1e-3),
        ("force", "lbf", LINEAR, 0.45359237 * 9.80665),
        ("force", "in-lb", ROTARY, 0.45359237 * 9.80665 * 0.0254),
        ("force", "oz-in", ROTARY, 0.45359237 / 16 * 9.80665 * 0.0254),
        ("force", "kg-cm", ROTARY, 0.0980665),
        ("time", "ms", ROTARY, 1e-3),
        ("time", "min", ROTARY, 60.0),
    ],
)
def test_a_unit_is_its_size(quantity, unit, of, expected):
    assert factor(quantity, unit, of) == pytest.approx(expected, rel=1e-12)


def test_counts_are_parts_of_a_turn():
    assert factor("position", "count", counts_per_revolution=1440) == pytest.approx(2 * np.pi / 1440)


def test_turns_of_the_motor_are_divided_by_the_gear():
    of = frame("rotary", gear_ratio=50.0)
    assert factor("position", "rev", of, position_at="motor") == pytest.approx(2 * np.pi / 50)
    assert factor("velocity", "rpm", of, position_at="motor") == pytest.approx(2 * np.pi / 60 / 50)


def test_turns_of_a_screw_are_its_lead():
    of = frame("linear", lead=0.02)
    assert factor("position", "rev", of) == pytest.approx(0.02)
    assert factor("position", "deg", of) == pytest.approx(0.02 / 360)
    of = frame("linear", lead=0.02, gear_ratio=3.0)
    assert factor("position", "rev", of, position_at="motor") == pytest.approx(0.02 / 3)


def test_parts_of_a_rated_current_or_of_a_supply():
    assert factor("force", "%", frame("rotary", rated=8.0)) == pytest.approx(0.08)
    assert factor("force", "%", frame("rotary", supply=24.0)) == pytest.approx(0.24)
    assert factor("force", "0.1 %", frame("rotary", rated=8.0)) == pytest.approx(0.008)
    with pytest.raises(InputError, match="of nothing that is stated; state in .actuator. either rated"):
        factor("force", "%")
    with pytest.raises(InputError, match="% is of rated or of supply"):
        factor("force", "%", frame("rotary", rated=8.0, supply=24.0))


def test_a_gain_is_the_force_for_one_per_cent():
    """So do drives give their torque: in parts of the rated one, whose hundredth is the gain."""
    assert factor("force", "%", frame("rotary", gain=0.4)) == pytest.approx(1.0)
    assert factor("force", "0.1 %", frame("rotary", gain=0.4)) == pytest.approx(0.1)
    assert factor("force", "%", frame("rotary", gain=2.0, rated=8.0)) == pytest.approx(0.08)


def assumed_of(names: dict[str, str], units: dict[str, str] | None = None, **actuator) -> list[str]:
    """Return what is said of columns by their names, beside the units that are stated."""
    table = LogTable(position="q", force="u", units=units)
    groups, columns = {q: np.ones((3, 1)) for q in names}, {q: [name] for q, name in names.items()}
    found = converted(groups, columns, {}, table, frame("rotary", **actuator), "log.csv")[1]
    return [assumed.reason for assumed in found]


def test_a_name_that_ends_in_a_unit_is_questioned():
    (said,) = assumed_of({"position": "pos_deg"})
    assert said == "the name 'pos_deg' ends in deg, and no unit is stated; state deg if that is right"
    for name in ("pos_rad", "pos", "pos_ms"):
        assert assumed_of({"position": name}) == [], name
    assert assumed_of({"force": "u_mA"}) == [], "the gain is of the column as it is"
    both = {"position": "pos_deg", "reference": "target_deg"}
    assert assumed_of(both, {"position": "deg"}) == ["that of the position"]


def test_a_current_in_milliamperes_is_not_taken_for_amperes():
    with pytest.raises(InputError, match="'u_mA' ends in mA, and .log. states no unit; state units.force"):
        assumed_of({"force": "u_mA"}, torque_constant=0.05)
    assert assumed_of({"force": "u_mA"}, {"force": "A"}, torque_constant=0.05) == []
    assert "goes with a current" in assumed_of({"force": "u_A"}, torque_constant=0.05)[0]


def test_an_offset_is_added_to_converted_values():
    log = as_log(
        DATA, {**COLUMNS, "units": {"position": "deg"}, "sign": {"position": -1}, "offset": {"position": 0.5}}
    )
    plain = as_log(DATA, COLUMNS)
    assert np.allclose(log.position, 0.5 - np.deg2rad(plain.position))


def test_signs_are_turned_by_column():
    log = as_log(DATA, {**COLUMNS, "sign": {"force": -1}})
    np.testing.assert_array_equal(log.force[:, 0], -U)
    np.testing.assert_array_equal(log.position[:, 0], Q)
    two = {**DATA, "q2": Q, "u2": U}
    columns = {"time": "t", "position": ["q", "q2"], "force": ["u", "u2"]}
    log = as_log(two, {**columns, "sign": {"force": [1, -1]}, "units": {"position": ["deg", "mm"]}}, joints=2)
    np.testing.assert_array_equal(log.force, np.stack([U, -U], axis=1))
    np.testing.assert_allclose(log.position, np.stack([Q * np.pi / 180, Q * 1e-3], axis=1), rtol=1e-12)


def test_a_reference_has_the_unit_of_the_position_and_that_is_said():
    log = as_log(DATA, {**COLUMNS, "reference": "r", "units": {"position": "mm"}}, frame=LINEAR)
    np.testing.assert_allclose(log.reference[:, 0], 1e-3 * Q, rtol=1e-12)
    assert [str(a) for a in log.assumed] == ["units.reference = 'mm': that of the position"]


@pytest.mark.parametrize(
    ("columns", "of", "match"),
    [
        ({"units": {"position": "furlong"}}, ROTARY, '"furlong" is not a known unit; take mm, um, in'),
        ({"units": {"position": "rpm"}}, ROTARY, '"rpm" is no unit of a position'),
        ({"units": {"position": "mm"}}, ROTARY, "position is in mm, and joint 1 turns"),
        ({"units": {"position": "deg"}}, LINEAR, "position is in deg, and joint 1 slides; state lead"),
        ({"units": {"position": "count"}}, ROTARY, "counts of no known size; state counts_per_revolution"),
        ({"units": {"velocity": "rpm"}}, ROTARY, "units.velocity converts nothing"),
        ({"sign": {"reference": -1}}, ROTARY, "sign.reference converts nothing"),
        ({"offset": {"reference": 1.0}}, ROTARY, "offset.reference converts nothing"),
        (
            {"offset": {"position": [1.0, 2.0]}},
            ROTARY,
            "offset.position has 2 entries, and there are 1 columns",
        ),
        ({"sign": {"position": [1, -1]}}, ROTARY, "sign.position has 2 entries, and there are 1 columns"),
        ({"sign": {"force": 2}}, ROTARY, "sign.force = 2 is no sign; give 1 or -1"),
        ({"units": {"force": "N"}}, ROTARY, "the force is in N, and joint 1 turns"),
        ({"units": {"force": "N m"}}, LINEAR, "the force is in N m, and joint 1 slides"),
        ({"position_at": "motor"}, ROTARY, "needs the gear's ratio; state gear_ratio"),
        ({"units": {"positon": "mm"}}, ROTARY, "unknown key 'positon'; did you mean 'position'"),
    ],
)
def test_what_does_not_convert_is_refused(columns, of, match):
    with pytest.raises(InputError, match=match) as caught:
        as_log(DATA, {**COLUMNS, **columns}, frame=of)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "mm/furlong", "-3 mm", "0 mm", "1/s^3", "xx", "5", "m/"])
def test_text_that_is_no_unit(text):
    assert parse_unit(text) is None


# Cases

AXIS = {
    "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": {"guess": 0.05}}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": 0.1}},
        {"kind": "coulomb_friction", "level": {"guess": 0.1}},
    ],
    "log": COLUMNS,
}


def case_with(**tables):
    return load_case({**AXIS, **{name: {**AXIS.get(name, {}), **table} for name, table in tables.items()}})


@pytest.mark.parametrize(
    ("tables", "match"),
    [
        ({"plant": {"units": {"position": "mm"}}}, r'units.position = "mm" is a label, and converts nothing'),
        ({"plant": {"units": {"position": "rad", "force": "kN m"}}}, r'units.force = "kN m" is a label'),
        ({"actuator": {"gain": 2.0, "torque_constant": 0.1}}, "gain does not go with torque_constant"),
        ({"actuator": {"gear_ratio": 3.0}}, "gear_ratio leaves open what the logged command is; state gain"),
        (
            {"log": {"counts_per_revolution": 9, "units": {"time": "s"}}},
            "counts_per_revolution converts nothing",
        ),
    ],
)
def test_a_case_whose_units_convert_nothing_is_refused(tables, match):
    with pytest.raises(InputError, match=match):
        case_with(**tables)


def test_labels_of_other_quantities_stay():
    case_with(plant={"units": {"position": "count", "force": "V"}})


@pytest.mark.parametrize(
    ("actuator", "match"),
    [
        ({"resistance": 2.0}, "resistance goes with torque_constant"),
        ({"torque_constant": 0.1}, "a drive whose voltage is logged needs resistance"),
    ],
)
def test_a_drive_that_lacks_a_value_is_refused(actuator, match):
    with pytest.raises(InputError, match=match):
        build_machine(case_with(actuator=actuator, log={"units": {"force": "V"}}))


def test_a_drive_by_its_constants():
    """Closed forms of a permanent-magnet motor: k_t N eta i, and k_t N eta (v - k_e N w) / R."""
    constants = {"torque_constant": 0.05, "gear_ratio": 20.0, "efficiency": 0.8, "resistance": 2.0}
    current = build_machine(case_with(actuator=constants, log={"units": {"force": "A"}}))
    assert current.gain == pytest.approx([0.05 * 20 * 0.8])
    assert [e.kind for e in current.plant.effects] == ["viscous_friction", "coulomb_friction"]
    voltage = build_machine(
        case_with(actuator={**constants, "back_emf": 0.06}, log={"units": {"force": "V"}})
    )
    assert voltage.gain == pytest.approx([0.05 * 20 * 0.8 / 2])
    assert voltage.plant.effects[-1].kind == "back_emf_damping"
    assert float(voltage.plant.effects[-1].coefficient) == pytest.approx(0.05 * 0.06 * 20**2 * 0.8 / 2)
    duty = build_machine(case_with(actuator={**constants, "supply": 24.0}, log={"units": {"force": "%"}}))
    assert duty.gain == pytest.approx(voltage.gain)


def test_a_screw_turns_torque_into_force():
    case = case_with(
        plant={"motion": "linear"},
        actuator={"torque_constant": 0.72, "lead": 0.02},
        log={"units": {"force": "A"}},
    )
    # 2 pi 0.72 / 0.02.
    assert build_machine(case).gain == pytest.approx([226.1947], rel=1e-6)


def as_log_of_file(folder, header, data):
    path = folder / "log.csv"
    np.savetxt(path, np.stack(list(data.values()), 1), delimiter=",", header=header, comments="")
    return path


def test_the_unit_of_a_drives_command_is_said_or_asked_for(tmp_path):
    case = case_with(actuator={"torque_constant": 0.1})
    data = {"t": T, "q": Q, "u": 10 * (0.05 * np.gradient(np.gradient(Q, T), T) + 0.1 * np.gradient(Q, T))}
    session = open_session(case, data)
    assert "torque_constant goes with a current" in str(session.fit.log.assumed[0])
    volts = as_log_of_file(tmp_path, "t,q,u [V]", data)
    with pytest.raises(InputError, match=r'gives the force in V, .*; state units.force = "V"'):
        open_session(case_with(actuator={"torque_constant": 0.1}, log={"force": "u [V]"}), volts)


def test_a_voltage_drive_gives_the_inertia_of_an_exact_simulation():
    """A motor by its own equations: J w' = k_t (v - k_e w) / R - b w, integrated in closed form."""
    inertia, friction, constant, resistance, rate = 2e-3, 1e-3, 0.05, 2.0, 500.0
    rng = np.random.default_rng(0)
    v = np.repeat(rng.uniform(-10, 10, 300), 10)
    drag, h = friction + constant**2 / resistance, 1 / rate
    q = w = 0.0
    rows = []
    for u in v:
        rows.append(q)
        end = constant * u / resistance / drag
        decay = np.exp(-drag / inertia * h)
        q += end * h + (w - end) * inertia / drag * (1 - decay)
        w = end + (w - end) * decay
    tables = {
        "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": {"guess": 1e-3}}},
        "effects": [{"kind": "viscous_friction", "coefficient": {"guess": 2e-3}}],
        "actuator": {"torque_constant": constant, "resistance": resistance, "supply": 12.0},
        "log": {"time": "ms", "position": "deg", "force": "duty", "hold": "zero_order"},
    }
    tables["log"]["units"] = {"time": "ms", "position": "deg", "force": "%"}
    from jaxid.commands.identify import identify

    data = {"ms": 1e3 * np.arange(v.size) / rate, "deg": np.rad2deg(rows), "duty": 100 * v / 12}
    result = identify(tables, data, method="inverse_dynamics")
    # Without noise the filter's error is left: 0.05 % of the inertia.
    assert result.value("inertia") == pytest.approx(inertia, rel=5e-3)
    assert result.value("viscous_friction.coefficient") == pytest.approx(friction, rel=2e-2)
