"""The site: its pages and links hold, its reference is complete, and it builds without a warning."""

import argparse
import importlib.util
import json
import re

import pytest

import jaxid
from docs.site import stage as staging
from docs.site.__main__ import CONFIG, build
from docs.site.case_reference import keys_table
from docs.site.curves import lines_of
from docs.site.stage import BrokenLinkError, check_links, stage
from jaxid import cli
from jaxid.case.tables import TOP
from jaxid.model.parameter import parameters_of


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Folder with all pages of the site; links are checked while it is made."""
    folder = tmp_path_factory.mktemp("site") / "pages"
    stage(folder)
    return folder


def text(pages, name: str) -> str:
    return (pages / name).read_text("utf-8")


def test_every_page_is_in_the_navigation(pages):
    listed = set(re.findall(r'= "([\w/]+\.md)"', CONFIG.read_text("utf-8")))
    made = {p.relative_to(pages).as_posix() for p in pages.rglob("*.md")}
    # Tables of results and lists of files are reached from the pages that cite them.
    made = {p for p in made if not p.startswith(("files/", "evidence/results/"))}
    missing = made - {"readme.md", "evidence/benchmarks.md"} - listed
    assert not missing, f"name these pages in the nav of docs/site/zensical.toml: {sorted(missing)}"
    assert listed <= made


def test_every_key_of_a_case_is_in_the_reference(pages):
    page, schema = text(pages, "reference/case.md"), json.loads(text(pages, "reference/case.schema.json"))
    assert {*schema["properties"]} == {*TOP}
    for name in set(TOP) - {"effects"}:
        section = page.partition(f"{{ #{name} }}")[2].partition("\n## ")[0]
        entry = schema["properties"][name]
        entry = entry.get("items", entry)
        for variant in [entry, *entry.get("oneOf", [])]:
            for key in set(variant.get("properties", {})) - {"kind"}:
                assert f"| `{key}` |" in section, f"[{name}] {key}"


@pytest.mark.parametrize("kind", jaxid.EFFECTS)
def test_every_effect_has_formula_curve_parameters_and_a_snippet(pages, kind):
    section = text(pages, "reference/effects.md").partition(f"\n## `{kind}`\n")[2].partition("\n## ")[0]
    first = (jaxid.EFFECTS[kind].__doc__ or "").strip().splitlines()[0]
    plain = section.replace("\\", "")
    assert f"**{first}**" in plain
    assert f'kind = "{kind}"' in section
    for name in parameters_of(jaxid.EFFECTS[kind]):
        assert f"| `{name}`" in section
    assert "<path" in text(pages, f"reference/curves/{kind}.svg")
    # A curve that is flat everywhere shows nothing.
    assert any(abs(y).max() > 0.01 for _, y, _ in lines_of(kind)[2])


def test_every_plant_command_and_public_name_is_in_the_reference(pages):
    for kind in jaxid.PLANTS:
        assert f"\n## `{kind}`\n" in text(pages, "reference/plants.md")
    for name in jaxid._HOMES:
        assert f"\n## `jaxid.{name}`\n" in text(pages, "reference/python.md")
    page = text(pages, "reference/commands.md")
    subparsers = next(a for a in cli.build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    for name, parser in subparsers.choices.items():
        section = page.partition(f"\n## `jaxid {name}`\n")[2].partition("\n## ")[0]
        for action in parser._actions:
            for option in set(action.option_strings) - {"-h", "--help"}:
                assert f"`{option}" in section, (name, option)


def test_every_schema_is_a_file_that_parses(pages):
    page = text(pages, "reference/schemas.md")
    found = {p.name for p in (pages / "reference").glob("*.schema.json")}
    assert "case.schema.json" in found
    for name in found:
        assert json.loads(text(pages, f"reference/{name}"))["type"] == "object"
        assert f"]({name})" in page


def test_a_table_of_keys_says_type_bounds_and_default():
    properties = {
        "runs": {"type": "integer", "minimum": 1, "default": 100, "description": "of a | study [1]"},
        "name": {"enum": ["a", "b"]},
    }
    lines = keys_table({"properties": properties, "required": ["name"]}).splitlines()
    assert lines[2] == "| `runs` | of a \\\\| study \\[1\\] | whole number ≥ 1; default `100` |"
    assert lines[3] == "| `name` |  | `a`, `b`; **required** |"


@pytest.mark.parametrize(
    ("page", "words"),
    [
        ("[away](nowhere.md)", "leads nowhere"),
        ("# Here\n\n[down](#there)", "no such heading"),
        ("[other](b.md#missing)", "no such heading"),
    ],
)
def test_a_link_that_leads_nowhere_stops_the_build(tmp_path, page, words):
    (tmp_path / "b.md").write_text("# Present")
    (tmp_path / "a.md").write_text(page)
    with pytest.raises(BrokenLinkError, match=words):
        check_links(tmp_path)
    (tmp_path / "a.md").write_text("# Here\n\n[down](#here), [other](b.md#present), `code`")
    check_links(tmp_path)


def test_percentages_in_tables_are_not_broken_over_lines():
    assert staging.unbroken("| 86.7-100.0 % | 95 % |") == "| 86.7\u2011100.0\u00a0% | 95\u00a0% |"
    assert staging.unbroken("of 60, 95 % hold; `1-2 %`") == "of 60, 95 % hold; `1-2 %`"


def test_a_link_to_a_file_that_does_not_exist_stops_the_build(tmp_path):
    source = staging.ROOT / "docs" / "page.md"
    with pytest.raises(BrokenLinkError, match="no page and no file"):
        staging.moved("[x](examples/absent.py)", source, "page.md", {}, tmp_path)


def test_the_site_builds_strictly_and_loads_nothing_from_elsewhere(tmp_path):
    if importlib.util.find_spec("zensical") is None:
        pytest.skip("the site needs pip install -e '.[docs]'")
    first = build(tmp_path / "site")
    for page in first.parent.rglob("*.html"):
        html = page.read_text("utf-8")
        loaded = re.findall(r"<(?:script|img|iframe)[^>]* src=\"(https?:[^\"]+)", html)
        loaded += re.findall(r"<link[^>]* href=\"(https?:[^\"]+)", html)
        assert not loaded, (page, loaded)
