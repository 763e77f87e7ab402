"""A user's own plant: a class in a file beside the case; a fault in it is one line."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.plants import PLANTS
from tests.support.case_faults import GOOD, message, write
from tests.support.cli_setup import run

PLANT = """
import jax
import jax.numpy as jnp
import numpy as np
from jaxid.model.parameter import parameter
from jaxid.model.plant import Plant
from jaxid.model.springs import WithSprings

class Twin(Plant):
    {head}
    joints = 2
    mass: jax.Array = parameter("inertia", "positive", "of each", more=0)
    pull: jax.Array = parameter("{dimension}", "{sign}", "between them")

    def inertial(self, q, qd, qdd):
        {inertial}
    {more}

class NotAPlant:
    pass

class Bare(Plant):
    mass: jax.Array = parameter("inertia", "positive", "m")

class Empty(Plant):
    def inertial(self, q, qd, qdd):
        return qdd
"""
RIGHT = "return self.mass * qdd + self.pull * jnp.stack([q[0] - q[1], q[1] - q[0]])"


def own(
    folder: Path,
    *,
    head: str = "pass",
    dimension: str = "force/position",
    sign: str = "nonnegative",
    inertial: str = RIGHT,
    more: str = "",
    kind: str = "mine.py:Twin",
) -> str:
    """Write a plant's file; return a case of it."""
    text = PLANT.format(head=head, dimension=dimension, sign=sign, inertial=inertial, more=more)
    write(folder, text, "mine.py")
    effects = GOOD.split("[controller]")[0].split("[[effects]]", 1)[1]
    plant = f'[plant]\nkind = "{kind}"\n[plant.parameters]\nmass = [2.0, {{ guess = 3.0 }}]\n'
    return f"{plant}pull = {{ guess = 50.0 }}\n[[effects]]{effects}".replace('"q"', '["a", "b"]').replace(
        '"u"', '["c", "d"]'
    )


@pytest.mark.parametrize(("head", "known_as"), [("pass", "mine.py:Twin"), ('kind = "twin"', "twin")])
def test_own_plant_takes_part(tmp_path, head, known_as):
    case = load_case(write(tmp_path, own(tmp_path, head=head)))
    assert case.plant.cls.kind == known_as
    assert known_as not in PLANTS
    # the same class again: what was compiled for it still serves
    assert load_case(case.path).plant.cls is case.plant.cls
    machine = build_machine(case)
    assert machine.parameters.names[:2] == ["mass[2]", "pull"]
    residual = machine.plant.inertial(jnp.asarray([1.0, 0.5]), jnp.zeros(2), jnp.asarray([1.0, 2.0]))
    np.testing.assert_allclose(residual, [27.0, -19.0])


def test_what_a_file_registers_stays_its_own(tmp_path):
    before = dict(PLANTS)
    text = own(tmp_path)
    file = tmp_path / "mine.py"
    file.write_text(file.read_text() + "\nfrom jaxid.plants import PLANTS\nPLANTS['twin'] = Twin\n")
    load_case(write(tmp_path, text))
    assert before == PLANTS


