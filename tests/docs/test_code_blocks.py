"""README and docs: their Python runs, their TOML and JSON parse, and their commands and links exist.

Python blocks of a page run in order in one fresh process, in a folder with the demo's files. A block that
cannot run by itself is marked above it: <!-- not run: reason -->
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

import jaxid
from jaxid import cli

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^ *```(\w*) *$")
MARK = re.compile(r"^ *<!-- not run: .{10,} -->$")
COMMAND = re.compile(r"^(?:\$ )?(?:\S*/bin/)?jaxid [a-z]")
MODULE = re.compile(r"python -m ((?:experiments|benchmarks|truth)[\w.]*)")
SCRIPT = re.compile(r"python (?:experiments|benchmarks|tests)/\S+")
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
# Pages whose blocks take over 5 s of a processor: they fit several times, or an arm.
LONG = {
    "docs/api.md",
    "docs/accelerator.md",
    "docs/in_a_loop.md",
    "docs/robots.md",
    "docs/short_logs.md",
    "docs/without_a_controller.md",
    "docs/without_a_force.md",
}
# tests/estimators/test_jax_door.py runs its blocks, and checks what they compute.
CHECKED_ELSEWHERE = "docs/jax.md"
# A block that begins so is a part of a file of docs/examples, which other tests run.
EXCERPT = re.compile(r"^# (\w+\.py)\n")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its first line in the page from 1, its text, and whether it is to run."""

    language: str
    line: int
    text: str
    runs: bool


def blocks_of(page: Path) -> list[Block]:
    """Return the fenced blocks of a page in order."""
    blocks, lines = [], page.read_text("utf-8").splitlines()
    start = None
    for k, line in enumerate(lines):
        fence = FENCE.match(line)
        if start is None and fence:
            start = k
        elif start is not None and line.strip() == "```":
            above = next((x for x in reversed(lines[:start]) if x.strip()), "")
            text = "\n".join(lines[start + 1 : k]) + "\n"
            blocks.append(Block(FENCE.match(lines[start])[1], start + 2, text, not MARK.match(above)))
            start = None
    assert start is None, f"{page}: the fence of line {start} is never closed"
    return blocks


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def having(*languages: str) -> list:
    """Return the pages with blocks of these languages, as parameters of a test."""
    chosen = [p for p in PAGES if any(b.language in languages for b in blocks_of(p))]
    return [pytest.param(p, id=name(p)) for p in chosen]


def with_long_ones_slow(pages: list) -> list:
    """Return the pages as parameters, those of `LONG` marked slow."""
    return [pytest.param(*p.values, id=p.id, marks=pytest.mark.slow) if p.id in LONG else p for p in pages]


@pytest.mark.parametrize(
    "page", [p for p in with_long_ones_slow(having("python")) if p.id != CHECKED_ELSEWHERE]
)
def test_python_blocks_run(page, tmp_path):
    for source in (Path(jaxid.__file__).parent / "demo").glob("*.*"):
        if source.suffix != ".py":
            shutil.copy(source, tmp_path)
    shutil.copy(tmp_path / "validation.csv", tmp_path / "other.csv")
    # Each block stands at its line of the page, so that a traceback names it.
    script = ""
    for block in (b for b in blocks_of(page) if b.language == "python"):
        assert block.text.strip(), f"{page}:{block.line}: empty"
        excerpt = EXCERPT.match(block.text)
        if excerpt:
            shown = block.text[excerpt.end() :].strip("\n")
            assert shown in (ROOT / "docs" / "examples" / excerpt[1]).read_text("utf-8"), (
                f"{page}:{block.line}"
            )
        elif block.runs:
            script += "\n" * (block.line - 1 - script.count("\n")) + block.text
        else:
            compile(block.text, name(page), "exec")
    (tmp_path / "blocks_of_page.py").write_text(script, "utf-8")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    run = subprocess.run(
        [sys.executable, "blocks_of_page.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, f"{name(page)}, by its lines:\n{run.stderr}"


@pytest.mark.parametrize("page", having("toml", "json"))
def test_toml_and_json_parse(page):
    parsers = {"toml": tomllib.loads, "json": json.loads}
    for block in blocks_of(page):
        if block.language in parsers:
            try:
                parsers[block.language](block.text)
            except ValueError as error:
                pytest.fail(f"{name(page)}, block at line {block.line}: {error}")


@pytest.fixture(scope="module")
def commands() -> dict[str, set[str]]:
    """Subcommands of the command line, and the options of each."""
    subparsers = next(a for a in cli.build_parser()._actions if a.choices)
    return {word: {*sub._option_string_actions} for word, sub in subparsers.choices.items()}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_are_those_of_the_command_line(page, commands):
    for block in blocks_of(page):
        if block.language in ("", "bash", "sh", "console"):
            for line in block.text.replace("\\\n", " ").splitlines():
                for part in line.split(" && "):
                    if COMMAND.match(part.strip()):
                        words = shlex.split(part.strip().removeprefix("$ "), comments=True)
                        cli.build_parser().parse_args(words[1:])
    # In prose a command may leave out its files.
    prose = re.sub(r"^ *```.*?^ *```", "", page.read_text("utf-8"), flags=re.M | re.S)
    for code in re.findall(r"`([^`]+)`", prose):
        code = " ".join(code.split())
        if COMMAND.match(code):
            _, command, *words = code.split()
            assert command in commands, f"{name(page)}: {code}"
            options = {w.split("=")[0] for w in words if w.startswith("-")}
            assert options <= commands[command], f"{name(page)}: {code}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_scripts_and_links_lead_to_files(page):
    # A call such as classes["kind"](value=1) in a block looks like a link.
    text = page.read_text("utf-8")
    prose = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    for module in MODULE.findall(text):
        assert (ROOT / module.replace(".", "/")).with_suffix(".py").is_file(), module
    assert not SCRIPT.findall(text), "scripts run as modules: python -m"
    for target in LINK.findall(prose):
        if "://" not in target:
            assert (page.parent / target).exists(), target
