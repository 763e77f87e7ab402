"""Cases checked without JAX: against stand-ins of the classes, with the words of the classes themselves."""

import copy
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from jaxid import cli
from jaxid.case import kinds
from jaxid.case.case import load_case, read_case
from jaxid.errors import InputError

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "jaxid" / "demo" / "case.toml"
CASES = sorted(
    path
    for folder in ("jaxid", "experiments", "benchmarks", "docs", "notebooks", "tests")
    for path in (ROOT / folder).rglob("*.toml")
    if "plant" in tomllib.loads(path.read_text(encoding="utf-8"))
)
CHAIN = """
[plant]
kind = "chain"
actuated = [1]

[plant.parameters]
mass = [1.0, { guess = 2.0 }]
damping = [0.1, 0.1]
stiffness = [10.0, 20.0, 0.0]

[[effects]]
kind = "cubic_stiffness"
spring = 3
coefficient = 1.0

[[effects]]
kind = "static_friction"
joint = [1, 2]
level = [1.0, 2.0]

[discover]
kinds = ["cogging"]
"""
ARM = """
[plant]
kind = "serial_arm"

[[plant.links]]
joint = "revolute"
alpha_deg = 90.0
a = 0.0
mass = 1.0
first_moment = [0.1, 0.0, 0.0]
inertia = [0.1, 0.0, 0.0, 0.1, 0.0, 0.1]

[[plant.links]]
joint = "revolute"
alpha = 0.0
a = 1.0
mass = { guess = 1.0 }
first_moment = [0.1, 0.0, 0.0]
inertia = [0.1, 0.0, 0.0, 0.1, 0.0, 0.1]

[[plant.shafts]]
joints = [1, 2]

[[effects]]
kind = "viscous_friction"
shaft = 1
coefficient = 1.0

[[inertial_sensors]]
kind = "gyroscope"
noise = 0.01
link = 2
"""
STAGE = """
[plant]
kind = "micropositioning_stage"
coupling = "rigid"

[plant.parameters]
motor_inertia = 1e-4
table_mass = { guess = 3.0 }
pitch = 0.01

[[effects]]
kind = "coulomb_friction"
joint = 2
level = { guess = 3.0 }

[controller]
kind = "adaptive"
kp = 10.0
kd = 1.0
"""
LOOP = """
[plant]
kind = "axis"
motion = "rotary"

[plant.parameters]
inertia = 1e-4

[[effects]]
kind = "unbalance"
moment = { guess = 0.02 }
phase = 0.0

[log]
sample_rate = 1000.0
position = "q"
loop_velocity = "v"
rows = [[0, 500], [600, 1200]]

[controller]
kind = "pid"
kp = { guess = 10.0, min = 1.0, max = 100.0 }
ki = 1.0
kd = { guess = 0.1 }
limit = { guess = 5.0 }
delay = { guess = 1e-3 }

[[fit]]
name = "loaded"
log = "loaded.csv"
rows = [0, 1000]
set = { "axis.inertia" = 2e-4 }
"""
STEADY = """
[plant]
kind = "axis"

[plant.parameters]
inertia = { guess = 1.0 }

[[effects]]
kind = "coulomb_friction"
level = { guess = 1.0 }

[log]
kind = "steady"
velocity = "v"
force = "f"
scatter = "s"
"""
TREE = """
[plant]
kind = "tree"
mjcf = "robot.xml"
joints = ["shoulder", "elbow"]
held = { wrist = 0.5 }
unknown = ["base", "damping"]
gear_ratio = { shoulder = 50.0 }
actuated = ["shoulder"]
actuators = false
gravity_vector = [0.0, 0.0, -9.81]
"""
TEXTS = {"chain": CHAIN, "arm": ARM, "stage": STAGE, "loop": LOOP, "steady": STEADY} | {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in CASES
}
# Values that hardly any key may have.
WRONG = ("word", -1.5, [], {"guess": 1.0, "gues": 2.0}, True)


def outcome(tables: dict, folder: Path, known: kinds.Kinds) -> str:
    """The line that refuses a case; empty if nothing does, "classes" where only classes could say."""
    try:
        read_case(tables, None, folder, known)
    except InputError as error:
        return str(error)
    except kinds.NeedsClassesError:
        return "classes"
    return ""


def spoilt(tables: dict) -> Iterator[dict]:
    """The case with one key misspelt, left out, or with a wrong value; every key in turn."""
    for path in keys(tables):
        for fault in ("misspelt", "missing", *WRONG):
            other = copy.deepcopy(tables)
            table = other
            for step in path[:-1]:
                table = table[step]
            name = path[-1]
            if isinstance(name, int):
                table[name] = fault
            elif fault == "misspelt":
                table[f"{name[:-1]}{name[-1]}x"] = table.pop(name)
            elif fault == "missing":
                del table[name]
            else:
                table[name] = fault
            yield other


def keys(value: object, path: tuple = ()) -> Iterator[tuple]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, inner in items:
        yield (*path, name)
        yield from keys(inner, (*path, name))


def test_the_file_is_what_the_classes_say():
    """If this fails, run `python -m jaxid.case.kinds` and commit the file."""
    assert kinds.FILE.read_text(encoding="utf-8") == kinds.text_of(kinds.declarations())


