"""Collect the pages of the site in one folder, with links that hold there."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

from docs.site import (
    case_reference,
    command_reference,
    effect_reference,
    notebook_pages,
    plant_reference,
    python_reference,
    schema_reference,
)

ROOT = Path(__file__).parents[2]
# Folders whose Markdown becomes pages: of the repository, and of the site.
FOLDERS = {"docs": "", "benchmarks/results": "evidence/results"}
# Further pages.
FILES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/README.md": "evidence/benchmarks.md",
    "README.md": "readme.md",
}
GENERATED: dict[str, Callable[[Path], str]] = {
    "reference/case.md": case_reference.page,
    "reference/effects.md": effect_reference.page,
    "reference/plants.md": plant_reference.page,
    "reference/commands.md": command_reference.page,
    "reference/python.md": python_reference.page,
    "reference/schemas.md": schema_reference.page,
}
LINK = re.compile(r"(?<!!)\[([^\]\[]*(?:\[[^\]]*\][^\]\[]*)*)\]\(([^)\s]+)\)")
IMAGE = re.compile(r"!\[[^\]]*\]\(([^)\s]+)\)")
FENCED = re.compile(r"^ *```.*?^ *```[^\n]*$", re.M | re.S)
# A number with its percent sign, or a range of them, in a table: neither is broken over two lines.
PERCENT = re.compile(r"(?<=\| )([\d.]+)(?:-([\d.]+))? %(?= \|)")
HEADING = re.compile(r"^#{1,6} +(.+?) *(?:\{ *#([\w-]+) *\})? *$", re.M)


class BrokenLinkError(SystemExit):
    """A link of a page that leads nowhere."""


def sources() -> dict[Path, str]:
    """Return the pages of the repository: file, and its name on the site."""
    out = {ROOT / source: name for source, name in FILES.items()}
    for folder, place in FOLDERS.items():
        for page in sorted((ROOT / folder).rglob("*.md")):
            name = Path(place) / page.relative_to(ROOT / folder)
            out[page] = name.with_name("index.md" if name.name == "README.md" else name.name).as_posix()
    return out


def stage(folder: Path) -> None:
    """Write all pages to a folder.

    Args:
        folder: Folder to write to; it must not exist.

    Raises:
        BrokenLinkError: If a link of a page, or its anchor, leads nowhere.
    """
    pages, notebooks = sources(), notebook_pages.sources()
    places = pages | {path.with_suffix(".ipynb"): name for path, name in notebooks.items()} | notebooks
    made: dict[str, str] = {}
    for name, generate in GENERATED.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        made[name] = generate((folder / name).parent)
    for path, name in notebooks.items():
        made[name] = moved(notebook_pages.page(path), path, name, places, folder)
    for path, name in pages.items():
        made[name] = moved(path.read_text("utf-8"), path, name, places, folder)
    for name, text in made.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(unbroken(text), "utf-8")
    shutil.copy(Path(__file__).with_name("style.css"), folder / "style.css")
    check_links(folder)


def moved(text: str, path: Path, name: str, places: dict[Path, str], folder: Path) -> str:
    """Return a page with its links as they are on the site.

    Files that are no pages are copied to `files/`.

    Args:
        text: Contents of the page.
        path: File that its links start from.
        name: Name of the page on the site.
        places: Names of all pages on the site, by file.
        folder: Folder of the site's pages.
    """

    def target(link: str) -> str:
        file, _, anchor = link.partition("#")
        if not file or "://" in file or file.startswith("mailto:"):
            return link
        aim = (path.parent / file).resolve()
        if aim.is_dir() and aim / "README.md" in places:
            aim = aim / "README.md"
        if aim in places:
            there = places[aim]
        elif aim.is_file():
            there = copied(aim, folder)
        elif aim.is_dir() and aim.is_relative_to(ROOT):
            there = listed(aim, folder)
        elif not aim.exists() and (folder / Path(name).parent / file).exists():
            return link
        else:
            raise BrokenLinkError(f"{path}: link to {link}: no page and no file of the repository")
        near = os.path.relpath(there, Path(name).parent)
        return near + (f"#{anchor}" if anchor else "")

    def outside_of_blocks(part: str) -> str:
        part = LINK.sub(lambda m: f"[{m[1]}]({target(m[2])})", part)
        return IMAGE.sub(lambda m: m[0].replace(f"({m[1]})", f"({target(m[1])})"), part)

    out, end = [], 0
    for block in FENCED.finditer(text):
        out += [outside_of_blocks(text[end : block.start()]), block[0]]
        end = block.end()
    return "".join([*out, outside_of_blocks(text[end:])])


def unbroken(text: str) -> str:
    """Return a page whose tables do not break a percentage, or a range of them, over two lines."""
    return PERCENT.sub(lambda m: "\u2011".join(filter(None, m.groups())) + "\u00a0%", text)


def copied(file: Path, folder: Path) -> str:
    """Copy a file of the repository to the site; return its name there."""
    there = f"files/{file.relative_to(ROOT).as_posix()}"
    (folder / there).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(file, folder / there)
    return there


def listed(directory: Path, folder: Path) -> str:
    """Copy the files of a folder to the site with a page that lists them; return its name."""
    names = [copied(file, folder) for file in sorted(directory.iterdir()) if file.is_file()]
    there = f"files/{directory.relative_to(ROOT).as_posix()}/index.md"
    items = "\n".join(f"- [{Path(name).name}]({Path(name).name})" for name in names)
    (folder / there).write_text(f"# {directory.relative_to(ROOT).as_posix()}\n\n{items}\n", "utf-8")
    return there


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and the site make them."""
    found: set[str] = set()
    for title, stated in HEADING.findall(FENCED.sub("", text)):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title).replace("`", "")
        anchor = stated or re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())
        found.add(anchor)
    return found


def check_links(folder: Path) -> None:
    """Check that each link between pages leads to a page, and each anchor to a heading.

    Raises:
        BrokenLinkError: If one does not.
    """
    pages = {path: path.read_text("utf-8") for path in sorted(folder.rglob("*.md"))}
    known = {path.resolve(): anchors(text) for path, text in pages.items()}
    faults = []
    for path, text in pages.items():
        for _, link in LINK.findall(FENCED.sub("", text)):
            file, _, anchor = link.partition("#")
            if "://" in link or file.startswith("mailto:"):
                continue
            aim = (path.parent / file).resolve() if file else path.resolve()
            if not aim.exists():
                faults.append(f"{path.relative_to(folder)}: {link} leads nowhere")
            elif anchor and aim in known and anchor not in known[aim]:
                faults.append(f"{path.relative_to(folder)}: {link}: there is no such heading")
    if faults:
        raise BrokenLinkError("\n".join(faults))
