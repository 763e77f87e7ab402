"""The case with what was found: as an object, as a file with its comments, and through the command line."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

import jaxid
from jaxid.settings import SensorTable
from tests.support.cli_setup import COULOMB, VISCOUS, place, recorded, run, text

COMMENT = "# the drive's own law"
OWN = """
from jaxid import Action, Effect, parameter

class Lump(Effect):
    kind = "lump"
    level: object = parameter("force", "nonnegative", "height")

    def act(self, x, state):
        import jax.numpy as jnp
        return Action(force=-self.level * jnp.tanh(x.yd / x.width))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("found")
    place(made, recorded(), text([VISCOUS]).replace("[controller]", f"{COMMENT}\n[controller]"))
    place(made / "second", recorded(1))
    with (made / "case.toml").open("a") as file:
        file.write('[[validation]]\nname = "again"\nlog = "second/log.csv"\n')
    return made


@pytest.fixture(scope="module")
def found(folder):
    return jaxid.discover(folder / "case.toml", folder / "log.csv", refit=False)


def same_but_for_the_file(one, other):
    strip = lambda case: replace(case, path=one.path, validations=())
    assert repr(strip(one)) == repr(strip(other))
    logs = [[v.log.resolve() for v in case.validations] for case in (one, other)]
    assert logs[0] == logs[1]


def test_the_case_holds_what_was_found(found):
    case, given = found.case(), found.session.declared
    assert [e.cls.kind for e in case.effects] == ["viscous_friction", "coulomb_friction"]
    assert case.plant.parameters["inertia"].guess == pytest.approx(found.value("inertia"), rel=1e-8)
    assert case.plant.parameters["inertia"].free
    level = case.effects[1].parameters["level"][0]
    assert (level.free, level.guess) == (True, pytest.approx(found.value("coulomb_friction.level"), rel=1e-8))
    assert given.effects == found.session.case.effects
    assert len(given.effects) == 1


@pytest.mark.parametrize("where", [".", "deep"])
def test_the_written_case_is_that_case_and_gives_the_values_found(where, folder, found):
    (folder / where).mkdir(exist_ok=True)
    path = found.save_case(folder / where / "found.toml", overwrite=True)
    assert COMMENT in path.read_text()
    written = jaxid.load_case(path)
    same_but_for_the_file(written, found.case())
    again = jaxid.identify(path, folder / "log.csv", method="inverse_dynamics")
    assert again.estimate.names == found.after.names
    np.testing.assert_allclose(again.estimate.theta, found.after.theta, rtol=1e-3)
    assert [run.name for run in again.session.runs] == ["fit", "again"]


def test_every_table_of_the_original_stays(folder, found):
    tables = tomllib.loads(found.save_case(folder / "kept.toml", overwrite=True).read_text())
    original = tomllib.loads((folder / "case.toml").read_text())
    assert tables.keys() == original.keys()
    assert tables["effects"][:1] == [
        {**original["effects"][0], "coefficient": tables["effects"][0]["coefficient"]}
    ]
    for name in original.keys() - {"effects", "plant"}:
        assert tables[name] == original[name]


def test_an_existing_file_is_kept(folder, found):
    with pytest.raises(jaxid.InputError, match="exists already"):
        found.save_case(folder / "case.toml")
    with pytest.raises(jaxid.InputError, match="has no such folder"):
        found.save_case(folder / "nowhere" / "case.toml")


def test_a_case_changed_in_python_is_an_object_only(folder):
    case = jaxid.load_case(folder / "case.toml")
    changed = replace(case, sensor=SensorTable(position_noise=1e-6))
    result = jaxid.identify(changed, folder / "log.csv", method="inverse_dynamics")
    assert result.case().sensor == changed.sensor
    with pytest.raises(jaxid.InputError, match="changed in Python"):
        result.save_case(folder / "changed.toml")


def test_an_unknown_that_is_not_identifiable_keeps_its_guess(tmp_path):
    blind = ("added_mass", {"mass": 1.0})
    case, log = place(tmp_path, recorded(), text([VISCOUS, COULOMB, blind]))
    result = jaxid.identify(case, log, method="inverse_dynamics")
    kept, given = result.case(), result.session.declared
    assert not result.parameters["inertia"].identifiable
    assert kept.plant.parameters["inertia"] == given.plant.parameters["inertia"]
    assert kept.effects[0].parameters["coefficient"][0].guess == pytest.approx(203.5, rel=0.05)
    same_but_for_the_file(jaxid.load_case(result.save_case(tmp_path / "kept.toml")), kept)