PLACE = "def place(self, port):\n        return {}"
SPRUNG = "def ports(self, q):\n        return {}"
FAULTS = {
    "no such file": ({"kind": "my.py:Twin"}, "my.py:Twin", "does not exist", "there is: mine.py"),
    "no such class": ({"kind": "mine.py:Tiwn"}, "Tiwn is not there", "'Twin'"),
    "no class": ({"kind": "mine.py"}, "names no class", "my_plant.py:CartPole"),
    "not a plant": ({"kind": "mine.py:NotAPlant"}, "not a subclass of jaxid.model.plant.Plant"),
    "no inertial": ({"kind": "mine.py:Bare"}, "Bare has no method inertial", "define inertial"),
    "no parameters": ({"kind": "mine.py:Empty"}, "Empty has no parameters", "parameter("),
    "kind of another": (
        {"head": 'kind = "axis"'},
        "takes the name of a plant there is: axis",
        "another kind",
    ),
    "dimension": ({"dimension": "N/m"}, "pull has dimension 'N/m'", "force*time/position"),
    "sign": ({"sign": "negative"}, "pull has sign 'negative'", "nonnegative, positive"),
    "motions": ({"head": 'motions = ("linear", "angular")'}, "motion 'angular'", "linear, rotary"),
    "few motions": ({"head": 'motions = ("linear",)'}, "1 of 2 entries", "for each joint"),
    "actuated": ({"head": "actuated = (2,)"}, "actuated = (2,)", "from 0 to 1"),
    "raises": ({"inertial": "return self.masses * qdd"}, "raises AttributeError", "masses"),
    "shape": ({"inertial": "return jnp.sum(self.mass * qdd)"}, "returns shape ()", "return (2,)"),
    "no array": ({"inertial": "return [1.0, 2.0]"}, "returns a list", "jnp.stack"),
    "not finite": ({"inertial": "return self.mass * qdd / (q - q)"}, "is not finite", "division by zero"),
    "not compiled": (
        {"inertial": "return self.mass * qdd if q[0] > 0 else 2 * self.mass * qdd"},
        "inertial, compiled, raises TracerBoolConversionError",
        "jnp.where",
    ),
    "not affine": ({"inertial": "return self.mass * qdd**2"}, "not affine in qdd", "M(q) qdd + h(q, qd)"),
    "not symmetric": (
        {"inertial": "return self.mass * qdd + jnp.stack([qdd[1], 0.0])"},
        "is not symmetric",
        "other joints",
    ),
    "not positive": ({"inertial": "return -self.mass * qdd"}, "not positive definite", "signs"),
    "not diagonal": (
        {"head": "diagonal = True", "inertial": "return self.mass * qdd + 0.1 * qdd[::-1]"},
        "the mass matrix is not diagonal",
        "leave diagonal out",
    ),
    "nothing": ({"inertial": "pass"}, "inertial returns a NoneType", "jnp.stack"),
    "complex": ({"inertial": RIGHT + " * 1j"}, "inertial returns complex128 numbers", "real numbers"),
    "NumPy": ({"inertial": "return np.dot(np.eye(2), qdd)"}, "TracerArrayConversionError", "jax.numpy"),
    "a callback": (
        {"inertial": "return self.mass * jax.pure_callback(np.positive, qdd, qdd)"},
        "inertial calls back into Python",
    ),
    "place fails": ({"more": PLACE.format("1 / 0")}, "place(0) raises ZeroDivisionError", "index of a port"),
    "place of another kind": ({"more": PLACE.format("3")}, "place(0) = 3", '("joint", 1)'),
    "no gravity": (
        {"more": "def port_gravity(self, q):\n        return None"},
        "port_gravity returns a NoneType",
    ),
    "no motion": (
        {"more": "def any_motion(self, rng):\n        return 3.0"},
        "any_motion returns an array of shape ()",
        "(3, n)",
    ),
    "a width that is a text": (
        {"more": 'drag: jax.Array = parameter("force", "free", "d", more="a")'},
        "drag has more = 'a'",
    ),
    "undeclared ports": (
        {"more": SPRUNG.format("jnp.concatenate([q, q[1:] - q[:1]])")},
        "ports returns 3 entries, and the class declares 2",
        "WithSprings",
    ),
    "other ports": ({"more": SPRUNG.format("q[::-1]")}, "does not begin with the joints", "concatenate"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_own_plant_fault(tmp_path, fault):
    changes, *words = FAULTS[fault]
    told = message(tmp_path, own(tmp_path, **changes))
    assert told.startswith(", [plant]: kind = ")
    assert all(word in told for word in words), told


def test_a_fault_is_one_line_of_the_command_line(tmp_path, capsys):
    path = write(tmp_path, own(tmp_path, inertial="return self.masses * qdd"))
    ran = run(capsys, "check", path, tmp_path / "log.csv")
    assert ran.status == 2
    (line,) = ran.err.splitlines()
    assert "mine.py:Twin" in line
    assert "AttributeError" in line


def test_own_plant_that_does_not_import(tmp_path):
    text = own(tmp_path)
    write(tmp_path, "1 / 0", "mine.py")
    assert "ZeroDivisionError" in message(tmp_path, text)


def test_own_plant_with_springs(tmp_path):
    laws = (
        "def elongations(self, q):\n        return q[1:] - q[:1]\n"
        "    def spring_laws(self):\n        return self.pull[None], jnp.zeros(1)"
    )
    text = own(tmp_path, more=laws)
    file = tmp_path / "mine.py"
    file.write_text(file.read_text().replace("class Twin(Plant)", "class Twin(WithSprings)"))
    case = load_case(
        write(tmp_path, text + '\n[[effects]]\nkind = "cubic_stiffness"\nspring = 1\ncoefficient = 3.0\n')
    )
    plant = build_machine(case).plant
    assert plant.effects[-1].port == 2
    assert plant.place(2) == ("spring", 1)
    np.testing.assert_allclose(plant.ports(jnp.asarray([1.0, 1.5])), [1.0, 1.5, 0.5])


CART = """
from jaxid.model.parameter import parameter
from jaxid.model.plant import Plant
import jax.numpy as jnp

class Cart(Plant):
    joints = 2
    actuated = (0,)
    mass: object = parameter("inertia", "positive", "of both")

    def inertial(self, q, qd, qdd):
        return self.mass * (jnp.asarray([2.0, 1.0]) * qdd + 0.5 * qdd[::-1])
"""


@pytest.mark.parametrize(
    ("law", "words"),
    [
        ('"flatness"\npoles = [-5.0, -6.0]\nepsilon = 0.01', "whose joints accelerate each other"),
        ('"computed_torque"\nkp = 1.0\nkd = 1.0', "since no reference states the motion of the others"),
    ],
)
def test_advice_on_controllers_holds_for_a_joint_without_a_drive(tmp_path, law, words):
    write(tmp_path, CART, "cart.py")
    plant = '[plant]\nkind = "cart.py:Cart"\n[plant.parameters]\nmass = { guess = 3.0 }\n'
    path = write(tmp_path, f"{plant}[controller]\nkind = {law}\nperiod = 0.001\n")
    with pytest.raises(InputError, match="needs a drive at every joint") as caught:
        build_machine(load_case(path))
    told = str(caught.value)
    assert words in told
    assert "take a law without a model: cascade_pd, pd, pid" in told
    assert "flatness" not in told.split("take")[1]


@pytest.mark.parametrize("law", ['"pid"\nkp = 1.0\nki = 1.0\nkd = 1.0', '"cascade_pd"\nkp = 1.0\nkv = 1.0'])
def test_laws_without_a_model_take_a_joint_without_a_drive(tmp_path, law):
    write(tmp_path, CART, "cart.py")
    plant = '[plant]\nkind = "cart.py:Cart"\n[plant.parameters]\nmass = { guess = 3.0 }\n'
    path = write(tmp_path, f"{plant}[controller]\nkind = {law}\nperiod = 0.001\n")
    assert build_machine(load_case(path)).controller is not None
