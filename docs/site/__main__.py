"""Build the documentation site: python -m docs.site [-o FOLDER]; needs pip install -e '.[docs]'."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from docs.site.stage import ROOT, stage

CONFIG = Path(__file__).with_name("zensical.toml")


def build(folder: Path) -> Path:
    """Write the pages to FOLDER/pages and the site to FOLDER/html.

    Args:
        folder: A folder that this function may empty.

    Returns:
        The first page of the site.

    Raises:
        SystemExit: If a link leads nowhere, or the generator warns.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    stage(folder / "pages")
    shutil.copy(CONFIG, folder / "zensical.toml")
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    return folder / "html" / "index.html"


def main() -> None:
    """Build the site and print its first page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", metavar="FOLDER", type=Path, default=ROOT / "build" / "site")
    print(build(parser.parse_args().o))


if __name__ == "__main__":
    main()
