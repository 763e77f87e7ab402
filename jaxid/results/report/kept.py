"""The files of a report in a folder of results: the page, its content, and the other command's page."""

from __future__ import annotations

import re
from pathlib import Path

from jaxid.results.report.data import ReportData
from jaxid.results.report.page import render
from jaxid.results.report.store import packed

# Name of the page, that of its content by command, and of the command in the head of the page.
PAGE = "report.html"
CONTENT = {"identify": "result.npz", "discover": "discovery.npz"}
_COMMAND = re.compile(r'<meta name="jaxid-command" content="(\w+)">')
# Characters of a page in which its head lies.
_HEAD = 2000


def report_files(folder: Path, data: ReportData) -> dict[str, str | bytes]:
    """Return the files of a report by name; the page of another command that is there is kept under its name.

    Args:
        folder: The folder to which they will be written.
        data: Content of the report.
    """
    files: dict[str, str | bytes] = {PAGE: render(data), CONTENT[data.command]: packed(data)}
    other = folder / PAGE
    if not other.is_file():
        return files
    text = other.read_text(encoding="utf-8", errors="replace")
    found = _COMMAND.search(text[:_HEAD])
    if found is not None and found[1] != data.command:
        files[kept_name(found[1])] = text
    return files


def kept_name(command: str) -> str:
    """Return the name of a command's page beside the page of another one."""
    return f"report_{command}.html"


def drop_old_page(folder: Path, command: str) -> None:
    """Remove the page of an earlier run of a command whose new page has been written."""
    (folder / kept_name(command)).unlink(missing_ok=True)
