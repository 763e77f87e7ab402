"""Parts that the experiments share: the folder of the data, a place for results, a table."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from jaxid.results.as_text import aligned


def parser_of(doc: str, default: str) -> argparse.ArgumentParser:
    """Command line of an experiment."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", metavar="DIR", type=Path, default=Path(default), help=f"default: {default}")
    return parser


def arguments(doc: str, default: str) -> argparse.Namespace:
    """Parse the command line of an experiment."""
    return parser_of(doc, default).parse_args()


def run_studies(doc: str, default: str, studies: Mapping[str, Callable[[Path], None]]) -> None:
    """Run all studies of an experiment, each with the folder of its results, or the one that is asked for."""
    parser = parser_of(doc, default)
    parser.add_argument("--only", choices=studies, help="one of the studies")
    args = parser.parse_args()
    args.o.mkdir(parents=True, exist_ok=True)
    for name, study in studies.items():
        if args.only in (None, name):
            study(args.o)


def case_with_data(folder: Path, cases: tuple[str, ...], data: str, files: tuple[str, ...]) -> Path:
    """Make a folder with case files and links to the measured logs beside them.

    So every number of an experiment can be had by hand with a `jaxid` command in that folder.
    """
    root = os.environ.get("JAXID_DATA")
    if not root or not (Path(root) / data).is_dir():
        sys.exit(f"set JAXID_DATA to a folder that holds {data}/ with {', '.join(files)}")
    copied(folder, cases)
    for name in files:
        link = folder / name
        link.unlink(missing_ok=True)
        link.symlink_to((Path(root) / data / name).resolve())
    return folder


def copied(folder: Path, cases: tuple[str, ...]) -> Path:
    """Copy case files to a folder, and return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in cases:
        shutil.copyfile(Path(__file__).parent / "cases" / name, folder / name)
    return folder


class Table:
    """A titled table that prints itself."""

    def __init__(self, title: str, head: list[str]) -> None:
        self.title, self.rows = title, [head]

    def row(self, *cells: object) -> None:
        """Add a row."""
        self.rows.append([str(c) for c in cells])

    def show(self, seconds: float) -> None:
        """Print it, with what it took."""
        print(f"\n{self.title} ({seconds:.1f} s)\n{aligned(self.rows)}", flush=True)