QUICK = ("chain", "arm", "stage", "loop", "steady", "docs/examples/axis.toml")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in TEXTS]
)
def test_every_fault_is_refused_in_the_same_words(name):
    tables = tomllib.loads(TEXTS[name])
    folder = (ROOT / name).parent if name.endswith(".toml") else ROOT
    ways = [lambda t, k=k: outcome(t, folder, k) for k in (kinds.declared_kinds(), kinds.loaded_kinds())]
    assert ways[0](tables) in ("", "classes")
    if ways[0]({"plant": tables["plant"]}) == "classes":
        return  # a user's plant: its class comes first, and takes a second for every fault
    refused = 0
    for other in spoilt(tables):
        early, late = (way(other) for way in ways)
        assert early in (late, "classes")
        refused += early not in ("", "classes")
    assert refused > 10


def test_the_classes_decide_only_where_files_are_named():
    known = kinds.declared_kinds()
    undecided = [name for name, text in TEXTS.items() if outcome(tomllib.loads(text), ROOT, known)]
    assert undecided
    for name in undecided:
        assert any(word in TEXTS[name] for word in (".py:", "urdf", "mjcf")), name


def test_keys_of_a_tree_are_refused_before_its_file_is_read():
    tables, known = tomllib.loads(TREE), kinds.declared_kinds()
    assert outcome(tables, ROOT, known) == "classes"
    faults = [(outcome(t, ROOT, known), outcome(t, ROOT, kinds.loaded_kinds())) for t in spoilt(tables)]
    early = [pair for pair in faults if pair[0] != "classes"]
    assert len(early) > len(faults) / 2
    assert all(first == later for first, later in early)


@pytest.mark.parametrize("name", ["own_velocity", "integral"])
@pytest.mark.parametrize("known", [kinds.declared_kinds, kinds.loaded_kinds])
def test_what_a_log_decides_of_a_controller_is_no_key(name, known):
    tables = tomllib.loads(LOOP)
    tables["controller"][name] = True
    assert f"[controller]: unknown key '{name}'" in outcome(tables, ROOT, known())


def test_effects_that_only_classes_can_check_are_not_declared(monkeypatch):
    from jaxid.effects import EFFECTS
    from jaxid.model.effect import Effect

    class Odd(Effect):
        """An effect with a check of its own."""

        kind = "odd"

        def __check_init__(self):
            raise ValueError

    monkeypatch.setitem(EFFECTS, "odd", Odd)
    with pytest.raises(TypeError, match="Odd.__check_init__ is unknown"):
        kinds.declarations()


LOADED = """
import sys
from jaxid import cli
try: status = cli.main(sys.argv[1:])
except SystemExit as end: status = end.code
heavy = [m for m in ("jax", "equinox", "scipy", "matplotlib", "xarray") if m in sys.modules]
print(heavy, status, file=sys.stderr)
"""


def alone(*words: str | Path) -> tuple[str, list[str]]:
    """Return what a new process prints and the lines of its errors; the last has its imports and status."""
    ran = subprocess.run(
        [sys.executable, "-c", LOADED, *map(str, words)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return ran.stdout, ran.stderr.splitlines()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("inertia =", "inertai ="),
        ("level =", "levle ="),
        ('"coulomb_friction"', '"coulomb"'),
        ("level = { guess = 10.0 }", "level = 1.0\nfriction_coefficient = 0.1"),
        ("position =", "positon ="),
        ("kp =", "pk ="),
        ("[sensor]", "[sensors]"),
    ],
)
@pytest.mark.parametrize("command", ["check", "identify", "discover"])
def test_a_faulty_case_is_refused_before_jax_is_imported(tmp_path, command, old, new):
    text = DEMO.read_text(encoding="utf-8")
    assert old in text
    case = tmp_path / "case.toml"
    case.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as late:
        load_case(case)
    assert alone(command, case, DEMO.with_name("log.csv")) == ("", [f"jaxid: {late.value}", "[] 2"])


@pytest.mark.parametrize("words", [("simulate", "-o", "x.csv"), ("design", "-o", "x.csv"), ("study",)])
def test_other_commands_refuse_it_too(tmp_path, monkeypatch, words):
    case = tmp_path / "case.toml"
    case.write_text("[plnt]\n", encoding="utf-8")
    places = [tmp_path / word if word.endswith(".csv") else word for word in words]
    _, errors = alone(places[0], case, *places[1:])
    assert errors[-1] == "[] 2"
    assert "did you mean 'plant'?" in errors[0]


def test_the_wrong_order_of_arguments_is_refused_before_jax_is_imported():
    log = DEMO.with_name("log.csv")
    told = f"{log}: is a log, in the place of the case; the case comes first: jaxid identify {DEMO} {log}"
    assert alone("identify", log, DEMO) == ("", [f"jaxid: {told}", "[] 2"])


@pytest.mark.parametrize("words", [("--help",), ("methods",), ("plants",), ("effects",), ("schema", "case")])
def test_lists_need_no_jax_and_are_those_of_the_classes(capsys, words):
    shown, errors = alone(*words)
    assert errors == ["[] 0"]
    if words == ("--help",):
        return
    assert "jaxid.effects" in sys.modules, "this process has the classes"
    assert cli.main(words) == 0
    assert shown == capsys.readouterr().out