def test_a_users_effect_is_named_by_its_file_from_the_new_folder(tmp_path):
    (tmp_path / "mine.py").write_text(OWN)
    more = '\n[discover]\ncandidates = ["mine.py:Lump"]\nkinds = ["cogging"]\n'
    case, log = place(tmp_path, recorded(), text([VISCOUS], more))
    found = jaxid.discover(case, log, refit=False)
    assert found.kinds == ["lump"]
    (tmp_path / "deep").mkdir()
    tables = tomllib.loads(found.save_case(tmp_path / "deep" / "case.toml").read_text())
    assert tables["effects"][-1]["kind"] == "../mine.py:Lump"
    assert tables["discover"]["candidates"] == ["../mine.py:Lump"]
    again = jaxid.identify(tmp_path / "deep" / "case.toml", log, method="inverse_dynamics")
    assert again.value("lump.level") == pytest.approx(found.value("lump.level"), rel=1e-3)


LISTS = """
[plant]
kind = "chain"
[plant.parameters]
mass = [{ guess = 2.0, true = 2.2 }, 2.5]
damping = { guess = [1.0, 2.0], min = 0.1 }
stiffness = [1000.0, { guess = 900.0, max = 1200.0 }, 1100.0]   # springs
[[effects]]
kind = "coulomb_friction"
level = { guess = 0.3 }
[[effects]]
kind = "viscous_friction"
joint = 2
coefficient = 0.5
[log]
time = "t"
position = ["x1", "x2"]
force = ["u1", "u2"]
"""


@pytest.mark.parametrize("style", ["tables", "one list"])
def test_lists_keep_their_form(tmp_path, style):
    """Guesses are put into entries, lists of guesses, and a guess that stood for several joints."""
    from jaxid.build import build_machine
    from jaxid.results.found_case import case_text, found_case

    written = LISTS
    if style == "one list":
        head, _, rest = LISTS.partition("[[effects]]")
        rest = rest[rest.index("[log]") :]
        effects = '[{ kind = "coulomb_friction", level = { guess = 0.3 } }, '
        effects += '{ kind = "viscous_friction", joint = 2, coefficient = 0.5 }]'
        written = f"effects = {effects}\n{head}{rest}"
    (tmp_path / "chain.toml").write_text(written)
    case = jaxid.load_case(tmp_path / "chain.toml")
    machine = build_machine(case, period=1e-3)
    names = machine.parameters.names
    theta = np.array([f.guess * 1.1 for f in machine.parameters.free])
    theta[names.index("coulomb_friction[2].level")] = 0.4

    class Result:
        class session:
            declared = case

        class estimate:
            pass

    Result.session.machine = machine
    Result.estimate.machine = machine.with_estimate(theta)
    Result.estimate.theta = theta
    Result.estimate.identifiable = np.array([name != "damping[1]" for name in names])
    tables = tomllib.loads(case_text(Result, tmp_path))
    assert tables["plant"]["parameters"] == {
        "mass": [{"guess": 2.2, "true": 2.2}, 2.5],
        "damping": {"guess": [1.0, 2.2], "min": 0.1},
        "stiffness": [1000.0, {"guess": 990.0, "max": 1200.0}, 1100.0],
    }
    assert tables["effects"][0]["level"] == {"guess": [0.33, 0.4]}
    assert tables["effects"][1]["coefficient"] == 0.5
    assert ("# springs" in case_text(Result, tmp_path)) or style == "one list"
    (tmp_path / "found.toml").write_text(case_text(Result, tmp_path))
    same_but_for_the_file(jaxid.load_case(tmp_path / "found.toml"), found_case(Result))


def test_the_command_writes_it_and_never_over_the_case(folder, tmp_path, capsys):
    case, log = folder / "case.toml", folder / "log.csv"
    ran = run(capsys, "discover", case, log, "--no-experiments", folder=tmp_path / "out")
    assert ran.status == 0, ran.err
    assert f"{tmp_path / 'out' / 'case.toml'}" in ran.out
    assert len(jaxid.load_case(tmp_path / "out" / "case.toml").effects) == 2

    own = tmp_path / "out" / "case.toml"
    before = own.read_text()
    ran = run(capsys, "discover", own, log, "--no-experiments", folder=tmp_path / "out")
    assert ran.status == 0, ran.err
    assert own.read_text() == before
    assert (tmp_path / "out" / "case_found.toml").is_file()
    assert ran.json("discovery.json")["verdict"] == "nothing_missing"


def test_the_command_refuses_before_the_search_to_write_over_a_users_case(folder, tmp_path, capsys):
    users = tmp_path / "users"
    users.mkdir()
    (users / "case.toml").write_text("mine")
    ran = run(capsys, "discover", folder / "case.toml", folder / "log.csv", folder=users)
    assert ran.status == 2
    assert "holds case.toml already" in ran.err
    assert (users / "case.toml").read_text() == "mine"
