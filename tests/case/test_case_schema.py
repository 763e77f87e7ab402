"""The JSON Schema of a case file: it takes every case of the repository, and refuses faulty ones."""

import json
import tomllib
from pathlib import Path

import jsonschema
import pytest

from jaxid import cli
from jaxid.case.case import load_case
from jaxid.case.json_schema import DRAFT, case_schema
from jaxid.case.tables import TOP
from jaxid.controllers import CONTROLLERS
from jaxid.effects import EFFECTS
from jaxid.plants import PLANTS
from jaxid.references import REFERENCES
from tests.support.case_faults import FAULTS, GOOD

ROOT = Path(__file__).parents[2]
FILES = sorted(p for d in ("experiments", "benchmarks", "jaxid/demo") for p in (ROOT / d).rglob("*.toml"))
# Faults that a schema cannot state: of two keys, of the size of the machine, or of numbers that JSON lacks.
BEYOND = {
    "no level",
    "both friction levels",
    "nan",
    "infinite",
    "infinite bound",
    "longer than a float",
    "list for one",
    "list of joints",
    "guess below min",
    "guess above max",
    "min above max",
    "min is max",
    "vertical and rotary",
    "joint",
    "joint text",
    "joint list",
    "joint twice",
    "spring",
    "passive",
    "joint and spring",
    "gains",
    "transmission",
    "rows",
    "rows backwards",
    "columns",
    "parabola of a low-pass",
    "same log",
    "same name",
    "validation disturbance",
    "reference without a loop",
    "reference and input",
    "input of two joints",
}


@pytest.fixture(scope="module")
def schema():
    return case_schema()


@pytest.fixture(scope="module")
def validator(schema):
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def read(path):
    return tomllib.loads(path.read_text(encoding="utf-8-sig"))


def test_there_are_cases():
    assert len(FILES) > 10


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_every_case_of_the_repository_is_valid(validator, path):
    validator.validate(read(path))
    load_case(path)


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_cases_are_not_valid(validator, fault):
    try:
        tables = tomllib.loads(FAULTS[fault][0])
    except tomllib.TOMLDecodeError:
        return
    assert validator.is_valid(tables) == (fault in BEYOND)


@pytest.mark.parametrize(
    "lines",
    [
        "[within_prior]\non = 'position'\n",
        "[within_prior]\nprior = 0\n",
        "[within_prior]\nprior = 0.5\nstarts = 0\n",
        "[output_error]\nstart = 'guesses'\n",
        "[recursive]\nrows = 'sum'\n",
        "[limits]\nstroke = 0.3\n",
    ],
)
def test_wrong_settings_are_not_valid(validator, lines):
    assert not validator.is_valid(tomllib.loads(GOOD + lines))


def test_the_registries_are_in_it(schema):
    tables = schema["properties"]
    assert list(tables) == list(TOP)
    assert schema["$schema"] == DRAFT
    kinds = {
        name: {v["properties"]["kind"].get("const") for v in variants if v.get("properties")}
        for name, variants in (
            ("plant", tables["plant"]["oneOf"]),
            ("effects", tables["effects"]["items"]["oneOf"]),
            ("controller", tables["controller"]["oneOf"]),
            ("reference", tables["reference"]["oneOf"]),
        )
    }
    assert kinds["plant"] == set(PLANTS)
    assert kinds["effects"] == {*EFFECTS, None}, "None: user-defined effects"
    assert kinds["controller"] == set(CONTROLLERS)
    assert kinds["reference"] == set(REFERENCES)


def test_every_key_is_described_with_its_unit(schema):
    tables = schema["properties"]
    for name, table in tables.items():
        for key, entry in table.get("properties", {}).items():
            assert entry.get("description"), f"[{name}] {key}"
    assert "[Hz]" in tables["preprocess"]["properties"]["cutoff_hz"]["description"]
    assert tables["simulation"]["properties"]["substeps"]["default"] == 4


def test_the_command_prints_it(capsys, schema):
    assert cli.main(["schema", "case"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(schema))
